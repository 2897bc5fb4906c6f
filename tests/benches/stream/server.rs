//! The server in its own process, so that its memory can be measured; beside it a plain TCP server that sends as many
//! bytes, which is the lower bound.

use std::io::{BufRead, BufReader};
use std::net::{SocketAddr, TcpListener};
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use clearway_client::now_ns;
use clearway_daemon::config::{Config, Udp};
use clearway_daemon::run::{Server, Setup};
use clearway_sim::scanner::ScannerConfig;
use clearway_tests::siege::watch::processor_s;
use tokio::io::AsyncReadExt;

/// Most browsers of a row.
const BROWSERS_MAX: usize = 2048;

/// The server's process and its addresses.
pub struct Process {
    child: Child,
    pub data: SocketAddr,
    pub grpc: SocketAddr,
    pub page: SocketAddr,
    pub floor: SocketAddr,
    pub zenoh: String,
}

impl Process {
    pub fn start() -> Self {
        let own = std::env::current_exe().expect("this program");
        let mut child =
            Command::new(own).arg("--serve").stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().expect("a process");
        let mut line = String::new();
        BufReader::new(child.stdout.take().expect("piped")).read_line(&mut line).expect("a line");
        let places: Vec<&str> = line.split_whitespace().collect();
        let [data, grpc, page, floor, zenoh] = places[..] else { panic!("the server prints {line:?}") };
        let at = |address: &str| address.parse().expect("an address");
        Self { data: at(data), grpc: at(grpc), page: at(page), floor: at(floor), zenoh: zenoh.into(), child }
    }

    /// Resident set of the process, in KiB.
    pub fn resident_kib(&self) -> i64 {
        let status = std::fs::read_to_string(format!("/proc/{}/status", self.child.id())).expect("Linux");
        let line = status.lines().find(|line| line.starts_with("VmRSS")).expect("VmRSS");
        line.split_whitespace().nth(1).and_then(|kib| kib.parse().ok()).expect("a number")
    }

    /// Processor time of the process so far, in seconds.
    pub fn processor_s(&self) -> f64 {
        processor_s(self.child.id())
    }

    /// Ends the process by the end of its standard input.
    pub fn stop(&mut self) {
        drop(self.child.stdin.take());
        self.child.wait().expect("it ends");
    }
}

/// Runs the server until standard input ends.
pub async fn serve() {
    let mut config = Config::of_one_vehicle("car", "top");
    let any: SocketAddr = "127.0.0.1:0".parse().expect("an address");
    config.grpc.listen = any;
    (config.page.enabled, config.page.listen, config.connections.max) = (true, any, BROWSERS_MAX);
    (config.connections.per_address_max, config.connections.kept) = (BROWSERS_MAX, 0);
    (config.connections.calls_max, config.connections.calls_per_address_max) = (BROWSERS_MAX, BROWSERS_MAX);
    config.zenoh.enabled = true;
    config.zenoh.listen = vec!["tcp/127.0.0.1:0".into()];
    let vehicle = &mut config.vehicles[0];
    vehicle.udp = Some(Udp { data: any, telemetry: any, ..Udp::default() });
    vehicle.sensors[0].extrinsics.z_m = ScannerConfig::default().ego_from_sensor.translation.z;
    // The drive is older than its arrival.
    vehicle.sensors[0].gps_late_days_max = 36_525.0;
    let running = Server::start(Setup { config, ..Setup::default() }).await.expect("the server starts");
    let (data, _) = running.inputs[0].udp.expect("a socket");
    let floor = TcpListener::bind(any).expect("a free port");
    let floor_at = floor.local_addr().expect("bound");
    tokio::spawn(serve_floor(floor));
    let zenoh = running.zenoh.iter().find(|endpoint| endpoint.starts_with("tcp/127.0.0.1")).expect("zenoh listens");
    let [grpc, page] = [running.grpc, running.page].map(|address| address.expect("it is served"));
    println!("{data} {grpc} {page} {floor_at} {zenoh}");
    let ended = tokio::task::spawn_blocking(|| std::io::copy(&mut std::io::stdin(), &mut std::io::sink()));
    ended.await.expect("no panic").expect("standard input");
}

/// Sends ten messages a second to every connection, each of the requested length and with the time of its making.
async fn serve_floor(listener: TcpListener) {
    use tokio::io::AsyncWriteExt;
    listener.set_nonblocking(true).expect("an option");
    let listener = tokio::net::TcpListener::from_std(listener).expect("a listener");
    let (tick, made) = tokio::sync::watch::channel(0);
    tokio::spawn(async move {
        let mut every = tokio::time::interval(Duration::from_millis(100));
        loop {
            every.tick().await;
            tick.send_replace(now_ns());
        }
    });
    while let Ok((mut stream, _)) = listener.accept().await {
        let mut made = made.clone();
        tokio::spawn(async move {
            stream.set_nodelay(true)?;
            let bytes = stream.read_u64_le().await?.clamp(8, 1 << 20);
            let mut message = vec![0; bytes as usize];
            while made.changed().await.is_ok() {
                let made_ns: i64 = *made.borrow_and_update();
                message[..8].copy_from_slice(&made_ns.to_le_bytes());
                stream.write_all(&message).await?;
            }
            Ok::<(), std::io::Error>(())
        });
    }
}
