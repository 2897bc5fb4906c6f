//! One TOML file -> [`Config`]: what is served where, what is recorded, and which vehicles there are.
//!
//! An error names where the key was given (the file and its line, or the option), the key, its value and what is
//! allowed. Calibration files are read here too, so that no socket is opened before the whole configuration is valid.
//! `deploy/clearway.toml` holds every key with its default. `layers` says which value holds if several places give one.

use std::collections::BTreeSet;
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::path::Path;

use clearway_lidar::calibration::Calibration;
use clearway_mapping::config::SensorConfig;
use serde::{Deserialize, Serialize};

use crate::base::file_advice::{advised, read_text};
use error::{ValueError, beside};
use layers::Layers;
use overrides::{blamed, matching, placed, set};
use read::{Problem, Refusal};

mod connections;
mod error;
mod explain;
mod grpc;
mod layers;
mod listeners;
mod overrides;
mod read;
mod recorder;
mod ros;
mod store;
mod traces;
mod udp;
mod vehicle;
mod zenoh;

pub use connections::{Connections, Service};
pub use error::{ConfigError, Origin};
pub use explain::differing_keys;
#[cfg(feature = "zenoh")]
pub(crate) use grpc::secret;
pub use grpc::{Access, Certificates, Grpc, Only, Tls};
pub use listeners::{Listener, Route, listeners};
pub use overrides::of_environment;
pub use recorder::{Recorder, SaveRule};
pub use ros::Ros;
pub use store::Store;
pub use traces::Traces;
pub use udp::{Ports, Sender, Udp};
pub use vehicle::{Ingest, Vehicle};
pub use zenoh::{Fleet, Ros2, Zenoh, ZenohMode};

/// The commented configuration: every key with its default, the optional tables as comments.
pub const COMMENTED: &str = include_str!("../../../../deploy/clearway.toml");

/// The configured tables by vehicle and sensor, in the order of the configuration; `None` selects the
/// factory's table.
pub type Calibrations = Vec<Vec<Option<Calibration>>>;

/// The whole configuration, as read from the file with its overrides.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    /// Streams over gRPC.
    #[serde(default)]
    pub grpc: Grpc,
    /// The page, its WebSocket, `/healthz`, `/readyz` and `/metrics`.
    #[serde(default)]
    pub page: Page,
    /// `/healthz`, `/readyz` and `/metrics` on a listener of their own.
    #[serde(default)]
    pub metrics: Metrics,
    /// Streams over zenoh.
    #[serde(default)]
    pub zenoh: Zenoh,
    /// The WebSocket for Foxglove.
    #[serde(default)]
    pub foxglove: Foxglove,
    /// What the peers of all TCP listeners may cost.
    #[serde(default)]
    pub connections: Connections,
    /// What is recorded, where to and for how long.
    #[serde(default)]
    pub recorder: Recorder,
    /// Where finished parts of the recording go.
    #[serde(default)]
    pub store: Store,
    /// Where the traces of revolutions go.
    #[serde(default)]
    pub traces: Traces,
    /// One or more vehicles.
    #[serde(default, rename = "vehicle")]
    pub vehicles: Vec<Vehicle>,
}

/// The table `[page]`: the page, its WebSocket, `/healthz`, `/readyz` and `/metrics`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Page {
    /// True if the page is served.
    pub enabled: bool,
    /// Address and port to listen on; port 0 selects a free port.
    pub listen: SocketAddr,
    /// URL at which others reach the page, for pages of other servers; empty: they show its vehicles without a link.
    pub advertise: String,
}

impl Default for Page {
    fn default() -> Self {
        let listen = SocketAddr::new(Ipv4Addr::LOCALHOST.into(), 8080);
        Self { enabled: true, listen, advertise: String::new() }
    }
}

impl Page {
    /// True if it may be the URL of a page.
    pub(crate) fn is_url(url: &str) -> bool {
        ["http://", "https://"].iter().any(|scheme| url.starts_with(scheme))
    }

    fn check(&self) -> Result<(), ValueError> {
        if !self.advertise.is_empty() && !Self::is_url(&self.advertise) {
            return Err(ValueError::new("page.advertise", &self.advertise, "http://HOST:PORT/ or https://HOST:PORT/"));
        }
        Ok(())
    }
}

/// The table `[metrics]`: `/healthz`, `/readyz` and `/metrics` alone, which no reader of the page can delay.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Metrics {
    /// True if the listener of the metrics is served.
    pub enabled: bool,
    /// Address and port to listen on; port 0 selects a free port.
    pub listen: SocketAddr,
}

impl Default for Metrics {
    fn default() -> Self {
        Self { enabled: false, listen: SocketAddr::new(Ipv4Addr::LOCALHOST.into(), 9464) }
    }
}

/// The table `[foxglove]`: a WebSocket for Foxglove.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Foxglove {
    /// True if the WebSocket for Foxglove is served.
    pub enabled: bool,
    /// Address and port to listen on; port 0 selects a free port.
    pub listen: SocketAddr,
}

impl Default for Foxglove {
    fn default() -> Self {
        Self { enabled: false, listen: SocketAddr::new(Ipv4Addr::LOCALHOST.into(), 8765) }
    }
}

impl Config {
    /// Reads `file`, applies the overrides (`grpc.listen=…`, in order) and checks every value.
    ///
    /// # Errors
    /// [`ConfigError::Read`] if the file cannot be read, and the errors of [`Config::parse`].
    pub fn load(file: &Path, overrides: &[String]) -> Result<Self, ConfigError> {
        Self::load_vehicles(file, overrides, &[])
    }

    /// As [`Config::load`], with the vehicles of these names alone; with all if there are no names.
    ///
    /// # Errors
    /// As [`Config::load`], and [`ConfigError::UnknownVehicle`] for a name that no vehicle has.
    pub fn load_vehicles(file: &Path, overrides: &[String], vehicles: &[String]) -> Result<Self, ConfigError> {
        Self::parse_vehicles(&text_of(file)?, file, overrides, vehicles)
    }

    /// Like [`Config::load`], from a text; errors name `file`.
    ///
    /// # Errors
    /// [`ConfigError::Syntax`] if the text is not TOML, [`ConfigError::Override`] or [`ConfigError::NotTable`] if an
    /// override is not `key=value` or its key goes on below a value; [`ConfigError::UnknownKey`],
    /// [`ConfigError::MissingKey`] and [`ConfigError::Value`] for the first key or value that is not allowed.
    pub fn parse(text: &str, file: &Path, overrides: &[String]) -> Result<Self, ConfigError> {
        Self::parse_vehicles(text, file, overrides, &[])
    }

    fn parse_vehicles(text: &str, file: &Path, overrides: &[String], vehicles: &[String]) -> Result<Self, ConfigError> {
        let syntax = |source| ConfigError::Syntax { file: file.to_owned(), source: Box::new(source) };
        let table: toml::Table = toml::from_str(text).map_err(syntax)?;
        let mut config = Self::of_file(text, &table, file)?;
        config.select(vehicles, file)?;
        if overrides.is_empty() {
            config.check(&Origin::file(file))?;
            return Ok(config);
        }
        let mut layers = Layers::of_file(text, &table, file);
        layers.select(vehicles);
        overrides.iter().try_for_each(|text| set(&mut layers, text))?;
        inherit(&mut layers, |key| Origin::Options(blamed(overrides, key)))?;
        let table = layers.into_table();
        let blamed = |key: &str| Origin::Options(blamed(overrides, key));
        let overridden: Self = read::from_table(&table).map_err(|refusal| {
            // A key is missing because an override begins its table.
            let is_missing = refusal.problem == Problem::Missing;
            let key = refusal.key.rsplit_once('.').filter(|_| is_missing).map_or(&*refusal.key, |(table, _)| table);
            let origin = blamed(key);
            refused(refusal, origin)
        })?;
        overridden.check_values().map_err(|error| {
            // What the file holds without the overrides is not the fault of one, unless it sets that key.
            let is_of_file = config.check_values().is_err() && matching(overrides, &error.key).next().is_none();
            let origin = if is_of_file { Origin::file(file) } else { blamed(&error.key) };
            error.at(&origin)
        })?;
        Ok(overridden)
    }

    /// Keeps the vehicles of these names alone; all if there are no names.
    fn select(&mut self, names: &[String], file: &Path) -> Result<(), ConfigError> {
        if let Some(name) = names.iter().find(|name| self.vehicles.iter().all(|vehicle| vehicle.name != **name)) {
            let known: Vec<_> = self.vehicles.iter().map(|vehicle| vehicle.name.as_str()).collect();
            let (file, name) = (file.to_owned(), name.clone());
            return Err(ConfigError::UnknownVehicle { file, name, known: known.join(", ") });
        }
        self.vehicles.retain(|vehicle| names.is_empty() || names.contains(&vehicle.name));
        Ok(())
    }

    /// The configuration of the file alone; its values are not checked yet.
    fn of_file(text: &str, table: &toml::Table, file: &Path) -> Result<Self, ConfigError> {
        let origin = |line| Origin::File { file: file.to_owned(), line };
        if !table.contains_key(layers::DEFAULTS) {
            return read::from_text(text, table).map_err(|refusal| {
                let line = refusal.at.map(|at| 1 + text[..at].matches('\n').count());
                refused(refusal, origin(line))
            });
        }
        let mut layers = Layers::of_file(text, table, file);
        let first = layers.origin(layers::DEFAULTS).unwrap_or(origin(None));
        inherit(&mut layers, |_| first.clone())?;
        read::from_table(&layers.clone().into_table()).map_err(|refusal| {
            let origin = layers.origin(&refusal.key).unwrap_or(origin(None));
            refused(refusal, origin)
        })
    }

    /// The configuration as TOML, with every default, and behind each other value where it was given.
    ///
    /// # Errors
    /// As [`Config::load_vehicles`].
    pub fn explain(file: &Path, overrides: &[String], vehicles: &[String]) -> Result<String, ConfigError> {
        let text = text_of(file)?;
        let config = Self::parse_vehicles(&text, file, overrides, vehicles)?;
        // The text has been parsed, and its layers have been merged.
        let table: toml::Table = toml::from_str(&text).unwrap_or_default();
        let mut layers = Layers::of_file(&text, &table, file);
        layers.select(vehicles);
        overrides.iter().try_for_each(|text| set(&mut layers, text))?;
        inherit(&mut layers, |_| Origin::file(file))?;
        Ok(explain::explained(&config.to_toml(), &layers.given()))
    }

    /// Checks that nothing is served to other hosts without protection, unless `connections.unprotected` names it.
    ///
    /// # Errors
    /// [`ConfigError::Value`] for the first address that other hosts can reach without TLS, or from any sender.
    pub fn check_exposure(&self, file: &Path, overrides: &[String]) -> Result<(), ConfigError> {
        self.check_exposed_values().map_err(|error| placed(error, overrides, file))
    }

    /// A configuration of one vehicle with one sensor and every default. The sensor is level, 2 m above the ground,
    /// until its extrinsics are set.
    pub fn of_one_vehicle(vehicle: &str, sensor: &str) -> Self {
        let text = format!(
            "[[vehicle]]\nname = {vehicle:?}\n[[vehicle.sensor]]\nname = {sensor:?}\n[vehicle.sensor.extrinsics]\n\
             x_m = 0.0\ny_m = 0.0\nz_m = 2.0\nroll_deg = 0.0\npitch_deg = 0.0\nyaw_deg = 0.0\n"
        );
        let table = toml::from_str(&text).expect("the text is TOML");
        read::from_table(&table).expect("a name and extrinsics are all that has no default")
    }

    /// The configuration as TOML, with every default.
    pub fn to_toml(&self) -> String {
        toml::to_string(self).expect("configurations have string keys only")
    }

    /// Checks the values, beyond their types; `origin` is where they were given.
    ///
    /// # Errors
    /// [`ConfigError::Value`] for the first value that is not allowed.
    pub fn check(&self, origin: &Origin) -> Result<(), ConfigError> {
        self.check_values().map_err(|error| error.at(origin))
    }

    fn check_values(&self) -> Result<(), ValueError> {
        if self.vehicles.is_empty() {
            return Err(ValueError::new("vehicle", "[]", "at least one [[vehicle]]"));
        }
        self.grpc.check()?;
        self.page.check()?;
        self.connections.check()?;
        self.recorder.check(self.vehicles.iter().any(|vehicle| vehicle.maps.memory.enabled))?;
        self.store.check()?;
        self.traces.check()?;
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

    /// The configuration with the paths `recorder.file`, `zenoh.file` and
    /// `zenoh.signing_key` made relative to the working directory: in the
    /// configuration they start at the folder of `file`.
    pub fn located(mut self, file: &Path) -> Self {
        for path in [&mut self.recorder.file, &mut self.zenoh.file, &mut self.zenoh.signing_key] {
            if !path.as_os_str().is_empty() {
                *path = beside(file, path);
            }
        }
        if !self.store.url.is_empty() && !self.store.url.contains("://") {
            self.store.url = beside(file, Path::new(&self.store.url)).display().to_string();
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
            let text = read_text(&path).map_err(|error| wrong(advised(&path, error).to_string()))?;
            let table = Calibration::load_str(&text).map_err(|error| wrong(error.to_string()))?;
            if let Some(model) = sensor.model {
                table.fits(model).map_err(|error| wrong(error.to_string()))?;
            }
            Ok(Some(table))
        };
        self.vehicles.iter().map(|v| v.sensors.iter().map(|s| of(v, s)).collect()).collect()
    }
}

fn text_of(file: &Path) -> Result<String, ConfigError> {
    read_text(file).map_err(|source| ConfigError::Read { file: file.to_owned(), source: advised(file, source) })
}

/// Gives every vehicle what it has from `[vehicle_defaults]`.
fn inherit(layers: &mut Layers, origin: impl FnOnce(&str) -> Origin) -> Result<(), ConfigError> {
    layers.inherit().map_err(|(key, value, allowed)| ConfigError::Value { origin: origin(&key), key, value, allowed })
}

/// The error for a key or value that was given at `origin`.
fn refused(refusal: Refusal, origin: Origin) -> ConfigError {
    let Refusal { key, problem, .. } = refusal;
    match problem {
        Problem::Unknown { known } => ConfigError::UnknownKey { origin, key, known },
        Problem::Missing => ConfigError::MissingKey { origin, key },
        Problem::Value { value, allowed } => ConfigError::Value { origin, key, value, allowed },
    }
}

impl Config {
    /// This configuration with `old`'s certificates, tokens, roles and limits, which a running server can replace. It
    /// equals `old` if nothing else differs.
    pub fn without_reloaded(mut self, old: &Self) -> Self {
        self.grpc.tls.clone_from(&old.grpc.tls);
        self.grpc.access.clone_from(&old.grpc.access);
        self.connections.clone_from(&old.connections);
        self
    }

    /// Checks that nothing is served to other hosts without protection, unless the configuration names it in
    /// `connections.unprotected`. For a server that starts; the configuration of a recording is not served.
    ///
    /// # Errors
    /// [`ValueError`] with the first address that other hosts can reach without TLS, or from any sender.
    fn check_exposed_values(&self) -> Result<(), ValueError> {
        let is_allowed = |service: Service| self.connections.unprotected.contains(&service);
        let refuse = |service: Service, key: String, value: String, protection: &str| {
            let name = service.as_str();
            let allowed = format!(
                "an address of this host, such as 127.0.0.1, or {protection}; connections.unprotected = [\"{name}\"] \
                 says that every host of the network may use it"
            );
            Err(ValueError::new(key, value, allowed))
        };
        let tcp = [
            (Service::Grpc, self.grpc.enabled, self.grpc.listen),
            (Service::Page, self.page.enabled, self.page.listen),
            (Service::Metrics, self.metrics.enabled, self.metrics.listen),
            (Service::Foxglove, self.foxglove.enabled, self.foxglove.listen),
        ];
        for (service, enabled, at) in tcp {
            if enabled && !at.ip().is_loopback() && self.grpc.tls.is_none() && !is_allowed(service) {
                let key = format!("{}.listen", service.as_str());
                return refuse(service, key, at.to_string(), "certificates in grpc.tls");
            }
        }
        let is_public = |endpoint: &&String| {
            let address = endpoint.split('/').nth(1).unwrap_or_default().split(['?', '#']).next().unwrap_or_default();
            let host = address.rsplit_once(':').map_or(address, |(host, _)| host).trim_matches(['[', ']']);
            host != "localhost" && !host.parse::<IpAddr>().is_ok_and(|ip| ip.is_loopback())
        };
        let endpoint = self.zenoh.listened().iter().find(is_public).filter(|_| self.zenoh.enabled);
        if let Some(endpoint) = endpoint.filter(|_| self.zenoh.file.as_os_str().is_empty())
            && !is_allowed(Service::Zenoh)
        {
            let protection = "TLS and access control in zenoh.file";
            return refuse(Service::Zenoh, "zenoh.listen".into(), endpoint.clone(), protection);
        }
        for listener in listeners(&self.vehicles) {
            let from_anyone = listener.routes.iter().find(|route| route.from.is_none());
            if let Some(route) = from_anyone.filter(|_| !listener.at.ip().is_loopback())
                && !is_allowed(Service::Udp)
            {
                let key = format!("vehicle.udp (of {})", self.vehicles[route.vehicle].name);
                let protection = "the address of each sensor in vehicle.udp.from";
                return refuse(Service::Udp, key, listener.at.to_string(), protection);
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests;
