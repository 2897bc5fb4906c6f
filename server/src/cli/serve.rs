//! `clearway serve`: a configuration file -> a server that runs until a signal.

use anyhow::{Context, Result, anyhow};
use clap::Args;
use tokio::signal::unix::{SignalKind, signal};

use crate::arguments::configuration::ConfigurationOptions;
use crate::process::service_manager;
use crate::process::{block_on, stop_signal};
use crate::terminal::{Exit, with_causes};
use clearway_daemon::base::held_sockets::HeldSockets;
use clearway_daemon::config::{Config, differing_keys};
use clearway_daemon::run::{Running, Server, Setup, ShutdownError};

/// Listen for sensor data, make maps and publish them, until SIGINT or SIGTERM.
///
/// SIGHUP reads certificates, tokens, roles and limits again. Under systemd it reports when it is ready and that it
/// lives, and uses the sockets that systemd holds.
#[derive(Args)]
#[command(after_help = "Examples:
  clearway serve
  clearway serve --config fleet.toml --vehicle car3
  clearway serve --config car.toml --set grpc.listen=0.0.0.0:50051 --set recorder.file=drive.mcap")]
pub struct ServeArguments {
    #[command(flatten)]
    configuration: ConfigurationOptions,
}

/// Runs the server that the configuration describes, until SIGINT or SIGTERM.
pub fn run(options: &ServeArguments) -> Result<Exit> {
    let held = HeldSockets::from_environment().context("LISTEN_FDS: a socket of the service manager")?;
    block_on(serve(&options.configuration, held))
}

async fn serve(configuration: &ConfigurationOptions, held_sockets: HeldSockets) -> Result<Exit> {
    let file = &configuration.config;
    let config = configuration.load()?;
    let calibrations = config.calibrations(file)?;
    let certificates = config.certificates(file)?;
    let mut config = config.located(file);
    config.recorder.is_numbered = true;
    // Before the server starts, so that a signal during the start ends it in order.
    let stop = stop_signal()?;
    let mut hangups = signal(SignalKind::hangup())?;
    let setup = Setup { config: config.clone(), calibrations, certificates, held_sockets, ..Setup::default() };
    let running = Server::start(setup).await?;
    running.log_endpoints();
    service_manager::ready();
    tokio::pin!(stop);
    loop {
        tokio::select! {
            () = &mut stop => break,
            () = service_manager::report_life(&running) => {}
            _ = hangups.recv() => {
                let reloaded = reload(&running, configuration, &config);
                running.note_reload(reloaded.as_ref().err().map(with_causes));
                match reloaded {
                    Ok(()) => tracing::info!("certificates, tokens, roles and limits are read again"),
                    Err(error) => tracing::error!("nothing is changed: {}", with_causes(&error)),
                }
            }
        }
    }
    service_manager::stopping();
    tracing::info!("stopping");
    let ended = running.shutdown_in_time().await;
    if let Err(error @ ShutdownError::Deadline { .. }) = &ended {
        // A thread that hangs would keep the runtime, and with it the process.
        tracing::error!(%error, "ending without it");
        std::process::exit(1);
    }
    ended?;
    Ok(Exit::Good)
}

/// Reads the configuration again and applies what can be changed without a restart; names the tables that cannot.
fn reload(running: &Running, configuration: &ConfigurationOptions, old: &Config) -> Result<()> {
    let file = &configuration.config;
    let config = configuration.load()?;
    let certificates = config.certificates(file)?;
    running.reload(&config, certificates.as_ref()).map_err(|reason| anyhow!("grpc.tls: {reason}"))?;
    let mut config = config.located(file);
    config.recorder.is_numbered = old.recorder.is_numbered;
    let changed = differing_keys(&config.without_reloaded(old).to_toml(), &old.to_toml());
    if !changed.is_empty() {
        let keys = changed.into_iter().collect::<Vec<_>>().join(", ");
        tracing::warn!(keys, "these keys have changed too, and need a restart");
    }
    Ok(())
}
