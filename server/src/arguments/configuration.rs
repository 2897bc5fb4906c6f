//! The options that name a configuration file -> the configuration.

use std::path::PathBuf;

use clap::Args;

use clearway_daemon::config::{Config, ConfigError, of_environment};

/// The options that name a configuration file and override its keys.
#[derive(Args)]
pub struct ConfigurationOptions {
    /// The configuration file, by default $CLEARWAY_CONFIG, else clearway.toml; `clearway check --default` prints one
    /// with every key explained.
    #[arg(short, long, value_name = "FILE", default_value_os_t = default_file())]
    pub config: PathBuf,
    /// Override a key of the configuration, such as grpc.listen=0.0.0.0:50051 or vehicle[car2].queue=4096; may be given
    /// several times. The environment variable CLEARWAY__GRPC__LISTEN=0.0.0.0:50051 does the same; this option takes
    /// precedence.
    #[arg(long, value_name = "KEY=VALUE")]
    pub set: Vec<String>,
    /// Use this vehicle of the file alone; several are separated by commas. On a vehicle, with one file for the whole
    /// fleet; all by default.
    #[arg(long = "vehicle", value_name = "NAME", env = "CLEARWAY_VEHICLE", value_delimiter = ',')]
    pub vehicles: Vec<String>,
}

impl ConfigurationOptions {
    /// Reads the file, applies the overrides and checks every value, and that nothing is served to other hosts
    /// without protection.
    ///
    /// # Errors
    /// [`ConfigError`].
    pub fn load(&self) -> Result<Config, ConfigError> {
        let overrides = self.overrides();
        let config = Config::load_vehicles(&self.config, &overrides, &self.vehicles)?;
        config.check_exposure(&self.config, &overrides)?;
        Ok(config)
    }

    /// The overrides of the environment, then the overrides of the options, which take precedence.
    pub fn overrides(&self) -> Vec<String> {
        let variables = std::env::vars_os();
        let variables =
            variables.filter_map(|(name, value)| Some((name.into_string().ok()?, value.into_string().ok()?)));
        of_environment(variables).into_iter().chain(self.set.iter().cloned()).collect()
    }
}

/// The file that `$CLEARWAY_CONFIG` names, else `clearway.toml`. For clap it is a default and not `env`: the variable
/// contradicts no option.
fn default_file() -> PathBuf {
    std::env::var_os("CLEARWAY_CONFIG").map_or_else(|| PathBuf::from("clearway.toml"), PathBuf::from)
}
