//! The command line of `clearway`, as clap reads it.

use std::path::PathBuf;
use std::time::Duration;

use clap::{Parser, Subcommand, ValueEnum};
use clearway_lidar::model::{Model, UnknownModelError};
use clearway_mapping::config::Extrinsics;
use crate::cli::evaluate;
use crate::cli::replay::Speed;

/// Turns LIDAR packets into maps of where a vehicle may drive.
#[derive(Parser)]
#[command(name = "clearway", version)]
pub struct Arguments {
    /// How logs look on stderr; RUST_LOG selects them.
    #[arg(long, value_enum, default_value = "text", global = true)]
    pub log_format: LogFormat,
    #[command(subcommand)]
    pub command: Command,
}

#[derive(Clone, Copy, ValueEnum)]
pub enum LogFormat {
    Text,
    Json,
}

#[derive(Subcommand)]
pub enum Command {
    /// Listen for datagrams, make maps and publish them, until SIGINT or SIGTERM.
    Serve {
        #[command(flatten)]
        config: ConfigArguments,
    },
    /// Make maps of pcap, pcapng, MCAP and KITTI files or folders, in the order given.
    Replay(Box<ReplayArguments>),
    /// Recompute every map of a recording from its events; exit 1 and name the first difference if there is one.
    Verify {
        /// The recording.
        file: PathBuf,
        /// One object on stdout.
        #[arg(long)]
        json: bool,
    },
    /// Judge every map against labelled scans (SemanticKITTI's .bin and .label) or simulated scenes.
    Evaluate(EvaluateArguments),
    /// Check a configuration and print it with every default.
    Check {
        #[command(flatten)]
        config: ConfigArguments,
    },
    Watch(super::watch::Options),
    Get(super::get::Options),
    Vehicles(super::vehicles::Options),
    Info(super::info::Options),
    Export(super::export::Options),
    Send(super::send::Options),
    Ingest(super::ingest::Options),
    /// Drive a simulated vehicle at a server of its own, over real UDP.
    Demo {
        /// End after so many seconds; without, at Ctrl-C.
        #[arg(long, value_parser = seconds)]
        seconds: Option<Duration>,
        /// Where to record; a temporary file where absent.
        #[arg(long)]
        record: Option<PathBuf>,
        /// One turning LIDAR in a town; or two of them and six that scan, poses and roads over gRPC, in traffic.
        #[arg(long, value_enum, default_value = "one")]
        sensors: Sensors,
        /// One object a second on stdout, and a summary.
        #[arg(long)]
        json: bool,
    },
}

#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Sensors {
    One,
    Many,
}

#[derive(clap::Args)]
pub struct ConfigArguments {
    /// The configuration file; deploy/clearway.toml shows every key.
    #[arg(short, long, env = "CLEARWAY_CONFIG", default_value = "clearway.toml")]
    pub config: PathBuf,
    /// Overrides a key: KEY=VALUE, such as grpc.listen=0.0.0.0:50051.
    #[arg(long, value_name = "KEY=VALUE")]
    pub set: Vec<String>,
}

#[derive(clap::Args)]
pub struct ReplayArguments {
    /// pcap, pcapng, MCAP, KITTI .bin, .pcd, or folders of them.
    #[arg(required = true)]
    pub files: Vec<PathBuf>,
    /// Record events and maps to this MCAP file.
    #[arg(long, value_name = "OUT.mcap")]
    pub record: Option<PathBuf>,
    /// as-recorded, max, or a factor [default: max; as-recorded with --serve].
    #[arg(long)]
    pub speed: Option<Speed>,
    /// One object on stdout.
    #[arg(long)]
    pub json: bool,
    /// Write each revolution's points, sensor frame, as binary PCD into this folder.
    #[arg(long, value_name = "DIR")]
    pub clouds: Option<PathBuf>,
    /// The sensor's own table: ROS YAML or Velodyne XML.
    #[arg(long, value_name = "FILE")]
    pub calibration: Option<PathBuf>,
    /// How the sensor is mounted: x,y,z in metres, roll,pitch,yaw in degrees; estimated from the ground where absent.
    #[arg(long, value_name = "x,y,z,roll,pitch,yaw", value_parser = extrinsics, allow_hyphen_values = true)]
    pub extrinsics: Option<Extrinsics>,
    /// The sensor's model, where the data lies about it.
    #[arg(long, value_parser = model)]
    pub model: Option<Model>,
    /// The sensor's turning rate, where the data lies about it.
    #[arg(long)]
    pub rpm: Option<f32>,
    /// A ROS topic of an MCAP file, several times for several; sensors and poses are chosen where absent.
    #[arg(long = "topic", value_name = "TOPIC")]
    pub topics: Vec<String>,
    /// Take vehicle, maps and publishers from this configuration.
    #[arg(long, value_name = "FILE")]
    pub config: Option<PathBuf>,
    /// Overrides a key of the configuration.
    #[arg(long, value_name = "KEY=VALUE", requires = "config")]
    pub set: Vec<String>,
    /// Publish the maps, until SIGINT or SIGTERM. They keep the stamps of their capture, so readers call old ones
    /// stale.
    #[arg(long)]
    pub serve: bool,
    /// Whose journal (of a recording) or configuration is used, where there are several.
    #[arg(long)]
    pub vehicle: Option<String>,
}

#[derive(clap::Args)]
pub struct EvaluateArguments {
    /// Folders with .bin and .label files of the same names, or sim:flat, sim:slopes, sim:canopy, sim:overhang,
    /// sim:town.
    #[arg(required = true, value_name = "PATH")]
    pub paths: Vec<String>,
    /// One object on stdout.
    #[arg(long)]
    pub json: bool,
    /// Degrees a column of the radial maps spans.
    #[arg(long, value_name = "1|2|4", value_parser = columns)]
    pub columns: Option<u16>,
    /// How the scans' sensor is mounted, as for replay; as on KITTI's car where absent.
    #[arg(long, value_name = "x,y,z,roll,pitch,yaw", value_parser = extrinsics, allow_hyphen_values = true)]
    pub extrinsics: Option<Extrinsics>,
    /// Judge the maps of this configuration's first vehicle.
    #[arg(long, value_name = "FILE")]
    pub config: Option<PathBuf>,
    /// Overrides a key of the configuration.
    #[arg(long, value_name = "KEY=VALUE", requires = "config")]
    pub set: Vec<String>,
}

fn columns(text: &str) -> Result<u16, String> {
    let degrees = text.parse().ok().filter(|degrees| evaluate::columns(*degrees).is_some());
    degrees.ok_or_else(|| "1, 2 or 4 degrees are allowed".into())
}

fn seconds(text: &str) -> Result<Duration, String> {
    let duration = text.parse().ok().and_then(|seconds| Duration::try_from_secs_f64(seconds).ok());
    duration.ok_or_else(|| "0 or more seconds are allowed".into())
}

fn extrinsics(text: &str) -> Result<Extrinsics, String> {
    let numbers: Vec<f64> = text.split(',').filter_map(|number| number.trim().parse().ok()).collect();
    match numbers[..] {
        [x_m, y_m, z_m, roll_deg, pitch_deg, yaw_deg] if text.split(',').count() == 6 => {
            Ok(Extrinsics { x_m, y_m, z_m, roll_deg, pitch_deg, yaw_deg })
        }
        _ => Err("six numbers are needed: x,y,z in metres, roll,pitch,yaw in degrees".into()),
    }
}

fn model(text: &str) -> Result<Model, UnknownModelError> {
    text.parse()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn extrinsics_are_six_numbers_in_metres_and_degrees() {
        let given = extrinsics("1,-0.5,1.9,0,-2.5,90").unwrap();
        assert_eq!((given.x_m, given.y_m, given.z_m), (1.0, -0.5, 1.9));
        assert_eq!((given.roll_deg, given.pitch_deg, given.yaw_deg), (0.0, -2.5, 90.0));
        for wrong in ["", "1,2,3", "1,2,3,4,5,6,7", "1,2,3,4,5,x,6"] {
            assert!(extrinsics(wrong).is_err(), "{wrong}");
        }
    }

    #[test]
    fn a_model_nobody_knows_is_answered_with_those_that_are() {
        assert_eq!(model("vls128"), Ok(Model::Vls128));
        assert!(model("ouster").unwrap_err().to_string().contains("hdl64e_s2"));
    }

    #[test]
    fn the_command_line_is_sound() {
        use clap::CommandFactory;
        Arguments::command().debug_assert();
    }
}
