//! `clearway demo`: a simulated vehicle -> a server of its own, over real UDP.

use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

use anyhow::Result;
use clap::Args;
use clearway_tools::demo::report::DemoReport;
use clearway_tools::demo::sensors::DemoSensors;
use clearway_tools::demo::{DemoEndpoints, DemoOptions, demo};

use super::shared::output::{block_on, print_line, stop_signal};

/// Drive a simulated car against a server of its own, over real UDP, and serve its maps.
///
/// A simulation that is too slow for this machine skips time and reports it. Only --record and a picture of the newest
/// map (target/demo.png, or demo.png in the temporary folder) write to the disk; the last line says what is left there.
#[derive(Args)]
#[command(after_help = "Examples:
  clearway demo
  clearway demo --sensors vlp16 --seconds 30 --record drive.mcap")]
pub struct DemoArguments {
    /// End after this many seconds; at Ctrl-C if absent.
    #[arg(long, value_parser = seconds)]
    seconds: Option<Duration>,
    /// Record events and maps to this MCAP file, which must not exist; it grows by about 115 MB a minute with an
    /// HDL-64E. The newest 2 GiB are kept.
    #[arg(long, value_name = "OUT.mcap")]
    record: Option<PathBuf>,
    /// The car's sensors.
    #[arg(long, value_enum, default_value_t, visible_alias = "sensor")]
    sensors: DemoSensors,
    /// Listen on ports that the operating system chooses. Without it a port that is in use is replaced by such a one.
    #[arg(long)]
    any_port: bool,
}

fn seconds(text: &str) -> Result<Duration, String> {
    let duration = text.parse().ok().and_then(|seconds| Duration::try_from_secs_f64(seconds).ok());
    duration.ok_or_else(|| "0 or more seconds are allowed".into())
}

/// Runs the demo and prints a line a second.
///
/// # Errors
/// As [`demo`].
pub fn run(arguments: DemoArguments) -> Result<()> {
    block_on(demo_and_print(arguments))
}

async fn demo_and_print(arguments: DemoArguments) -> Result<()> {
    let DemoArguments { seconds: duration, record, sensors, any_port } = arguments;
    let folder = if Path::new("target").is_dir() { PathBuf::from("target") } else { std::env::temp_dir() };
    let picture = record.as_ref().map_or_else(|| folder.join("demo.png"), |record| record.with_extension("png"));
    let began = SystemTime::now();
    let options = DemoOptions { duration, record: record.clone(), picture: Some(picture.clone()), sensors, any_port };
    let begun = |endpoints: &DemoEndpoints| {
        let _ = print_line(&introduction(endpoints, record.as_deref(), &picture));
    };
    let report = |report: &DemoReport| {
        let _ = print_line(&report.line());
    };
    let summary = demo(options, begun, report, stop_signal()?).await?;
    print_line(&summary.text())?;
    print_line(&left_behind(record.as_deref(), &picture, began))?;
    Ok(())
}

/// What the demo leaves on the disk.
fn left_behind(record: Option<&Path>, picture: &Path, began: SystemTime) -> String {
    let size = |path: &Path| path.metadata().map_or(0.0, |metadata| metadata.len() as f64 / 1e6);
    let parts = record.map(clearway_daemon::record::writer::parts_of).unwrap_or_default();
    let is_new = |picture: &PathBuf| picture.metadata().and_then(|of| of.modified()).is_ok_and(|at| at >= began);
    let picture = Some(picture.to_owned()).filter(is_new);
    let files: Vec<String> =
        parts.iter().chain(&picture).map(|file| format!("{} ({:.1} MB)", file.display(), size(file))).collect();
    format!("left on the disk: {}", if files.is_empty() { "nothing".to_owned() } else { files.join(", ") })
}

fn introduction(endpoints: &DemoEndpoints, record: Option<&Path>, picture: &Path) -> String {
    let DemoEndpoints { page, grpc, zenoh, sensors, notes } = endpoints;
    let record = record.map_or("none (--record OUT.mcap makes one)".into(), |file| file.display().to_string());
    let mut text: String = notes.iter().map(|note| format!("{note}\n")).collect();
    text += "A simulated car drives through a simulated world.";
    for (name, value) in [
        ("page", format!("http://{page}/")),
        ("gRPC", format!("{grpc}   (clearway watch --server http://{grpc})")),
        ("zenoh", format!("{}   (clearway/car/map/freespace)", zenoh.join(", "))),
        ("sensors", sensors.clone()),
        ("recording", record),
        ("newest map", format!("{}   (drawn every second)", picture.display())),
    ] {
        text += &format!("\n  {name:<10} {value}");
    }
    text
}
