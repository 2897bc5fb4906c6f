//! Options that several subcommands share: the configuration file, how a sensor is mounted.

use std::path::PathBuf;

use clap::Args;
use clearway_mapping::config::Extrinsics;

use clearway_daemon::config::{Config, ConfigError, Origin, of_environment};

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
        let config = Config::load_vehicles(&self.config, &self.overrides(), &self.vehicles)?;
        config.check_exposure(&Origin::file(&self.config))?;
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

/// Reads extrinsics from the command line: six numbers, separated by commas.
///
/// # Errors
/// If there are not six numbers.
pub fn extrinsics(text: &str) -> Result<Extrinsics, String> {
    let numbers: Vec<f64> = text.split(',').filter_map(|number| number.trim().parse().ok()).collect();
    match numbers[..] {
        [x_m, y_m, z_m, roll_deg, pitch_deg, yaw_deg] if text.split(',').count() == 6 => {
            Ok(Extrinsics { x_m, y_m, z_m, roll_deg, pitch_deg, yaw_deg })
        }
        _ => Err("six numbers are needed: x,y,z in metres, roll,pitch,yaw in degrees".into()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn extrinsics_are_six_numbers_in_metres_and_degrees() {
        let given = extrinsics("1,-0.5,1.9,0,-2.5,90").unwrap();
        assert_eq!((given.x_m, given.y_m, given.z_m), (1.0, -0.5, 1.9));
        assert_eq!((given.roll_deg, given.pitch_deg, given.yaw_deg), (0.0, -2.5, 90.0));
        for wrong in ["", "1,2,3", "1,2,3,4,5,6,7", "1,2,3,4,5,x,6"] {
            assert!(extrinsics(wrong).is_err(), "{wrong}");
        }
    }
}
