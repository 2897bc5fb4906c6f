//! A server on ports of the system's choice, and what a simulated vehicle sends.
#![allow(dead_code, reason = "each test file uses its part")]

pub mod certificates;
pub mod venv;

use std::future::Future;
use std::io;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use bytes::Bytes;
use clearway_mapping::event::Body;
use clearway_proto::v1;
use clearway_proto::v1::map_service_client::MapServiceClient;
use clearway::config::{Config, Udp};
use clearway::ingest::Reading;
use clearway::record::reader::{Entry, Recording};
use clearway::server::{Running, Server, Setup};
use clearway_sim::scanner::ScannerConfig;
use clearway_sim::scenes::flat;
use clearway_sim::send::{Pace, Sent, Until, drive};
use clearway_sim::vehicle::SimulatedVehicle;
use prost::Message;
use tonic::transport::Channel;

/// Layers of a map by the default configuration.
pub const LAYERS: u64 = 6;

/// Nothing in these tests takes a tenth of it; a test that hangs must end all the same.
const PATIENCE: Duration = Duration::from_secs(120);

/// One vehicle `car` with the simulated vehicle's mount; every port of the system's choice.
pub fn config() -> Config {
    let mut config = Config::of_one_vehicle("car", "top");
    let any = "127.0.0.1:0".parse().unwrap();
    (config.grpc.listen, config.page.listen) = (any, any);
    config.zenoh.listen = vec!["tcp/127.0.0.1:0".into()];
    config.zenoh.enabled = false;
    config.page.enabled = false;
    config.vehicles[0].sensors[0].extrinsics.z_m = ScannerConfig::default().ego_from_sensor.translation.z;
    config.vehicles[0].udp = Some(Udp { data: any, telemetry: any, ..Udp::default() });
    config
}

pub async fn start(config: Config) -> Running {
    // Nothing here may be lost to a slow test machine's disk.
    Server::start(Setup { config, from_files: true, ..Setup::default() }).await.expect("the server starts")
}

/// A vehicle that drives, in real time, until it is told to halt.
pub struct Driving {
    halt: Arc<AtomicBool>,
    thread: JoinHandle<io::Result<Sent>>,
}

impl Driving {
    /// The vehicle on a plain, to a running server's first vehicle.
    pub fn to(running: &Running) -> Self {
        let (data, telemetry) = running.doors[0].udp.expect("the vehicle has a socket");
        let halt = Arc::new(AtomicBool::new(false));
        let until = halt.clone();
        let thread = std::thread::spawn(move || {
            let until = Until { stop: Some(&until), device_time: None };
            drive(anywhere(), vehicle(), data, telemetry, Pace::RealTime, until)
        });
        Self { halt, thread }
    }

    /// What it has sent.
    pub fn halt(self) -> Sent {
        self.halt.store(true, Ordering::Relaxed);
        self.thread.join().unwrap().unwrap()
    }
}

/// Any port of any address, to send from.
pub fn anywhere() -> std::net::SocketAddr {
    (std::net::Ipv4Addr::UNSPECIFIED, 0).into()
}

/// A vehicle on a plain.
pub fn vehicle() -> SimulatedVehicle {
    SimulatedVehicle::new(flat(), ScannerConfig::default())
}

/// What the vehicle sends in this many tenths of a second, a turn each.
pub fn readings(tenths: i64) -> Vec<Reading> {
    let mut readings = Vec::new();
    let mut first_ns = None;
    for datagram in vehicle() {
        let first_ns = *first_ns.get_or_insert(datagram.stamp_ns);
        if datagram.stamp_ns - first_ns > tenths * 100_000_000 {
            break;
        }
        let body = Body::Datagram(Bytes::from(datagram.payload));
        readings.push(Reading { arrival_ns: datagram.stamp_ns, source: 0, body });
    }
    readings
}

/// Puts datagrams through the door of the first vehicle, losing nothing; gives the number of maps made so far.
pub async fn feed(running: &Running, readings: Vec<Reading>) -> u64 {
    let door = running.doors[0].door.clone();
    let status = &running.vehicles.0[0].status;
    let received = status.snapshot().ledger.received + readings.len() as u64;
    tokio::task::spawn_blocking(move || readings.into_iter().try_for_each(|reading| door.enter_captured(reading)))
        .await
        .expect("no panic")
        .expect("the engine runs");
    until("all datagrams are taken", || status.snapshot().ledger.received >= received).await;
    status.snapshot().maps
}

/// Waits for a condition, giving way to everybody else.
pub async fn until(what: &str, condition: impl Fn() -> bool) {
    within(what, async {
        while !condition() {
            tokio::task::yield_now().await;
        }
    })
    .await;
}

pub async fn within<T>(what: &str, future: impl Future<Output = T>) -> T {
    tokio::time::timeout(PATIENCE, future).await.unwrap_or_else(|_| panic!("waited in vain: {what}"))
}

pub async fn grpc(running: &Running) -> MapServiceClient<Channel> {
    let address = format!("http://{}", running.grpc.expect("gRPC is served"));
    // A small window: what a stopped reader may have on its way is counted in maps, not megabytes.
    let channel = Channel::from_shared(address).unwrap().initial_stream_window_size(65_535).connect().await;
    MapServiceClient::new(channel.expect("gRPC answers"))
}

/// A first request of `Watch`.
pub fn selection(vehicle: &str, layers: &[&str], max_in_flight: u32) -> v1::WatchRequest {
    let layers = layers.iter().map(|&layer| layer.to_owned()).collect();
    let selection = v1::Selection { vehicle: vehicle.into(), layers, max_in_flight, ..Default::default() };
    v1::WatchRequest { selection: Some(selection), ..Default::default() }
}

pub fn sequence(map: &Bytes) -> u64 {
    v1::Map::decode(map.clone()).expect("a map").header.expect("a header").sequence
}

/// The recorded bytes of each map and layer.
pub fn recorded(file: &Path) -> std::collections::BTreeMap<(u64, String), Bytes> {
    let mut maps = std::collections::BTreeMap::new();
    for entry in Recording::open(file).expect("a recording") {
        if let Entry::Map { layer, bytes, .. } = entry.expect("whole") {
            assert!(maps.insert((sequence(&bytes), layer), bytes).is_none(), "each map once");
        }
    }
    maps
}
