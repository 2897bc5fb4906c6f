//! The processes of a simulated fleet, as `machines` starts them: routers, servers, senders and readers.
//!
//! A server is the program `clearway`; every other process is the binary of the run itself with one of the [`Role`]s.

use std::path::PathBuf;
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use clap::Subcommand;
use clearway_client::{
    Client, MapStream, MapView, Observation, Staleness, StreamEvent, Subscription, Update, ZenohClient, now_ns,
};
use clearway_daemon::config::{Config, Vehicle, ZenohMode};
use clearway_proto::v1;
use prost::Message;
use rand::{Rng, SeedableRng};

/// The environment of a router, as in `deploy/`: a thread that closes the connection of a peer behind a cut link is
/// blocked for up to 10 s, because zenoh lets the socket linger. With zenoh's two threads that receive, two such peers
/// stop a router.
pub const ROUTER_ENVIRONMENT: (&str, &str) = ("ZENOH_RUNTIME", "(rx: (worker_threads: 16))");

/// What a process of the run does.
///
/// Lists are separated by commas.
#[derive(Subcommand)]
pub enum Role {
    /// Sends scans to the gRPC server of this machine.
    Feed {
        /// Names of the vehicles.
        vehicles: String,
        /// Scans of rough ground with walls, each another one, instead of the same plain.
        #[arg(long)]
        rough: bool,
    },
    /// Prints of each map of a layer, and when the newest becomes stale: the vehicle, `fresh` or why it is stale, its
    /// age in ms, its bytes, `whole` or `delta`.
    Ages {
        /// Endpoints of routers, as `ZenohClient::connect` takes them. Or `grpc:` and the address of a server, for
        /// deltas.
        endpoints: String,
        /// Names of the vehicles.
        vehicles: String,
        /// The layer.
        layer: String,
    },
    /// Prints when a stream becomes stale, and why, or fresh, or changes its server.
    Read {
        /// Endpoints of routers, as `ZenohClient::connect` takes them.
        endpoints: String,
        /// Names of the vehicles.
        vehicles: String,
    },
    /// A router.
    Router {
        /// The endpoint on which it listens.
        listen: String,
        /// Endpoints of the routers to which it connects.
        others: String,
    },
}

impl Role {
    /// Runs the role. It ends with the process.
    ///
    /// # Panics
    /// If the process cannot do what the role says.
    pub fn run(&self) {
        let runtime =
            tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build().expect("a runtime");
        match self {
            Self::Feed { vehicles, rough } => runtime.block_on(feed(vehicles, *rough)),
            Self::Ages { endpoints, vehicles, layer } => runtime.block_on(age(endpoints, vehicles, layer)),
            Self::Read { endpoints, vehicles } => runtime.block_on(read(endpoints, vehicles)),
            Self::Router { listen, others } => runtime.block_on(route(listen, others)),
        }
    }
}

/// A process of the run; it is killed when this is dropped.
pub struct Process(pub Child);

impl Process {
    /// Starts a command whose standard output is read and whose errors are not.
    ///
    /// # Panics
    /// If it cannot be started.
    pub fn start(command: &mut Command) -> Self {
        let command = command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::null());
        Self(command.spawn().unwrap_or_else(|error| panic!("{command:?}: {error}")))
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        let _ended = self.0.kill();
        let _reaped = self.0.wait();
    }
}

/// The server's program: `clearway` beside this one, unless another is named.
///
/// # Panics
/// If the path of this program is not known.
pub fn server_binary(named: Option<&PathBuf>) -> PathBuf {
    named
        .cloned()
        .unwrap_or_else(|| std::env::current_exe().expect("the path of this binary").with_file_name("clearway"))
}

/// The name of the vehicle with this number.
pub fn name(number: usize) -> String {
    format!("v{number:02}")
}

/// The configuration of a server with these vehicles, each with one sensor `top` and without UDP, behind these routers.
pub fn server_config(vehicles: &[String], routers: &[String]) -> Config {
    let mut config = Config::of_one_vehicle("car", "top");
    let vehicle = Vehicle { udp: None, ..config.vehicles.remove(0) };
    config.vehicles = vehicles.iter().map(|name| Vehicle { name: name.clone(), ..vehicle.clone() }).collect();
    config.page.enabled = false;
    config.zenoh.mode = ZenohMode::Client;
    (config.zenoh.listen, config.zenoh.connect) = (Vec::new(), routers.to_vec());
    config
}

/// The points of a scan, x, y and z: a plain, 1,440 points.
fn plain() -> [Vec<f32>; 3] {
    let rays = || (0..1440_u32).map(|ray| (f64::from(ray).to_radians(), 3.0 + f64::from(ray / 360) * 4.0));
    let list = |of: &dyn Fn(f64, f64) -> f64| rays().map(|(angle, range_m)| of(angle, range_m) as f32).collect();
    [list(&|angle, range_m| angle.cos() * range_m), list(&|angle, range_m| angle.sin() * range_m), list(&|_, _| -2.0)]
}

/// The points of a scan as [`plain`]: 32 rings of rough ground, and walls here and there, another scan for each number.
/// Its maps of `speed` are as long as a recorded drive's.
fn rough(number: u64) -> [Vec<f32>; 3] {
    let mut random = rand_pcg::Pcg64Mcg::seed_from_u64(number);
    let mut points: [Vec<f32>; 3] = Default::default();
    for ray in 0..5760_u32 {
        let (angle, ring) = (f64::from(2 * ray).to_radians(), f64::from(ray / 180));
        let (range_m, z_m) = (3.0 + ring + random.random_range(0.0..1.0), random.random_range(0.0..0.1));
        let is_wall = ring > 8.0 && ray % 180 % 20 < 4;
        let z_m = if is_wall { z_m - 1.0 } else { z_m - 2.0 };
        let point = [angle.cos() * range_m, angle.sin() * range_m, z_m];
        points.iter_mut().zip(point).for_each(|(list, value)| list.push(value as f32));
    }
    points
}

/// Ten scans a second of each vehicle.
async fn feed(vehicles: &str, is_rough: bool) {
    let feeds = vehicles.split(',').map(|vehicle| async move {
        let ([mut x, mut y, mut z], mut number) = (plain(), 0);
        let mut every = tokio::time::interval(Duration::from_millis(100));
        loop {
            every.tick().await;
            let Ok(client) = Client::connect("127.0.0.1:50051").await else { continue };
            let Ok(mut ingester) = client.ingest(vehicle).await else { continue };
            while ingester.send(Observation::scan("top", now_ns(), &x, &y, &z)).await.is_ok() {
                every.tick().await;
                if is_rough {
                    number += 1;
                    [x, y, z] = rough(number);
                }
            }
        }
    });
    futures::future::join_all(feeds).await;
}

/// Connects as often as necessary.
async fn connect(endpoints: &str) -> ZenohClient {
    loop {
        match ZenohClient::connect(endpoints).await {
            Ok(client) => return client,
            Err(_) => tokio::time::sleep(Duration::from_millis(100)).await,
        }
    }
}

/// Follows every vehicle.
async fn read(endpoints: &str, vehicles: &str) {
    let client = connect(endpoints).await;
    let streams = vehicles.split(',').map(|vehicle| {
        let client = client.clone();
        async move {
            let (mut said, mut run) = ("", 0);
            let mut maps = client.subscribe(vehicle, "drivability").await.expect("a subscription");
            while let Ok(event) = maps.next_or_stale().await {
                let (StreamEvent::Fresh(update) | StreamEvent::Stale(update)) = event;
                let boot_id = update.map.header().boot_id;
                if boot_id != run {
                    println!("{vehicle} run {boot_id}");
                    run = boot_id;
                }
                let why = freshness(&update.map);
                if why != said {
                    println!("{vehicle} {}{why}", if why == "fresh" { "" } else { "stale " });
                    said = why;
                }
            }
        }
    });
    futures::future::join_all(streams).await;
}

/// `fresh`, or why a map is stale.
fn freshness(map: &MapView) -> &'static str {
    match map.staleness(map.now_ns()) {
        None => "fresh",
        Some(Staleness::NoNewer) => "no-newer",
        Some(Staleness::OnArrival { .. }) => "old-on-arrival",
        Some(Staleness::InTheFuture { .. }) => "in-the-future",
    }
}

/// Follows a layer of every vehicle.
async fn age(endpoints: &str, vehicles: &str, layer: &str) {
    let mut streams = Vec::new();
    for vehicle in vehicles.split(',') {
        streams.push(match endpoints.strip_prefix("grpc:") {
            Some(server) => subscribe_deltas(server, vehicle, layer).await,
            None => connect(endpoints).await.subscribe(vehicle, layer).await.expect("a subscription"),
        });
    }
    futures::future::join_all(streams.into_iter().map(|mut maps| async move {
        while let Ok(event) = maps.next_or_stale().await {
            let (StreamEvent::Fresh(Update { map, .. }) | StreamEvent::Stale(Update { map, .. })) = event;
            let encoded = v1::Map::decode(map.bytes().clone()).expect("it was decoded before");
            let is_delta = encoded.layers.iter().any(|layer| layer.base_sequence.is_some());
            let (kind, bytes) = (if is_delta { "delta" } else { "whole" }, map.bytes().len());
            println!("{} {} {:.0} {bytes} {kind}", map.vehicle(), freshness(&map), map.age_ms(map.now_ns()));
        }
    }))
    .await;
}

/// A stream of one layer from a server, with deltas.
async fn subscribe_deltas(server: &str, vehicle: &str, layer: &str) -> MapStream {
    let subscription = Subscription {
        vehicle: vehicle.into(),
        layers: vec![layer.into()],
        deltas: true,
        max_in_flight: 1,
        ..Subscription::default()
    };
    loop {
        let Ok(client) = Client::connect(server).await else { continue };
        match client.subscribe(subscription.clone()).await {
            Ok(maps) => return maps,
            Err(_) => tokio::time::sleep(Duration::from_millis(100)).await,
        }
    }
}

/// The router of `deploy/`, in plain text and without access control.
async fn route(listen: &str, others: &str) {
    let file = crate::workspace().join("deploy/zenoh/router.json5");
    let text = std::fs::read_to_string(file).expect("a file of the repository");
    let mut config = zenoh::Config::from_json5(&text.replace("tls/0.0.0.0:7447", listen)).expect("a configuration");
    config.insert_json5("access_control/enabled", "false").expect("a setting of zenoh");
    let others: Vec<_> = others.split(',').filter(|other| !other.is_empty()).collect();
    config.insert_json5("connect/endpoints", &format!("{others:?}")).expect("a setting of zenoh");
    let _router = zenoh::open(config).await.expect("the port is free");
    std::future::pending::<()>().await;
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_routers_of_deploy_have_the_environment_of_those_that_are_measured() {
        for file in ["container/compose.yaml", "kubernetes/router.yaml", "guide/fleet.md"] {
            let text = std::fs::read_to_string(crate::workspace().join("deploy").join(file)).expect("it is there");
            assert!(text.contains(ROUTER_ENVIRONMENT.0) && text.contains(ROUTER_ENVIRONMENT.1), "{file}");
        }
    }
}
