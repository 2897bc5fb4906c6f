//! A [`Rig`] at work, in real time: each turning sensor sends datagrams from an address of its own, and what the car
//! tells goes over gRPC.

use std::net::{Ipv4Addr, SocketAddr};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use clearway_client::{Client, ClientError};
use clearway_sim::send::{Pace, Sent, Until, drive};

use super::DemoError;
use super::rig::{Rig, Told};
use crate::clock::now_ns;

/// A car that drives until it is stopped.
pub struct Car {
    sensors: Vec<JoinHandle<std::io::Result<Sent>>>,
    told: Option<JoinHandle<Result<(), ClientError>>>,
    halt: Arc<AtomicBool>,
}

/// Where the datagrams of turning sensor `index` come from.
pub fn address(index: usize) -> Ipv4Addr {
    Ipv4Addr::new(127, 0, 0, 2 + u8::try_from(index).unwrap_or(u8::MAX - 2))
}

impl Car {
    /// Starts it: datagrams go to `data` and `telemetry`, and where it has units that scan, they, poses and roads to
    /// `grpc`.
    ///
    /// # Errors
    /// What the system says where it has no thread to give.
    pub fn start(rig: Rig, (data, telemetry): (SocketAddr, SocketAddr), grpc: SocketAddr) -> std::io::Result<Self> {
        let halt = Arc::new(AtomicBool::new(false));
        let several = rig.scanners.len() > 1;
        let runtime = tokio::runtime::Handle::current();
        let telling = |rig: Rig, halt| {
            let tell = move || runtime.block_on(tell(rig, grpc, halt));
            std::thread::Builder::new().name("simulated car".into()).spawn(tell)
        };
        let told = (!rig.units.is_empty()).then(|| telling(rig.clone(), halt.clone())).transpose()?;
        let start = |(index, (name, _)): (usize, &(String, _))| {
            let (vehicle, halt) = (rig.vehicle(index), halt.clone());
            let own = if several { address(index) } else { Ipv4Addr::UNSPECIFIED };
            std::thread::Builder::new().name(format!("simulated {name}")).spawn(move || {
                let until = Until { stop: Some(&halt), device_time: None };
                drive((own, 0).into(), vehicle, data, telemetry, Pace::RealTime, until)
            })
        };
        let sensors = rig.scanners.iter().enumerate().map(start).collect::<Result<_, _>>()?;
        Ok(Self { sensors, told, halt })
    }

    /// Whether a part of it has ended by itself, which is a fault.
    pub fn has_stopped(&self) -> bool {
        self.sensors.iter().any(JoinHandle::is_finished) || self.told.as_ref().is_some_and(JoinHandle::is_finished)
    }

    /// Stops it; gives what its sensors have sent.
    ///
    /// # Errors
    /// How sending, or telling, has failed.
    pub async fn stop(self) -> Result<Sent, DemoError> {
        self.halt.store(true, Ordering::Relaxed);
        let panicked = || std::io::Error::other("panicked");
        let (sensors, told) = (self.sensors, self.told);
        let ended = tokio::task::spawn_blocking(move || -> Result<Sent, DemoError> {
            let mut sum = Sent::default();
            for sensor in sensors {
                let sent = sensor.join().map_err(|_| panicked())??;
                sum.packets += sent.packets;
                sum.telemetry += sent.telemetry;
                sum.device_time = sum.device_time.max(sent.device_time);
            }
            told.map_or(Ok(Ok(())), JoinHandle::join).map_err(|_| panicked())??;
            Ok(sum)
        });
        ended.await.map_err(std::io::Error::other)?
    }
}

/// Tells each when its time has come, casting scans as it goes.
async fn tell(rig: Rig, grpc: SocketAddr, halt: Arc<AtomicBool>) -> Result<(), ClientError> {
    let mut ingester = Client::connect(&grpc.to_string()).await?.ingest("car").await?;
    for Told { stamp_ns, observation } in rig.told() {
        let early_ns = u64::try_from(stamp_ns - now_ns()).unwrap_or(0);
        tokio::time::sleep(Duration::from_nanos(early_ns)).await;
        if halt.load(Ordering::Relaxed) {
            break;
        }
        ingester.send(observation).await?;
    }
    Ok(())
}
