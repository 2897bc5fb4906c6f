//! One TOML file -> [`Config`]: what is served where, what is recorded, and which vehicles there are.
//!
//! An unknown key is refused with its line; a value that is not allowed is refused with the file, the key, the value and
//! what is allowed. Calibration files are read here too, so that no socket is opened before the whole configuration is
//! valid.
//! `deploy/clearway.toml` holds every key with its default.

use std::collections::BTreeSet;
use std::net::{Ipv4Addr, SocketAddr};
use std::path::{Path, PathBuf};

use clearway_lidar::calibration::Calibration;
use clearway_mapping::config::SensorConfig;
use serde::{Deserialize, Serialize};

use error::{ValueError, beside};

mod error;
mod grpc;
mod listeners;
mod ros;
mod udp;
mod vehicle;
mod zenoh;

pub use error::ConfigError;
pub use grpc::{Access, Certificates, Grpc, Tls};
pub use listeners::{Listener, Route, listeners};
pub use ros::Ros;
pub use udp::{Ports, Sender, Udp};
pub use vehicle::{Ingest, Vehicle};
pub use zenoh::{Ros2, Zenoh, ZenohMode};

/// The configured tables by vehicle and sensor, in the order of the configuration; `None` selects the
/// factory's table.
pub type Calibrations = Vec<Vec<Option<Calibration>>>;

/// The whole configuration.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    /// Streams over gRPC.
    #[serde(default)]
    pub grpc: Grpc,
    /// The page, its WebSocket, `/healthz` and `/metrics`.
    #[serde(default)]
    pub page: Page,
    /// Streams over zenoh.
    #[serde(default)]
    pub zenoh: Zenoh,
    /// The WebSocket for Foxglove.
    #[serde(default)]
    pub foxglove: Foxglove,
    /// The recording.
    #[serde(default)]
    pub recorder: Recorder,
    /// One or more vehicles.
    #[serde(default, rename = "vehicle")]
    pub vehicles: Vec<Vehicle>,
}

/// The table `[page]`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Page {
    /// True if it is served.
    pub enabled: bool,
    /// Address and port to listen on; port 0 selects a free port.
    pub listen: SocketAddr,
}

impl Default for Page {
    fn default() -> Self {
        Self { enabled: true, listen: SocketAddr::new(Ipv4Addr::LOCALHOST.into(), 8080) }
    }
}

/// The table `[foxglove]`: a WebSocket for Foxglove. Every client that can connect may read.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Foxglove {
    /// True if it is served.
    pub enabled: bool,
    /// Address and port to listen on; port 0 selects a free port.
    pub listen: SocketAddr,
}

impl Default for Foxglove {
    fn default() -> Self {
        Self { enabled: false, listen: SocketAddr::new(Ipv4Addr::LOCALHOST.into(), 8765) }
    }
}

/// The table `[recorder]`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Recorder {
    /// MCAP file to write; a relative path starts at the configuration's folder. Empty: nothing is recorded.
    pub file: PathBuf,
    /// Longest time between two flushes, in ms: what a crash may cost of the recording.
    pub flush_ms: u64,
    /// Events and maps that may wait for the disk; more are counted as lost.
    pub queue: usize,
}

impl Default for Recorder {
    fn default() -> Self {
        Self { file: PathBuf::new(), flush_ms: 1000, queue: 16_384 }
    }
}

impl Recorder {
    fn check(&self) -> Result<(), ValueError> {
        if !(10..=60_000).contains(&self.flush_ms) {
            return Err(ValueError::new("recorder.flush_ms", self.flush_ms, "10 to 60000 ms"));
        }
        if !(16..=1 << 20).contains(&self.queue) {
            return Err(ValueError::new("recorder.queue", self.queue, "16 to 1048576 events"));
        }
        Ok(())
    }
}

impl Config {
    /// Reads `file`, applies the overrides (`grpc.listen=…`, in order) and checks every value.
    ///
    /// # Errors
    /// [`ConfigError::Read`] if the file cannot be read, and the errors of [`Config::parse`].
    pub fn load(file: &Path, overrides: &[String]) -> Result<Self, ConfigError> {
        let text =
            std::fs::read_to_string(file).map_err(|source| ConfigError::Read { file: file.to_owned(), source })?;
        Self::parse(&text, file, overrides)
    }

    /// Like [`Config::load`], from a text; errors name `file`.
    ///
    /// # Errors
    /// [`ConfigError::Parse`] if the text is not TOML or has an unknown key, [`ConfigError::Override`] if an override is
    /// not `key=value`, [`ConfigError::Value`] if a value is not allowed.
    pub fn parse(text: &str, file: &Path, overrides: &[String]) -> Result<Self, ConfigError> {
        let parse = |source| ConfigError::Parse { file: file.to_owned(), source: Box::new(source) };
        let mut config: Self = toml::from_str(text).map_err(parse)?;
        if !overrides.is_empty() {
            let mut table: toml::Table = toml::from_str(text).map_err(parse)?;
            for text in overrides {
                set(&mut table, text)?;
            }
            config = table.try_into().map_err(parse)?;
        }
        config.check(file)?;
        Ok(config)
    }

    /// A configuration of one vehicle with one sensor and every default. The sensor is level, 2 m above the ground, until
    /// its extrinsics are set.
    pub fn of_one_vehicle(vehicle: &str, sensor: &str) -> Self {
        let text = format!(
            "[[vehicle]]\nname = {vehicle:?}\n[[vehicle.sensor]]\nname = {sensor:?}\n[vehicle.sensor.extrinsics]\n\
             x_m = 0.0\ny_m = 0.0\nz_m = 2.0\nroll_deg = 0.0\npitch_deg = 0.0\nyaw_deg = 0.0\n"
        );
        toml::from_str(&text).expect("a name and extrinsics are all that has no default")
    }

    /// The configuration as TOML, with every default.
    pub fn to_toml(&self) -> String {
        toml::to_string(self).expect("configurations have string keys only")
    }

    /// Checks the values, beyond their types.
    ///
    /// # Errors
    /// [`ConfigError::Value`] for the first value that is not allowed.
    pub fn check(&self, file: &Path) -> Result<(), ConfigError> {
        self.check_values().map_err(|ValueError { key, value, allowed }| {
            let file = file.to_owned();
            ConfigError::Value { file, key, value, allowed }
        })
    }

    fn check_values(&self) -> Result<(), ValueError> {
        if self.vehicles.is_empty() {
            return Err(ValueError::new("vehicle", "[]", "at least one [[vehicle]]"));
        }
        self.grpc.check()?;
        self.recorder.check()?;
        self.zenoh.check(&self.vehicles)?;
        let mut names = BTreeSet::new();
        for vehicle in &self.vehicles {
            vehicle.check(self.zenoh.enabled)?;
            if !names.insert(&vehicle.name) {
                return Err(ValueError::new("vehicle.name", &vehicle.name, "a different name for each vehicle"));
            }
        }
        listeners::check(&self.vehicles)
    }

    /// Reads the files of `[grpc.tls]`; `None` without that table. Relative paths start at the folder of `file`.
    ///
    /// # Errors
    /// [`ConfigError::File`] if a file cannot be read or has no PEM block of its kind.
    pub fn certificates(&self, file: &Path) -> Result<Option<Certificates>, ConfigError> {
        self.grpc.certificates(file)
    }

    /// The configuration with the paths `recorder.file` and `zenoh.file` made relative to the working directory: in the
    /// configuration they start at the folder of `file`.
    pub fn located(mut self, file: &Path) -> Self {
        for path in [&mut self.recorder.file, &mut self.zenoh.file] {
            if !path.as_os_str().is_empty() {
                *path = beside(file, path);
            }
        }
        self
    }

    /// Reads the calibration files of all sensors: by vehicle and sensor, in the order of the configuration; `None`
    /// selects the factory's table. Relative paths start at the folder of `file`.
    ///
    /// # Errors
    /// [`ConfigError::File`] if a file cannot be read, is no calibration, or does not fit the model of its sensor.
    pub fn calibrations(&self, file: &Path) -> Result<Calibrations, ConfigError> {
        let of = |vehicle: &Vehicle, sensor: &SensorConfig| {
            let Some(path) = &sensor.calibration else { return Ok(None) };
            let path = beside(file, Path::new(path));
            let wrong = |reason: String| ConfigError::File {
                file: file.to_owned(),
                key: format!("vehicle.sensor.calibration (of {}/{})", vehicle.name, sensor.name),
                named: path.clone(),
                reason,
            };
            let text = std::fs::read_to_string(&path).map_err(|error| wrong(error.to_string()))?;
            let table = Calibration::load_str(&text).map_err(|error| wrong(error.to_string()))?;
            if let Some(model) = sensor.model {
                table.fits(model).map_err(|error| wrong(error.to_string()))?;
            }
            Ok(Some(table))
        };
        self.vehicles.iter().map(|v| v.sensors.iter().map(|s| of(v, s)).collect()).collect()
    }
}

/// Applies the override `a.b=value`; the value is TOML, or a bare string.
fn set(table: &mut toml::Table, text: &str) -> Result<(), ConfigError> {
    let wrong = || ConfigError::Override { text: text.to_owned() };
    let (path, value) = text.split_once('=').ok_or_else(wrong)?;
    let value = match toml::from_str::<toml::Table>(&format!("v = {value}")) {
        Ok(mut parsed) => parsed.remove("v").ok_or_else(wrong)?,
        Err(_) => toml::Value::String(value.to_owned()),
    };
    let mut keys: Vec<&str> = path.trim().split('.').collect();
    let last = keys.pop().filter(|key| !key.is_empty()).ok_or_else(wrong)?;
    let mut place = table;
    for key in keys {
        let slot = place.entry(key).or_insert_with(|| toml::Value::Table(toml::Table::new()));
        // `vehicle.udp.data` means the first vehicle: the common case has one.
        let slot = match slot {
            toml::Value::Array(items) => items.first_mut().ok_or_else(wrong)?,
            other => other,
        };
        place = slot.as_table_mut().ok_or_else(wrong)?;
    }
    place.insert(last.to_owned(), value);
    Ok(())
}

#[cfg(test)]
mod tests;
