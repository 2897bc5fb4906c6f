//! `clearway evaluate`: every map against the truth, of labelled scans, of simulated scenes and of random worlds.

use std::io::IsTerminal;
use std::ops::Range;
use std::path::PathBuf;

use anyhow::Result;
use clap::Args;
use clearway_lidar::model::Model;
use clearway_mapping::config::Extrinsics;
use clearway_tools::evaluate::footprint::gate::FootprintGate;
use clearway_tools::evaluate::source::variation::Variation;
use clearway_tools::evaluate::{EvaluateOptions, evaluate};
use indicatif::ProgressBar;

use crate::arguments::values::extrinsics;
use crate::terminal::{Exit, print, print_line, usage_error};

/// Judge every map against labelled scans, simulated scenes or random worlds.
///
/// Prints, for each map, precision and reach (recall of all reachable ground) of the drivable cells, recall by range
/// and by class of ground, false obstacles (ground called occupied), F1 of ground points, and the leaks: cells called
/// drivable with a car, person, pole or fence in them, or behind a fence. Then for each map the share of the vehicle
/// footprints (4 m by 2 m) free by the truth that it answers free, and the footprints answered free in which something
/// stands.
#[derive(Args)]
#[command(after_help = "Examples:
  clearway evaluate sequences/00
  clearway evaluate sequences/00 --variations all
  clearway evaluate sequences/00 --objects
  clearway evaluate sequences/00 --set vehicle.maps.terrain.variant=paper
  clearway evaluate scans --labels truth --extrinsics 0,0,1.9,0,0,0 --model hdl32e --config car.toml
  clearway evaluate sim:town --json
  clearway evaluate sim:random --seeds 0..100 --model vlp16
  clearway evaluate sequences/00 --fail-under freespace=96 --fail-under freespace=95@20-30

Even seeds, and the variations without an asterisk, are for tuning. Odd seeds, and the variations with an asterisk, are
for final tables only: no parameter may be chosen by their figures.")]
pub struct EvaluateArguments {
    /// Folders with scans (.bin, .pcd) and labels (.label) of the same names, scans, sim:flat, sim:slopes, sim:canopy,
    /// sim:overhang, sim:town, sim:street, sim:track, or sim:random.
    #[arg(required = true, value_name = "PATH")]
    paths: Vec<String>,
    /// Labels of the scans, a folder or a file; inside the paths themselves if absent.
    #[arg(long, value_name = "PATH")]
    labels: Option<PathBuf>,
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
    /// Position and orientation of the sensor in the ego frame, in metres and degrees; as on KITTI's car if absent.
    #[arg(long, value_name = "x,y,z,roll,pitch,yaw", value_parser = extrinsics, allow_hyphen_values = true)]
    extrinsics: Option<Extrinsics>,
    /// Model of the sensor. If absent: of scans, their rings or the order of their points define the rows of radial
    /// maps, as in a replay, and else the rows are 1 m deep; of simulated scenes, an HDL-64E.
    #[arg(long, value_name = "MODEL")]
    model: Option<Model>,
    /// Judge each labelled scan in these variations, or all: recorded, bend+3 (the world rises by 3 percent from 8 m
    /// on), bend-3, bend+6, bend-6, bend+10, bend-10, roll+3 (the world is rolled by 3 degrees), roll-3, lasers32,
    /// lasers16 (of 64), offset+1.5 (the sensor is 1.5 m ahead of the ego origin).
    #[arg(long, value_name = "NAME", value_delimiter = ',', default_value = "recorded")]
    variations: Vec<String>,
    /// Cut objects into each labelled scan by ray geometry (a box, a log, a kerb, a person who lies, a pole, a trench,
    /// at 7, 10, 15 and 20 m) and count their cells that are called free.
    #[arg(long)]
    objects: bool,
    /// Write each scan and its truth to this folder, for other programs, but no scan of sim:NAME other than
    /// sim:random; files that exist are not replaced.
    #[arg(long, value_name = "DIR")]
    write_scans: Option<PathBuf>,
    /// Seeds of the random worlds: from the first up to the second, without it.
    #[arg(long, value_name = "FIRST..END", value_parser = seeds, default_value = "0..156")]
    seeds: Range<u64>,
    /// Judge the maps of the first vehicle of this configuration; of the default configuration if absent.
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Override a key of the configuration, such as vehicle.maps.terrain.variant=paper; may be given several times.
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
    /// Exit with code 1 if the layer answers free less than this percentage of the vehicle footprints that the truth
    /// calls free, at 4 to 20 m or in the range given, or any in which something of 0.5 m stands, or of 0.3 m within
    /// 20 m; may be given several times.
    #[arg(long, value_name = "LAYER=PERCENT[@FROM-TO]")]
    fail_under: Vec<FootprintGate>,
}

/// Reads a range of seeds.
fn seeds(text: &str) -> Result<Range<u64>, String> {
    let range = text.split_once("..").and_then(|(first, end)| Some(first.parse().ok()?..end.parse().ok()?));
    let range = range.filter(|range: &Range<u64>| !range.is_empty() && range.end - range.start <= 100_000);
    range.ok_or_else(|| "FIRST..END of 1 to 100000 seeds, such as 0..156, is allowed".into())
}

/// The variations of these names, each once.
fn variations(names: &[String]) -> Result<Vec<Variation>, String> {
    let mut found = Vec::new();
    for name in names {
        let named = |variation: &Variation| name == "all" || variation.to_string() == *name;
        let named: Vec<Variation> = Variation::ALL.into_iter().filter(named).collect();
        if named.is_empty() {
            let names = Variation::ALL.map(|variation| variation.to_string()).join(", ");
            return Err(format!("--variations {name}: all, {names} are allowed"));
        }
        for variation in named {
            if !found.contains(&variation) {
                found.push(variation);
            }
        }
    }
    Ok(found)
}

/// Judges the maps and prints the report.
pub fn run(arguments: EvaluateArguments) -> Result<Exit> {
    let variations = variations(&arguments.variations).map_err(usage_error)?;
    let EvaluateArguments { paths, labels, extrinsics, model, objects, write_scans, seeds, config, set, .. } =
        arguments;
    let options =
        EvaluateOptions { paths, labels, extrinsics, model, variations, objects, write_scans, seeds, config, set };
    let shown = !arguments.json && std::io::stderr().is_terminal();
    let bar = if shown { ProgressBar::new(0) } else { ProgressBar::hidden() };
    let outcome = evaluate(&options, |done, total| {
        bar.set_length(total);
        bar.set_position(done);
    });
    bar.finish_and_clear();
    let evaluation = outcome?;
    if arguments.json {
        print_line(&format!("{:#}", evaluation.to_json()))?
    } else {
        print(&evaluation.to_text())?
    };
    let failures = evaluation.failures(&arguments.fail_under);
    failures.iter().for_each(|failure| eprintln!("clearway: {failure}"));
    Ok(if failures.is_empty() { Exit::Good } else { Exit::Differs })
}
