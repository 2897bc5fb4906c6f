//! `clearway serve`: a configuration file -> a server that runs until a signal.

use anyhow::Result;
use clap::Args;

use super::configuration::ConfigurationOptions;
use super::output::{block_on, stop_signal};
use crate::record::writer;
use crate::server::{Running, Server, Setup};

/// Listen for sensor data, make maps and publish them, until SIGINT or SIGTERM.
#[derive(Args)]
#[command(after_help = "Examples:
  clearway serve
  clearway serve --config car.toml --set grpc.listen=0.0.0.0:50051 --set recorder.file=drive.mcap")]
pub struct Options {
    #[command(flatten)]
    configuration: ConfigurationOptions,
}

/// Runs the server that the configuration describes, until SIGINT or SIGTERM.
///
/// # Errors
/// [`ConfigError`](crate::config::ConfigError), [`StartError`](crate::server::StartError), and
/// [`ShutdownError`](crate::server::ShutdownError) at the end.
pub fn run(options: &Options) -> Result<()> {
    block_on(serve(&options.configuration))
}

async fn serve(configuration: &ConfigurationOptions) -> Result<()> {
    let file = &configuration.config;
    let config = configuration.load()?;
    let calibrations = config.calibrations(file)?;
    let certificates = config.certificates(file)?;
    let mut config = config.located(file);
    if let Some(recording) = writer::recording_path(&config.recorder) {
        let free = writer::next_free_name(recording);
        config.recorder.family = std::mem::replace(&mut config.recorder.file, free);
    }
    // Before the server starts, so that a signal during the start ends it in order.
    let stop = stop_signal()?;
    let running = Server::start(Setup { config, calibrations, certificates, ..Setup::default() }).await?;
    log_endpoints(&running);
    stop.await;
    tracing::info!("stopping");
    running.shutdown().await?;
    Ok(())
}

/// Logs every address at which the server listens, and the recording.
pub fn log_endpoints(running: &Running) {
    for vehicle in &running.inputs {
        if let Some((data, telemetry)) = vehicle.udp {
            tracing::info!(vehicle = %vehicle.name, %data, %telemetry, "listening for datagrams");
        }
    }
    if let Some(at) = running.grpc {
        tracing::info!(%at, "gRPC");
    }
    if let Some(at) = running.page {
        tracing::info!("page http://{at}/");
    }
    for endpoint in &running.zenoh {
        tracing::info!(%endpoint, "zenoh");
    }
    if let Some(at) = running.foxglove {
        tracing::info!("foxglove ws://{at}");
    }
    if let Some(recording) = running.recording() {
        tracing::info!(%recording, "recording");
    }
}
