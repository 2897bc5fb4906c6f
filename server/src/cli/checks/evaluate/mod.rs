//! `clearway evaluate`: every map against the truth, of labelled scans, of simulated scenes and of random worlds.
//!
//! In: folders or files as SemanticKITTI has them, or `sim:NAME`. Out: a [`Report`]. The scans and datagrams go through
//! the same pipeline as live data; its maps are judged point by point and cell by cell.
//!
//! | file | in -> out |
//! |---|---|
//! | [`source`] | paths, scenes, seeds -> maps, and the truth about their points |
//! | [`judge`] | a layer and points of known truth -> counts |
//! | [`tally`] | counts -> sums and shares |
//! | [`report`] | counts -> JSON |
//! | [`table`] | counts -> tables |
//! | [`error`] | why an evaluation failed |

use std::io::IsTerminal;
use std::path::{Path, PathBuf};

use clap::{Args, ValueEnum};
use clearway_lidar::model::Model;
use clearway_mapping::config::{Extrinsics, MapsConfig};
use indicatif::ProgressBar;

use crate::cli::shared::configuration::extrinsics;
use crate::cli::shared::output::{print, print_line};
use clearway_daemon::config::Config;

pub mod error;
pub mod judge;
pub mod report;
pub mod source;
pub mod table;
pub mod tally;

use error::EvaluateError;
use report::{Report, Source};
use source::argoverse::Log;
use source::pairs;
use source::scans::{Plan, judge_folder};
use source::setup::SensorSetup;
use source::variation::Variation;
#[cfg(feature = "sim")]
use source::{random, worlds};

/// Number of random worlds that are judged by default: every form of ground with every theme, once in even and once in
/// odd seeds.
const SEEDS: u64 = 156;

/// Judge every map against labelled scans, logs of Argoverse 2, simulated scenes or random worlds.
///
/// Prints, for each map, precision and reach (recall of all reachable ground) of the drivable cells, recall by range
/// and by class of ground, false obstacles (ground called occupied), precision, recall and F1 of ground points, and the
/// leaks: cells called drivable with a car, person, pole or fence in them, or behind a fence.
#[derive(Args, Clone, Debug, Default)]
#[command(after_help = "Examples:
  clearway evaluate sequences/00
  clearway evaluate sequences/00 --variations all
  clearway evaluate sequences/00 --set vehicle.maps.terrain.variant=paper
  clearway evaluate scans --labels truth --extrinsics 0,0,1.9,0,0,0 --model hdl32e --config car.toml
  clearway evaluate sim:town --json
  clearway evaluate sim:random --seeds 100 --model vlp16

Even seeds, and the variations without an asterisk, are for tuning. Odd seeds, and the variations with an asterisk, are
for final tables only: no parameter may be chosen by their figures.")]
pub struct Options {
    /// Folders with scans (.bin, .pcd) and labels (.label) of the same names, logs of Argoverse 2 and folders of logs,
    /// sim:flat, sim:slopes, sim:canopy, sim:overhang, sim:town, sim:street, sim:track, or sim:random.
    #[arg(required = true, value_name = "PATH")]
    pub paths: Vec<String>,
    /// Labels of the scans, a folder or a file; inside the paths themselves if absent.
    #[arg(long, value_name = "PATH")]
    pub labels: Option<PathBuf>,
    /// Print one JSON object.
    #[arg(long)]
    pub json: bool,
    /// Width of a column of the radial maps, in degrees; the configuration's if absent.
    #[arg(long = "columns", value_name = "1|2|4", value_parser = columns_deg)]
    pub columns_deg: Option<u16>,
    /// Position and orientation of the sensor in the ego frame, in metres and degrees; as on KITTI's car if absent.
    #[arg(long, value_name = "x,y,z,roll,pitch,yaw", value_parser = extrinsics, allow_hyphen_values = true)]
    pub extrinsics: Option<Extrinsics>,
    /// Model of the sensor. If absent: of scans, the rings in the file define the rows of radial maps, or an HDL-64E if
    /// the file has no rings; of simulated scenes, an HDL-64E.
    #[arg(long, value_name = "MODEL")]
    pub model: Option<Model>,
    /// Elevation of each laser of the scans' sensor, in degrees, separated by commas.
    #[arg(long, value_name = "DEG,...", value_delimiter = ',', allow_hyphen_values = true, conflicts_with = "model")]
    pub elevations_deg: Vec<f32>,
    /// Judge each labelled scan as recorded and in all variations: bent by ±3, 6 and 10 %, rolled by ±3 degrees, with
    /// 32 and 16 lasers, with the ego origin 1.5 m behind the sensor.
    #[arg(long, value_name = "all")]
    pub variations: Option<Variations>,
    /// Judge each labelled scan of a world that rises by this many percent from 8 m on, or falls (negative); may be
    /// given several times.
    #[arg(long, value_name = "PERCENT", allow_hyphen_values = true, value_parser = amount)]
    pub bend: Vec<f64>,
    /// Judge each labelled scan of a world that is rolled about the vehicle's forward axis; may be given several times.
    #[arg(long, value_name = "DEG", allow_hyphen_values = true, value_parser = amount)]
    pub roll: Vec<f64>,
    /// Judge every 2nd or 4th laser of each labelled scan of an HDL-64E, by the order of the points in the file.
    #[arg(long, value_name = "32|16", value_parser = lasers)]
    pub lasers: Vec<u16>,
    /// Judge each labelled scan with the ego frame's origin this many metres behind the sensor.
    #[arg(long, value_name = "M", allow_hyphen_values = true, value_parser = amount)]
    pub sensor_offset: Vec<f64>,
    /// Write each scan and its truth to this folder, for other programs, but not those of sim:NAME other than
    /// sim:random; files that exist are not replaced.
    #[arg(long, value_name = "DIR")]
    pub write_scans: Option<PathBuf>,
    /// Number of random worlds.
    #[arg(long, value_name = "N", default_value_t = SEEDS, value_parser = clap::value_parser!(u64).range(1..=100_000))]
    pub seeds: u64,
    /// Seed of the first random world.
    #[arg(long, value_name = "N", default_value_t = 0, value_parser = clap::value_parser!(u64).range(..=u64::MAX / 2))]
    pub first_seed: u64,
    /// Judge the maps of the first vehicle of this configuration; of the default configuration if absent.
    #[arg(long, value_name = "FILE")]
    pub config: Option<PathBuf>,
    /// Override a key of the configuration, such as vehicle.maps.terrain.variant=paper; may be given several times.
    #[arg(long, value_name = "KEY=VALUE")]
    pub set: Vec<String>,
}

/// A family of variations.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Variations {
    /// The whole family.
    All,
}

impl Options {
    /// The variations in the order of the report; the scans as recorded if none is given.
    fn variations(&self) -> Vec<Variation> {
        let bends = self.bend.iter().copied().map(Variation::Bend);
        let rolls = self.roll.iter().copied().map(Variation::Roll);
        let lasers = self.lasers.iter().copied().map(Variation::Lasers);
        let offsets = self.sensor_offset.iter().copied().map(Variation::SensorOffset);
        let mut variations = if self.variations.is_some() { Variation::ALL.to_vec() } else { Vec::new() };
        for variation in bends.chain(rolls).chain(lasers).chain(offsets) {
            if !variations.contains(&variation) {
                variations.push(variation);
            }
        }
        if variations.is_empty() { vec![Variation::Recorded] } else { variations }
    }

    fn plan(&self) -> Plan {
        let sensor =
            SensorSetup { model: self.model, elevations_deg: self.elevations_deg.clone(), extrinsics: self.extrinsics };
        Plan { sensor, variations: self.variations(), write_to: self.write_scans.clone() }
    }
}

/// Judges the maps and prints the report.
///
/// # Errors
/// [`EvaluateError`].
pub fn run(options: &Options) -> anyhow::Result<()> {
    let shown = !options.json && std::io::stderr().is_terminal();
    let bar = if shown { ProgressBar::new(0) } else { ProgressBar::hidden() };
    let outcome = evaluate(options, |done, total| {
        bar.set_length(total);
        bar.set_position(done);
    });
    bar.finish_and_clear();
    let report = outcome?;
    if options.json {
        print_line(&format!("{:#}", report.to_json()))?
    } else {
        print(&report.to_text())?
    };
    Ok(())
}

fn columns_deg(text: &str) -> Result<u16, String> {
    let degrees = text.parse().ok().filter(|degrees| columns(*degrees).is_some());
    degrees.ok_or_else(|| "1, 2 or 4 degrees are allowed".into())
}

fn amount(text: &str) -> Result<f64, String> {
    let amount = text.parse().ok().filter(|amount: &f64| amount.abs() <= 45.0);
    amount.ok_or_else(|| "-45 to 45 are allowed".into())
}

fn lasers(text: &str) -> Result<u16, String> {
    let number = text.parse().ok().filter(|number| matches!(number, 16 | 32));
    number.ok_or_else(|| "32 and 16 are allowed".into())
}

/// The number of columns of a radial map whose columns are `degrees` wide; `None` if that width is not allowed.
pub fn columns(degrees: u16) -> Option<u16> {
    matches!(degrees, 1 | 2 | 4).then(|| 360 / degrees)
}

/// Judges every map that the configuration enables. `progress` is called with the number of frames judged and of all
/// frames.
///
/// # Errors
/// [`EvaluateError`] for the first path that cannot be judged.
pub fn evaluate(options: &Options, mut progress: impl FnMut(u64, u64) + Send) -> Result<Report, EvaluateError> {
    let (maps, plan) = (maps(options)?, options.plan());
    let paths: Vec<String> = options.paths.iter().flat_map(|path| logs_of(path)).collect();
    // Every path is checked before the first is judged, so that an error appears at once.
    let sources = paths.iter().map(|path| Input::new(path, options)).collect::<Result<Vec<_>, _>>()?;
    let total = sources.iter().map(|input| input.frames(&plan)).sum();
    let (mut done, mut report) = (0, Report::default());
    for (path, input) in paths.into_iter().zip(sources) {
        let mut source = Source { path, ..Source::default() };
        let mut judged = || {
            done += 1;
            progress(done, total);
        };
        match input {
            #[cfg(feature = "sim")]
            Input::World(name, revolutions) => {
                judge_world(name, revolutions, options.model, &maps, &mut source, &mut judged)?;
            }
            #[cfg(feature = "sim")]
            Input::Random(seeds) => random::judge_worlds(&seeds, &maps, &mut source, &mut judged)?,
            Input::Argoverse(log) => log.judge(&maps, plan.write_to.as_deref(), &mut source, &mut judged)?,
            Input::Labelled(found) => {
                source.unlabelled = found.unlabelled;
                for pairs in found.pairs.chunk_by(|a, b| a.scan.parent() == b.scan.parent()) {
                    judge_folder(pairs, &plan, &maps, &mut source, &mut judged)?;
                }
            }
        }
        report.sources.push(source);
    }
    Ok(report)
}

/// The logs of Argoverse 2 in a folder of logs; else the path itself.
fn logs_of(path: &str) -> Vec<String> {
    let logs = Log::folders_in(Path::new(path));
    if logs.is_empty() { vec![path.into()] } else { logs.iter().map(|log| log.display().to_string()).collect() }
}

/// What one path stands for.
enum Input {
    /// A simulated scene, and how many revolutions of it are judged.
    #[cfg(feature = "sim")]
    World(&'static str, u64),
    /// Random worlds.
    #[cfg(feature = "sim")]
    Random(random::Seeds),
    /// A log of Argoverse 2.
    Argoverse(Log),
    /// Labelled scans.
    Labelled(pairs::Pairs),
}

impl Input {
    fn new(path: &str, options: &Options) -> Result<Self, EvaluateError> {
        if let Some(name) = path.strip_prefix("sim:") {
            return Self::world(name, options);
        }
        if let Some(log) = Log::find(Path::new(path)) {
            return Ok(Self::Argoverse(log));
        }
        Ok(Self::Labelled(pairs::find(Path::new(path), options.labels.as_deref())?))
    }

    #[cfg(feature = "sim")]
    fn world(name: &str, options: &Options) -> Result<Self, EvaluateError> {
        if name == "random" {
            let (first, count, model) = (options.first_seed, options.seeds, options.model);
            let write_to = options.write_scans.clone();
            return Ok(Self::Random(random::Seeds { first, count, model, write_to }));
        }
        let known = || worlds::SCENES.map(|(name, _)| name).join(", ") + ", random";
        let found = worlds::SCENES.iter().find(|(known, _)| *known == name);
        let (name, revolutions) = found.ok_or_else(|| EvaluateError::Scene { name: name.into(), known: known() })?;
        Ok(Self::World(name, *revolutions))
    }

    #[cfg(not(feature = "sim"))]
    fn world(name: &str, _: &Options) -> Result<Self, EvaluateError> {
        let known = "not in this build, which is without the feature sim; folders and files are allowed".into();
        Err(EvaluateError::Scene { name: name.into(), known })
    }

    fn frames(&self, plan: &Plan) -> u64 {
        match self {
            #[cfg(feature = "sim")]
            Self::World(_, revolutions) => *revolutions,
            #[cfg(feature = "sim")]
            Self::Random(seeds) => seeds.count,
            Self::Argoverse(log) => log.frames(),
            Self::Labelled(found) => (found.pairs.len() * plan.variations.len()) as u64,
        }
    }
}

fn maps(options: &Options) -> Result<MapsConfig, EvaluateError> {
    let config = match &options.config {
        Some(file) => Config::load(file, &options.set)?,
        None => {
            let text = Config::of_one_vehicle("car", "top").to_toml();
            Config::parse(&text, Path::new("the default configuration"), &options.set)?
        }
    };
    let mut maps = config.vehicles.into_iter().next().map(|vehicle| vehicle.maps).unwrap_or_default();
    if let Some(columns) = options.columns_deg.and_then(columns) {
        (maps.drivability.columns, maps.height_difference.columns) = (columns, columns);
    }
    Ok(maps)
}

#[cfg(feature = "sim")]
fn judge_world(
    name: &str,
    revolutions: u64,
    model: Option<Model>,
    maps: &MapsConfig,
    source: &mut Source,
    judged: &mut impl FnMut(),
) -> Result<(), EvaluateError> {
    let scene = crate::cli::sources::simulate::scene(name).expect("the list has only names of scenes");
    let scanner = worlds::scanner(model);
    let mut pipeline = worlds::pipeline_of(&scanner, maps)?;
    worlds::drive(scene, scanner, &mut pipeline, revolutions, |pipeline, points| {
        source.row("", false).judge_map(pipeline, &points);
        judged();
    });
    Ok(())
}

#[cfg(test)]
mod tests;
