//! `clearway evaluate`: every map against the truth, of labelled scans and of simulated scenes.
//!
//! In: folders or files as SemanticKITTI has them, or `sim:NAME`. Out: a [`Report`]. The scans and datagrams go through
//! the same [`Pipeline`] as live data; its maps are judged point by point and cell by cell.
//!
//! | file | in -> out |
//! |---|---|
//! | [`pairs`] | paths -> scans with their labels |
//! | [`labels`] | labels -> the truth about the points of a scan |
//! | [`worlds`] | a simulated scene -> maps, and the truth about their points |
//! | [`judge`] | a layer and points of known truth -> counts |
//! | [`report`] | counts -> table, JSON |

use std::io::IsTerminal;
use std::path::{Path, PathBuf};

use clap::Args;
use clearway_lidar::model::Model;
use clearway_mapping::config::{Extrinsics, MapsConfig};
use clearway_mapping::error::EventError;
use clearway_mapping::event::{Body, Event, Scan};
use clearway_mapping::pipeline::Pipeline;
use clearway_mapping::sensor::mount::{MountError, estimate};
use clearway_mapping::sensor::sweep::{Mount, Sweep};
use indicatif::ProgressBar;

use super::configuration::extrinsics;
use super::output::{print, print_line};
use crate::config::{Config, ConfigError};
use crate::ingest::files::kitti::{self, ScanError};

pub mod judge;
pub mod labels;
pub mod pairs;
pub mod report;
#[cfg(feature = "sim")]
pub mod worlds;

use judge::{Point, Tally};
use pairs::Pair;
use report::{Report, Source};

/// How the sensor is mounted on KITTI's car, from KITTI's published sensor setup. The published metrics of other
/// methods use it, and an estimate from one scan tilts with the road under it.
const KITTI_EXTRINSICS: Extrinsics =
    Extrinsics { x_m: 0.0, y_m: 0.0, z_m: 1.73, roll_deg: 0.0, pitch_deg: 0.0, yaw_deg: 0.0 };
/// Largest difference between the estimated height of the sensor and KITTI's, in metres; beyond it the scans are from
/// another car. Ours.
const MOUNT_M_OFF_MAX: f64 = 0.3;
/// Number of scans from which the height of the sensor is estimated.
const MOUNT_SCANS: usize = 10;

/// Judge every map against labelled scans (.bin and .label as SemanticKITTI has them) or simulated scenes.
///
/// Prints, for each map, precision, recall and F1 of the drivable cells and of the ground points, and the leaks: cells
/// called drivable with a car, person, pole or fence in them.
#[derive(Args, Clone, Debug, Default)]
#[command(after_help = "Examples:
  clearway evaluate sequences/00
  clearway evaluate sim:town --json
  clearway evaluate scans --extrinsics 0,0,1.9,0,0,0 --config car.toml")]
pub struct Options {
    /// Folders with .bin and .label files of the same names, or sim:flat, sim:slopes, sim:canopy, sim:overhang,
    /// sim:town.
    #[arg(required = true, value_name = "PATH")]
    pub paths: Vec<String>,
    /// Print one JSON object.
    #[arg(long)]
    pub json: bool,
    /// Width of a column of the radial maps, in degrees; the configuration's if absent.
    #[arg(long = "columns", value_name = "1|2|4", value_parser = columns_deg)]
    pub columns_deg: Option<u16>,
    /// Position and orientation of the sensor in the ego frame, in metres and degrees; as on KITTI's car if absent.
    #[arg(long, value_name = "x,y,z,roll,pitch,yaw", value_parser = extrinsics, allow_hyphen_values = true)]
    pub extrinsics: Option<Extrinsics>,
    /// Judge the maps of the first vehicle of this configuration; of the default configuration if absent.
    #[arg(long, value_name = "FILE")]
    pub config: Option<PathBuf>,
    /// Override a key of the configuration; may be given several times.
    #[arg(long, value_name = "KEY=VALUE", requires = "config")]
    pub set: Vec<String>,
}

/// Why an evaluation failed.
#[derive(Debug, thiserror::Error)]
pub enum EvaluateError {
    /// The scans and labels do not match.
    #[error(transparent)]
    Pairs(#[from] pairs::PairsError),
    /// A scan cannot be read.
    #[error(transparent)]
    Scan(#[from] ScanError),
    /// Labels cannot be used.
    #[error(transparent)]
    Labels(#[from] labels::LabelError),
    /// No simulated scene has that name.
    #[error("sim:{name}: the scenes are {known}")]
    Scene {
        /// Name of the scene, as given.
        name: String,
        /// Names of the scenes, separated by commas.
        known: String,
    },
    /// The estimate of the sensor's mount failed.
    #[error("{}: {source}; give --extrinsics", folder.display())]
    Mount {
        /// Folder of the scans.
        folder: PathBuf,
        /// Why the estimate failed.
        source: MountError,
    },
    /// The scans are not from KITTI's car.
    #[error(
        "{}: the sensor is {height_m:.2} m above the ground, on KITTI's car 1.73 m; give --extrinsics",
        folder.display()
    )]
    OtherMount {
        /// Folder of the scans.
        folder: PathBuf,
        /// Height of the sensor, estimated from the ground, in metres.
        height_m: f64,
    },
    /// The configuration cannot be used.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// A value of the maps' configuration cannot be used.
    #[error(transparent)]
    Maps(#[from] clearway_mapping::config::ConfigValueError),
    /// The pipeline refused a scan.
    #[error("{}: {source}", scan.display())]
    Rejected {
        /// File of the scan.
        scan: PathBuf,
        /// Why it was refused.
        source: EventError,
    },
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

/// The number of columns of a radial map whose columns are `degrees` wide; `None` if that width is not allowed.
pub fn columns(degrees: u16) -> Option<u16> {
    matches!(degrees, 1 | 2 | 4).then(|| 360 / degrees)
}

/// Judges every map that the configuration enables. `progress` is called with the number of frames judged and of all
/// frames.
///
/// # Errors
/// [`EvaluateError`] for the first path that cannot be judged.
pub fn evaluate(options: &Options, mut progress: impl FnMut(u64, u64)) -> Result<Report, EvaluateError> {
    let maps = maps(options)?;
    // Every path is checked before the first is judged, so that an error appears at once.
    let sources = options.paths.iter().map(|path| Input::new(path)).collect::<Result<Vec<_>, _>>()?;
    let total = sources.iter().map(Input::frames).sum();
    let (mut done, mut report) = (0, Report::default());
    for (path, input) in options.paths.iter().zip(sources) {
        let mut source = Source { path: path.clone(), ..Source::default() };
        let mut judged = || {
            done += 1;
            progress(done, total);
        };
        match input {
            #[cfg(feature = "sim")]
            Input::World(name, revolutions) => judge_world(name, revolutions, &maps, &mut source, &mut judged)?,
            Input::Labelled(found) => {
                source.unlabelled = found.unlabelled;
                for pairs in found.pairs.chunk_by(|a, b| a.scan.parent() == b.scan.parent()) {
                    judge_folder(pairs, options.extrinsics, &maps, &mut source, &mut judged)?;
                }
            }
        }
        report.sources.push(source);
    }
    Ok(report)
}

/// What one path stands for.
enum Input {
    /// A simulated scene, and how many revolutions of it are judged.
    #[cfg(feature = "sim")]
    World(&'static str, u64),
    /// Labelled scans.
    Labelled(pairs::Pairs),
}

impl Input {
    fn new(path: &str) -> Result<Self, EvaluateError> {
        match path.strip_prefix("sim:") {
            Some(name) => Self::world(name),
            None => Ok(Self::Labelled(pairs::find(Path::new(path))?)),
        }
    }

    #[cfg(feature = "sim")]
    fn world(name: &str) -> Result<Self, EvaluateError> {
        let known = || worlds::SCENES.map(|(name, _)| name).join(", ");
        let found = worlds::SCENES.iter().find(|(known, _)| *known == name);
        let (name, revolutions) = found.ok_or_else(|| EvaluateError::Scene { name: name.into(), known: known() })?;
        Ok(Self::World(name, *revolutions))
    }

    #[cfg(not(feature = "sim"))]
    fn world(name: &str) -> Result<Self, EvaluateError> {
        let known = "not in this build, which is without the feature sim; folders and files are allowed".into();
        Err(EvaluateError::Scene { name: name.into(), known })
    }

    fn frames(&self) -> u64 {
        match self {
            #[cfg(feature = "sim")]
            Self::World(_, revolutions) => *revolutions,
            Self::Labelled(found) => found.pairs.len() as u64,
        }
    }
}

fn maps(options: &Options) -> Result<MapsConfig, EvaluateError> {
    let config = match &options.config {
        Some(file) => Config::load(file, &options.set)?,
        None => Config::of_one_vehicle("car", "top"),
    };
    let mut maps = config.vehicles.into_iter().next().map(|vehicle| vehicle.maps).unwrap_or_default();
    if let Some(columns) = options.columns_deg.and_then(columns) {
        (maps.drivability.columns, maps.height_difference.columns) = (columns, columns);
    }
    Ok(maps)
}

/// The pipeline of a vehicle with one sensor, and the sensor's mount.
fn pipeline(maps: &MapsConfig, model: Model, extrinsics: Extrinsics) -> Result<(Pipeline, Mount), EvaluateError> {
    let mut config = Config::of_one_vehicle("car", "top").vehicles.remove(0).core();
    config.maps = maps.clone();
    let sensor = &mut config.sensors[0];
    (sensor.model, sensor.extrinsics) = (Some(model), extrinsics);
    let mount = Mount { ego_from_sensor: extrinsics.ego_from_sensor(), range_m_min: sensor.range_m_min };
    Ok((Pipeline::new(&config, vec![None])?, mount))
}

impl Source {
    fn judge(&mut self, layers: &[clearway_mapping::layer::Layer], points: &[Point]) {
        self.frames += 1;
        for layer in layers {
            let at = self.layers.iter().position(|(name, _)| name == layer.name);
            let mut tally = Tally::default();
            let tally = at.map_or(&mut tally, |at| &mut self.layers[at].1);
            match (tally.add(layer, points), at) {
                (true, None) => {
                    let tally = tally.clone();
                    self.layers.push((layer.name.to_owned(), tally));
                }
                (false, None) if !self.left_out.iter().any(|name| name == layer.name) => {
                    self.left_out.push(layer.name.to_owned());
                }
                _ => {}
            }
        }
    }
}

#[cfg(feature = "sim")]
fn judge_world(
    name: &str,
    revolutions: u64,
    maps: &MapsConfig,
    source: &mut Source,
    judged: &mut impl FnMut(),
) -> Result<(), EvaluateError> {
    let scene = super::simulate::scene(name).expect("the list has only names of scenes");
    let scanner = worlds::scanner();
    let at = scanner.ego_from_sensor.translation;
    // The simulated sensor is upright.
    let extrinsics = Extrinsics { x_m: at.x, y_m: at.y, z_m: at.z, roll_deg: 0.0, pitch_deg: 0.0, yaw_deg: 0.0 };
    let (mut pipeline, _) = pipeline(maps, scanner.model, extrinsics)?;
    worlds::drive(scene, &mut pipeline, revolutions, |pipeline, points| {
        let map = pipeline.newest_map().expect("a revolution makes a map");
        source.judge(&map.layers, &points);
        judged();
    });
    Ok(())
}

/// Judges the labelled scans of one folder, in order, with one pipeline.
fn judge_folder(
    pairs: &[Pair],
    extrinsics: Option<Extrinsics>,
    maps: &MapsConfig,
    source: &mut Source,
    judged: &mut impl FnMut(),
) -> Result<(), EvaluateError> {
    let folder = pairs[0].scan.parent().unwrap_or(Path::new("")).to_owned();
    let (extrinsics, origin) = match extrinsics {
        Some(extrinsics) => (extrinsics, "as given".to_owned()),
        None => (KITTI_EXTRINSICS, kitti_mount(&folder, pairs)?),
    };
    let Extrinsics { x_m, y_m, z_m, roll_deg, pitch_deg, yaw_deg } = extrinsics;
    let numbers = format!("{x_m},{y_m},{z_m},{roll_deg},{pitch_deg},{yaw_deg}");
    source.mounts.push(format!("{numbers} in {}: {origin}", folder.display()));
    // The sensor of SemanticKITTI.
    let (mut pipeline, mount) = pipeline(maps, Model::Hdl64eS2, extrinsics)?;
    for (index, pair) in (0..).zip(pairs) {
        let scan = read_scan(&pair.scan, index)?;
        let classes = labels::read(&pair.labels, &pair.scan, scan.x.len())?;
        let kept = (0..classes.len()).filter(|i| Sweep::keeps(&mount, [scan.x[*i], scan.y[*i], scan.z[*i]]));
        let classes: Vec<u32> = kept.map(|i| classes[i]).collect();
        let event = Event { sequence: index, arrival_ns: scan.stamp_ns, source: 0, body: Body::Scan(scan) };
        let rejected = |source| EvaluateError::Rejected { scan: pair.scan.clone(), source };
        pipeline.step(&event).map_err(rejected)?;
        let points = labels::truth(pipeline.newest_sweep(), &classes);
        source.judge(&pipeline.newest_map().expect("a scan makes a map").layers, &points);
        judged();
    }
    Ok(())
}

/// Checks KITTI's mount against the ground in the scans; returns the reason for using it, for the report.
fn kitti_mount(folder: &Path, pairs: &[Pair]) -> Result<String, EvaluateError> {
    let points = |scan: Scan| scan.x.iter().zip(&scan.y).zip(&scan.z).map(|((&x, &y), &z)| [x, y, z]).collect();
    let first = pairs.iter().zip(0..).take(MOUNT_SCANS).map(|(pair, index)| read_scan(&pair.scan, index).map(points));
    let scans: Vec<Vec<[f32; 3]>> = first.collect::<Result<_, _>>()?;
    let estimated = estimate(&scans).map_err(|source| EvaluateError::Mount { folder: folder.to_owned(), source })?;
    let Extrinsics { z_m, pitch_deg, roll_deg, .. } = estimated.extrinsics();
    if (z_m - KITTI_EXTRINSICS.z_m).abs() > MOUNT_M_OFF_MAX {
        return Err(EvaluateError::OtherMount { folder: folder.to_owned(), height_m: z_m });
    }
    Ok(format!(
        "KITTI's car as published; estimated from the ground in {} scan(s): {z_m:.2} m, pitch {pitch_deg:.1}°, roll \
         {roll_deg:.1}°",
        scans.len()
    ))
}

fn read_scan(file: &Path, index: u64) -> Result<Scan, EvaluateError> {
    match kitti::read(file, index)?.body {
        Body::Scan(scan) => Ok(scan),
        _ => unreachable!("the reading of a scan file is a scan"),
    }
}

#[cfg(test)]
mod tests;
