//! `clearway init`: datagrams of sensors, live or of a capture -> a first configuration, with comments.

use std::net::SocketAddr;
use std::path::PathBuf;
use std::time::Duration;

use anyhow::{Result, bail};
use clap::Args;
use clearway_daemon::config::Config;
use clearway_tools::init::{SensorSearch, find_sensors, vehicle_name};

use crate::terminal::{Exit, print_line};
use clearway_daemon::base::files;

/// Find sensors by their packets, and write a first configuration.
///
/// Listens on UDP, or reads a capture. Each sender of Velodyne data packets becomes a sensor, with the model that its
/// packets show and the height, pitch and roll that the ground shows. Its position on the vehicle and its yaw cannot be
/// seen: they are 0 in the file, and to be measured.
#[derive(Args)]
#[command(after_help = "Examples:
  clearway init
  clearway init --listen 0.0.0.0:2368 --listen 0.0.0.0:2369 --seconds 10
  clearway init --from drive.pcap --out car.toml")]
pub struct InitArguments {
    /// Read a capture (pcap, pcapng) instead of listening.
    #[arg(long, value_name = "FILE", conflicts_with_all = ["listen", "seconds"])]
    from: Option<PathBuf>,
    /// Address and port at which data packets or telemetry arrive; may be given several times.
    #[arg(long, value_name = "ADDRESS:PORT", default_values = ["0.0.0.0:2368", "0.0.0.0:8308"])]
    listen: Vec<SocketAddr>,
    /// Time to listen.
    #[arg(long, default_value_t = 5, value_parser = clap::value_parser!(u64).range(1..=3600))]
    seconds: u64,
    /// Name of the vehicle.
    #[arg(long, value_name = "NAME", default_value = "car", value_parser = vehicle_name)]
    vehicle: String,
    /// The file to write.
    #[arg(long, value_name = "FILE", default_value = "clearway.toml")]
    out: PathBuf,
    /// Replace the file if it exists.
    #[arg(long)]
    force: bool,
}

/// Finds the sensors and writes the configuration.
pub fn run(arguments: InitArguments) -> Result<Exit> {
    let InitArguments { from, listen, seconds, vehicle, out, force } = arguments;
    let file = out.display();
    // Before the wait.
    if !force && out.symlink_metadata().is_ok() {
        bail!("{file} exists, and is not overwritten; --force replaces it, --out names another file");
    }
    let search = from.map_or(SensorSearch::Live(listen, Duration::from_secs(seconds)), SensorSearch::Capture);
    let found = find_sensors(&search)?;
    let text = found.configuration(&vehicle);
    if force {
        files::write(&out, text.as_bytes())?
    } else {
        files::write_new(&out, text.as_bytes())?
    }
    found.report().iter().try_for_each(|line| print_line(line).map(drop))?;
    print_line(&match Config::parse(&text, &out, &[]) {
        Ok(_) => format!("wrote {file}; next: clearway serve --config {file}"),
        Err(error) => format!("wrote {file}, which is not complete yet: {error}"),
    })?;
    Ok(Exit::Good)
}
