//! A [`Rig`] at work, in real time: each turning sensor sends datagrams from an address of its own, and what the car tells
//! goes over gRPC.

use std::net::{Ipv4Addr, SocketAddr};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use clearway_client::{Client, ClientError};
use clearway_sim::send::{Pace, Sent, Until, drive_from};
use tokio::sync::mpsc;

use super::DemoError;
use super::rig::{Rig, Told};
use crate::ingest::now_ns;

/// What the car is ahead of the clock with casting its scans, at most.
const CAST_AHEAD: usize = 64;

/// A car that drives until it is stopped.
pub struct Car {
    sensors: Vec<JoinHandle<std::io::Result<Sent>>>,
    told: Option<tokio::task::JoinHandle<Result<(), ClientError>>>,
    halt: Arc<AtomicBool>,
}

/// Where the datagrams of turning sensor `index` come from.
pub fn address(index: usize) -> Ipv4Addr {
    Ipv4Addr::new(127, 0, 0, 2 + u8::try_from(index).unwrap_or(u8::MAX - 2))
}

impl Car {
    /// Starts it: datagrams go to `data` and `telemetry`, and where it has units that scan, they, poses and roads to `grpc`.
    ///
    /// # Errors
    /// What the system says where it has no thread to give.
    pub fn start(rig: Rig, (data, telemetry): (SocketAddr, SocketAddr), grpc: SocketAddr) -> std::io::Result<Self> {
        let halt = Arc::new(AtomicBool::new(false));
        let several = rig.scanners.len() > 1;
        let told = (!rig.units.is_empty()).then(|| tell(rig.clone(), grpc, halt.clone())).transpose()?;
        let start = |(index, (name, _)): (usize, &(String, _))| {
            let (vehicle, halt) = (rig.vehicle(index), halt.clone());
            let own = if several { address(index) } else { Ipv4Addr::UNSPECIFIED };
            std::thread::Builder::new().name(format!("simulated {name}")).spawn(move || {
                let until = Until { stop: Some(&halt), device_time: None };
                drive_from((own, 0).into(), vehicle, data, telemetry, Pace::RealTime, until)
            })
        };
        let sensors = rig.scanners.iter().enumerate().map(start).collect::<Result<_, _>>()?;
        Ok(Self { sensors, told, halt })
    }

    /// Whether a part of it has ended by itself, which is a fault.
    pub fn has_stopped(&self) -> bool {
        self.sensors.iter().any(JoinHandle::is_finished)
            || self.told.as_ref().is_some_and(tokio::task::JoinHandle::is_finished)
    }

    /// Stops it; gives what its sensors have sent.
    ///
    /// # Errors
    /// How sending, or telling, has failed.
    pub async fn stop(self) -> Result<Sent, DemoError> {
        self.halt.store(true, Ordering::Relaxed);
        let panicked = || std::io::Error::other("panicked");
        let sensors = self.sensors;
        let joined = tokio::task::spawn_blocking(move || {
            sensors.into_iter().map(|sensor| sensor.join().map_err(|_| panicked())?).collect::<Result<Vec<_>, _>>()
        });
        let mut sum = Sent::default();
        for sent in joined.await.map_err(std::io::Error::other)?? {
            sum.packets += sent.packets;
            sum.telemetry += sent.telemetry;
            sum.device_time = sum.device_time.max(sent.device_time);
        }
        if let Some(told) = self.told {
            told.await.map_err(std::io::Error::other)??;
        }
        Ok(sum)
    }
}

/// Casts scans on a thread of its own, a little ahead, and tells each when its time has come.
fn tell(
    rig: Rig,
    grpc: SocketAddr,
    halt: Arc<AtomicBool>,
) -> std::io::Result<tokio::task::JoinHandle<Result<(), ClientError>>> {
    let (cast, mut due) = mpsc::channel::<Told>(CAST_AHEAD);
    // Ends when nobody takes from it any more.
    std::thread::Builder::new().name("simulated car".into()).spawn(move || {
        let _ = rig.told().try_for_each(|told| cast.blocking_send(told));
    })?;
    Ok(tokio::spawn(async move {
        let mut ingester = Client::connect(&grpc.to_string()).await?.ingest("car").await?;
        while let Some(Told { stamp_ns, observation }) = due.recv().await {
            let early_ns = u64::try_from(stamp_ns - now_ns()).unwrap_or(0);
            tokio::time::sleep(Duration::from_nanos(early_ns)).await;
            if halt.load(Ordering::Relaxed) {
                break;
            }
            ingester.send(observation).await?;
        }
        Ok(())
    }))
}
