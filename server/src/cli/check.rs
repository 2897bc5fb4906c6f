//! `clearway check`: a configuration file -> the configuration with every default, or its first error.

use anyhow::Result;
use clap::Args;

use super::configuration::ConfigurationOptions;
use super::output::print;

/// Check a configuration file and print it with every default.
#[derive(Args)]
pub struct Options {
    #[command(flatten)]
    configuration: ConfigurationOptions,
}

/// Prints the configuration that the options name, as TOML.
///
/// # Errors
/// [`ConfigError`](crate::config::ConfigError), also for a calibration or a certificate that the file names.
pub fn run(options: &Options) -> Result<()> {
    let Options { configuration } = options;
    let config = configuration.load()?;
    config.calibrations(&configuration.config)?;
    config.certificates(&configuration.config)?;
    print(&config.to_toml())?;
    Ok(())
}
