//! Every map against the truth, of labelled scans, of simulated scenes and of random worlds.
//!
//! In: folders or files as SemanticKITTI has them, or `sim:NAME`. Out: an [`Evaluation`]. The scans and datagrams go
//! through the same pipeline as live data; its maps are judged point by point and cell by cell.
//!
//! | file | in -> out |
//! |---|---|
//! | [`source`] | paths, scenes, seeds -> maps, and the truth about their points |
//! | [`judge`] | a layer and points of known truth -> counts |
//! | [`tally`] | counts -> sums and shares |
//! | [`report`] | counts -> JSON |
//! | [`table`] | counts -> tables |

use std::ops::Range;
use std::path::{Path, PathBuf};

use anyhow::{Result, bail};
use clearway_daemon::config::Config;
use clearway_lidar::model::Model;
use clearway_mapping::config::{Extrinsics, MapsConfig};

use crate::scenes::{self, NamedScene, SCENES};

pub mod judge;
pub mod report;
pub mod source;
mod table;
pub mod tally;

use report::{EvaluatedSource, Evaluation};
use source::pairs::{LabelledScans, find_pairs};
use source::random::judge_random_worlds;
use source::scans::judge_folder;
use source::variation::Variation;
use source::worlds;

/// Seeds of the random worlds that are judged by default: every form of ground with every theme, once in even and once
/// in odd seeds.
pub const SEEDS: Range<u64> = 0..156;

/// What is judged, and how.
#[derive(Clone, Debug)]
pub struct EvaluateOptions {
    /// Folders with scans and labels, scans, `sim:` with the name of a scene, or `sim:random`.
    pub paths: Vec<String>,
    /// Labels of the scans, a folder or a file; inside the paths themselves if `None`.
    pub labels: Option<PathBuf>,
    /// Position and orientation of the scans' sensor in the ego frame; as on KITTI's car if `None`.
    pub extrinsics: Option<Extrinsics>,
    /// Model of the sensor. `None`: of scans, the rings in the file define the rows of radial maps, or an HDL-64E if
    /// the file has no rings; of simulated scenes, an HDL-64E.
    pub model: Option<Model>,
    /// The variations of each labelled scan that are judged, in the order of the report.
    pub variations: Vec<Variation>,
    /// Folder to which each scan and its truth is written, but not those of `sim:` other than `sim:random`.
    pub write_scans: Option<PathBuf>,
    /// Seeds of the random worlds.
    pub seeds: Range<u64>,
    /// Configuration of the maps, those of its first vehicle; the default configuration if `None`.
    pub config: Option<PathBuf>,
    /// Overrides of keys of the configuration.
    pub set: Vec<String>,
}

impl Default for EvaluateOptions {
    fn default() -> Self {
        Self {
            paths: Vec::new(),
            labels: None,
            extrinsics: None,
            model: None,
            variations: vec![Variation::Recorded],
            write_scans: None,
            seeds: SEEDS,
            config: None,
            set: Vec::new(),
        }
    }
}

/// Judges every map that the configuration enables. `progress` is called with the number of frames judged and of all
/// frames.
///
/// # Errors
/// For the first path that cannot be judged.
pub fn evaluate(options: &EvaluateOptions, mut progress: impl FnMut(u64, u64) + Send) -> Result<Evaluation> {
    let maps = options.maps()?;
    // Every path is checked before the first is judged, so that an error appears at once.
    let inputs = options.paths.iter().map(|path| Input::new(path, options)).collect::<Result<Vec<_>>>()?;
    let total = inputs.iter().map(|input| input.frames(options)).sum();
    let (mut done, mut evaluation) = (0, Evaluation::default());
    for (path, input) in options.paths.iter().zip(inputs) {
        let mut source = EvaluatedSource { path: path.clone(), ..EvaluatedSource::default() };
        let mut judged = || {
            done += 1;
            progress(done, total);
        };
        match input {
            Input::World(scene) => worlds::judge_scene(scene, options.model, &maps, &mut source, &mut judged)?,
            Input::Random => judge_random_worlds(options, &maps, &mut source, &mut judged)?,
            Input::Labelled(found) => {
                source.unlabelled = found.unlabelled;
                for pairs in found.pairs.chunk_by(|a, b| a.scan.parent() == b.scan.parent()) {
                    judge_folder(pairs, options, &maps, &mut source, &mut judged)?;
                }
            }
        }
        evaluation.sources.push(source);
    }
    Ok(evaluation)
}

/// What one path stands for.
enum Input {
    /// A simulated scene.
    World(&'static NamedScene),
    /// Random worlds.
    Random,
    /// Labelled scans.
    Labelled(LabelledScans),
}

impl Input {
    fn new(path: &str, options: &EvaluateOptions) -> Result<Self> {
        match path.strip_prefix("sim:") {
            None => Ok(Self::Labelled(find_pairs(Path::new(path), options.labels.as_deref())?)),
            Some("random") => Ok(Self::Random),
            Some(name) => match scenes::find(name) {
                Some(scene) => Ok(Self::World(scene)),
                None => bail!("{path}: the scenes are {}, random", SCENES.map(|scene| scene.name).join(", ")),
            },
        }
    }

    fn frames(&self, options: &EvaluateOptions) -> u64 {
        match self {
            Self::World(scene) => scene.revolutions,
            Self::Random => options.seeds.clone().count() as u64,
            Self::Labelled(found) => (found.pairs.len() * options.variations.len()) as u64,
        }
    }
}

impl EvaluateOptions {
    fn maps(&self) -> Result<MapsConfig> {
        let config = match &self.config {
            Some(file) => Config::load(file, &self.set)?,
            None => {
                let text = Config::of_one_vehicle("car", "top").to_toml();
                Config::parse(&text, Path::new("the default configuration"), &self.set)?
            }
        };
        Ok(config.vehicles.into_iter().next().map(|vehicle| vehicle.maps).unwrap_or_default())
    }
}

#[cfg(test)]
mod tests;
