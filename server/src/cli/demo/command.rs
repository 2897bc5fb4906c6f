//! `clearway demo`.

use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Duration;

use anyhow::Result;

use super::report::Report;
use super::run::{Endpoints, Options as DemoOptions, demo};
use super::sensors::Sensors;
use crate::cli::connect::say;
use crate::cli::run::stop_signal;

/// Drive a simulated car at a server of its own, over real UDP, and serve its maps.
///
/// A simulation that is too slow for this machine skips time and reports it. Only --record and a picture of the newest
/// map, target/demo.png or demo.png in the temporary folder, are written to the disk.
#[derive(clap::Args)]
pub struct Options {
    /// End after this many seconds; without it, at Ctrl-C.
    #[arg(long, value_parser = crate::cli::arguments::seconds)]
    seconds: Option<Duration>,
    /// Record events and maps to this MCAP file. It grows by about 115 MB a minute with an HDL-64E.
    #[arg(long, value_name = "OUT.mcap")]
    record: Option<PathBuf>,
    /// The car's sensors.
    #[arg(long, value_enum, default_value_t, visible_alias = "sensor")]
    sensors: Sensors,
    /// Print one JSON object a second on stdout, and a summary.
    #[arg(long)]
    json: bool,
}

/// Runs the demo until its time is over or a signal ends it.
pub async fn run(options: Options) -> Result<ExitCode> {
    let Options { seconds, record, sensors, json } = options;
    let folder = if Path::new("target").is_dir() { PathBuf::from("target") } else { std::env::temp_dir() };
    let picture = record.as_ref().map_or_else(|| folder.join("demo.png"), |record| record.with_extension("png"));
    let begun = |endpoints: &Endpoints| {
        if !json {
            print(&introduction(endpoints, record.as_deref(), &picture));
        }
    };
    let report = |report: &Report| print(&if json { report.to_json().to_string() } else { report.line() });
    let stop = stop_signal()?;
    let options =
        DemoOptions { duration: seconds, record: record.clone(), picture: picture.clone(), sensors, any_port: false };
    let summary = demo(options, begun, report, stop).await?;
    print(&if json { summary.to_json().to_string() } else { summary.text() });
    Ok(ExitCode::SUCCESS)
}

/// Prints lines. A reader that has gone, such as `head`, does not end the demo.
fn print(lines: &str) {
    let _ = say(lines);
}

fn introduction(endpoints: &Endpoints, record: Option<&Path>, picture: &Path) -> String {
    let Endpoints { page, grpc, zenoh, sensors, notes } = endpoints;
    let record = record.map_or("none (--record OUT.mcap makes one)".into(), |file| file.display().to_string());
    let mut text: String = notes.iter().map(|note| format!("{note}\n")).collect();
    text += "A simulated car drives through a simulated world.";
    for (name, value) in [
        ("page", format!("http://{page}/")),
        ("gRPC", format!("{grpc}   (clearway watch --server http://{grpc})")),
        ("zenoh", format!("{}   (clearway/car/map/drivability)", zenoh.join(", "))),
        ("sensors", sensors.clone()),
        ("recording", record),
        ("newest map", format!("{}   (drawn every second)", picture.display())),
    ] {
        text += &format!("\n  {name:<10} {value}");
    }
    text
}
