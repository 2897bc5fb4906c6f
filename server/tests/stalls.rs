//! A server that stands still, that hangs, that has no data and that is gone, as planners and people see it.

use std::io::{BufRead, BufReader};
use std::net::{Ipv4Addr, SocketAddr, TcpListener, UdpSocket};
use std::path::Path;
use std::process::{Child, Command, Output, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicI64, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use clearway_client::{Client, MapStream, MapView, StreamEvent, Subscription, now_ns};
use clearway_daemon::config::{Config, Udp};
use clearway_daemon::run::{Setup, ShutdownError};
use clearway_mapping::pipeline::Pipeline;
use clearway_sim::scanner::ScannerConfig;
use clearway_sim::scenes::flat;
use clearway_sim::send::{Pace, Until, drive};
use clearway_sim::vehicle::SimulatedVehicle;

use crate::common::text;

/// Longest wait, so that a test that hangs ends: ten times what any step of these tests needs.
const PATIENCE: Duration = Duration::from_secs(120);
const REVOLUTION_NS: i64 = 100_000_000;

/// A server in its own process; it is killed at the end of the test.
struct Server {
    process: Child,
    grpc: SocketAddr,
    zenoh: SocketAddr,
    data: SocketAddr,
}

impl Server {
    /// Starts a server at this loopback address, which no other test uses.
    fn start(folder: &Path, address: [u8; 4]) -> Self {
        let address = Ipv4Addr::from(address);
        let tcp = || TcpListener::bind((address, 0)).unwrap().local_addr().unwrap();
        let udp = || UdpSocket::bind((address, 0)).unwrap().local_addr().unwrap();
        let (grpc, zenoh, data) = (tcp(), tcp(), udp());
        let mut config = Config::of_one_vehicle("car", "top");
        config.page.enabled = false;
        config.grpc.listen = grpc;
        (config.zenoh.enabled, config.zenoh.listen) = (true, vec![format!("tcp/{zenoh}")]);
        let vehicle = &mut config.vehicles[0];
        vehicle.sensors[0].extrinsics.z_m = ScannerConfig::default().ego_from_sensor.translation.z;
        vehicle.udp = Some(Udp { data, telemetry: udp(), ..Udp::default() });
        let path = folder.join("clearway.toml");
        std::fs::write(&path, config.to_toml()).unwrap();
        let mut command = Command::new(env!("CARGO_BIN_EXE_clearway"));
        let process = command.args(["serve", "--config"]).arg(&path).stderr(Stdio::null()).spawn().unwrap();
        Self { process, grpc, zenoh, data }
    }

    fn signal(&self, name: &str) {
        let id = self.process.id().to_string();
        assert!(Command::new("kill").args([name, &id]).status().unwrap().success(), "{name}");
    }

    /// Connects as soon as the server listens.
    async fn subscribe(&self) -> MapStream {
        let client = loop {
            match Client::connect(&self.grpc.to_string()).await {
                Ok(client) => break client,
                Err(_) => tokio::time::sleep(Duration::from_millis(2)).await,
            }
        };
        client.subscribe(Subscription { layers: vec!["drivability".into()], ..Subscription::default() }).await.unwrap()
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}

/// A vehicle that drives in real time until this is dropped. Its receiver reports a year that is long past, so that the
/// stamps follow arrivals.
struct Vehicle {
    halt: Arc<AtomicBool>,
    /// By how much a busy machine has delayed a packet at most, ns; a test may set it back to 0.
    late_ns: Arc<AtomicI64>,
    thread: Option<JoinHandle<()>>,
}

impl Vehicle {
    fn driving_to(data: SocketAddr, pace: Pace) -> Self {
        let (halt, late_ns) = (Arc::new(AtomicBool::new(false)), Arc::new(AtomicI64::new(0)));
        let thread = std::thread::spawn({
            let (halt, late_ns) = (halt.clone(), late_ns.clone());
            move || {
                let vehicle = SimulatedVehicle::new(flat(), ScannerConfig::default());
                // A packet is asked for when the packet before it has been sent.
                let mut least_ns = i64::MAX;
                let packets = vehicle.filter(|datagram| datagram.payload.len() == 1206).inspect(move |datagram| {
                    let behind_ns = now_ns() - datagram.stamp_ns;
                    least_ns = least_ns.min(behind_ns);
                    late_ns.fetch_max(behind_ns - least_ns, Ordering::Relaxed);
                });
                let until = Until { stop: Some(&halt), device_time: None };
                // A server that has not started yet refuses datagrams; nothing else can fail here.
                let _ = drive((Ipv4Addr::UNSPECIFIED, 0).into(), packets, data, data, pace, until);
            }
        });
        Self { halt, late_ns, thread: Some(thread) }
    }
}

impl Drop for Vehicle {
    fn drop(&mut self) {
        self.halt.store(true, Ordering::Relaxed);
        self.thread.take().map(JoinHandle::join);
    }
}

async fn within<T>(what: &str, future: impl Future<Output = T>) -> T {
    tokio::time::timeout(PATIENCE, future).await.unwrap_or_else(|_| panic!("waited in vain: {what}"))
}

/// The next map that a planner may use.
async fn next_fresh(maps: &mut MapStream) -> MapView {
    within("a fresh map", async {
        loop {
            if let StreamEvent::Fresh(update) = maps.next_or_stale().await.unwrap() {
                return update.map;
            }
        }
    })
    .await
}

/// By how much the stamps of two maps differ from a whole number of revolutions.
fn moved_ns(first: &MapView, second: &MapView) -> i64 {
    let off_ns = (second.header().capture_end_ns - first.header().capture_end_ns).rem_euclid(REVOLUTION_NS);
    off_ns.min(REVOLUTION_NS - off_ns)
}

/// Runs `clearway watch` to its end.
async fn watch(arguments: Vec<String>) -> Output {
    let run = move || Command::new(env!("CARGO_BIN_EXE_clearway")).arg("watch").args(arguments).output().unwrap();
    within("the end of watch", tokio::task::spawn_blocking(run)).await.unwrap()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn after_a_stop_of_the_server_stamps_go_on_as_if_it_had_not_stopped() {
    let folder = tempfile::tempdir().unwrap();
    let server = Server::start(folder.path(), [127, 0, 0, 81]);
    let mut maps = within("a connection", server.subscribe()).await;
    let vehicle = Vehicle::driving_to(server.data, Pace::RealTime);
    let mut last = next_fresh(&mut maps).await;
    for stop_ms in [1000.0, 2000.0] {
        within("a stop while nothing else delays the sender", async {
            let mut late_ns = i64::MAX;
            while late_ns > REVOLUTION_NS / 10 {
                vehicle.late_ns.store(0, Ordering::Relaxed);
                for _ in 0..8 {
                    last = next_fresh(&mut maps).await;
                }
                server.signal("-STOP");
                while last.age_ms(now_ns()) < stop_ms {
                    tokio::time::sleep(Duration::from_millis(1)).await;
                }
                server.signal("-CONT");
                let after = next_fresh(&mut maps).await;
                late_ns = vehicle.late_ns.load(Ordering::Relaxed);
                if late_ns <= REVOLUTION_NS / 10 {
                    // The kernel has stamped the packets that waited: nothing had to be corrected, back or forth.
                    assert_eq!(after.header().epoch, last.header().epoch);
                    // Stamps of the wrong time would move by up to half a revolution.
                    let (moved_ns, allowed_ns) = (moved_ns(&last, &after), REVOLUTION_NS / 5 + 2 * late_ns);
                    assert!(moved_ns < allowed_ns, "moved by {moved_ns} of {allowed_ns} ns");
                }
                last = after;
            }
        })
        .await;
    }
    drop(vehicle);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn after_packets_that_came_too_fast_stamps_return_in_a_new_epoch() {
    let folder = tempfile::tempdir().unwrap();
    let server = Server::start(folder.path(), [127, 0, 0, 82]);
    let mut maps = within("a connection", server.subscribe()).await;
    let vehicle = Vehicle::driving_to(server.data, Pace::Times(10.0));
    within("a map that is ahead", async {
        loop {
            let (StreamEvent::Fresh(update) | StreamEvent::Stale(update)) = maps.next_or_stale().await.unwrap();
            if update.map.header().capture_end_ns > now_ns() + 2_000_000_000 {
                assert!(update.map.is_stale(now_ns()), "its age is not known");
                return;
            }
        }
    })
    .await;
    drop(vehicle);
    let vehicle = Vehicle::driving_to(server.data, Pace::RealTime);
    let map = next_fresh(&mut maps).await;
    assert!(map.header().epoch > 0 && map.header().sensors[0].epoch > 0, "{:?}", map.header());
    drop(vehicle);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn an_engine_that_hangs_is_in_the_status_and_does_not_keep_the_server_from_ending() {
    let any = "127.0.0.1:0".parse().unwrap();
    let mut config = Config::of_one_vehicle("car", "top");
    (config.page.enabled, config.zenoh.enabled, config.grpc.listen) = (false, false, any);
    config.vehicles[0].udp = Some(Udp { data: any, telemetry: any, ..Udp::default() });
    let (hang, hung) = std::sync::mpsc::channel::<()>();
    let observer = Box::new(move |_: &Pipeline| _ = hung.recv());
    let setup = Setup { config, observer: Some(observer), ..Setup::default() };
    let running = clearway_daemon::run::Server::start(setup).await.unwrap();
    let status = running.vehicles.0[0].status.clone();
    assert_eq!(status.fault(), None);
    let vehicle = Vehicle::driving_to(running.inputs[0].udp.unwrap().0, Pace::RealTime);
    within("the fault", async {
        while status.fault().is_none() {
            tokio::time::sleep(Duration::from_millis(1)).await;
        }
    })
    .await;
    assert!(status.fault().unwrap().contains("the engine of vehicle car has hung"), "{:?}", status.fault());
    assert!(!status.is_alive() && status.to_proto().fault == status.fault().unwrap());
    drop(vehicle);
    let ended = within("the end", running.shutdown_in_time()).await;
    assert!(matches!(ended, Err(ShutdownError::Deadline { waiting_for: "the engines", .. })), "{ended:?}");
    drop(hang);
    within("the engine's end", async {
        while !status.fault().is_some_and(|fault| fault.contains("has stopped")) {
            tokio::time::sleep(Duration::from_millis(1)).await;
        }
    })
    .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn watch_waits_for_a_server_that_is_not_there_and_again_when_it_has_ended() {
    let folder = tempfile::tempdir().unwrap();
    let mut server = Server::start(folder.path(), [127, 0, 0, 84]);
    drop(within("a connection", server.subscribe()).await);
    let mut watch = Command::new(env!("CARGO_BIN_EXE_clearway"));
    watch.args(["watch", "--server", &server.grpc.to_string()]);
    let mut watching = watch.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    let mut lines = BufReader::new(watching.stdout.take().unwrap()).lines();
    let mut says = |part: &str| {
        let line = lines.by_ref().take(120).map(Result::unwrap).find(|line| line.contains(part));
        assert!(line.is_some(), "watch ended before a line with {part:?}");
    };
    let why = "STALE: waiting for the first map: no packets from top since the server started";
    says(why);
    let mut over_zenoh = Command::new(env!("CARGO_BIN_EXE_clearway"));
    over_zenoh.args(["watch", "--zenoh", &format!("tcp/{}", server.zenoh)]).stdout(Stdio::piped());
    let mut over_zenoh = over_zenoh.spawn().unwrap();
    let mut lines = BufReader::new(over_zenoh.stdout.take().unwrap()).lines().take(120).map(Result::unwrap);
    assert!(lines.any(|line| line.contains(why)), "watch over zenoh ended before a line with the server's reason");
    over_zenoh.kill().unwrap();
    over_zenoh.wait().unwrap();
    server.process.kill().unwrap();
    server.process.wait().unwrap();
    says(&server.grpc.to_string());
    let restart = || {
        let mut command = Command::new(env!("CARGO_BIN_EXE_clearway"));
        command.args(["serve", "--config"]).arg(folder.path().join("clearway.toml")).stderr(Stdio::null()).spawn()
    };
    server.process = restart().unwrap();
    let vehicle = Vehicle::driving_to(server.data, Pace::RealTime);
    says("car #");
    watching.kill().unwrap();
    watching.wait().unwrap();
    // At the start too.
    server.process.kill().unwrap();
    server.process.wait().unwrap();
    let mut watching = watch.spawn().unwrap();
    let mut said = BufReader::new(watching.stderr.take().unwrap()).lines();
    let waits = said.next().unwrap().unwrap();
    assert!(waits.contains("no clearway server answers") && waits.ends_with("waiting for it"), "{waits}");
    server.process = restart().unwrap();
    let first = BufReader::new(watching.stdout.take().unwrap()).lines().next().unwrap().unwrap();
    assert!(first.starts_with("car #") || first.starts_with("STALE"), "{first}");
    watching.kill().unwrap();
    watching.wait().unwrap();
    drop(vehicle);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn watch_says_stale_when_nothing_comes_and_its_exit_code_too() {
    let folder = tempfile::tempdir().unwrap();
    let mut server = Server::start(folder.path(), [127, 0, 0, 83]);
    drop(within("a connection", server.subscribe()).await);
    let grpc = ["--server".to_owned(), server.grpc.to_string()];
    let zenoh = ["--zenoh".to_owned(), format!("tcp/{}", server.zenoh)];
    let until_stale = |at: &[String; 2]| watch([&at[..], &["--until-stale".into()]].concat());
    // Without data.
    for at in [&grpc, &zenoh] {
        let output = until_stale(at).await;
        let said = text(&output.stdout);
        assert!(
            said.starts_with("STALE: waiting for the first map") && output.status.code() == Some(4),
            "{at:?}: {said}"
        );
    }
    let of_another = ["--vehicle", "cra", "--until-stale"].map(str::to_owned);
    let said = text(&watch([&zenoh[..], &of_another].concat()).await.stderr);
    assert!(said.contains("--vehicle cra: no server") && said.contains("publishes it now (others: car)"), "{said}");
    // With data that end.
    for (at, stops) in [(&grpc, false), (&zenoh, false), (&zenoh, true)] {
        let vehicle = Vehicle::driving_to(server.data, Pace::RealTime);
        let mut maps = within("a connection", server.subscribe()).await;
        next_fresh(&mut maps).await;
        let watching = tokio::spawn(until_stale(at));
        // The command has received some of these.
        for _ in 0..20 {
            next_fresh(&mut maps).await;
        }
        if stops {
            server.process.kill().unwrap();
        }
        drop((vehicle, maps));
        let output = within("the end of watch", watching).await.unwrap();
        let said = text(&output.stdout);
        assert!(said.lines().last().is_some_and(|line| line.contains("STALE")), "{at:?}: {said}");
        assert_eq!(output.status.code(), Some(4), "{at:?}: {said} {}", text(&output.stderr));
    }
}
