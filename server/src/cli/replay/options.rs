//! The options of `clearway replay`, and why a replay fails.

use std::path::PathBuf;

use clap::Args;
use clearway_lidar::model::Model;
use clearway_mapping::config::Extrinsics;

use super::clouds::CloudError;
use crate::cli::shared::configuration::extrinsics;
use crate::cli::shared::model::ModelParser;
use clearway_daemon::config::ConfigError;
use clearway_daemon::ingest::files::FilesError;
use clearway_daemon::replay::control::{ControlError, RATES};
use clearway_daemon::replay::faults::{Fault, FaultError};
use clearway_daemon::replay::outcome::PlayError;
use clearway_daemon::run::{ShutdownError, StartError};
use clearway_journal::reader::RecordingError;

/// Make maps from recorded drives: pcap, pcapng, MCAP, KITTI, nuScenes and PCD files or folders.
///
/// The sensor's model, return mode and rotation rate are found from the data. If nothing says how the sensor is
/// mounted, height, pitch and roll are estimated from the ground in the first revolutions; the estimate is printed and
/// recorded.
#[derive(Args, Clone, Debug, Default)]
#[command(after_help = "Examples:
  clearway replay drive.pcap --record drive.mcap
  clearway replay drive.pcap --extrinsics 0,0,1.9,0,0,0 --json
  clearway replay drive.mcap --serve --as-live
  clearway replay drive.mcap --serve --as-live --any-port --ready-file ready.json --wait-readers 1 --exit-at-end

Exit codes: 0 the end was reached, 2 failure, no reading, a file that is not whole, or a signal before the end, 3 wrong use.")]
pub struct Options {
    /// pcap, pcapng, MCAP, KITTI .bin, nuScenes .pcd.bin and .pcd files, or folders of them, in the order
    /// given.
    #[arg(required = true)]
    pub files: Vec<PathBuf>,
    /// Record the events and the maps to this MCAP file, which must not exist.
    #[arg(long, value_name = "OUT.mcap")]
    pub record: Option<PathBuf>,
    /// Replace the file of --record if it exists, when the new one is whole. If the replay ends before, or a file is
    /// not whole or has no reading, the file keeps its name, and the new one is named OUT.early.mcap.
    #[arg(long, requires = "record")]
    pub force: bool,
    /// Speed of the replay: as-recorded, max, or a factor such as 0.5 [default: max; as-recorded with --serve].
    #[arg(long, value_name = "as-recorded|max|X")]
    pub speed: Option<Speed>,
    /// Print one JSON object at the end.
    #[arg(long)]
    pub json: bool,
    /// Write the points of each revolution, in the sensor frame, to this folder as binary PCD files.
    #[arg(long, value_name = "DIR")]
    pub clouds: Option<PathBuf>,
    /// Calibration file of the first sensor (ROS YAML or Velodyne XML); the factory's values if absent.
    #[arg(long, value_name = "FILE")]
    pub calibration: Option<PathBuf>,
    /// Position and orientation of the first sensor in the ego frame, in metres and degrees, such as 0,0,1.9,0,0,0;
    /// estimated from the ground if neither this nor the files nor the configuration has it.
    #[arg(long, value_name = "x,y,z,roll,pitch,yaw", value_parser = extrinsics, allow_hyphen_values = true)]
    pub extrinsics: Option<Extrinsics>,
    /// Model of every sensor, if the data names the wrong one or none; of scans, the model whose elevations they have.
    #[arg(long, value_parser = ModelParser)]
    pub model: Option<Model>,
    /// Rotation rate of every sensor, in revolutions per minute, if the data gives the wrong one or none.
    #[arg(long)]
    pub rpm: Option<f32>,
    /// A ROS topic of a ROS 2 bag (MCAP) to read; may be given several times. Sensors and poses are chosen if absent.
    #[arg(long = "topic", value_name = "TOPIC")]
    pub topics: Vec<String>,
    /// Use the vehicle, the maps and the publishers of this configuration.
    #[arg(long, value_name = "FILE")]
    pub config: Option<PathBuf>,
    /// Override a key of that configuration, or of the recorded one, such as vehicle.maps.valid_ms=500; may be given
    /// several times.
    #[arg(long, value_name = "KEY=VALUE")]
    pub set: Vec<String>,
    /// Publish the maps, and the last one until SIGINT (Ctrl-C) or SIGTERM. Without --as-live the maps keep the stamps
    /// of the recording, so readers see those of an old recording as stale.
    #[arg(long)]
    pub serve: bool,
    /// The vehicle to replay; needed if the recording or the configuration has several.
    #[arg(long, value_name = "NAME")]
    pub vehicle: Option<String>,
    /// Begin this many seconds after the first event; the maps from there are those of the whole drive.
    #[arg(long, value_name = "SECONDS", value_parser = offset)]
    pub from: Option<f64>,
    /// Stand at this many seconds after the first event at the start, with the whole drive before and after it.
    #[arg(skip)]
    pub seek: Option<f64>,
    /// End this many seconds after the first event.
    #[arg(long, value_name = "SECONDS", value_parser = seconds)]
    pub to: Option<f64>,
    /// Move the stamps of the maps to the present, so that readers judge their age as on the vehicle.
    #[arg(long, requires = "serve")]
    pub as_live: bool,
    /// Begin again at the end of the drive or of --to, until a signal.
    #[arg(long, requires = "serve", conflicts_with_all = ["record", "exit_at_end"])]
    pub r#loop: bool,
    /// Begin paused; `clearway transport`, the page or a key starts it.
    #[arg(long, requires = "serve")]
    pub paused: bool,
    /// Make the next map when every reader that acknowledges has acknowledged the last one; the default speed is max.
    #[arg(long, requires = "serve")]
    pub lockstep: bool,
    /// Longest wait for an acknowledgement with --lockstep [default: 10]. After it the server ends with exit code 2,
    /// and names the map and the readers.
    #[arg(long, value_name = "SECONDS", requires = "lockstep", value_parser = seconds)]
    pub lockstep_timeout: Option<f64>,
    /// Wait for this many readers before the first event: gRPC streams, pages, zenoh keys and Foxglove subscriptions.
    #[arg(long, value_name = "N", requires = "serve")]
    pub wait_readers: Option<u32>,
    /// Write the process id and the addresses to this file as JSON once readers can connect; it is removed at the end.
    /// Only the file of an earlier replay, or an empty one, is replaced.
    #[arg(long, value_name = "FILE.json", requires = "serve")]
    pub ready_file: Option<PathBuf>,
    /// Listen on free ports of this machine only; --ready-file and the log say which.
    #[arg(long, requires = "serve")]
    pub any_port: bool,
    /// Replay with a fault: lost:SENSOR@FROM-TO, loss:PERCENT or loss:PERCENT@FROM-TO, clock:MS@AT, pose:X,Y,YAW@AT or
    /// stop@FROM-TO, in seconds after the first event, metres and degrees; may be given several times. clock steps the
    /// clock of this host, by which packets arrive: maps stamped by a sensor's own clock keep their stamps, and the
    /// status names the difference.
    #[arg(long = "fault", value_name = "FAULT", value_parser = |text: &str| text.parse::<Fault>())]
    pub faults: Vec<Fault>,
    /// Replay with the faults of this file, one a line; # begins a comment.
    #[arg(long, value_name = "FILE")]
    pub fault_script: Option<PathBuf>,
    /// Seed of the faults; without --fault and --fault-script it draws one of each kind.
    #[arg(long, value_name = "SEED")]
    pub fault_seed: Option<u64>,
    /// End when the end of the drive or of --to is reached, instead of serving the last map.
    #[arg(long, requires = "serve")]
    pub exit_at_end: bool,
}

/// Speed of a replay, relative to the recorded time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Speed {
    /// This many times the recorded speed; above 0.
    Times(f64),
    /// As fast as the machine can.
    Max,
}

impl Speed {
    /// The rate relative to recorded time; infinity for [`Speed::Max`].
    pub fn rate(self) -> f64 {
        match self {
            Self::Times(times) => times,
            Self::Max => f64::INFINITY,
        }
    }
}

/// Greatest number of seconds, about 30 years. Ours.
const SECONDS_MAX: f64 = 1e9;

/// A number of seconds after the first event.
pub(crate) fn offset(text: &str) -> Result<f64, String> {
    match text.parse() {
        Ok(seconds) if (0.0..=SECONDS_MAX).contains(&seconds) => Ok(seconds),
        _ => Err("0 to 1000000000 seconds are allowed".into()),
    }
}

/// A number of seconds above 0.
fn seconds(text: &str) -> Result<f64, String> {
    match text.parse() {
        Ok(seconds) if seconds > 0.0 && seconds <= SECONDS_MAX => Ok(seconds),
        _ => Err("a number of seconds above 0, up to 1000000000, is allowed".into()),
    }
}

impl std::str::FromStr for Speed {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text {
            "as-recorded" => Ok(Self::Times(1.0)),
            "max" => Ok(Self::Max),
            factor => match factor.parse() {
                Ok(times) if RATES.contains(&times) => Ok(Self::Times(times)),
                _ => Err("as-recorded, max, or a factor from 0.1 to 1000 is allowed".into()),
            },
        }
    }
}

/// Why a replay failed.
#[derive(Debug, thiserror::Error)]
pub enum ReplayError {
    /// A file cannot be read.
    #[error(transparent)]
    Files(#[from] FilesError),
    /// A recording cannot be used.
    #[error(transparent)]
    Recording(#[from] RecordingError),
    /// The configuration cannot be used.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// The configuration has no vehicle of that name.
    #[error("--vehicle {name}: the configuration has: {known}")]
    Vehicle {
        /// Name of the vehicle, as given.
        name: String,
        /// Names of the vehicles of the configuration, separated by commas.
        known: String,
    },
    /// The recording or the configuration has several vehicles.
    #[error("{} has the vehicles {known}: name one with --vehicle", file.display())]
    Vehicles {
        /// The recording or the configuration.
        file: PathBuf,
        /// Names of its vehicles, separated by commas.
        known: String,
    },
    /// An option has no meaning for these files.
    #[error("{option}: {reason}")]
    Unused {
        /// The option, with its value.
        option: String,
        /// Why it has no meaning.
        reason: String,
    },
    /// The recording would replace a file that is replayed.
    #[error("--record {}: this file is replayed; name another file", file.display())]
    RecordsInput {
        /// The file.
        file: PathBuf,
    },
    /// The recording would replace the file of another option, or is written to it meanwhile.
    #[error("--record {}: this is the file of {option}, or written under its name; name another file", file.display())]
    RecordOfOption {
        /// The file.
        file: PathBuf,
        /// The option.
        option: &'static str,
    },
    /// The recording would replace a folder, a pipe or a device.
    #[error("--record {}: this is a folder, a pipe or a device; name a file", file.display())]
    RecordNoFile {
        /// The file.
        file: PathBuf,
    },
    /// The recording would be one of the files of a folder that is replayed.
    #[error("--record {}: the folder {} is replayed; name a file in another folder", file.display(), folder.display())]
    RecordsIntoInput {
        /// The file.
        file: PathBuf,
        /// Its folder.
        folder: PathBuf,
    },
    /// The recording would replace a file, and that was not allowed.
    #[error("--record {}: the file exists and is not overwritten; name another file, or add --force", file.display())]
    RecordExists {
        /// The file.
        file: PathBuf,
    },
    /// The recording would replace a symbolic link by a file.
    #[error("--record {}: this is a symbolic link; name the file that it leads to", file.display())]
    RecordLink {
        /// The link.
        file: PathBuf,
    },
    /// A recording that is not finished has that name, or a name that the new one needs.
    #[error(
        "--record {}: {} is the name of a recording that is being written or that a crash has left; name another file",
        file.display(),
        unfinished.display()
    )]
    RecordUnfinished {
        /// The file.
        file: PathBuf,
        /// The unfinished recording.
        unfinished: PathBuf,
    },
    /// The recording would become the first part of an earlier one.
    #[error("--record {}: {} is a part of an earlier recording of this name; name another file", file.display(), part.display())]
    RecordParts {
        /// The file.
        file: PathBuf,
        /// The other part.
        part: PathBuf,
    },
    /// The recording that --force replaces cannot be kept until the new one is whole.
    #[error("--record {}: the file that --force replaces cannot be kept meanwhile: {source}", file.display())]
    Former {
        /// The file.
        file: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
    /// The point clouds cannot be written.
    #[error(transparent)]
    Clouds(#[from] CloudError),
    /// The server did not start.
    #[error(transparent)]
    Start(#[from] StartError),
    /// The server did not end in order.
    #[error(transparent)]
    End(#[from] ShutdownError),
    /// The thread of the replay panicked.
    #[error("the thread of the replay has panicked")]
    Engine,
    /// The range is not in the files.
    #[error("--{0}")]
    Control(#[from] ControlError),
    /// The files have no events.
    #[error("the files have no events to serve{truncated}")]
    Empty {
        /// Which of them are truncated and how, for people; empty if none.
        truncated: String,
    },
    /// A fault is not known.
    #[error(transparent)]
    Fault(#[from] FaultError),
    /// The script of the faults cannot be read.
    #[error("--fault-script {}: {source}", file.display())]
    FaultScript {
        /// The file.
        file: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
    /// A line of the script is no fault.
    #[error("--fault-script {}, line {line}: {source}", file.display())]
    FaultLine {
        /// The file.
        file: PathBuf,
        /// Number of the line, from 1 on.
        line: usize,
        /// What is wrong with it.
        source: FaultError,
    },
    /// Two recordings of one vehicle have different configurations of it.
    #[error("{}: its configuration of vehicle {vehicle} differs from that of the files before", file.display())]
    Differs {
        /// The recording.
        file: PathBuf,
        /// The vehicle's name.
        vehicle: String,
    },
    /// The configuration's vehicle is none of the recording.
    #[error("{}: its vehicle is {configured}, but the recording has {recorded}; the same name is allowed", file.display())]
    OtherVehicle {
        /// The configuration.
        file: PathBuf,
        /// Name of its vehicle.
        configured: String,
        /// Names of the recorded vehicles, separated by commas.
        recorded: String,
    },
    /// The configuration does not fit the recording: its sensors are others, or in another order.
    #[error(
        "{}: vehicle {vehicle} has the sensors [{configured}], but the recording has [{recorded}]; the same names in \
         the same order are allowed",
        file.display()
    )]
    Sensors {
        /// The configuration.
        file: PathBuf,
        /// The vehicle's name.
        vehicle: String,
        /// Its sensors in the configuration, separated by commas.
        configured: String,
        /// Its sensors in the recording, separated by commas.
        recorded: String,
    },
    /// The replay could not go on.
    #[error(transparent)]
    Play(#[from] PlayError),
    /// The file that tells programs the addresses cannot be written.
    #[error("--ready-file {}: {source}", file.display())]
    ReadyFile {
        /// The file.
        file: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_speed_is_a_word_or_a_factor() {
        assert_eq!("as-recorded".parse(), Ok(Speed::Times(1.0)));
        assert_eq!("max".parse(), Ok(Speed::Max));
        assert_eq!("2.5".parse(), Ok(Speed::Times(2.5)));
        for wrong in ["0", "-1", "0.05", "inf", "NaN", "fast"] {
            assert!(wrong.parse::<Speed>().unwrap_err().contains("as-recorded, max"), "{wrong}");
        }
    }
}
