//! `clearway evaluate`: every map against the truth, of labelled scans and of simulated scenes.
//!
//! In: SemanticKITTI-style folders or files, or `sim:NAME`. Out: a [`Report`]. The scans and datagrams go through the
//! real [`Pipeline`]; what its maps say is judged point by point and cell by cell.
//!
//! | file | in -> out |
//! |---|---|
//! | [`pairs`] | paths -> scans with their labels |
//! | [`labels`] | labels -> the truth about the points of a scan |
//! | [`worlds`] | a simulated scene -> maps, and the truth about their points |
//! | [`judge`] | a layer and points of known truth -> counts |
//! | [`report`] | counts -> table, JSON |

use std::path::{Path, PathBuf};

use clearway_lidar::model::Model;
use clearway_mapping::config::{Extrinsics, MapsConfig};
use clearway_mapping::event::{Body, Event, Scan};
use clearway_mapping::sensor::mount::{MountError, estimate};
use clearway_mapping::error::EventError;
use clearway_mapping::pipeline::Pipeline;
use clearway_mapping::sensor::sweep::{Mount, Sweep};

use crate::config::{Config, ConfigError};
use crate::ingest::files::kitti::{self, ScanError};

pub mod judge;
pub mod labels;
pub mod pairs;
pub mod report;
pub mod worlds;

use judge::{Point, Tally};
use pairs::Pair;
use report::{Report, Source};

/// How the sensor sits on KITTI's car, as its makers publish it. Published figures were measured with it, and an
/// estimate from one scan leans with the road under it.
const KITTI_EXTRINSICS: Extrinsics =
    Extrinsics { x_m: 0.0, y_m: 0.0, z_m: 1.73, roll_deg: 0.0, pitch_deg: 0.0, yaw_deg: 0.0 };
/// A sensor that stands so much higher or lower over the ground it sees is another car's.
const MOUNT_M_OFF_MAX: f64 = 0.3;
/// Scans that are asked for the ground under them.
const MOUNT_SCANS: usize = 10;

/// What to evaluate, and how.
#[derive(Clone, Debug, Default)]
pub struct Options {
    /// Folders, files, or `sim:NAME`.
    pub paths: Vec<String>,
    /// Columns of the radial maps, in degrees: 1, 2 or 4; the configuration's where absent.
    pub columns_deg: Option<u16>,
    /// How the scans' sensor is mounted; as on KITTI's car where absent.
    pub extrinsics: Option<Extrinsics>,
    /// Configuration whose first vehicle's maps are judged; the defaults where absent.
    pub config: Option<PathBuf>,
    /// Overrides of the configuration.
    pub set: Vec<String>,
}

/// Why an evaluation did not come to its end.
#[derive(Debug, thiserror::Error)]
pub enum EvaluateError {
    /// Scans and labels do not belong together.
    #[error(transparent)]
    Pairs(#[from] pairs::PairsError),
    /// A scan cannot be read.
    #[error(transparent)]
    Scan(#[from] ScanError),
    /// Labels cannot be used.
    #[error(transparent)]
    Labels(#[from] labels::LabelError),
    /// No such scene.
    #[error("sim:{name}: the scenes are {known}")]
    Scene {
        /// As it was given.
        name: String,
        /// What there is.
        known: String,
    },
    /// The scans do not show how their sensor is mounted.
    #[error("{}: {source}; give --extrinsics", folder.display())]
    Mount {
        /// Where they lie.
        folder: PathBuf,
        /// Why.
        source: MountError,
    },
    /// The scans are not from KITTI's car.
    #[error(
        "{}: the sensor stands {height_m:.2} m over the ground, on KITTI's car 1.73 m; give --extrinsics",
        folder.display()
    )]
    OtherMount {
        /// Where they lie.
        folder: PathBuf,
        /// As estimated from the ground.
        height_m: f64,
    },
    /// The configuration cannot be used.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// A value of the maps' configuration cannot be used.
    #[error(transparent)]
    Maps(#[from] clearway_mapping::config::ConfigValueError),
    /// The pipeline does not take a scan.
    #[error("{}: {source}", scan.display())]
    Rejected {
        /// The scan.
        scan: PathBuf,
        /// Why.
        source: EventError,
    },
}

/// How many degrees a radial map's column may span, and how many columns that makes.
pub fn columns(degrees: u16) -> Option<u16> {
    matches!(degrees, 1 | 2 | 4).then(|| 360 / degrees)
}

/// Judges every map that is switched on; `progress` is told of frames done and frames known of.
///
/// # Errors
/// [`EvaluateError`] for the first path that cannot be judged.
pub fn evaluate(options: &Options, mut progress: impl FnMut(u64, u64)) -> Result<Report, EvaluateError> {
    let maps = maps(options)?;
    // All paths are looked at before the first is judged, so that a wrong one costs no waiting.
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

enum Input {
    World(&'static str, u64),
    Labelled(pairs::Pairs),
}

impl Input {
    fn new(path: &str) -> Result<Self, EvaluateError> {
        let Some(name) = path.strip_prefix("sim:") else { return Ok(Self::Labelled(pairs::find(Path::new(path))?)) };
        let known = || worlds::SCENES.map(|(name, _)| name).join(", ");
        let found = worlds::SCENES.iter().find(|(known, _)| *known == name);
        let (name, revolutions) = found.ok_or_else(|| EvaluateError::Scene { name: name.into(), known: known() })?;
        Ok(Self::World(name, *revolutions))
    }

    fn frames(&self) -> u64 {
        match self {
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

/// The core of a vehicle with one sensor.
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

fn judge_world(
    name: &str,
    revolutions: u64,
    maps: &MapsConfig,
    source: &mut Source,
    judged: &mut impl FnMut(),
) -> Result<(), EvaluateError> {
    let scene = worlds::scene(name).expect("a scene of the list");
    let scanner = worlds::scanner();
    let at = scanner.ego_from_sensor.translation;
    // The simulated sensor stands upright.
    let extrinsics = Extrinsics { x_m: at.x, y_m: at.y, z_m: at.z, roll_deg: 0.0, pitch_deg: 0.0, yaw_deg: 0.0 };
    let (mut pipeline, _) = pipeline(maps, scanner.model, extrinsics)?;
    worlds::drive(scene, &mut pipeline, revolutions, |pipeline, points| {
        let map = pipeline.newest_map().expect("a revolution makes a map");
        source.judge(&map.layers, &points);
        judged();
    });
    Ok(())
}

/// The labelled scans of one folder, in order, through one pipeline.
fn judge_folder(
    pairs: &[Pair],
    extrinsics: Option<Extrinsics>,
    maps: &MapsConfig,
    source: &mut Source,
    judged: &mut impl FnMut(),
) -> Result<(), EvaluateError> {
    let folder = pairs[0].scan.parent().unwrap_or(Path::new("")).to_owned();
    let (extrinsics, said) = match extrinsics {
        Some(extrinsics) => (extrinsics, "as given".to_owned()),
        None => (KITTI_EXTRINSICS, kitti_mount(&folder, pairs)?),
    };
    let Extrinsics { x_m, y_m, z_m, roll_deg, pitch_deg, yaw_deg } = extrinsics;
    let numbers = format!("{x_m},{y_m},{z_m},{roll_deg},{pitch_deg},{yaw_deg}");
    source.mounts.push(format!("{numbers} in {}: {said}", folder.display()));
    // SemanticKITTI's sensor.
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

/// Why KITTI's mounting is taken for these scans; the ground in them must not contradict.
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
        "KITTI's car as published; the ground in {} scan(s) says {z_m:.2} m, pitch {pitch_deg:.1}°, roll {roll_deg:.1}°",
        scans.len()
    ))
}

fn read_scan(file: &Path, index: u64) -> Result<Scan, EvaluateError> {
    match kitti::read(file, index)?.body {
        Body::Scan(scan) => Ok(scan),
        _ => unreachable!("a scan's reading is a scan"),
    }
}

#[cfg(test)]
mod tests;
