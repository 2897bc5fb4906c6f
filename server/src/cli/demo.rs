//! `clearway demo`: a simulated vehicle -> a server of its own, over real UDP.

use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

use anyhow::{Context, Result};
use clap::Args;
use clearway_daemon::record::writer::parts_of;
use clearway_tools::demo::report::DemoReport;
use clearway_tools::demo::run::{BLACK_BOX_MIB, RECORDING_MIB};
use clearway_tools::demo::sensors::DemoSensors;
use clearway_tools::demo::{DemoEndpoints, DemoOptions, demo};

use crate::process::stop_signal;
use crate::terminal::{Exit, print_line};

/// Drive a simulated car against a server of its own, over real UDP, and serve its maps.
///
/// A simulation that is too slow for this machine skips time and reports it. The drive is recorded, and the page saves
/// its last seconds when asked (a black box); without --record the recording is in the temporary folder, and all but
/// the saves is deleted at the end. The newest map is drawn beside the recording, else to
/// target/demo.png, or demo.png in the temporary folder.
/// The last lines say what is left on the disk, and what the maps cost.
#[derive(Args)]
#[command(after_help = "Examples:
  clearway demo
  clearway demo --vehicles 5
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
    /// Number of vehicles, each with a VLP-16 unless --sensors says otherwise. One of several fails after a minute, and
    /// comes back.
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u8).range(1..=50))]
    vehicles: u8,
    /// Listen on ports that the operating system chooses. Without it a port that is in use is replaced by such a one.
    #[arg(long)]
    any_port: bool,
}

fn seconds(text: &str) -> Result<Duration, String> {
    let duration = text.parse().ok().and_then(|seconds| Duration::try_from_secs_f64(seconds).ok());
    duration.ok_or_else(|| "0 or more seconds are allowed".into())
}

/// Runs the demo and prints a line a second.
pub async fn run(arguments: DemoArguments) -> Result<Exit> {
    let DemoArguments { seconds: duration, record, sensors, vehicles, any_port } = arguments;
    let pictures = if Path::new("target").is_dir() { PathBuf::from("target") } else { std::env::temp_dir() };
    let picture = record.as_ref().map_or_else(|| pictures.join("demo.png"), |record| record.with_extension("png"));
    let began = SystemTime::now();
    // Without a file, the recording is a black box in a folder of its own.
    let folder = std::env::temp_dir().join(format!("clearway-demo-{}", std::process::id()));
    let black_box = record.is_none();
    if black_box {
        std::fs::create_dir(&folder).with_context(|| folder.display().to_string())?;
    }
    let file = record.unwrap_or_else(|| folder.join("drive.mcap"));
    let (record, drawn, vehicles) = (Some(file.clone()), Some(picture.clone()), vehicles.into());
    let options = DemoOptions { duration, record, black_box, picture: drawn, sensors, vehicles, any_port };
    let begun = |endpoints: &DemoEndpoints| {
        let _ = print_line(&introduction(endpoints, &file, black_box, &picture));
    };
    let report = |report: &DemoReport| {
        let _ = print_line(&report.line());
    };
    let driven = demo(options, begun, report, stop_signal()?).await;
    if black_box {
        // What was saved stays, and so does its folder.
        parts_of(&file).iter().for_each(|part| _ = std::fs::remove_file(part));
        let _ = std::fs::remove_dir(&folder);
    }
    let summary = driven?;
    print_line(&left_behind(&file, &picture, began))?;
    print_line(&summary.text())?;
    Ok(Exit::Good)
}

/// What the demo leaves on the disk.
fn left_behind(record: &Path, picture: &Path, began: SystemTime) -> String {
    let size = |path: &Path| path.metadata().map_or(0.0, |metadata| metadata.len() as f64 / 1e6);
    let is_new = |picture: &PathBuf| picture.metadata().and_then(|of| of.modified()).is_ok_and(|at| at >= began);
    let saved = Some(record.with_file_name("saved")).filter(|folder| folder.is_dir());
    let saved = saved.map(|folder| format!("saves in {}", folder.display()));
    let picture = Some(picture.to_owned()).filter(is_new);
    let parts = parts_of(record);
    let file = |file: &PathBuf| format!("{} ({:.1} MB)", file.display(), size(file));
    let files: Vec<String> = parts.iter().chain(&picture).map(file).chain(saved).collect();
    format!("left on the disk: {}", if files.is_empty() { "nothing".to_owned() } else { files.join(", ") })
}

fn introduction(endpoints: &DemoEndpoints, record: &Path, black_box: bool, picture: &Path) -> String {
    let DemoEndpoints { page, grpc, zenoh, sensors, notes } = endpoints;
    let keep_mib = if black_box { BLACK_BOX_MIB } else { RECORDING_MIB };
    let mut text: String = notes.iter().map(|note| format!("{note}\n")).collect();
    text += "A simulated car drives through a simulated world.";
    for (name, value) in [
        ("page", format!("http://{page}/")),
        ("gRPC", format!("{grpc}   (clearway watch --server http://{grpc})")),
        ("zenoh", format!("{}   (clearway/car/map/freespace)", zenoh.join(", "))),
        ("sensors", sensors.clone()),
        ("recording", format!("{}   (the newest {keep_mib} MiB; the page saves the last seconds)", record.display())),
        ("newest map", format!("{}   (drawn every second)", picture.display())),
    ] {
        text += &format!("\n  {name:<10} {value}");
    }
    text
}
