//! Every map against the truth, of labelled scans, of simulated scenes and of random worlds.
//!
//! In: folders or files as SemanticKITTI has them, or `sim:NAME`. Out: an [`Evaluation`]. The scans and datagrams go
//! through the same pipeline as live data; its maps are judged point by point and cell by cell.
//!
//! | file | in -> out |
//! |---|---|
//! | [`options`] | what is judged -> a configuration of the maps |
//! | [`source`] | paths, scenes, seeds -> maps, and the truth about their points |
//! | [`judge`] | a layer and points of known truth -> counts |
//! | [`footprint`] | a map and points of known truth -> counts of whole footprints of a vehicle |
//! | [`tally`] | counts -> sums and shares |
//! | [`report`] | counts -> JSON |
//! | [`table`] | counts -> tables |

use std::path::Path;

use anyhow::{Result, bail};

use crate::scenes::{self, NamedScene, SCENES};

pub mod footprint;
pub mod judge;
pub mod options;
pub mod report;
pub mod source;
mod table;
pub mod tally;

use report::{EvaluatedSource, Evaluation};
use source::pairs::{LabelledScans, find_pairs};
use source::random::judge_random_worlds;
use source::scans::judge_folder;
use source::worlds;

pub use options::EvaluateOptions;

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
    /// `sim:NAME`: a simulated scene.
    World(&'static NamedScene),
    /// `sim:random`: random worlds.
    Random,
    /// A path: labelled scans.
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

#[cfg(test)]
mod tests;
