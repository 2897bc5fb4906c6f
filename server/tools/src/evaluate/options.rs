//! What is judged, and how.

use std::ops::Range;
use std::path::{Path, PathBuf};

use anyhow::Result;
use clearway_daemon::config::Config;
use clearway_lidar::model::Model;
use clearway_mapping::config::{Extrinsics, MapsConfig};

use super::source::variation::Variation;

/// Seeds of the random worlds that are judged by default: every form of ground with every theme, once in even and once
/// in odd seeds.
pub const SEEDS: Range<u64> = 0..156;

/// Options of an evaluation: inputs, configuration and outputs.
#[derive(Clone, Debug)]
pub struct EvaluateOptions {
    /// Folders with scans and labels, scans, `sim:` with the name of a scene, or `sim:random`.
    pub paths: Vec<String>,
    /// Labels of the scans, a folder or a file; inside the paths themselves if `None`.
    pub labels: Option<PathBuf>,
    /// Position and orientation of the scans' sensor in the ego frame; as on KITTI's car if `None`.
    pub extrinsics: Option<Extrinsics>,
    /// Model of the sensor. `None`: of scans, their rings or the order of their points define the rows of radial maps,
    /// as in a replay, and else the rows are 1 m deep; of simulated scenes, an HDL-64E.
    pub model: Option<Model>,
    /// The variations of each labelled scan that are judged, in the order of the report.
    pub variations: Vec<Variation>,
    /// True if objects are cut into each labelled scan as it was recorded, and their cells are counted.
    pub objects: bool,
    /// Folder to which each scan and its truth is written, except scans of `sim:` other than `sim:random`.
    pub write_scans: Option<PathBuf>,
    /// Seeds of the random worlds.
    pub seeds: Range<u64>,
    /// Configuration file, whose first vehicle configures the maps; `None`: the default configuration.
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
            objects: false,
            write_scans: None,
            seeds: SEEDS,
            config: None,
            set: Vec::new(),
        }
    }
}

impl EvaluateOptions {
    /// The configuration of the maps.
    ///
    /// # Errors
    /// If the configuration is wrong.
    pub fn maps(&self) -> Result<MapsConfig> {
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
