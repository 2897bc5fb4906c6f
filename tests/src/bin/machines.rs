//! Faults between machines: three servers, two routers, 20 vehicles and two planners, each machine in a network
//! namespace of its own, with IP links between them that are cut, slowed and repaired. It needs root.
//!
//!   cargo run --release -p clearway-tests --bin machines
//!
//! Each planner reads every vehicle over zenoh. For each fault the table has, of all streams, how many went STALE while
//! it lasted, of the vehicles it concerns and of the others; how long the longest of the others was; the time from the
//! repair until every stream was fresh again; and how many streams had maps of another run of a server than before.

use std::collections::{BTreeMap, BTreeSet};
use std::io::{BufRead, BufReader, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, Command, ExitCode, Stdio};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use clap::{Parser, Subcommand};
use clearway::config::{Config, ZenohMode};
use clearway_client::{Client, Observation, StreamEvent, ZenohClient, now_ns};

/// Faults between machines.
#[derive(Parser)]
struct Arguments {
    #[command(subcommand)]
    role: Option<Role>,
    /// Time for which each fault lasts, in seconds.
    #[arg(long, default_value_t = 8.0)]
    seconds: f64,
    /// The server's binary; by default `clearway` beside this one.
    #[arg(long)]
    server: Option<PathBuf>,
}

/// What a process of the run does in its namespace.
#[derive(Subcommand)]
enum Role {
    /// Sends scans of these vehicles to the server of this machine.
    Feed { vehicles: String },
    /// Prints when a stream of one of these vehicles becomes stale or fresh, or changes its server.
    Read { endpoints: String, vehicles: String },
    /// A router, connected to others.
    Router { others: String },
}

const HOSTS: &str = "r1:1 r2:2 s1:11 s2:12 s3:13 p1:21 p2:22";
const ROUTERS: [&str; 2] = ["tcp/10.99.0.1:7447", "tcp/10.99.0.2:7447"];
/// Vehicles of each server.
const VEHICLES: [std::ops::Range<usize>; 3] = [0..7, 7..14, 14..20];
/// The vehicle that two servers claim for a while.
const CLAIMED: &str = "v00";
/// Longest wait for the fleet to be whole.
const PATIENCE: Duration = Duration::from_secs(60);

fn main() -> ExitCode {
    let arguments = Arguments::parse();
    let runtime =
        tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build().expect("a runtime");
    match &arguments.role {
        Some(Role::Feed { vehicles }) => runtime.block_on(feed(vehicles)),
        Some(Role::Read { endpoints, vehicles }) => runtime.block_on(read(endpoints, vehicles)),
        Some(Role::Router { others }) => runtime.block_on(route(others)),
        None => return run(&arguments),
    }
    ExitCode::SUCCESS
}

fn names(range: std::ops::Range<usize>) -> Vec<String> {
    range.map(|number| format!("v{number:02}")).collect()
}

/// Ten scans a second of each vehicle: a plain, 1,440 points.
async fn feed(vehicles: &str) {
    let rays = || (0..1440_u32).map(|ray| (f64::from(ray).to_radians(), 3.0 + f64::from(ray / 360) * 4.0));
    let list = |of: &dyn Fn(f64, f64) -> f64| rays().map(|(angle, range_m)| of(angle, range_m) as f32).collect();
    let x: Vec<f32> = list(&|angle, range_m| angle.cos() * range_m);
    let y: Vec<f32> = list(&|angle, range_m| angle.sin() * range_m);
    let z: Vec<f32> = list(&|_, _| -2.0);
    let feeds = vehicles.split(',').map(|vehicle| async {
        let mut every = tokio::time::interval(Duration::from_millis(100));
        loop {
            every.tick().await;
            let Ok(client) = Client::connect("127.0.0.1:50051").await else { continue };
            let Ok(mut ingester) = client.ingest(vehicle).await else { continue };
            while ingester.send(Observation::scan("top", now_ns(), &x, &y, &z)).await.is_ok() {
                every.tick().await;
            }
        }
    });
    futures::future::join_all(feeds).await;
}

/// Follows every vehicle; ends with its standard input.
async fn read(endpoints: &str, vehicles: &str) {
    let client = loop {
        match ZenohClient::connect(endpoints).await {
            Ok(client) => break client,
            Err(_) => tokio::time::sleep(Duration::from_millis(100)).await,
        }
    };
    let streams = vehicles.split(',').map(|vehicle| {
        let client = client.clone();
        async move {
            let (mut was_fresh, mut run) = (false, 0);
            let mut maps = client.subscribe(vehicle, "drivability").await.expect("a subscription");
            while let Ok(event) = maps.next_or_stale().await {
                let (is_fresh, update) = match event {
                    StreamEvent::Fresh(update) => (true, update),
                    StreamEvent::Stale(update) => (false, update),
                };
                let boot_id = update.map.header().boot_id;
                if boot_id != run {
                    println!("{vehicle} run {boot_id}");
                    run = boot_id;
                }
                if is_fresh != was_fresh {
                    println!("{vehicle} {}", if is_fresh { "fresh" } else { "stale" });
                    was_fresh = is_fresh;
                }
            }
        }
    });
    futures::future::join_all(streams).await;
}

/// The router of `deploy/`, in plain text and without access control.
async fn route(others: &str) {
    let file = clearway_tests::workspace().join("deploy/zenoh/router.json5");
    let text = std::fs::read_to_string(file).expect("a file of the repository");
    let text = text.replace("tls/0.0.0.0:7447", "tcp/0.0.0.0:7447");
    let mut config = zenoh::Config::from_json5(&text).expect("a configuration");
    config.insert_json5("access_control/enabled", "false").expect("a setting of zenoh");
    let others: Vec<_> = others.split(',').collect();
    config.insert_json5("connect/endpoints", &format!("{others:?}")).expect("a setting of zenoh");
    config.insert_json5("connect/timeout_ms", "0").expect("a setting of zenoh");
    let _router = zenoh::open(config).await.expect("the port is free");
    std::future::pending::<()>().await;
}

/// What one stream has shown.
#[derive(Clone, Debug, Default)]
struct Shown {
    is_fresh: bool,
    since: Option<Instant>,
    /// Periods in which it was stale.
    stale: Vec<(Instant, Instant)>,
    runs: Vec<u64>,
}

type Streams = Arc<Mutex<BTreeMap<(&'static str, String), Shown>>>;

/// A process in the namespace of a machine; it is killed at the end.
struct Process(Child);

impl Process {
    fn start(machine: &str, program: &Path, arguments: &[&str]) -> Self {
        let mut command = Command::new("ip");
        command.args(["netns", "exec", machine]).arg(program).args(arguments).stderr(Stdio::null());
        Self(command.stdin(Stdio::null()).stdout(Stdio::piped()).spawn().expect("ip is installed"))
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        let _ended = self.0.kill();
        let _reaped = self.0.wait();
    }
}

/// The links between the machines.
struct Hub {
    process: Child,
    rules: Option<ChildStdin>,
}

impl Hub {
    fn start() -> Self {
        let script = clearway_tests::workspace().join("tests/python/hub.py");
        let mut command = Command::new("python3");
        command.arg(script).args(HOSTS.split(' ')).stdin(Stdio::piped()).stdout(Stdio::piped());
        let mut process = command.spawn().expect("python3 is installed");
        let mut line = String::new();
        BufReader::new(process.stdout.take().expect("piped")).read_line(&mut line).expect("the hub lives");
        assert_eq!(line.trim(), "ready", "the hub needs root, /dev/net/tun and ip");
        Self { rules: process.stdin.take(), process }
    }

    fn link(&mut self, first: &str, second: &str, delay_ms: u32, loss: f64) {
        let rules = self.rules.as_mut().expect("it is taken at the end");
        writeln!(rules, "{first} {second} {delay_ms} {loss}").and_then(|()| rules.flush()).expect("the hub lives");
    }
}

impl Drop for Hub {
    fn drop(&mut self) {
        drop(self.rules.take());
        let _ended = self.process.wait();
    }
}

/// Follows the lines of a reader.
fn follow(planner: &'static str, process: &mut Process, streams: &Streams) {
    let (lines, streams) = (BufReader::new(process.0.stdout.take().expect("piped")), streams.clone());
    std::thread::spawn(move || {
        for line in lines.lines().map_while(Result::ok) {
            let mut words = line.split(' ');
            let (Some(vehicle), Some(what), run) = (words.next(), words.next(), words.next()) else { continue };
            let (mut streams, now) = (streams.lock().expect("no panic"), Instant::now());
            let shown = streams.entry((planner, vehicle.to_owned())).or_default();
            match what {
                "run" => shown.runs.extend(run.and_then(|run| run.parse::<u64>().ok())),
                "fresh" => {
                    if let Some(since) = shown.since.replace(now) {
                        shown.stale.push((since, now));
                    }
                    shown.is_fresh = true;
                }
                _ => (shown.is_fresh, shown.since) = (false, Some(now)),
            }
        }
    });
}

/// The run: what is started, and what the streams show.
struct Bed {
    own: PathBuf,
    server: PathBuf,
    folder: tempfile::TempDir,
    hub: Hub,
    processes: BTreeMap<String, Process>,
    streams: Streams,
    seconds: f64,
}

impl Bed {
    fn start(&mut self, name: &str, machine: &str, arguments: &[&str]) {
        let process = Process::start(machine, &self.own.clone(), arguments);
        self.processes.insert(name.into(), process);
    }

    fn start_router(&mut self, index: usize) {
        self.start(["r1", "r2"][index], ["r1", "r2"][index], &["router", ROUTERS[1 - index]]);
    }

    /// Starts the server of this machine with these vehicles.
    fn start_server(&mut self, machine: &str, vehicles: &[String]) {
        let mut config = Config::of_one_vehicle(CLAIMED, "top");
        let vehicle = config.vehicles.remove(0);
        config.vehicles =
            vehicles.iter().map(|name| clearway::config::Vehicle { name: name.clone(), ..vehicle.clone() }).collect();
        config.vehicles.iter_mut().for_each(|vehicle| vehicle.udp = None);
        config.page.enabled = false;
        config.zenoh.mode = ZenohMode::Client;
        (config.zenoh.listen, config.zenoh.connect) = (Vec::new(), ROUTERS.map(str::to_owned).to_vec());
        let file = self.folder.path().join(format!("{machine}.toml"));
        std::fs::write(&file, config.to_toml()).expect("a file of ours");
        let arguments = ["serve", "--config", file.to_str().expect("UTF-8")];
        let process = Process::start(machine, &self.server.clone(), &arguments);
        self.processes.insert(machine.into(), process);
    }

    /// Waits until every stream is fresh; the time that it took.
    fn whole(&self) -> Option<Duration> {
        let (began, streams) = (Instant::now(), 2 * VEHICLES[2].end);
        loop {
            let shown = self.streams.lock().expect("no panic");
            if shown.len() == streams && shown.values().all(|shown| shown.is_fresh) {
                return Some(began.elapsed());
            }
            drop(shown);
            if began.elapsed() > PATIENCE {
                return None;
            }
            std::thread::sleep(Duration::from_millis(5));
        }
    }

    /// Makes a fault, waits, repairs it, and prints the line of the table.
    fn fault(
        &mut self,
        name: &str,
        concerned: &[String],
        make: impl FnOnce(&mut Self),
        repair: impl FnOnce(&mut Self),
    ) {
        let runs =
            |bed: &Self| bed.streams.lock().expect("no panic").values().map(|shown| shown.runs.len()).sum::<usize>();
        let (began, runs_before) = (Instant::now(), runs(self));
        make(self);
        std::thread::sleep(Duration::from_secs_f64(self.seconds));
        repair(self);
        let repaired = Instant::now();
        let whole = self.whole();
        let concerned: BTreeSet<_> = concerned.iter().collect();
        let (mut stale, mut longest) = ([0; 2], Duration::ZERO);
        for ((_, vehicle), shown) in &*self.streams.lock().expect("no panic") {
            let is_concerned = concerned.contains(vehicle);
            let periods = shown.stale.iter().copied().filter(|(_, end)| *end > began);
            let open = shown.since.filter(|_| !shown.is_fresh).map(|since| (since, repaired));
            let mut was_stale = false;
            for (from, to) in periods.chain(open).filter(|(from, _)| *from < repaired) {
                was_stale = true;
                if !is_concerned {
                    longest = longest.max(to.saturating_duration_since(from));
                }
            }
            stale[usize::from(!is_concerned)] += u32::from(was_stale);
        }
        let whole =
            whole.map_or(format!("not in {} s", PATIENCE.as_secs()), |whole| format!("{:.2}", whole.as_secs_f64()));
        println!(
            "| {name} | {} of {} | {} of {} | {:.2} | {whole} | {} |",
            stale[0],
            2 * concerned.len(),
            stale[1],
            2 * (VEHICLES[2].end - concerned.len()),
            longest.as_secs_f64(),
            runs(self) - runs_before
        );
        // What follows begins with a whole fleet that has been whole for a while.
        std::thread::sleep(Duration::from_secs(2));
    }
}

fn run(arguments: &Arguments) -> ExitCode {
    let own = std::env::current_exe().expect("the path of this binary");
    let server = arguments.server.clone().unwrap_or_else(|| own.with_file_name("clearway"));
    let folder = tempfile::tempdir().expect("a folder");
    let (hub, processes, streams) = (Hub::start(), BTreeMap::new(), Streams::default());
    let mut bed = Bed { own, server, folder, hub, processes, streams, seconds: arguments.seconds };
    let of: Vec<_> = VEHICLES.into_iter().map(names).collect();
    (0..2).for_each(|index| bed.start_router(index));
    for (machine, vehicles) in ["s1", "s2", "s3"].into_iter().zip(&of) {
        bed.start_server(machine, vehicles);
        bed.start(&format!("{machine} feed"), machine, &["feed", &vehicles.join(",")]);
    }
    let all = names(0..VEHICLES[2].end).join(",");
    for (planner, endpoints) in [("p1", ROUTERS.join(",")), ("p2", [ROUTERS[1], ROUTERS[0]].join(","))] {
        let mut process = Process::start(planner, &bed.own, &["read", &endpoints, &all]);
        follow(planner, &mut process, &bed.streams);
        bed.processes.insert(planner.into(), process);
    }
    let Some(whole) = bed.whole() else {
        eprintln!("not every stream is fresh after {PATIENCE:?}: {:?}", bed.streams.lock().expect("no panic").len());
        return ExitCode::FAILURE;
    };
    eprintln!("whole after {whole:?}");
    println!(
        "| fault, {} s each | streams of its vehicles that went STALE | of the others | longest of the others, s \
         | all fresh after the repair, s | streams with another run |\n|---|---:|---:|---:|---:|---:|",
        bed.seconds
    );
    faults(&mut bed, &of);
    ExitCode::SUCCESS
}

fn faults(bed: &mut Bed, of: &[Vec<String>]) {
    let cut = |bed: &mut Bed, loss| ["r1", "r2"].iter().for_each(|router| bed.hub.link("s1", router, 0, loss));
    bed.fault("none", &[], |_| {}, |_| {});
    bed.fault("the links of s1 are cut", &of[0], |bed| cut(bed, 1.0), |bed| cut(bed, 0.0));
    bed.fault(
        "the link of s1 to r1 is cut",
        &of[0],
        |bed| bed.hub.link("s1", "r1", 0, 1.0),
        |bed| bed.hub.link("s1", "r1", 0, 0.0),
    );
    bed.fault(
        "the link between the routers is cut",
        &[],
        |bed| bed.hub.link("r1", "r2", 0, 1.0),
        |bed| bed.hub.link("r1", "r2", 0, 0.0),
    );
    let slow = |bed: &mut Bed, delay_ms, loss| {
        ["r1", "r2"].iter().for_each(|router| bed.hub.link("s2", router, delay_ms, loss))
    };
    bed.fault("300 ms and 5 % loss at s2", &of[1], |bed| slow(bed, 300, 0.05), |bed| slow(bed, 0, 0.0));
    bed.fault("r1 restarts", &[], |bed| drop(bed.processes.remove("r1")), |bed| bed.start_router(0));
    let moved = of[2].clone();
    bed.fault(
        "s3 restarts at another address",
        &of[2],
        |bed| drop(bed.processes.remove("s3")),
        |bed| {
            let status =
                Command::new("ip").args(["-n", "s3", "address", "delete", "10.99.0.13/24", "dev", "wire"]).status();
            assert!(status.expect("ip runs").success());
            bed.start_server("s3", &moved);
        },
    );
    let claimed = [CLAIMED.to_owned()];
    bed.fault(
        "another server claims v00",
        &[],
        |bed| {
            bed.start_server("p2", &claimed);
            bed.start("p2 feed", "p2", &["feed", CLAIMED]);
        },
        |bed| ["p2 feed", "p2"].into_iter().for_each(|name| drop(bed.processes.remove(name))),
    );
}
