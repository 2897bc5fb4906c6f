//! What a replay does, as the command line or a test gives it.

use std::path::PathBuf;
use std::str::FromStr;
use std::time::Duration;

use clearway_daemon::replay_control::RATES;
use clearway_lidar::model::Model;
use clearway_mapping::config::Extrinsics;

use crate::player::faults::Fault;

/// The files of a replay and what is made of them.
#[derive(Clone, Debug, Default)]
pub struct ReplayOptions {
    /// Captures, recordings, ROS 2 bags and scans, or folders of them, in the order in which they are read.
    pub files: Vec<PathBuf>,
    /// Name of the vehicle, if the recording or the configuration has several.
    pub vehicle: Option<String>,
    /// Topics of a ROS 2 bag; sensors and poses are chosen if there are none.
    pub topics: Vec<String>,
    /// Configuration file with the vehicle, the maps and the publishers.
    pub config: Option<PathBuf>,
    /// Overrides of the configuration, as KEY=VALUE.
    pub set: Vec<String>,
    /// Mount of the first sensor; estimated if neither this nor the files nor the configuration has it.
    pub extrinsics: Option<Extrinsics>,
    /// Model of every sensor.
    pub model: Option<Model>,
    /// Recording that is written.
    pub record: Option<PathBuf>,
    /// Begin, in seconds after the first event.
    pub from_s: Option<f64>,
    /// End, in seconds after the first event.
    pub to_s: Option<f64>,
    /// Speed; as recorded for readers without lockstep, else as fast as possible.
    pub speed: Option<ReplaySpeed>,
    /// Faults of the drive.
    pub faults: Vec<Fault>,
    /// How the maps are published; `None`: they are made for the summary and the recording alone.
    pub served: Option<ServedReplay>,
}

/// How a replay is published.
#[derive(Clone, Debug, Default)]
pub struct ServedReplay {
    /// The stamps of the maps move to the present.
    pub as_live: bool,
    /// The drive begins again at its end.
    pub repeat: bool,
    /// The drive begins paused.
    pub paused: bool,
    /// Time at which the drive stands at the start, in seconds after the first event.
    pub seek_s: Option<f64>,
    /// Longest wait for the acknowledgement of each map; `None`: no map waits for one.
    pub lockstep: Option<Duration>,
    /// Number of readers that must be there before the first event.
    pub wait_readers: u32,
    /// File that gets the process id and the addresses as JSON when readers can connect.
    pub ready_file: Option<PathBuf>,
    /// Every listener has a free port of this machine.
    pub any_port: bool,
    /// The replay ends at the end of the drive, instead of publishing the last map until a signal.
    pub exits_at_end: bool,
}

/// Speed of a replay, relative to the recorded time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum ReplaySpeed {
    /// This many times the recorded speed; above 0.
    Times(f64),
    /// As fast as the machine can.
    Max,
}

impl ReplaySpeed {
    /// The rate relative to recorded time; infinity for [`ReplaySpeed::Max`].
    pub fn rate(self) -> f64 {
        match self {
            Self::Times(times) => times,
            Self::Max => f64::INFINITY,
        }
    }
}

impl FromStr for ReplaySpeed {
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_speed_is_a_word_or_a_factor() {
        assert_eq!("as-recorded".parse(), Ok(ReplaySpeed::Times(1.0)));
        assert_eq!("max".parse(), Ok(ReplaySpeed::Max));
        assert_eq!("2.5".parse(), Ok(ReplaySpeed::Times(2.5)));
        for wrong in ["0", "-1", "0.05", "inf", "NaN", "fast"] {
            assert!(wrong.parse::<ReplaySpeed>().unwrap_err().contains("as-recorded, max"), "{wrong}");
        }
    }
}
