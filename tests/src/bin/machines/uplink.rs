//! A vehicle's server behind a thin uplink: what its readers at two routers see while the uplink has one rate after the
//! other, and how its recording reaches a store after the uplink was cut.
//!
//! The server of the vehicle v00 is s1, with the limited uplink; v01 is at s2, without a limit. The planners p1 and p2,
//! at a router each, read one layer of both over zenoh; the planner `deltas`, on p2, reads v00 over gRPC with deltas. The
//! counter of s1's interface says what the uplink carries, with all headers.

use std::collections::{BTreeMap, BTreeSet};
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use clearway_tests::machines::{Machines, ROUTERS, command, sent_bytes};
use clearway_tests::roles::{Process, server_config};

use crate::Arguments;

const VEHICLE: &str = "v00";
const OTHER: &str = "v01";
const LAYER: &str = "drivability";
const S3: &str = "10.99.0.31:9000";
const STORE: &str = "s3://fleet/kept";
/// Longest wait for fresh maps, and for the store to have every part.
const PATIENCE: Duration = Duration::from_secs(90);

/// One line of a reader.
struct Shown {
    at: Instant,
    /// `fresh`, or why the newest map is stale.
    why: String,
    age_ms: f64,
    bytes: usize,
    is_delta: bool,
}

impl Shown {
    /// False if a map of an earlier line became stale.
    fn is_map(&self) -> bool {
        self.why != "no-newer"
    }
}

/// The lines of each reader and vehicle.
type Seen = Arc<Mutex<BTreeMap<(&'static str, String), Vec<Shown>>>>;

fn follow(reader: &'static str, process: &mut Process, seen: &Seen) {
    let (lines, seen) = (BufReader::new(process.0.stdout.take().expect("piped")), seen.clone());
    std::thread::spawn(move || {
        for line in lines.lines().map_while(Result::ok) {
            let words: Vec<_> = line.split(' ').collect();
            let [vehicle, why, age_ms, bytes, kind] = words[..] else { continue };
            let (Ok(age_ms), Ok(bytes)) = (age_ms.parse(), bytes.parse()) else { continue };
            let shown = Shown { at: Instant::now(), why: why.into(), age_ms, bytes, is_delta: kind == "delta" };
            seen.lock().expect("no panic").entry((reader, vehicle.to_owned())).or_default().push(shown);
        }
    });
}

/// A row of the table: the rate of the uplink, 0 for none, and who reads.
struct Phase {
    kbit_s: u32,
    readers: &'static [&'static str],
}

const PHASES: [Phase; 8] = [
    Phase { kbit_s: 0, readers: &[] },
    Phase { kbit_s: 1000, readers: &[] },
    Phase { kbit_s: 1000, readers: &["p1"] },
    Phase { kbit_s: 1000, readers: &["p1", "p2"] },
    Phase { kbit_s: 200, readers: &["p1", "p2"] },
    Phase { kbit_s: 1000, readers: &["p1", "p2"] },
    Phase { kbit_s: 200, readers: &["deltas"] },
    Phase { kbit_s: 1000, readers: &["deltas"] },
];

struct Bed {
    machines: Machines,
    seen: Seen,
    valid_ms: u32,
    /// An interpreter with the package `moto`.
    python: PathBuf,
}

/// Runs all phases, then the recording.
pub fn run(arguments: &Arguments) -> ExitCode {
    let (machines, seen) = (Machines::start(arguments.server.as_ref()), Seen::default());
    let mut bed = Bed { machines, seen, valid_ms: arguments.valid_ms, python: arguments.python.clone() };
    (0..2).for_each(|index| bed.machines.start_router(index));
    for (machine, vehicle) in [("s1", VEHICLE), ("s2", OTHER)] {
        bed.start_server(machine, vehicle, &[]);
        bed.machines.start_role(&format!("{machine} feed"), machine, "", &["feed", vehicle, "--rough"]);
    }
    println!(
        "| uplink, kbit/s | reader | of | maps/s | kB a map | deltas, % | age, ms: median, most | fresh, % of the time \
         | uplink carried, kbit/s | said |\n|---:|---|---|---:|---:|---:|---:|---:|---:|---|"
    );
    let length = Duration::from_secs_f64(arguments.seconds);
    let is_whole = PHASES.iter().all(|phase| bed.measure(phase, length)) && bed.record(length);
    if is_whole { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}

impl Bed {
    fn start_server(&mut self, machine: &str, vehicle: &str, recording: &[(&str, &str)]) {
        let mut config = server_config(&[vehicle.to_owned()], &ROUTERS.map(str::to_owned));
        config.vehicles[0].maps.valid_ms = self.valid_ms;
        config.grpc.listen = ([0, 0, 0, 0], 50051).into();
        if !recording.is_empty() {
            config.recorder.file = self.recording().join("car.mcap");
            (config.recorder.part_s, config.recorder.save_s) = (2, 1);
            (config.store.url, config.store.delete) = (STORE.into(), true);
        }
        self.machines.start_server(machine, "", &config, recording);
    }

    fn recording(&self) -> PathBuf {
        self.machines.folder.path().join("recording")
    }

    /// Starts the readers that are missing, and ends the others.
    fn read(&mut self, readers: &[&'static str]) {
        for (reader, machine, endpoints) in [
            ("p1", "p1", ROUTERS[0]),
            ("p2", "p2", ROUTERS[1]),
            ("deltas", "p2", "grpc:10.99.0.11:50051"),
        ] {
            if !readers.contains(&reader) {
                self.machines.stop(&[reader]);
            } else if !self.machines.processes.contains_key(reader) {
                let vehicles = if reader == "deltas" { VEHICLE.to_owned() } else { [VEHICLE, OTHER].join(",") };
                let process = self.machines.start_role(reader, machine, "", &["ages", endpoints, &vehicles, LAYER]);
                follow(reader, process, &self.seen);
            }
        }
    }

    /// Waits until every reader has had a fresh map of the vehicle after `since`; the time from then.
    fn fresh(&self, readers: &[&'static str], since: Instant) -> Option<Duration> {
        while since.elapsed() < PATIENCE {
            let seen = self.seen.lock().expect("no panic");
            let first = |reader: &&'static str| {
                let lines = seen.get(&(*reader, VEHICLE.to_owned()))?;
                lines.iter().find(|shown| shown.at > since && shown.why == "fresh").map(|shown| shown.at)
            };
            if let Some(all) = readers.iter().map(first).collect::<Option<Vec<_>>>() {
                return Some(all.into_iter().max().map_or(Duration::ZERO, |last| last.duration_since(since)));
            }
            drop(seen);
            std::thread::sleep(Duration::from_millis(5));
        }
        None
    }

    /// Sets the rate and the readers, waits, and prints a row for each of their streams. Returns false if no map is
    /// fresh.
    fn measure(&mut self, phase: &Phase, length: Duration) -> bool {
        let is_new = !phase.readers.iter().all(|reader| self.machines.processes.contains_key(*reader));
        self.machines.limit("s1", phase.kbit_s);
        let began = Instant::now();
        self.read(phase.readers);
        let Some(fresh) = self.fresh(phase.readers, began) else {
            eprintln!("no fresh map after {PATIENCE:?}");
            return false;
        };
        eprintln!("{} kbit/s, {:?}: fresh after {:.2} s", phase.kbit_s, phase.readers, fresh.as_secs_f64());
        // What travels while servers and readers start is not counted.
        let from = if phase.readers.is_empty() || is_new {
            std::thread::sleep(Duration::from_secs(2));
            Instant::now()
        } else {
            began
        };
        let bytes = sent_bytes("s1");
        std::thread::sleep(length.saturating_sub(from.elapsed()));
        let carried = (sent_bytes("s1") - bytes) as f64 * 8e-3 / from.elapsed().as_secs_f64();
        let rate = if phase.kbit_s == 0 { "no limit".to_owned() } else { phase.kbit_s.to_string() };
        if phase.readers.is_empty() {
            println!("| {rate} | nobody |  |  |  |  |  |  | {carried:.0} |  |");
        }
        for ((reader, vehicle), lines) in &*self.seen.lock().expect("no panic") {
            if phase.readers.contains(reader) {
                println!("| {rate} | {reader} | {vehicle} | {} | {carried:.0} | {} |", figures(lines, from), said(lines, from));
            }
        }
        true
    }

    /// Records, cuts the uplink while parts finish, repairs it, and prints what the store has.
    fn record(&mut self, length: Duration) -> bool {
        std::fs::create_dir_all(self.recording()).expect("a folder of ours");
        let script = clearway_tests::workspace().join("tests/python/s3_server.py");
        let arguments = ["-B", script.to_str().expect("UTF-8"), S3];
        let mut server = command("w1", "", &self.python, &arguments);
        let url = line(self.machines.start_command("store", server.stdin(std::process::Stdio::piped())));
        let keys = [("AWS_ACCESS_KEY_ID", "test"), ("AWS_SECRET_ACCESS_KEY", "test"), ("AWS_REGION", "us-east-1")];
        let variables = [&[("AWS_ENDPOINT_URL", &*url)][..], &keys].concat();
        self.start_server("s1", VEHICLE, &variables);
        self.read(&["p1"]);
        if self.fresh(&["p1"], Instant::now()).is_none() {
            return false;
        }
        std::thread::sleep(length);
        self.cut(1.0);
        let before = parts(&self.recording());
        std::thread::sleep(length);
        let after = parts(&self.recording());
        let deleted = before.difference(&after).count();
        let wanted: BTreeMap<_, _> = after.iter().map(|part| (part.clone(), crc(part))).collect();
        self.cut(0.0);
        let repaired = Instant::now();
        let fresh = self.fresh(&["p1"], repaired);
        // The newest of them may still be written.
        let is_done = || parts(&self.recording()).is_disjoint(&after);
        while !is_done() && repaired.elapsed() < PATIENCE {
            std::thread::sleep(Duration::from_millis(100));
        }
        let caught_up = repaired.elapsed();
        let verified = self.machines.run("w1", &["verify", STORE], &variables);
        let listed = self.machines.run("w1", &["recordings", "--store", STORE, "--json"], &variables);
        let listed = String::from_utf8_lossy(&listed.stdout).into_owned();
        let stored = wanted.values().filter(|crc| listed.contains(&format!("-{crc:08x}.mcap"))).count();
        println!(
            "\n| parts on the disk when the uplink was cut | when it was repaired | deleted while it was cut | maps fresh \
             after the repair, s | all parts of the cut confirmed, s | in the store by their CRC | `clearway verify` |\n\
             |---:|---:|---:|---:|---:|---:|---:|\n| {} | {} | {deleted} | {:.2} | {:.1} | {stored} of {} | exit {:?} |",
            before.len(),
            after.len(),
            fresh.map_or(f64::INFINITY, |fresh| fresh.as_secs_f64()),
            caught_up.as_secs_f64(),
            wanted.len(),
            verified.status.code()
        );
        let lines = &self.seen.lock().expect("no panic")[&("p1", VEHICLE.to_owned())];
        println!("\nMaps at p1 from the repair until then: | {} | {} |", figures(lines, repaired), said(lines, repaired));
        true
    }

    fn cut(&mut self, loss: f64) {
        ["r1", "r2", "w1"].iter().for_each(|other| self.machines.link("s1", other, 0, loss));
    }
}

/// The first line that a process prints.
fn line(process: &mut Process) -> String {
    let mut line = String::new();
    BufReader::new(process.0.stdout.take().expect("piped")).read_line(&mut line).expect("it lives");
    line.trim().to_owned()
}

/// The parts of a recording on the disk.
fn parts(folder: &Path) -> BTreeSet<PathBuf> {
    let files = std::fs::read_dir(folder).expect("a folder of ours").flatten().map(|file| file.path());
    files.filter(|file| file.extension().is_some_and(|extension| extension == "mcap")).collect()
}

fn crc(file: &Path) -> u32 {
    std::fs::read(file).map_or(0, |bytes| crc32fast::hash(&bytes))
}

/// Cells of the table from the lines of a stream since then: maps/s, kB a map, deltas, ages, the time it was fresh.
fn figures(lines: &[Shown], from: Instant) -> String {
    let now = Instant::now();
    let maps: Vec<_> = lines.iter().filter(|shown| shown.at >= from && shown.is_map()).collect();
    let share = |of: f64| 100.0 * of / maps.len().max(1) as f64;
    let mut ages: Vec<f64> = maps.iter().map(|shown| shown.age_ms).collect();
    ages.sort_by(f64::total_cmp);
    // The state before the first line is that of the line before.
    let first = lines.partition_point(|shown| shown.at < from);
    let ends = lines[first..].iter().map(|shown| shown.at).chain([now]);
    let states = lines[first.saturating_sub(1)..].iter().zip(ends.skip(usize::from(first == 0)));
    let fresh = states.filter(|(shown, _)| shown.why == "fresh").map(|(shown, end)| end - shown.at.max(from));
    let seconds = now.duration_since(from).as_secs_f64();
    format!(
        "{:.1} | {:.1} | {:.0} | {:.0}, {:.0} | {:.0}",
        maps.len() as f64 / seconds,
        1e-3 * maps.iter().map(|shown| shown.bytes).sum::<usize>() as f64 / maps.len().max(1) as f64,
        share(maps.iter().filter(|shown| shown.is_delta).count() as f64),
        ages.get(ages.len() / 2).unwrap_or(&0.0),
        ages.last().unwrap_or(&0.0),
        100.0 * fresh.sum::<Duration>().as_secs_f64() / seconds
    )
}

/// Why a stream was stale since then, each reason with how often.
fn said(lines: &[Shown], from: Instant) -> String {
    let mut said = BTreeMap::new();
    let stale = lines.iter().filter(|shown| shown.at >= from && shown.why != "fresh");
    stale.for_each(|shown| *said.entry(&shown.why).or_insert(0) += 1);
    said.into_iter().map(|(why, times)| format!("{why} {times}")).collect::<Vec<_>>().join(", ")
}
