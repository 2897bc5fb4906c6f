//! One TOML file -> [`Config`]: what is served where, what is recorded, and which vehicles there are.
//!
//! Unknown keys are refused with their line; values that make no sense are named with the file, the key, the value and
//! what is allowed. Calibration files are read here too, so that nothing opens a socket before all of it is known good.
//! `deploy/clearway.toml` holds every key with its default.

use std::collections::BTreeSet;
use std::net::{Ipv4Addr, SocketAddr};
use std::path::{Path, PathBuf};

use clearway_lidar::calibration::Calibration;
use clearway_mapping::config::SensorConfig;
use serde::{Deserialize, Serialize};

mod grpc;
mod ros;
mod udp;
mod vehicle;
mod zenoh;

pub use grpc::{Access, Certificates, Grpc, Tls};
pub use ros::Ros;
pub use udp::{Listener, Ports, Route, Sender, Udp, listeners};
pub use vehicle::{Ingest, Vehicle};
pub use zenoh::{Ros2, Zenoh, ZenohMode};

/// The configured tables by vehicle and sensor, in the order of the configuration; `None` where the factory's serves.
pub type Calibrations = Vec<Vec<Option<Calibration>>>;

/// The whole configuration.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    /// Maps over gRPC.
    #[serde(default)]
    pub grpc: Grpc,
    /// The page, its WebSocket, `/healthz` and `/metrics`.
    #[serde(default)]
    pub page: Page,
    /// Maps over zenoh.
    #[serde(default)]
    pub zenoh: Zenoh,
    /// Maps for Foxglove.
    #[serde(default)]
    pub foxglove: Foxglove,
    /// The recording.
    #[serde(default)]
    pub recorder: Recorder,
    /// One or more vehicles.
    #[serde(default, rename = "vehicle")]
    pub vehicles: Vec<Vehicle>,
}

/// `[page]`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Page {
    /// Whether it is served at all.
    pub enabled: bool,
    /// Address and port; port 0 takes a free one.
    pub listen: SocketAddr,
}

impl Default for Page {
    fn default() -> Self {
        Self { enabled: true, listen: SocketAddr::new(Ipv4Addr::LOCALHOST.into(), 8080) }
    }
}

/// `[foxglove]`: a WebSocket for Foxglove; whoever reaches it may read.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Foxglove {
    /// Whether it is served at all.
    pub enabled: bool,
    /// Address and port; port 0 takes a free one.
    pub listen: SocketAddr,
}

impl Default for Foxglove {
    fn default() -> Self {
        Self { enabled: false, listen: SocketAddr::new(Ipv4Addr::LOCALHOST.into(), 8765) }
    }
}

/// `[recorder]`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Recorder {
    /// MCAP file to write, relative paths from the configuration's folder; empty: nothing is recorded.
    pub file: PathBuf,
    /// How much a crash may cost.
    pub flush_ms: u64,
    /// Events and maps that may wait for the disk.
    pub queue: usize,
}

impl Default for Recorder {
    fn default() -> Self {
        Self { file: PathBuf::new(), flush_ms: 1000, queue: 16_384 }
    }
}

impl Recorder {
    fn check(&self) -> Result<(), Wrong> {
        if !(10..=60_000).contains(&self.flush_ms) {
            return Err(Wrong::new("recorder.flush_ms", self.flush_ms, "10 to 60000 ms"));
        }
        if !(16..=1 << 20).contains(&self.queue) {
            return Err(Wrong::new("recorder.queue", self.queue, "16 to 1048576 events"));
        }
        Ok(())
    }
}

/// A value that makes no sense.
struct Wrong {
    /// Path of the key.
    key: String,
    value: String,
    allowed: String,
}

impl Wrong {
    fn new(key: impl Into<String>, value: impl ToString, allowed: impl Into<String>) -> Self {
        Self { key: key.into(), value: value.to_string(), allowed: allowed.into() }
    }
}

/// What is wrong with a configuration.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    /// The file cannot be read.
    #[error("configuration {}: {source}", file.display())]
    Read {
        /// The configuration file.
        file: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// Not TOML, an unknown key, a value of the wrong kind. The source shows line and column.
    #[error("configuration {}: {source}", file.display())]
    Parse {
        /// The configuration file.
        file: PathBuf,
        /// Where and why.
        source: Box<toml::de::Error>,
    },
    /// An override is not `key=value`.
    #[error("--set {text}: expected KEY=VALUE, such as grpc.listen=\"0.0.0.0:50051\"")]
    Override {
        /// The override.
        text: String,
    },
    /// A value that makes no sense.
    #[error("configuration {}: {key} = {value}: allowed: {allowed}", file.display())]
    Value {
        /// The configuration file.
        file: PathBuf,
        /// Path of the key.
        key: String,
        /// What was found.
        value: String,
        /// What may stand there.
        allowed: String,
    },
    /// A file that the configuration names (a calibration, a certificate) is missing or unreadable.
    #[error("configuration {}: {key} = {}: {reason}", file.display(), named.display())]
    File {
        /// The configuration file.
        file: PathBuf,
        /// Path of the key.
        key: String,
        /// The file it names.
        named: PathBuf,
        /// What is wrong with it, and what is allowed.
        reason: String,
    },
}

impl Config {
    /// Reads `file`, applies the overrides (`grpc.listen=…`, in order) and checks every value.
    ///
    /// # Errors
    /// [`ConfigError`], which names the file, the key, the value and what is allowed.
    pub fn load(file: &Path, overrides: &[String]) -> Result<Self, ConfigError> {
        let text =
            std::fs::read_to_string(file).map_err(|source| ConfigError::Read { file: file.to_owned(), source })?;
        Self::parse(&text, file, overrides)
    }

    /// [`Config::load`] of a text; `file` is only named in errors, and where relative calibration paths start.
    ///
    /// # Errors
    /// [`ConfigError`], which names the file, the key, the value and what is allowed.
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

    /// One vehicle with one sensor and every default. Its extrinsics are yet to be set: the sensor stands 2 m above the
    /// ground, level.
    pub fn of_one_vehicle(vehicle: &str, sensor: &str) -> Self {
        let text = format!(
            "[[vehicle]]\nname = {vehicle:?}\n[[vehicle.sensor]]\nname = {sensor:?}\n[vehicle.sensor.extrinsics]\n\
             x_m = 0.0\ny_m = 0.0\nz_m = 2.0\nroll_deg = 0.0\npitch_deg = 0.0\nyaw_deg = 0.0\n"
        );
        toml::from_str(&text).expect("a name and extrinsics are all that has no default")
    }

    /// The configuration as TOML, every default spelled out.
    pub fn to_toml(&self) -> String {
        toml::to_string(self).expect("configurations have string keys only")
    }

    /// Checks what the types cannot.
    ///
    /// # Errors
    /// [`ConfigError::Value`] for the first value that makes no sense.
    pub fn check(&self, file: &Path) -> Result<(), ConfigError> {
        self.check_values().map_err(|Wrong { key, value, allowed }| {
            let file = file.to_owned();
            ConfigError::Value { file, key, value, allowed }
        })
    }

    fn check_values(&self) -> Result<(), Wrong> {
        if self.vehicles.is_empty() {
            return Err(Wrong::new("vehicle", "[]", "at least one [[vehicle]]"));
        }
        self.grpc.check()?;
        self.recorder.check()?;
        self.zenoh.check(&self.vehicles)?;
        let mut names = BTreeSet::new();
        for vehicle in &self.vehicles {
            vehicle.check(self.zenoh.enabled)?;
            if !names.insert(&vehicle.name) {
                return Err(Wrong::new("vehicle.name", &vehicle.name, "each vehicle its own"));
            }
        }
        udp::check(&self.vehicles)
    }

    /// The configuration as it is served: relative paths of `recorder.file` and `zenoh.file` start at the
    /// configuration's folder, `file`'s parent, as do those of the files that are read beforehand.
    pub fn located(mut self, file: &Path) -> Self {
        for path in [&mut self.recorder.file, &mut self.zenoh.file] {
            if !path.as_os_str().is_empty() {
                *path = beside(file, path);
            }
        }
        self
    }

    /// Reads the calibration files of all sensors: by vehicle and sensor, in the order of the configuration; `None`
    /// where the factory's table serves. Relative paths start at the configuration's folder, `file`'s parent.
    ///
    /// # Errors
    /// [`ConfigError::File`] with what is wrong and what is allowed.
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

/// A path that stands in the configuration `file`, seen from the working directory.
fn beside(file: &Path, path: &Path) -> PathBuf {
    file.parent().unwrap_or(Path::new("")).join(path)
}

/// `a.b=value`: the value is TOML, or a bare string.
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
        // `vehicle.udp.data` means the first vehicle's: the common case has one.
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
