//! `clearway check`: a configuration file -> the configuration with every default, or its first error.

use anyhow::Result;
use clap::Args;

use crate::arguments::configuration::ConfigurationOptions;
use crate::terminal::{Exit, print};
use clearway_daemon::base::clock::now_ns;
use clearway_daemon::config::{COMMENTED, Config};
use clearway_daemon::publish::listen::security::Current;
use clearway_daemon::run::StartError;
use clearway_daemon::status::network::end_text;
#[cfg(feature = "zenoh")]
use clearway_daemon::zenoh_session;

/// The first lines of the configuration that is printed.
const HEAD: &str = "# Every value that this configuration has. A comment says where it was given: a line of the file \
    (and whether the\n# vehicle has it from [vehicle_defaults]), an environment variable, or --set. A value without a \
    comment is a default.\n# Optional tables that the configuration does not have are not here.\n\
    # `clearway check --default` prints them too, and what each key means.\n\n";

/// Check a configuration file and print it with every default, and where each other value was given.
///
/// With --default, print instead the default configuration with an explanation of every key; optional keys and tables
/// are comments in it.
#[derive(Args)]
#[command(after_help = "Examples:
  clearway check --default > clearway.toml
  clearway check --config clearway.toml
  clearway check --config fleet.toml --vehicle car3
  clearway check --set grpc.listen=0.0.0.0:50051")]
pub struct CheckArguments {
    /// Print the default configuration, in which every key and every optional table is explained.
    #[arg(long, conflicts_with_all = ["config", "set"])]
    default: bool,
    #[command(flatten)]
    configuration: ConfigurationOptions,
}

/// Prints the configuration that the options name, as TOML.
pub fn run(options: &CheckArguments) -> Result<Exit> {
    let CheckArguments { default, configuration } = options;
    if *default {
        print(COMMENTED)?;
        return Ok(Exit::Good);
    }
    let config = configuration.load()?;
    config.calibrations(&configuration.config)?;
    let certificates = config.certificates(&configuration.config)?;
    let current = Current::new(&config, certificates.as_ref()).map_err(StartError::Certificates)?;
    for (name, end_s) in current.tls.iter().flat_map(|tls| &tls.ends_s) {
        if let Some(text) = end_text(name, *end_s, now_ns() / 1_000_000_000) {
            eprintln!("clearway: {text}");
        }
    }
    #[cfg(feature = "zenoh")]
    if config.zenoh.enabled {
        zenoh_session::settings(&config.zenoh, 0, config.vehicles.iter().map(|vehicle| &*vehicle.name))?;
    }
    let ConfigurationOptions { config: file, vehicles, .. } = configuration;
    print(&format!("{HEAD}{}", Config::explain(file, &configuration.overrides(), vehicles)?))?;
    Ok(Exit::Good)
}
