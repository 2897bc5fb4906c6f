//! Faults between machines: three servers, two routers, vehicles and two planners, each machine in a network namespace
//! of its own, with IP links between them that are cut, slowed and repaired. It needs root.
//!
//!   cargo run --release -p clearway-tests --bin machines
//!   cargo run --release -p clearway-tests --bin machines -- --faults cut,clock-behind --seconds 3
//!
//! Each planner reads every vehicle over zenoh, at both routers at once. For each fault the table has how many streams
//! went STALE while it lasted, counted apart for the streams that it concerns and for the other streams; how long the
//! longest other stream was STALE; the time from the repair until every stream was fresh again; how many streams had
//! maps of another run of a server than before; and why the concerned streams said they were stale, with their number.
//!
//! `--uplink`: the thin uplink of a vehicle instead (`uplink.rs`).
//!
//! A clock is set by libfaketime (Debian: `apt-get install faketime`) for the processes of one machine.

mod uplink;

use std::collections::{BTreeMap, BTreeSet};
use std::io::{BufRead, BufReader};
use std::path::PathBuf;
use std::process::{Command, ExitCode};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use clap::Parser;
use clearway_tests::machines::{Machines, ROUTERS, namespace};
use clearway_tests::roles::{Process, Role, name, server_config};

/// Faults between machines.
#[derive(Parser)]
struct MachinesArguments {
    #[command(subcommand)]
    role: Option<Role>,
    /// Time for which each fault lasts, in seconds.
    #[arg(long, default_value_t = 8.0)]
    seconds: f64,
    /// Number of vehicles, shared by the three servers.
    #[arg(long, default_value_t = 20)]
    vehicles: usize,
    /// Validity of a map, in ms.
    #[arg(long, default_value_t = 300)]
    valid_ms: u32,
    /// The faults that are made; all by default.
    #[arg(long, value_delimiter = ',')]
    faults: Vec<String>,
    /// The thin uplink of a vehicle instead of the faults.
    #[arg(long)]
    uplink: bool,
    /// For `--uplink`: an interpreter with the package `moto`, whose server is the store.
    #[arg(long, default_value = "python3")]
    python: PathBuf,
    /// The server's binary; by default `clearway` beside this one.
    #[arg(long)]
    server: Option<PathBuf>,
}

const SERVERS: [&str; 3] = ["s1", "s2", "s3"];
const PLANNERS: [&str; 2] = ["p1", "p2"];
/// The vehicle that two servers claim for a while.
const CLAIMED: &str = "v00";
/// Longest wait for the fleet to be whole.
const PATIENCE: Duration = Duration::from_secs(60);
/// Time for which a fleet is whole before the next fault.
const CALM: Duration = Duration::from_secs(2);

fn main() -> ExitCode {
    let arguments = MachinesArguments::parse();
    match &arguments.role {
        Some(role) => role.run(),
        None if arguments.uplink => return uplink::run(&arguments),
        None => return run(&arguments),
    }
    ExitCode::SUCCESS
}

/// What one stream has shown.
#[derive(Clone, Debug, Default)]
struct Shown {
    is_fresh: bool,
    since: Option<Instant>,
    /// Periods in which it was stale.
    stale: Vec<(Instant, Instant)>,
    runs: Vec<u64>,
    /// Why it said that it was stale, and when.
    said: Vec<(Instant, String)>,
}

type Streams = Arc<Mutex<BTreeMap<(&'static str, String), Shown>>>;

/// Follows the lines of a reader. A reader that has ended has no fresh map.
fn follow(planner: &'static str, process: &mut Process, streams: &Streams) {
    let (lines, streams) = (BufReader::new(process.0.stdout.take().expect("piped")), streams.clone());
    std::thread::spawn(move || {
        for line in lines.lines().map_while(Result::ok) {
            let mut words = line.split(' ');
            let (Some(vehicle), Some(what), more) = (words.next(), words.next(), words.next()) else { continue };
            let (mut streams, now) = (streams.lock().expect("no panic"), Instant::now());
            let shown = streams.entry((planner, vehicle.to_owned())).or_default();
            match what {
                "run" => shown.runs.extend(more.and_then(|run| run.parse::<u64>().ok())),
                "fresh" => {
                    if let Some(since) = shown.since.take() {
                        shown.stale.push((since, now));
                    }
                    shown.is_fresh = true;
                }
                _ => {
                    shown.said.extend(more.map(|why| (now, why.to_owned())));
                    shown.end(now);
                }
            }
        }
        let mut streams = streams.lock().expect("no panic");
        let of_planner = streams.iter_mut().filter(|((of, _), _)| *of == planner);
        of_planner.for_each(|(_, shown)| shown.end(Instant::now()));
    });
}

impl Shown {
    fn end(&mut self, now: Instant) {
        self.is_fresh = false;
        self.since.get_or_insert(now);
    }
}

/// True if a fault concerns the stream of a planner and a vehicle.
type Concerns = fn(&Bed, &str, &str) -> bool;

/// A fault: its name for `--faults`, what the table calls it, the streams it concerns, how it is made and repaired.
struct Fault {
    name: &'static str,
    title: &'static str,
    concerns: Concerns,
    make: fn(&mut Bed),
    repair: fn(&mut Bed),
}

/// The run: what is started, and what the streams show.
struct Bed {
    machines: Machines,
    streams: Streams,
    /// The vehicles of each server.
    vehicles: [Vec<String>; 3],
    seconds: f64,
    valid_ms: u32,
}

impl Bed {
    /// Starts the server of this machine with these vehicles.
    fn start_server(&mut self, machine: &str, clock: &str, vehicles: &[String]) {
        let mut config = server_config(vehicles, &ROUTERS.map(str::to_owned));
        config.vehicles.iter_mut().for_each(|vehicle| vehicle.maps.valid_ms = self.valid_ms);
        self.machines.start_server(machine, clock, &config, &[]);
    }

    /// Changes the links of a server or planner to both routers.
    fn links(&mut self, machine: &str, delay_ms: u32, loss: f64) {
        ["r1", "r2"].iter().for_each(|router| self.machines.link(machine, router, delay_ms, loss));
    }

    /// Starts a server with its vehicles, and the sender of their scans.
    fn start_vehicles(&mut self, index: usize, clock: &str) {
        let (machine, vehicles) = (SERVERS[index], self.vehicles[index].clone());
        self.start_server(machine, clock, &vehicles);
        self.machines.start_role(&format!("{machine} feed"), machine, clock, &["feed", &vehicles.join(",")]);
    }

    fn start_planner(&mut self, index: usize, clock: &str) {
        let (planner, all) = (PLANNERS[index], self.vehicles.concat().join(","));
        let endpoints = [ROUTERS[index], ROUTERS[1 - index]].join("+");
        let process = self.machines.start_role(planner, planner, clock, &["read", &endpoints, &all]);
        follow(planner, process, &self.streams);
    }

    /// Waits until every stream is fresh; the time that it took.
    fn whole(&self) -> Option<Duration> {
        let (began, streams) = (Instant::now(), PLANNERS.len() * self.vehicles.concat().len());
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
    fn suffer(&mut self, fault: &Fault) {
        let runs =
            |bed: &Self| bed.streams.lock().expect("no panic").values().map(|shown| shown.runs.len()).sum::<usize>();
        let (began, runs_before) = (Instant::now(), runs(self));
        (fault.make)(self);
        std::thread::sleep(Duration::from_secs_f64(self.seconds));
        (fault.repair)(self);
        let repaired = Instant::now();
        let whole = self.whole();
        let (mut streams, mut stale, mut longest, mut said) = ([0; 2], [0; 2], Duration::ZERO, BTreeMap::new());
        for ((planner, vehicle), shown) in &*self.streams.lock().expect("no panic") {
            let is_other = !(fault.concerns)(self, planner, vehicle);
            let open = shown.since.map(|since| (since, repaired));
            let periods = shown.stale.iter().copied().filter(|(_, end)| *end > began).chain(open);
            let periods: Vec<_> = periods.filter(|(from, _)| *from < repaired).collect();
            streams[usize::from(is_other)] += 1;
            stale[usize::from(is_other)] += usize::from(!periods.is_empty());
            if is_other {
                let longest_of_stream = periods.iter().map(|(from, to)| to.saturating_duration_since(*from)).max();
                longest = longest.max(longest_of_stream.unwrap_or_default());
            } else {
                let of_fault = shown.said.iter().filter(|(at, _)| (began..repaired).contains(at));
                let why: BTreeSet<_> = of_fault.map(|(_, why)| why.clone()).collect();
                why.into_iter().for_each(|why| *said.entry(why).or_insert(0) += 1);
            }
        }
        let whole =
            whole.map_or(format!("not in {} s", PATIENCE.as_secs()), |whole| format!("{:.2}", whole.as_secs_f64()));
        let said: Vec<_> = said.into_iter().map(|(why, streams)| format!("{why} {streams}")).collect();
        println!(
            "| {} | {} of {} | {} of {} | {:.2} | {whole} | {} | {} |",
            fault.title,
            stale[0],
            streams[0],
            stale[1],
            streams[1],
            longest.as_secs_f64(),
            runs(self) - runs_before,
            said.join(", ")
        );
        std::thread::sleep(CALM);
    }
}

fn run(arguments: &MachinesArguments) -> ExitCode {
    let (all, asked) = (faults(), &arguments.faults);
    if let Some(unknown) = asked.iter().find(|name| all.iter().all(|fault| fault.name != **name)) {
        let known: Vec<_> = all.iter().map(|fault| fault.name).collect();
        eprintln!("no fault is named {unknown:?}; known: {}", known.join(", "));
        return ExitCode::FAILURE;
    }
    let faults: Vec<_> =
        all.into_iter().filter(|fault| asked.is_empty() || asked.iter().any(|name| name == fault.name)).collect();
    let (machines, streams) = (Machines::start(arguments.server.as_ref()), Streams::default());
    let share = arguments.vehicles.div_ceil(3);
    let vehicles =
        [0, 1, 2].map(|index| (index * share..((index + 1) * share).min(arguments.vehicles)).map(name).collect());
    let (seconds, valid_ms) = (arguments.seconds, arguments.valid_ms);
    let mut bed = Bed { machines, streams, vehicles, seconds, valid_ms };
    (0..2).for_each(|index| bed.machines.start_router(index));
    (0..3).for_each(|index| bed.start_vehicles(index, ""));
    (0..2).for_each(|index| bed.start_planner(index, ""));
    let Some(whole) = bed.whole() else {
        eprintln!("not every stream is fresh after {PATIENCE:?}: {:?}", bed.streams.lock().expect("no panic").len());
        return ExitCode::FAILURE;
    };
    eprintln!("whole after {whole:?}");
    println!(
        "| fault, {} s each | streams it concerns that went STALE | of the others | longest of the others, s \
         | all fresh after the repair, s | streams with another run | said by those it concerns |\n\
         |---|---:|---:|---:|---:|---:|---|",
        bed.seconds
    );
    std::thread::sleep(CALM);
    faults.iter().for_each(|fault| bed.suffer(fault));
    ExitCode::SUCCESS
}

fn faults() -> Vec<Fault> {
    let fault = |name, title, concerns, make, repair| Fault { name, title, concerns, make, repair };
    let no_stream: Concerns = |_, _, _| false;
    let of_p1: Concerns = |_, planner, _| planner == "p1";
    let of: [Concerns; 3] = [
        |bed, _, vehicle| bed.vehicles[0].iter().any(|name| name == vehicle),
        |bed, _, vehicle| bed.vehicles[1].iter().any(|name| name == vehicle),
        |bed, _, vehicle| bed.vehicles[2].iter().any(|name| name == vehicle),
    ];
    vec![
        fault("none", "none", no_stream, |_| {}, |_| {}),
        fault("cut", "the links of s1 are cut", of[0], |bed| bed.links("s1", 0, 1.0), |bed| bed.links("s1", 0, 0.0)),
        fault(
            "cut-one",
            "the link of s1 to r1 is cut",
            of[0],
            |bed| bed.machines.link("s1", "r1", 0, 1.0),
            |bed| bed.machines.link("s1", "r1", 0, 0.0),
        ),
        fault(
            "cut-planner",
            "the links of p2 are cut",
            |_, planner, _| planner == "p2",
            |bed| bed.links("p2", 0, 1.0),
            |bed| bed.links("p2", 0, 0.0),
        ),
        fault(
            "cut-routers",
            "the link between the routers is cut",
            no_stream,
            |bed| bed.machines.link("r1", "r2", 0, 1.0),
            |bed| bed.machines.link("r1", "r2", 0, 0.0),
        ),
        fault(
            "slow",
            "300 ms and 5 % loss at s2",
            of[1],
            |bed| bed.links("s2", 300, 0.05),
            |bed| bed.links("s2", 0, 0.0),
        ),
        fault("router", "r1 restarts", no_stream, |bed| bed.machines.stop(&["r1"]), |bed| bed.machines.start_router(0)),
        fault(
            "moved",
            "s3 restarts at another address",
            of[2],
            |bed| bed.machines.stop(&["s3 server"]),
            |bed| {
                let s3 = namespace("s3");
                let arguments = ["-n", &s3, "address", "delete", "10.99.0.13/24", "dev", "wire"];
                assert!(Command::new("ip").args(arguments).status().expect("ip runs").success());
                bed.start_server("s3", "", &bed.vehicles[2].clone());
            },
        ),
        fault(
            "claimed",
            "another server claims v00",
            no_stream,
            |bed| {
                bed.start_server("p2", "", &[CLAIMED.to_owned()]);
                bed.machines.start_role("p2 feed", "p2", "", &["feed", CLAIMED]);
            },
            |bed| bed.machines.stop(&["p2 feed", "p2 server"]),
        ),
        fault("server-behind", "the clock of s2 is 2 s behind", of[1], clock_of_s2::<-2>, clock_of_s2::<0>),
        fault("server-ahead", "the clock of s2 is 2 s ahead", of[1], clock_of_s2::<2>, clock_of_s2::<0>),
        fault("planner-behind", "the clock of p1 is 2 s behind", of_p1, clock_of_p1::<-2>, clock_of_p1::<0>),
        fault("planner-ahead", "the clock of p1 is 2 s ahead", of_p1, clock_of_p1::<2>, clock_of_p1::<0>),
    ]
}

/// Starts the server of s2 and its feed again, with a clock that is so many seconds ahead.
fn clock_of_s2<const AHEAD_S: i32>(bed: &mut Bed) {
    bed.start_vehicles(1, &clock(AHEAD_S));
}

/// Starts the reader of p1 again, with a clock that is so many seconds ahead.
fn clock_of_p1<const AHEAD_S: i32>(bed: &mut Bed) {
    bed.start_planner(0, &clock(AHEAD_S));
}

/// The clock as libfaketime takes it; empty for the machine's own.
fn clock(ahead_s: i32) -> String {
    if ahead_s == 0 { String::new() } else { format!("{ahead_s:+}s") }
}
