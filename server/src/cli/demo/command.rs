//! The options of `clearway demo`, and how its course is printed.

use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::Result;
use clap::{Args, ValueEnum};

use super::{Options as DemoOptions, Places, Second, demo};
use crate::cli::output::{block_on, print, print_line, stop_signal};

/// Drive a simulated vehicle against a server of its own, over real UDP.
#[derive(Args)]
pub struct Options {
    /// End after this many seconds; at Ctrl-C if absent.
    #[arg(long, value_parser = seconds)]
    seconds: Option<Duration>,
    /// Record to this MCAP file; to a temporary file if absent.
    #[arg(long)]
    record: Option<PathBuf>,
    /// one: one rotating LIDAR in a town. many: two of them and six that send scans, poses and roads over gRPC, in
    /// traffic.
    #[arg(long, value_enum, default_value = "one")]
    sensors: Sensors,
    /// Print one JSON object a second, and a summary.
    #[arg(long)]
    json: bool,
}

#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Sensors {
    One,
    Many,
}

fn seconds(text: &str) -> Result<Duration, String> {
    let duration = text.parse().ok().and_then(|seconds| Duration::try_from_secs_f64(seconds).ok());
    duration.ok_or_else(|| "0 or more seconds are allowed".into())
}

/// Runs the demo and prints a line a second.
///
/// # Errors
/// [`DemoError`](super::DemoError).
pub fn run(options: Options) -> Result<()> {
    block_on(demo_and_print(options))
}

async fn demo_and_print(options: Options) -> Result<()> {
    let Options { seconds, record, sensors, json } = options;
    let folder = if Path::new("target").is_dir() { PathBuf::from("target") } else { std::env::temp_dir() };
    let record = record.unwrap_or_else(|| folder.join("demo.mcap"));
    let picture = record.with_extension("png");
    let many_sensors = sensors == Sensors::Many;
    let options = DemoOptions { duration: seconds, record, picture, many_sensors, any_port: false };
    let begun = |places: &Places| {
        if !json {
            places.notes.iter().for_each(|note| _ = print_line(note));
            let _ = print(&welcome(places));
        }
    };
    let second = |second: &Second| {
        let _ = print_line(&if json { second.to_json().to_string() } else { second.line() });
    };
    let summary = demo(options, begun, second, stop_signal()?).await?;
    if json {
        print_line(&summary.to_json().to_string())?;
    } else {
        let (sent, last) = (summary.sent, &summary.last.snapshot);
        print_line(&format!(
            "The car sent {} data packets and {} telemetry datagrams; {} were received, {} maps made.",
            sent.packets, sent.telemetry, last.ledger.received, last.maps
        ))?;
    }
    Ok(())
}

fn welcome(places: &Places) -> String {
    format!(
        "A simulated car drives through a simulated town.
  page       http://{}/
  gRPC       {}   (clearway watch --server http://{})
  zenoh      {}   (clearway/car/map/drivability)
  recording  {}
  newest map {}   (drawn each second)
",
        places.page,
        places.grpc,
        places.grpc,
        places.zenoh.join(", "),
        places.record.display(),
        places.picture.display(),
    )
}
