//! Compares the maps of drives, byte for byte, between builds of `clearway`, live runs and many replays.
//!
//! `cargo run --release -p clearway-tests --no-default-features --bin determinism` builds the command three ways
//! (debug, release, release for x86-64-v3) and prints a Markdown table: for each drive the number of its maps, one
//! digest of all of them, and how many replays of each build gave the same bytes. The replays run in turn on one, two
//! and four processors, and every other one with the functions that the C library has for processors without FMA. The
//! exit code is 1 if one byte of one map differs.
//!
//! `--program NAME=PATH` takes a build that is there, of this machine or of another; it may be given several times.

mod drives;
mod programs;

use std::path::Path;
use std::process::ExitCode;

use clap::Parser;
use clearway_tests::digests::{Digests, digest_of};

use drives::Drive;
use programs::{Program, Surroundings};

/// The simulated drives: scene and sensor.
const SIMULATED: [(&str, &str); 5] =
    [("town", "hdl64e_s2"), ("street", "vlp16"), ("slopes", "hdl32e"), ("overhang", "vlp32c"), ("track", "vls128")];
/// The simulated drive that four vehicles of one server receive: its sensor.
const FLEET_SENSOR: &str = "vlp16";

/// Compares the maps of drives, byte for byte, between builds of `clearway`, live runs and many replays.
#[derive(Parser)]
struct Arguments {
    /// A build of the command; without one, three are built.
    #[arg(long = "program", value_name = "NAME=PATH")]
    programs: Vec<Program>,
    /// Replays of each drive by each build.
    #[arg(long, default_value_t = 10, value_parser = clap::value_parser!(u16).range(1..))]
    replays: u16,
    /// Compare only drives with this in their name; may be given several times.
    #[arg(long, value_name = "TEXT")]
    only: Vec<String>,
}

/// A line of the table.
struct Row {
    name: String,
    /// Number of maps, of one layer each; `None` for packets.
    maps: Option<usize>,
    /// Digest of all maps, or of the packets.
    digest: String,
    /// Of each program, the number of equal runs.
    equal: Vec<usize>,
    runs: usize,
    /// The first difference.
    difference: Option<String>,
}

fn main() -> ExitCode {
    let arguments = Arguments::parse();
    let programs = if arguments.programs.is_empty() { programs::build() } else { arguments.programs };
    let folder = tempfile::tempdir().expect("a folder");
    let replays = usize::from(arguments.replays);
    let is_wanted =
        |name: &str| arguments.only.is_empty() || arguments.only.iter().any(|text| name.contains(text.as_str()));
    println!("| drive | maps | digest |{}", programs.iter().map(|of| format!(" {} |", of.name)).collect::<String>());
    println!("|---|---|---|{}", "---|".repeat(programs.len()));
    let mut is_equal = true;
    let mut print = |row: Row| {
        let maps = row.maps.map_or_else(String::new, |maps| maps.to_string());
        let equal: String = row.equal.iter().map(|equal| format!(" {equal} of {} equal |", row.runs)).collect();
        println!("| {} | {maps} | `{}` |{equal}", row.name, row.digest);
        if let Some(difference) = row.difference {
            eprintln!("{}: {difference}", row.name);
            is_equal = false;
        }
    };
    let mut drives = drives::golden();
    for (scene, sensor) in SIMULATED {
        let file = folder.path().join(format!("{scene}.pcap"));
        if !is_wanted(&drives::simulated(scene, sensor, &file).name) {
            continue;
        }
        print(packets(&programs, scene, sensor, &file));
        drives.push(drives::simulated(scene, sensor, &file));
    }
    drives.extend(drives::recorded(&drives::data()));
    if is_wanted("live, eight sensors") || is_wanted("live, four vehicles") {
        let capture = folder.path().join("fleet.pcap");
        drives::simulate(&programs[0], Surroundings::PLAIN, "town", FLEET_SENSOR, &capture);
        for program in &programs {
            drives.push(drives::live_demo(program, folder.path()));
            drives.push(drives::live_fleet(program, &capture, folder.path()));
        }
    }
    for drive in drives.iter().filter(|drive| is_wanted(&drive.name)) {
        print(replayed(&programs, drive, replays, folder.path()));
    }
    if is_equal { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}

/// The packets that each program simulates, with each choice of the C library's functions; the first ones stay in
/// `file`.
fn packets(programs: &[Program], scene: &str, sensor: &str, file: &Path) -> Row {
    let again = file.with_extension("again.pcap");
    let mut digest = None;
    let (mut equal, mut difference) = (Vec::new(), None);
    for program in programs {
        let mut of_program = 0;
        for without_fma in [false, true] {
            let surroundings = Surroundings { without_fma, ..Surroundings::PLAIN };
            let file = if digest.is_none() { file } else { &again };
            drives::simulate(program, surroundings, scene, sensor, file);
            let simulated = digest_of(&std::fs::read(file).expect("the capture is there"));
            if *digest.get_or_insert(simulated.clone()) == simulated {
                of_program += 1;
            } else {
                difference.get_or_insert(format!("{} simulates other packets, {surroundings:?}", program.name));
            }
        }
        equal.push(of_program);
    }
    let name = format!("packets of simulated {scene}, {sensor}");
    Row { name, maps: None, digest: digest.unwrap_or_default(), equal, runs: 2, difference }
}

/// Replays a drive with each program, and compares its maps with the recorded ones, or with those of the first replay.
fn replayed(programs: &[Program], drive: &Drive, replays: usize, folder: &Path) -> Row {
    let file = folder.join("replayed.mcap");
    let record = file.to_str().expect("a path in UTF-8");
    let mut reference: Option<Digests> = drive.recorded.clone();
    let (mut equal, mut difference) = (Vec::new(), None);
    for program in programs {
        let mut of_program = 0;
        for run in 0..replays {
            let mut arguments = vec!["replay"];
            arguments.extend(drive.arguments.iter().map(String::as_str));
            arguments.extend(["--record", record]);
            let surroundings = Surroundings::of_run(run);
            let _ = std::fs::remove_file(&file);
            program.run(surroundings, &arguments);
            let maps = Digests::of(&file).expect("the recording is whole");
            match reference.get_or_insert_with(|| maps.clone()).first_difference(&maps) {
                None => of_program += 1,
                Some(map) => {
                    difference.get_or_insert(format!("{map} of run {run} of {}, {surroundings:?}", program.name));
                }
            }
        }
        equal.push(of_program);
    }
    let maps = reference.unwrap_or_default();
    let difference = difference.or_else(|| maps.is_empty().then(|| "no maps".to_owned()));
    Row { name: drive.name.clone(), maps: Some(maps.len()), digest: maps.sum(), equal, runs: replays, difference }
}
