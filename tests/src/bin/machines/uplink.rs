//! A vehicle's server behind a thin uplink: what its readers at two routers see while the uplink has one rate after the
//! other, and how its recording reaches a store after the uplink was cut.
//!
//! The server of the vehicle v00 is s1, with the limited uplink; v01 is at s2, without a limit. The planners p1 and p2,
//! at a router each, read one layer of both over zenoh; the planner `deltas`, on p2, reads v00 over gRPC with deltas,
//! one map on the way at a time. The counter of s1's interface says what the uplink carries, with all headers.

use std::collections::BTreeMap;
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{ExitCode, Stdio};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use clearway_daemon::config::Service;
use clearway_tests::machines::{Machines, ROUTERS, command, sent_bytes};
use clearway_tests::roles::{Process, server_config};

use crate::MachinesArguments;

const VEHICLE: &str = "v00";
const OTHER: &str = "v01";
const LAYER: &str = "speed";
const S3: &str = "10.99.0.31:9000";
const STORE: &str = "s3://fleet/kept";
/// What uploads of recordings may send.
const UPLOAD_KBIT_S: u32 = 500;
/// Longest wait for fresh maps, and for the store to have every part.
const PATIENCE: Duration = Duration::from_secs(90);
/// Time for which servers and readers have started before anything is measured.
const SETTLED: Duration = Duration::from_secs(1);

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

/// The rate of the uplink, 0 without a limit; what happens; and who reads.
#[derive(Clone, Copy)]
struct Phase {
    kbit_s: u32,
    what: &'static str,
    readers: &'static [&'static str],
}

const PHASES: [Phase; 6] = [
    Phase { kbit_s: 1000, what: "no reader", readers: &[] },
    Phase { kbit_s: 1000, what: "one reader", readers: &["p1"] },
    Phase { kbit_s: 1000, what: "one at each router", readers: &["p1", "p2"] },
    Phase { kbit_s: 200, what: "one at each router", readers: &["p1", "p2"] },
    Phase { kbit_s: 1000, what: "repaired", readers: &["p1", "p2"] },
    Phase { kbit_s: 200, what: "gRPC, deltas", readers: &["deltas"] },
];

struct Bed {
    machines: Machines,
    seen: Seen,
    valid_ms: u32,
    /// An interpreter with the package `moto`.
    python: PathBuf,
}

/// Runs all phases, then the recording.
pub fn run(arguments: &MachinesArguments) -> ExitCode {
    let (machines, seen) = (Machines::start(arguments.server.as_ref()), Seen::default());
    let mut bed = Bed { machines, seen, valid_ms: arguments.valid_ms, python: arguments.python.clone() };
    (0..2).for_each(|index| bed.machines.start_router(index));
    for (machine, vehicle) in [("s1", VEHICLE), ("s2", OTHER)] {
        bed.start_server(machine, vehicle, &[]);
        bed.machines.start_role(&format!("{machine} feed"), machine, "", &["feed", vehicle, "--rough"]);
    }
    println!(
        "| uplink, kbit/s (0: no limit) | what | reader, vehicle | fresh after, s | maps/s | kB a map | deltas, % \
         | age, ms: median, most | fresh, % of the time | the uplink carried, kbit/s | said |\n\
         |---:|---|---|---:|---:|---:|---:|---:|---:|---:|---|"
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
        config.connections.unprotected = vec![Service::Grpc];
        if !recording.is_empty() {
            config.recorder.file = self.recording().join("car.mcap");
            (config.recorder.part_s, config.recorder.save_s, config.recorder.warm_up_ms) = (2, 1, 500);
            // It keeps ground for longer than this warm-up.
            config.vehicles[0].maps.memory.enabled = false;
            (config.store.url, config.store.delete) = (STORE.into(), true);
            config.store.upload_kbit_s_max = UPLOAD_KBIT_S;
        }
        self.machines.start_server(machine, "", &config, recording);
    }

    fn recording(&self) -> PathBuf {
        self.machines.folder.path().join("recording")
    }

    /// Starts the readers that are missing, and ends the others.
    fn read(&mut self, readers: &[&'static str]) {
        for (reader, machine, endpoints) in
            [("p1", "p1", ROUTERS[0]), ("p2", "p2", ROUTERS[1]), ("deltas", "p2", "grpc:10.99.0.11:50051")]
        {
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

    /// Sets the rate and the readers, waits, and prints a row for each of their streams. Returns false if no map
    /// becomes fresh.
    fn measure(&mut self, phase: &Phase, length: Duration) -> bool {
        let is_new = !phase.readers.iter().all(|reader| self.machines.processes.contains_key(*reader));
        self.machines.limit("s1", phase.kbit_s);
        let began = Instant::now();
        self.read(phase.readers);
        let Some(fresh) = self.fresh(phase.readers, began) else {
            eprintln!("no fresh map after {PATIENCE:?}");
            return false;
        };
        // What travels while servers and readers start is not counted.
        if is_new || phase.readers.is_empty() {
            std::thread::sleep(SETTLED);
        }
        self.print(phase, fresh, length);
        true
    }

    /// Waits, and prints a row for each stream of the readers.
    fn print(&self, phase: &Phase, fresh: Duration, length: Duration) {
        let (from, bytes) = (Instant::now(), sent_bytes("s1"));
        std::thread::sleep(length);
        let carried = (sent_bytes("s1") - bytes) as f64 * 8e-3 / from.elapsed().as_secs_f64();
        let (Phase { kbit_s, what, readers }, fresh) = (phase, fresh.as_secs_f64());
        if readers.is_empty() {
            println!("| {kbit_s} | {what} | | | | | | | | {carried:.0} | |");
        }
        let seen = self.seen.lock().expect("no panic");
        for ((reader, vehicle), lines) in seen.iter().filter(|((reader, _), _)| readers.contains(reader)) {
            let (figures, said) = (figures(lines, from), said(lines, from));
            println!("| {kbit_s} | {what} | {reader}, {vehicle} | {fresh:.2} | {figures} | {carried:.0} | {said} |");
        }
    }

    /// Records, cuts the uplink while parts finish, repairs it to a thin and then to a good one, and prints what the
    /// store has. Returns false if a part is missing.
    fn record(&mut self, length: Duration) -> bool {
        std::fs::create_dir_all(self.recording()).expect("a folder of ours");
        let url = self.start_store();
        let keys = [("AWS_ACCESS_KEY_ID", "test"), ("AWS_SECRET_ACCESS_KEY", "test"), ("AWS_REGION", "us-east-1")];
        let variables = [&[("AWS_ENDPOINT_URL", &*url)][..], &keys].concat();
        self.start_server("s1", VEHICLE, &variables);
        // Scans of a plain, which compress: a recording within the limit of uploads.
        self.machines.start_role("s1 feed", "s1", "", &["feed", VEHICLE]);
        let thin = Phase { kbit_s: 1000, what: "with the recording", readers: &["p1"] };
        if !self.measure(&Phase { kbit_s: 0, ..thin }, length) {
            return false;
        }
        self.cut(1.0);
        let before = parts(&self.recording());
        std::thread::sleep(length);
        let after = parts(&self.recording());
        let deleted = before.keys().filter(|part| !after.contains_key(*part)).count();
        self.machines.limit("s1", thin.kbit_s);
        self.cut(0.0);
        let is_fresh = self.measure(&thin, length);
        self.machines.limit("s1", 0);
        let repaired = Instant::now();
        while parts(&self.recording()).keys().any(|part| after.contains_key(part)) && repaired.elapsed() < PATIENCE {
            std::thread::sleep(Duration::from_millis(100));
        }
        let caught_up = repaired.elapsed().as_secs_f64();
        let verified = self.machines.run("w1", &["verify", STORE], &variables).status.code();
        let listed = self.machines.run("w1", &["recordings", "--store", STORE, "--json"], &variables);
        let listed = String::from_utf8_lossy(&listed.stdout).into_owned();
        let stored = after.values().filter(|crc| listed.contains(&format!("-{crc:08x}.mcap"))).count();
        println!(
            "\n| parts that wait when the uplink is cut | when it is repaired | deleted between | all confirmed after the \
             uplink is good, s | in the store by their CRC | `clearway verify` |\n|---:|---:|---:|---:|---:|---:|\n\
             | {} | {} | {deleted} | {caught_up:.1} | {stored} of {} | exit {} |",
            before.len(),
            after.len(),
            after.len(),
            verified.map_or("by signal".to_owned(), |code| code.to_string()),
        );
        is_fresh && stored == after.len() && verified == Some(0)
    }

    /// Starts the store; its URL. It ends when its standard input does.
    fn start_store(&mut self) -> String {
        let script = clearway_tests::workspace().join("tests/python/s3_server.py");
        let mut server = command("w1", "", &self.python, &["-B", script.to_str().expect("UTF-8"), S3]);
        let server = server.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::null());
        let process = self.machines.add("store", Process(server.spawn().expect("it starts")));
        let mut line = String::new();
        BufReader::new(process.0.stdout.take().expect("piped")).read_line(&mut line).expect("it lives");
        line.trim().to_owned()
    }

    fn cut(&mut self, loss: f64) {
        ["r1", "r2", "w1"].iter().for_each(|other| self.machines.link("s1", other, 0, loss));
    }
}

/// The finished parts of a recording on the disk that the store has not confirmed, with their CRCs.
fn parts(folder: &Path) -> BTreeMap<PathBuf, u32> {
    let files = std::fs::read_dir(folder).expect("a folder of ours").flatten().map(|file| file.path());
    let parts = files.filter(|file| file.extension().is_some_and(|extension| extension == "mcap"));
    let finished = parts.filter_map(|file| {
        let bytes = std::fs::read(&file).ok().filter(|bytes| bytes.ends_with(mcap::MAGIC))?;
        Some((file, crc32fast::hash(&bytes)))
    });
    finished.filter(|(file, _)| !file.with_added_extension("confirmed").exists()).collect()
}

/// Cells of the table from the lines of a stream since then: maps/s, kB a map, deltas, ages, the time it was fresh.
fn figures(lines: &[Shown], from: Instant) -> String {
    let now = Instant::now();
    let maps: Vec<_> = lines.iter().filter(|shown| shown.at >= from && shown.is_map()).collect();
    let share = |of: f64| 100.0 * of / maps.len().max(1) as f64;
    let mut ages: Vec<f64> = maps.iter().map(|shown| shown.age_ms).collect();
    ages.sort_by(f64::total_cmp);
    // The state before the first line is the state of the line before.
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
