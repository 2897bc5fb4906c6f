//! A [`Rig`] that drives in real time: each rotating sensor sends datagrams from an address of its own, and the car's
//! observations go over gRPC.
//!
//! In: a rig, the server's addresses. Out: UDP datagrams and gRPC observations, and how much simulated time a slow
//! machine skipped.

use std::net::{Ipv4Addr, SocketAddr};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicI64, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use anyhow::{Context, Result};
use clearway_client::{Client, ClientError};
use clearway_sim::real_time::{Progress, RealTimeVehicle, Skipped};
use clearway_sim::send::{Pace, Sent, Until, drive};

use tokio::sync::watch;

use super::rig::Rig;
use clearway_daemon::base::clock::now_ns;
use clearway_daemon::engine::newest::Newest;

/// From one look at the sensor's newest firing to the next: short beside a revolution.
const POLL: Duration = Duration::from_millis(2);

/// A car that drives until it is stopped.
pub struct DemoCar {
    sensors: Vec<JoinHandle<std::io::Result<Sent>>>,
    observer: JoinHandle<Result<(), ClientError>>,
    /// The time that each sensor, and the observations, skipped.
    skipped: Vec<Skipped>,
    halt: Arc<AtomicBool>,
}

/// The address that the datagrams of rotating sensor `index` come from.
pub fn address(index: usize) -> Ipv4Addr {
    Ipv4Addr::new(127, 0, 0, 2 + u8::try_from(index).unwrap_or(u8::MAX - 2))
}

impl DemoCar {
    /// Starts the car of this name. Datagrams go to `data` and `telemetry`, observations to `grpc`. The car waits for a
    /// server whose `newest` map is late.
    ///
    /// # Errors
    /// The operating system's error if it starts no thread.
    pub fn start(
        name: &str,
        rig: Rig,
        (data, telemetry): (SocketAddr, SocketAddr),
        grpc: SocketAddr,
        newest: &watch::Receiver<Newest>,
    ) -> std::io::Result<Self> {
        let (halt, newest_firing_ns) = (Arc::new(AtomicBool::new(false)), Arc::new(AtomicI64::new(i64::MIN)));
        let mut skipped = Vec::new();
        let mut new_skipped = || {
            skipped.push(Skipped::default());
            skipped.last().cloned().unwrap_or_default()
        };
        let observer = {
            let (rig, halt, skipped, progress) = (rig.clone(), halt.clone(), new_skipped(), progress(newest));
            let (runtime, name) = (tokio::runtime::Handle::current(), name.to_owned());
            // The poses of a car with one sensor are no earlier than its packets, if the machine is late with packets.
            let firing_ns = rig.units.is_empty().then(|| newest_firing_ns.clone());
            let observe = move || runtime.block_on(observe(&name, rig, grpc, halt, firing_ns, progress, skipped));
            std::thread::Builder::new().name("simulated car".into()).spawn(observe)?
        };
        let several = rig.scanners.len() > 1;
        let mut start = |(index, (name, _)): (usize, &(String, _))| {
            let firing_ns = newest_firing_ns.clone();
            let vehicle = RealTimeVehicle::new(rig.vehicle(index), progress(newest), new_skipped())
                .inspect(move |datagram| firing_ns.store(datagram.stamp_ns, Ordering::Relaxed));
            let own = if several { address(index) } else { Ipv4Addr::UNSPECIFIED };
            let halt = halt.clone();
            std::thread::Builder::new().name(format!("simulated {name}")).spawn(move || {
                let until = Until { stop: Some(&halt), device_time: None };
                drive((own, 0).into(), vehicle, data, telemetry, Pace::RealTime, until)
            })
        };
        let sensors = rig.scanners.iter().enumerate().map(&mut start).collect::<Result<_, _>>()?;
        Ok(Self { sensors, observer, skipped, halt })
    }

    /// True if a part of the car has ended by itself, which is a fault.
    pub fn has_stopped(&self) -> bool {
        self.sensors.iter().any(JoinHandle::is_finished) || self.observer.is_finished()
    }

    /// Simulated time skipped so far by the sensor that skipped most, because the machine is too slow.
    pub fn skipped(&self) -> Duration {
        self.skipped.iter().map(Skipped::time).max().unwrap_or_default()
    }

    /// Stops the car; returns what its sensors have sent.
    ///
    /// # Errors
    /// If a datagram or an observation could not be sent.
    pub async fn stop(self) -> Result<Sent> {
        self.halt.store(true, Ordering::Relaxed);
        let panicked = || std::io::Error::other("panicked");
        let (sensors, observer) = (self.sensors, self.observer);
        let ended = tokio::task::spawn_blocking(move || -> Result<Sent> {
            let mut sum = Sent::default();
            for sensor in sensors {
                sum += sensor.join().map_err(|_| panicked())??;
            }
            observer.join().map_err(|_| panicked())??;
            Ok(sum)
        });
        ended.await.map_err(std::io::Error::other)?.context("the simulated car")
    }
}

/// The clock, and the newest map's time.
fn progress(newest: &watch::Receiver<Newest>) -> impl Fn() -> Progress + Send + 'static {
    let newest = newest.clone();
    move || Progress { now_ns: now_ns(), mapped_ns: newest.borrow().as_ref().map(|map| map.capture_end_ns) }
}

/// Sends each observation at the time of its stamp, and not before a firing of that time (`firing_ns`). Scans that are
/// too late are skipped, not simulated.
async fn observe(
    name: &str,
    rig: Rig,
    grpc: SocketAddr,
    halt: Arc<AtomicBool>,
    firing_ns: Option<Arc<AtomicI64>>,
    progress: impl Fn() -> Progress,
    skipped: Skipped,
) -> Result<(), ClientError> {
    let mut ingester = Client::connect(&grpc.to_string()).await?.ingest(name).await?;
    let mut observations = rig.observations();
    let mut sent_ns = None;
    while !halt.load(Ordering::Relaxed) {
        if let Some(target_ns) = progress().skip_target_ns(observations.next_stamp_ns(), sent_ns) {
            skipped.add(observations.skip_scans_to(target_ns));
        }
        let Some(observation) = observations.next() else { break };
        let early_ns = u64::try_from(observation.stamp_ns - now_ns()).unwrap_or(0);
        tokio::time::sleep(Duration::from_nanos(early_ns)).await;
        let is_early = |ns: &Arc<AtomicI64>| ns.load(Ordering::Relaxed) < observation.stamp_ns;
        while firing_ns.as_ref().is_some_and(is_early) && !halt.load(Ordering::Relaxed) {
            tokio::time::sleep(POLL).await;
        }
        sent_ns = Some(observation.stamp_ns);
        ingester.send(observation.observation).await?;
    }
    Ok(())
}
