//! One TOML file -> [`Config`]: what is served where, what is recorded, and which vehicles there are.
//!
//! Unknown keys are refused with their line; values that make no sense are named with the file, the key, the value and
//! what is allowed. Calibration files are read here too, so that nothing opens a socket before all of it is known good.
//! `deploy/clearway.toml` holds every key with its default.

use std::collections::BTreeSet;
use std::net::{Ipv4Addr, SocketAddr};
use std::path::{Path, PathBuf};

use clearway_lidar::calibration::Calibration;
use clearway_mapping::config::{BodyConfig, FusionConfig, MapsConfig, SensorConfig, VehicleConfig};
use serde::{Deserialize, Serialize};

mod ros;
mod udp;
mod zenoh;

pub use ros::Ros;
pub use udp::{Listener, Ports, Route, Sender, Udp, listeners};
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

/// `[grpc]`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Grpc {
    /// Whether it is served at all.
    pub enabled: bool,
    /// Address and port; port 0 takes a free one.
    pub listen: SocketAddr,
    /// Peers connected at once; more are told so.
    pub connections_max: usize,
    /// Certificates; plain text without.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub tls: Option<Tls>,
    /// Who may do what, once client certificates are asked for.
    pub access: Access,
}

impl Default for Grpc {
    fn default() -> Self {
        let listen = SocketAddr::new(Ipv4Addr::LOCALHOST.into(), 50051);
        Self { enabled: true, listen, connections_max: 256, tls: None, access: Access::default() }
    }
}

/// `[grpc.tls]`: PEM files; relative paths start at the configuration's folder.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Tls {
    /// The server's certificate, and those between it and the CA.
    pub certificate: PathBuf,
    /// Its private key. Only the path is ever recorded.
    pub key: PathBuf,
    /// Whose certificates clients must have; without, no client is asked who it is.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub client_ca: Option<PathBuf>,
}

/// `[grpc.access]`: names in client certificates (common name or DNS name), by what their bearers may do. Whoever is in
/// no list may do nothing.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Access {
    /// May read maps and status.
    pub readers: Vec<String>,
    /// May send scans, poses, roads and packets.
    pub ingesters: Vec<String>,
    /// May do both.
    pub operators: Vec<String>,
}

/// The files of `[grpc.tls]`, read. The key never leaves this value.
#[derive(Clone)]
pub struct Certificates {
    /// PEM.
    pub certificate: String,
    /// PEM.
    pub key: String,
    /// PEM.
    pub client_ca: Option<String>,
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
    /// MCAP file to write; empty: nothing is recorded.
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

/// One `[[vehicle]]`: its sensors and maps, and the doors its events come through.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Vehicle {
    /// Names the vehicle in keys and topics: `[a-z0-9_-]+`.
    pub name: String,
    /// Events that may wait for the engine; more are counted as lost.
    #[serde(default = "queue")]
    pub queue: usize,
    /// The UDP door; a vehicle without one is fed by other doors.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub udp: Option<Udp>,
    /// The ROS 2 door, through rmw_zenoh's key space.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub ros: Option<Ros>,
    /// Observations over gRPC and zenoh.
    #[serde(default)]
    pub ingest: Ingest,
    /// How one map is made of several sensors.
    #[serde(default)]
    pub fusion: FusionConfig,
    /// Where the vehicle itself is; nothing is taken for it where absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub body: Option<BodyConfig>,
    /// Which maps are made, and how.
    #[serde(default)]
    pub maps: MapsConfig,
    /// The sensors.
    #[serde(rename = "sensor")]
    pub sensors: Vec<SensorConfig>,
}

fn queue() -> usize {
    8192
}

impl Vehicle {
    /// What the core needs of it.
    pub fn core(&self) -> VehicleConfig {
        VehicleConfig {
            name: self.name.clone(),
            sensors: self.sensors.clone(),
            fusion: self.fusion.clone(),
            body: self.body,
            maps: self.maps.clone(),
        }
    }
}

/// `[vehicle.ingest]`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Ingest {
    /// Whether anybody may send scans, poses, roads and packets.
    pub enabled: bool,
    /// Points of one scan; the longest message follows from it.
    pub points_max: usize,
    /// Streams at once; each may have its share of half the queue on the way.
    pub streams_max: usize,
}

impl Default for Ingest {
    fn default() -> Self {
        Self { enabled: true, points_max: 2_000_000, streams_max: 8 }
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
        let wrong = |key: String, value: &dyn ToString, allowed: &str| {
            Err(ConfigError::Value {
                file: file.to_owned(),
                key,
                value: value.to_string(),
                allowed: allowed.to_owned(),
            })
        };
        if self.vehicles.is_empty() {
            return wrong("vehicle".into(), &"[]", "at least one [[vehicle]]");
        }
        let Access { readers, ingesters, operators } = &self.grpc.access;
        let asked = self.grpc.tls.as_ref().is_some_and(|tls| tls.client_ca.is_some());
        if let Some(name) = readers.iter().chain(ingesters).chain(operators).next().filter(|_| !asked) {
            return wrong(
                "grpc.access".into(),
                name,
                "nobody, unless grpc.tls.client_ca says whose certificates to ask for",
            );
        }
        if !(1..=65_536).contains(&self.grpc.connections_max) {
            return wrong("grpc.connections_max".into(), &self.grpc.connections_max, "1 to 65536 connections");
        }
        if !(10..=60_000).contains(&self.recorder.flush_ms) {
            return wrong("recorder.flush_ms".into(), &self.recorder.flush_ms, "10 to 60000 ms");
        }
        if !(16..=1 << 20).contains(&self.recorder.queue) {
            return wrong("recorder.queue".into(), &self.recorder.queue, "16 to 1048576 events");
        }
        for (key, endpoints) in [("zenoh.listen", &self.zenoh.listen), ("zenoh.connect", &self.zenoh.connect)] {
            if let Some(endpoint) = endpoints.iter().find(|e| !e.starts_with("tcp/") && !e.starts_with("tls/")) {
                return wrong(
                    key.into(),
                    endpoint,
                    "endpoints such as \"tcp/127.0.0.1:7447\" or \"tls/localhost:7447\"",
                );
            }
        }
        if let Err((key, value, allowed)) = self.zenoh.ros2.check(self.zenoh.enabled, &self.vehicles) {
            return wrong(key.into(), &value, &allowed);
        }
        let mut names = BTreeSet::new();
        for vehicle in &self.vehicles {
            if let Err(error) = vehicle.core().validate() {
                return wrong(format!("{} (of {})", error.key, vehicle.name), &error.value, error.allowed);
            }
            if !names.insert(&vehicle.name) {
                return wrong("vehicle.name".into(), &vehicle.name, "each vehicle its own");
            }
            let at = |key: &str| format!("vehicle.{key} (of {})", vehicle.name);
            if !(16..=1 << 20).contains(&vehicle.queue) {
                return wrong(at("queue"), &vehicle.queue, "16 to 1048576 events");
            }
            if let Some(ros) = &vehicle.ros
                && let Err((key, value, allowed)) = ros.check(self.zenoh.enabled, &vehicle.sensors)
            {
                return wrong(at(key), &value, &allowed);
            }
            if !(1000..=20_000_000).contains(&vehicle.ingest.points_max) {
                return wrong(at("ingest.points_max"), &vehicle.ingest.points_max, "1000 to 20000000 points");
            }
            if !(1..=64).contains(&vehicle.ingest.streams_max) {
                return wrong(at("ingest.streams_max"), &vehicle.ingest.streams_max, "1 to 64 streams");
            }
        }
        if let Err((key, value, allowed)) = udp::check(&self.vehicles) {
            return wrong(key, &value, &allowed);
        }
        Ok(())
    }

    /// Reads the files of `[grpc.tls]`; `None` where there is no such table. Relative paths start at the
    /// configuration's folder, `file`'s parent.
    ///
    /// # Errors
    /// [`ConfigError::File`] with what is wrong.
    pub fn certificates(&self, file: &Path) -> Result<Option<Certificates>, ConfigError> {
        let Some(tls) = &self.grpc.tls else { return Ok(None) };
        let read = |key: &str, path: &PathBuf| {
            let named = file.parent().unwrap_or(Path::new("")).join(path);
            let wrong = |reason: String| ConfigError::File {
                file: file.to_owned(),
                key: format!("grpc.tls.{key}"),
                named: named.clone(),
                reason,
            };
            let text = std::fs::read_to_string(&named).map_err(|error| wrong(error.to_string()))?;
            let what = if key == "key" { "PRIVATE KEY-----" } else { "BEGIN CERTIFICATE-----" };
            let found = text.contains(what);
            if found { Ok(text) } else { Err(wrong(format!("no PEM block \"{what}\" in it"))) }
        };
        let client_ca = tls.client_ca.as_ref().map(|path| read("client_ca", path)).transpose()?;
        let (certificate, key) = (read("certificate", &tls.certificate)?, read("key", &tls.key)?);
        Ok(Some(Certificates { certificate, key, client_ca }))
    }

    /// Reads the calibration files of all sensors: by vehicle and sensor, in the order of the configuration; `None`
    /// where the factory's table serves. Relative paths start at the configuration's folder, `file`'s parent.
    ///
    /// # Errors
    /// [`ConfigError::File`] with what is wrong and what is allowed.
    pub fn calibrations(&self, file: &Path) -> Result<Calibrations, ConfigError> {
        let of = |vehicle: &Vehicle, sensor: &SensorConfig| {
            let Some(path) = &sensor.calibration else { return Ok(None) };
            let path = file.parent().unwrap_or(Path::new("")).join(path);
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
