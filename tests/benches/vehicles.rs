//! Measures how many vehicles one server bears: HDL-64Es at 10 Hz over UDP, poses at 20 Hz over gRPC, and one gRPC
//! reader of `drivability` and `speed` for each vehicle.
//!
//!   cargo bench -p clearway-tests --bench vehicles                                1, 2, 4, 8 and 16 vehicles
//!   cargo bench -p clearway-tests --bench vehicles -- --vehicles 4 --seconds 60 --cpus 0,1 --json
//!
//! The server runs in its own process, on the processors of `--cpus`; senders and readers run on the others. The
//! datagrams are made beforehand, and every vehicle sends the same datagrams, each vehicle from another moment of a
//! revolution. Age: from the moment at which a map's last packet is due to be sent to the reader's hands. Lost:
//! datagrams that were sent and not received, dropped by the kernel or lost at the queue. Memory: growth of the
//! server's resident set over the resident set without vehicles' data, divided by the number of vehicles. The last
//! column says which threads the processor time of a map went to.

use std::io::{BufRead, BufReader};
use std::net::SocketAddr;
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{Duration, Instant};

use clap::Parser;
use clearway_client::{Client, Observation, Subscription, now_ns};
use clearway_daemon::config::{Config, Udp};
use clearway_daemon::run::{Server, Setup};
use clearway_sim::scanner::ScannerConfig;
use clearway_sim::scenes::town;
use clearway_sim::vehicle::{Datagram, SimulatedVehicle};
use clearway_tests::packets::{REVOLUTION, later, packets, send};
use serde_json::{Value, json};
use tokio::task::JoinSet;

/// Time after which readers are connected and memory is allocated; maps until then are not counted.
const SETTLE: Duration = Duration::from_secs(3);
/// Time between two poses of a vehicle.
const POSE_PERIOD: Duration = Duration::from_millis(50);
/// Threads that send.
const SENDERS: usize = 2;
/// The layers that are read.
const LAYERS: [&str; 2] = ["drivability", "speed"];

#[derive(Parser)]
struct VehiclesBenchArguments {
    /// How many vehicles, one row each.
    #[arg(long, value_delimiter = ',', default_values_t = [1, 2, 4, 8, 16])]
    vehicles: Vec<usize>,
    /// Seconds of each row.
    #[arg(long, default_value_t = 20)]
    seconds: u64,
    /// Processors of the server.
    #[arg(long, default_value = "0,1")]
    cpus: String,
    /// Prints one JSON object instead of a table.
    #[arg(long)]
    json: bool,
    /// Runs as the server of so many vehicles; this program starts itself so.
    #[arg(long, hide = true)]
    serve: Option<usize>,
    /// Set by cargo bench.
    #[arg(long, hide = true)]
    bench: bool,
}

fn main() {
    let arguments = VehiclesBenchArguments::parse();
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build();
    let runtime = runtime.expect("a runtime");
    if let Some(vehicles) = arguments.serve {
        return runtime.block_on(serve(vehicles));
    }
    let length = SETTLE + Duration::from_secs(arguments.seconds) + 2 * REVOLUTION;
    let vehicle = SimulatedVehicle::new(town(), ScannerConfig::default());
    let drive: Arc<[Datagram]> = packets(vehicle, length).into();
    let mut rows = Vec::new();
    if !arguments.json {
        print_header();
    }
    for &vehicles in &arguments.vehicles {
        let row = runtime.block_on(measure(vehicles, &arguments, &drive));
        if !arguments.json {
            print_row(&row);
        }
        rows.push(row);
    }
    if arguments.json {
        println!("{}", json!({ "rows": rows }));
    }
}

fn print_header() {
    println!(
        "| vehicles | maps/s | age p50 / p99 / worst ms | maps missed | datagrams lost | MiB a vehicle | server's cores \
         | ms a map: engine / UDP / all else |"
    );
    println!("|---|---|---|---|---|---|---|---|");
}

fn print_row(row: &Value) {
    let number = |value: &Value| value.as_f64().unwrap_or(f64::NAN);
    let [p50, p99, worst] = [0, 1, 2].map(|at| number(&row["age_ms"][at]));
    let [engine, udp, other] = ["engine", "udp", "other"].map(|group| number(&row["ms_per_map"][group]));
    println!(
        "| {} | {:.0} | {p50:.1} / {p99:.1} / {worst:.0} | {} | {} | {:.0} | {:.2} | {engine:.1} / {udp:.1} / {other:.1} |",
        row["vehicles"],
        number(&row["maps_per_s"]),
        row["missed"],
        row["lost"],
        number(&row["mib_per_vehicle"]),
        number(&row["server_cores"]),
    );
}

/// Runs one row.
async fn measure(vehicles: usize, arguments: &VehiclesBenchArguments, drive: &Arc<[Datagram]>) -> Value {
    let mut server = Process::start(vehicles, &arguments.cpus);
    let client = Client::connect(&server.grpc).await.expect("the server answers");
    let empty_kib = server.resident_kib();
    let is_measured = Arc::new(AtomicBool::new(false));
    let mut readers = JoinSet::new();
    let (start, start_ns) = (Instant::now() + REVOLUTION, now_ns() + REVOLUTION.as_nanos() as i64);
    for number in 0..vehicles {
        let (client, is_measured) = (client.clone(), is_measured.clone());
        let shift_ns = start_ns + later(number, vehicles).as_nanos() as i64 - drive[0].stamp_ns;
        readers.spawn(async move { read(client, name(number), shift_ns, &is_measured).await });
    }
    let poses = std::thread::spawn({
        let client = client.clone();
        move || {
            let senders = (0..vehicles).map(|number| send_poses(client.clone(), name(number)));
            let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().expect("a runtime");
            runtime.block_on(futures::future::join_all(senders));
        }
    });
    let sent = Arc::new(AtomicU64::new(0));
    let senders: Vec<_> = (0..SENDERS.min(vehicles))
        .map(|sender| {
            let to: Vec<_> = server.data.iter().copied().enumerate().skip(sender).step_by(SENDERS).collect();
            let (drive, sent) = (drive.clone(), sent.clone());
            std::thread::spawn(move || send(&drive, &to, vehicles, start, &sent))
        })
        .collect();
    tokio::time::sleep(SETTLE).await;
    let (began, before) = (Instant::now(), server.processor_s());
    is_measured.store(true, Ordering::Relaxed);
    tokio::time::sleep(Duration::from_secs(arguments.seconds)).await;
    is_measured.store(false, Ordering::Relaxed);
    let (seconds, after, kib) = (began.elapsed().as_secs_f64(), server.processor_s(), server.resident_kib());
    let spent_s = [0, 1, 2].map(|group| after[group] - before[group]);
    senders.into_iter().for_each(|sender| sender.join().expect("it sends"));
    // The engines finish what waits.
    tokio::time::sleep(Duration::from_secs(2)).await;
    let received: u64 = counts(&client).await;
    server.stop();
    poses.join().expect("it sends");
    let (mut ages, mut missed) = (Vec::new(), 0);
    while let Some(read) = readers.join_next().await {
        let (of_vehicle, skipped) = read.expect("no panic");
        ages.extend(of_vehicle);
        missed += skipped;
    }
    ages.sort_by(f64::total_cmp);
    let at = |share: f64| ages.get(((ages.len() as f64 * share) as usize).min(ages.len().max(1) - 1)).copied();
    // Median, 99th percentile, worst.
    let ages_ms = [0.5, 0.99, 1.0].map(at);
    let rate = ages.len() as f64 / arguments.seconds as f64;
    let [engine, udp, other] = spent_s.map(|spent_s| 1e3 * spent_s / seconds / rate);
    json!({
        "vehicles": vehicles,
        "maps_per_s": rate,
        "age_ms": ages_ms,
        "missed": missed,
        "lost": sent.load(Ordering::Relaxed).saturating_sub(received),
        "mib_per_vehicle": (kib - empty_kib) as f64 / 1024.0 / vehicles as f64,
        "server_cores": spent_s.iter().sum::<f64>() / seconds,
        "ms_per_map": { "engine": engine, "udp": udp, "other": other },
    })
}

fn name(number: usize) -> String {
    format!("v{number:02}")
}

/// The datagrams that the server has received and not lost.
async fn counts(client: &Client) -> u64 {
    let vehicles = client.vehicles().await.expect("the server answers");
    let ledgers = vehicles.into_iter().filter_map(|vehicle| vehicle.ledger);
    ledgers.map(|ledger| ledger.received).sum()
}

/// Ages in ms of the maps of a vehicle that come while they are measured, and the number of maps that were skipped.
/// Packets are sent `shift_ns` after their stamps.
async fn read(client: Client, vehicle: String, shift_ns: i64, is_measured: &AtomicBool) -> (Vec<f64>, u64) {
    let layers = LAYERS.map(str::to_owned).to_vec();
    let subscription = Subscription { vehicle, layers, ..Subscription::default() };
    let mut maps = client.subscribe(subscription).await.expect("a stream");
    let (mut ages, mut missed, mut last) = (Vec::new(), 0, None);
    while let Ok(update) = maps.next().await {
        let sequence = update.map.sequence();
        let between = last.replace(sequence).map_or(0, |last: u64| sequence.saturating_sub(last + 1));
        if is_measured.load(Ordering::Relaxed) {
            ages.push((now_ns() - shift_ns - update.map.header().capture_end_ns) as f64 * 1e-6);
            missed += between;
        }
    }
    (ages, missed)
}

/// Sends where the vehicle is, until the server ends.
async fn send_poses(client: Client, vehicle: String) {
    let mut ingester = client.ingest(&vehicle).await.expect("ingest is allowed");
    let mut every = tokio::time::interval(POSE_PERIOD);
    loop {
        every.tick().await;
        let pose = Observation::pose(now_ns(), [0.0; 3], [0.0, 0.0, 0.0, 1.0], 0.0);
        if ingester.send(pose).await.is_err() {
            return;
        }
    }
}

/// A process of the server under test, with its addresses.
struct Process {
    child: Child,
    grpc: String,
    data: Vec<SocketAddr>,
}

impl Process {
    fn start(vehicles: usize, cpus: &str) -> Self {
        let mut command = Command::new("taskset");
        command.args(["--cpu-list", cpus]).arg(std::env::current_exe().expect("this program"));
        command.args(["--serve", &vehicles.to_string()]).stdin(Stdio::piped()).stdout(Stdio::piped());
        let mut child = command.spawn().expect("taskset, of util-linux");
        let mut line = String::new();
        BufReader::new(child.stdout.take().expect("piped")).read_line(&mut line).expect("a line");
        let mut places = line.split_whitespace();
        let grpc = places.next().expect("an address").to_owned();
        Self { grpc, data: places.map(|at| at.parse().expect("an address")).collect(), child }
    }

    /// Resident set of the process, in KiB.
    fn resident_kib(&self) -> i64 {
        let status = std::fs::read_to_string(format!("/proc/{}/status", self.child.id())).expect("Linux");
        let line = status.lines().find(|line| line.starts_with("VmRSS")).expect("VmRSS");
        line.split_whitespace().nth(1).and_then(|kib| kib.parse().ok()).expect("a number")
    }

    /// Processor time so far, in seconds: of the engines, of the threads that receive datagrams, of all others.
    fn processor_s(&self) -> [f64; 3] {
        let tasks = std::fs::read_dir(format!("/proc/{}/task", self.child.id())).expect("Linux");
        let mut groups_s = [0.0; 3];
        for task in tasks.flatten() {
            // A thread that has ended meanwhile has no files.
            let text = |name| std::fs::read_to_string(task.path().join(name)).unwrap_or_default();
            let name = text("comm");
            let group = ["engine ", "udp "].iter().position(|prefix| name.starts_with(prefix)).unwrap_or(2);
            let spent_ns = text("schedstat").split_whitespace().next().and_then(|ns| ns.parse().ok());
            groups_s[group] += spent_ns.unwrap_or(0.0) * 1e-9;
        }
        groups_s
    }

    /// Ends the process by the end of its standard input.
    fn stop(&mut self) {
        drop(self.child.stdin.take());
        self.child.wait().expect("it ends");
    }
}

/// Runs the server until standard input ends.
async fn serve(vehicles: usize) {
    let any: SocketAddr = "127.0.0.1:0".parse().expect("an address");
    let mut config = Config::of_one_vehicle("v00", "top");
    config.grpc.listen = any;
    config.page.enabled = false;
    config.zenoh.enabled = false;
    config.connections.per_address_max = 256;
    let vehicle = &mut config.vehicles[0];
    vehicle.udp = Some(Udp { data: any, telemetry: any, ..Udp::default() });
    vehicle.sensors[0].extrinsics.z_m = ScannerConfig::default().ego_from_sensor.translation.z;
    // The drive is older than its arrival.
    vehicle.sensors[0].gps_late_days_max = 36_525.0;
    let first = vehicle.clone();
    config.vehicles =
        (0..vehicles).map(|number| clearway_daemon::config::Vehicle { name: name(number), ..first.clone() }).collect();
    let running = Server::start(Setup { config, ..Setup::default() }).await.expect("the server starts");
    print!("{}", running.grpc.expect("gRPC is served"));
    running.inputs.iter().for_each(|input| print!(" {}", input.udp.expect("a socket").0));
    println!();
    let ended = tokio::task::spawn_blocking(|| std::io::copy(&mut std::io::stdin(), &mut std::io::sink()));
    ended.await.expect("no panic").expect("standard input");
}
