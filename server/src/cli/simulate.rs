//! `clearway simulate`: a simulated scene -> the datagrams of a simulated vehicle, in a capture or over UDP.

use std::path::PathBuf;
use std::time::Duration;

use anyhow::Result;
use clap::Args;
use clap::builder::{PossibleValue, PossibleValuesParser};
use clearway_lidar::model::Model;
use clearway_tools::scenes::{self, SCENES};
use clearway_tools::send::target;
use clearway_tools::simulate::SimulatedDrive;

use crate::arguments::model::ModelParser;
use crate::process::stop_flag;
use crate::terminal::{Exit, counted, print_line, progress_bar};

/// The names of the scenes as the command line accepts them.
fn names() -> PossibleValuesParser {
    PossibleValuesParser::new(SCENES.iter().map(|scene| PossibleValue::new(scene.name).help(scene.description)))
}

/// Simulate a drive: write the datagrams of a simulated vehicle to a capture, or send them over UDP.
///
/// The vehicle has one LIDAR on its roof, 1.9 m above the ground, and sends data packets and telemetry (position and
/// speed). In a capture the drive begins on 2026-01-01 at 12:00 UTC, so that the same options make the same file.
#[derive(Args)]
#[command(after_help = "Examples:
  clearway simulate town --seconds 10 --out drive.pcap
  clearway simulate street --sensor vlp16 --to udp://127.0.0.1:2368 --endless")]
pub struct SimulateArguments {
    /// The scene.
    #[arg(value_parser = names())]
    scene: String,
    /// Model of the sensor.
    #[arg(long, visible_alias = "model", value_name = "MODEL", default_value = "hdl64e_s2")]
    #[arg(value_parser = ModelParser)]
    sensor: Model,
    /// Duration of the drive, in seconds.
    #[arg(long, default_value = "10", value_parser = seconds)]
    seconds: Duration,
    /// With --to: drive on until Ctrl-C.
    #[arg(long, requires = "to", conflicts_with_all = ["seconds", "out"])]
    endless: bool,
    /// Seed of the sensor's noise; the same seed makes the same datagrams.
    #[arg(long, default_value = "1")]
    seed: u64,
    /// Write a capture to this new file.
    #[arg(long, value_name = "FILE.pcap", required_unless_present = "to", conflicts_with = "to")]
    out: Option<PathBuf>,
    /// Send the datagrams to this address as they are made, in real time.
    #[arg(long, value_name = "udp://HOST:PORT")]
    to: Option<String>,
    /// With --to: the target of the telemetry; the target of the data packets if absent.
    #[arg(long, value_name = "udp://HOST:PORT", requires = "to", conflicts_with = "out")]
    telemetry_to: Option<String>,
}

fn seconds(text: &str) -> Result<Duration, String> {
    let duration = text.parse().ok().filter(|seconds| (0.1..=3600.0).contains(seconds));
    duration.map(Duration::from_secs_f64).ok_or_else(|| "0.1 to 3600 seconds are allowed".into())
}

/// Simulates the drive.
pub fn run(arguments: &SimulateArguments) -> Result<Exit> {
    let SimulateArguments { scene, sensor, seconds, endless, seed, out, to, telemetry_to } = arguments;
    let named = scenes::find(scene).expect("clap accepts only names of scenes");
    let drive = SimulatedDrive { scene: (named.make)(), model: *sensor, duration: *seconds, seed: *seed };
    let (sent, place) = match (out, to) {
        (Some(file), _) => {
            let bar = progress_bar(seconds.as_millis() as u64);
            let written = drive.write_capture(file, |time| bar.set_position(time.as_millis() as u64))?;
            bar.finish_and_clear();
            (written, format!("in {}", file.display()))
        }
        (None, Some(to)) => {
            let to = target(to)?;
            let telemetry_to = telemetry_to.as_deref().map_or(Ok(to), target)?;
            (drive.send(to, telemetry_to, *endless, &*stop_flag()?)?, format!("sent to {to}"))
        }
        (None, None) => unreachable!("clap requires --out or --to"),
    };
    let (packets, telemetry) = (counted(sent.packets, "data packet"), counted(sent.telemetry, "telemetry datagram"));
    let (seconds, sensor) = (sent.device_time.as_secs_f64(), sensor.as_str());
    print_line(&format!("{seconds:.1} s of {scene} with the sensor {sensor}: {packets} and {telemetry} {place}"))?;
    Ok(Exit::Good)
}
