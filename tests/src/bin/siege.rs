//! Runs every attack against one server process with healthy readers beside it, and prints what each attack costs.
//!
//!   cargo run --release -p clearway-tests --bin siege -- --minutes 10
//!
//! Columns: a healthy gRPC reader of all layers: the 99th percentile and worst age of its maps, the maps it missed, and
//! how often its stream broke; the same of a healthy zenoh reader of one layer, with the messages it passed over; the
//! scans of ten a second that a healthy zenoh sender lost; the time until a new gRPC client has its first map (`-`:
//! none in 5 s); the server's resident memory before, at most during, and 5 s after; the processor time that it used,
//! in percent of one core. TCP attacks come from 127.0.0.2, the honest peers from 127.0.0.1: limits are by address. The
//! attackers get only processor time that no other process wants, as if they ran on another machine.

use std::net::{Ipv4Addr, SocketAddr, TcpListener, UdpSocket};
use std::path::PathBuf;
use std::process::{Child, Command, ExitCode, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use clap::Parser;
use clearway_sim::scanner::ScannerConfig;
use clearway_sim::scenes::flat;
use clearway_sim::send::{Pace, Until, drive};
use clearway_sim::vehicle::SimulatedVehicle;
use clearway_tests::siege::attacks;
use clearway_tests::siege::target::{Attack, Target};
use clearway_tests::siege::watch::{Seen, Sender, SiegeReader, newcomer, processor_s, resident_mib};
use tokio::runtime::Handle;

/// Every attack against one server, with healthy readers beside it.
#[derive(Parser)]
struct SiegeArguments {
    /// Time for all attacks together, in minutes.
    #[arg(long, default_value_t = 10.0)]
    minutes: f64,
    /// Only attacks whose name contains this text.
    #[arg(long, default_value = "")]
    only: String,
    /// The server's binary; by default `clearway` beside this one, built first.
    #[arg(long)]
    server: Option<PathBuf>,
}

/// Time for which the server recovers after an attack, before its memory is read.
const RECOVERY: Duration = Duration::from_secs(5);
/// Interval at which the memory is read.
const SAMPLE: Duration = Duration::from_millis(100);

fn main() -> ExitCode {
    let arguments = SiegeArguments::parse();
    let server = arguments.server.clone().unwrap_or_else(build);
    let chosen: Vec<_> = attacks().into_iter().filter(|attack| attack.name.contains(&arguments.only)).collect();
    if chosen.is_empty() {
        eprintln!("no attack is named {:?}", arguments.only);
        return ExitCode::FAILURE;
    }
    let each = Duration::from_secs_f64(arguments.minutes * 60.0 / chosen.len() as f64);
    let (folder, target) = (tempfile::tempdir().expect("a folder"), target());
    let mut process = start(&server, folder.path().join("clearway.toml"), &target);
    let runtime = |on_start: fn()| {
        let mut threads = tokio::runtime::Builder::new_multi_thread();
        threads.worker_threads(2).enable_all().on_thread_start(on_start).build().expect("a runtime")
    };
    let (own, attackers) = (runtime(|| ()), runtime(take_idle_time_only));
    let ended = own.block_on(besiege(&mut process, &target, chosen, each, attackers.handle()));
    attackers.shutdown_background();
    let _ended_already = process.kill();
    let _reaped = process.wait();
    if let Some(attack) = ended {
        eprintln!("the server ended during {attack:?}");
        return ExitCode::FAILURE;
    }
    ExitCode::SUCCESS
}

/// Lets the calling thread run only while no other thread wants the processor.
fn take_idle_time_only() {
    let thread = std::fs::read_link("/proc/thread-self").expect("the kernel tells");
    let thread = thread.file_name().expect("the number of the thread");
    let changed = Command::new("chrt").args(["--idle", "--pid", "0"]).arg(thread).status();
    assert!(changed.is_ok_and(|status| status.success()), "chrt of util-linux is needed");
}

/// Builds the server in the profile and folder of this binary.
fn build() -> PathBuf {
    let own = std::env::current_exe().expect("the path of this binary");
    let folder = own.parent().expect("target/<profile>");
    let mut cargo = clearway_tests::cargo();
    cargo.args(["build", "--quiet", "--workspace", "--bin", "clearway", "--target-dir"]);
    cargo.arg(folder.parent().expect("target"));
    if folder.ends_with("release") {
        cargo.arg("--release");
    }
    let built = cargo.status().expect("cargo runs");
    assert!(built.success(), "cargo build: {built}");
    folder.join("clearway")
}

/// Addresses that are free now.
fn target() -> Target {
    let any = (Ipv4Addr::LOCALHOST, 0);
    let tcp = || TcpListener::bind(any).and_then(|listener| listener.local_addr()).expect("a free port");
    let udp = UdpSocket::bind(any).and_then(|socket| socket.local_addr()).expect("a free port");
    Target { grpc: tcp(), page: tcp(), foxglove: tcp(), udp, zenoh: format!("tcp/{}", tcp()) }
}

/// Starts the server with the default configuration, and the sensor's sender known.
fn start(server: &PathBuf, config: PathBuf, target: &Target) -> Child {
    let Target { grpc, page, foxglove, udp, zenoh } = target;
    let telemetry = SocketAddr::new(udp.ip(), 0);
    let extrinsics = "[vehicle.sensor.extrinsics]\nx_m = 0.0\ny_m = 0.0\nz_m = 1.9\nroll_deg = 0.0\n\
                      pitch_deg = 0.0\nyaw_deg = 0.0\n";
    let text = format!(
        "[grpc]\nlisten = \"{grpc}\"\n[page]\nlisten = \"{page}\"\n[foxglove]\nenabled = true\n\
         listen = \"{foxglove}\"\n[zenoh]\nlisten = [\"{zenoh}\"]\n\
         [[vehicle]]\nname = \"car\"\n[vehicle.udp]\ndata = \"{udp}\"\ntelemetry = \"{telemetry}\"\n\
         [vehicle.udp.from]\ntop = \"127.0.0.1\"\n[[vehicle.sensor]]\nname = \"top\"\n\
         {extrinsics}[[vehicle.sensor]]\nname = \"side\"\nmodel = \"hdl32e\"\n{extrinsics}"
    );
    std::fs::write(&config, text).expect("a file of ours");
    let log = std::fs::File::create(config.with_extension("log")).expect("a file of ours");
    let mut command = Command::new(server);
    // As in deploy/systemd/clearway.service.
    command.envs([("MALLOC_ARENA_MAX", "2"), ("MALLOC_TRIM_THRESHOLD_", "131072")]);
    command.args(["serve", "--config"]).arg(&config).stdout(Stdio::null()).stderr(log);
    command.spawn().unwrap_or_else(|error| panic!("{}: {error}", server.display()))
}

/// The peers beside the attacks.
struct Healthy {
    /// Over gRPC and over zenoh.
    readers: [SiegeReader; 2],
    sender: Sender,
}

impl Healthy {
    /// What the readers have seen and the sender has lost since the last call.
    fn take(&self) -> ([Seen; 2], u64) {
        (self.readers.each_ref().map(SiegeReader::take), self.sender.take())
    }
}

/// Runs the attacks one after the other. Returns the attack during which the server ended.
async fn besiege(
    process: &mut Child,
    target: &Target,
    attacks: Vec<Attack>,
    each: Duration,
    attackers: &Handle,
) -> Option<&'static str> {
    let halt = Arc::new(AtomicBool::new(false));
    let sensor = std::thread::spawn({
        let (halt, at) = (halt.clone(), target.udp);
        move || {
            let (vehicle, until) = (SimulatedVehicle::new(flat(), ScannerConfig::default()), Until::default());
            let until = Until { stop: Some(&halt), ..until };
            drive((Ipv4Addr::LOCALHOST, 0).into(), vehicle, at, at, Pace::RealTime, until)
        }
    });
    let began = Instant::now();
    while newcomer(target).await.is_none() {
        assert!(began.elapsed() < Duration::from_secs(60), "the server does not start");
    }
    let healthy = Healthy {
        readers: [SiegeReader::start(target, false), SiegeReader::start(target, true)],
        sender: Sender::start(target),
    };
    tokio::time::sleep(RECOVERY).await;
    println!(
        "| attack | gRPC p99 ms | worst ms | missed | broken | zenoh p99 ms | worst ms | missed | broken | passed over \
         | scans lost | newcomer ms | MiB before | during | after | server % |\n|---|{}",
        "---:|".repeat(15)
    );
    drop(healthy.take());
    let calm = Attack { name: "none", run: |_| Box::pin(std::future::pending()) };
    let mut ended = None;
    for attack in std::iter::once(calm).chain(attacks) {
        run(process.id(), target, &attack, each, attackers, &healthy).await;
        if !matches!(process.try_wait(), Ok(None)) {
            ended = Some(attack.name);
            break;
        }
    }
    healthy.readers.into_iter().for_each(SiegeReader::stop);
    healthy.sender.stop();
    halt.store(true, Ordering::Relaxed);
    let _sent = sensor.join();
    ended
}

/// Runs one attack and prints its line.
async fn run(process: u32, target: &Target, attack: &Attack, each: Duration, attackers: &Handle, healthy: &Healthy) {
    let before = resident_mib(process);
    let (begun, used) = (Instant::now(), processor_s(process));
    let (attacking, end) = (attackers.spawn((attack.run)(target.clone())), Instant::now() + each);
    let joining = tokio::spawn({
        let target = target.clone();
        async move {
            tokio::time::sleep(each / 2).await;
            newcomer(&target).await
        }
    });
    let mut during = before;
    while Instant::now() < end {
        tokio::time::sleep(SAMPLE).await;
        during = during.max(resident_mib(process));
    }
    let share = 100.0 * (processor_s(process) - used) / begun.elapsed().as_secs_f64();
    let joined = joining.await.ok().flatten();
    attacking.abort();
    let (seen, lost) = healthy.take();
    tokio::time::sleep(RECOVERY).await;
    drop(healthy.take());
    let of = |mut seen: Seen| {
        let (p99, worst) = (seen.age_ms(0.99), seen.age_ms(1.0));
        (format!("{p99:.0} | {worst:.0} | {} | {}", seen.missed, seen.broken), seen.passed_over)
    };
    let [(grpc, _), (zenoh, passed_over)] = seen.map(of);
    let joined = joined.map_or("-".into(), |joined| format!("{}", joined.as_millis()));
    let after = resident_mib(process);
    println!(
        "| {} | {grpc} | {zenoh} | {passed_over} | {lost} | {joined} | {before:.0} | {during:.0} | {after:.0} | {share:.0} |",
        attack.name
    );
}
