//! Why an evaluation failed.

use std::path::PathBuf;

use clearway_mapping::error::EventError;
use clearway_mapping::sensor::mount::MountError;

use super::source::labels::LabelError;
use super::source::pairs::PairsError;
use super::source::variation::VariationError;
use clearway_daemon::config::ConfigError;
use clearway_daemon::ingest::files::kitti::ScanError;

/// Why an evaluation failed.
#[derive(Debug, thiserror::Error)]
pub enum EvaluateError {
    /// The scans and labels do not match.
    #[error(transparent)]
    Pairs(#[from] PairsError),
    /// A scan cannot be read.
    #[error(transparent)]
    Scan(#[from] ScanError),
    /// Labels cannot be used.
    #[error(transparent)]
    Labels(#[from] LabelError),
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
    /// A scan cannot be varied as asked for.
    #[error("{}: {source}", scan.display())]
    Variation {
        /// File of the scan.
        scan: PathBuf,
        /// Why it cannot.
        source: VariationError,
    },
    /// A file of a log of Argoverse 2 cannot be used.
    #[error("{}: {what}", file.display())]
    Argoverse {
        /// The file or folder.
        file: PathBuf,
        /// What is wrong, or what is needed.
        what: String,
    },
    /// A varied scan cannot be written.
    #[error("{}: {source}", file.display())]
    Write {
        /// The file.
        file: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
}
