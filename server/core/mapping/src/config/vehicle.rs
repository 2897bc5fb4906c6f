//! The table `[vehicle]`.

use serde::{Deserialize, Serialize};

use clearway_lidar::calibration::Calibration;

use crate::config::body::BodyConfig;
use crate::config::check::{ConfigValueError, check_name};
use crate::config::fusion::FusionConfig;
use crate::config::sensor::SensorConfig;
use crate::config::time::TimeConfig;
use crate::layer::registry::MapsConfig;

/// Greatest number of sensors of one vehicle, declared ones included. Ours: the newest scan of each takes some
/// megabytes.
pub const SENSORS_MAX: usize = 32;

/// One vehicle: all that the core needs to make maps from its events.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct VehicleConfig {
    /// Name of the vehicle in keys and topics: `[a-z0-9_-]+`.
    pub name: String,
    /// The sensors. The source of an event is an index into them.
    #[serde(rename = "sensor")]
    pub sensors: Vec<SensorConfig>,
    /// How stamps follow the clocks.
    #[serde(default)]
    pub time: TimeConfig,
    /// How one map is made from several sensors.
    #[serde(default)]
    pub fusion: FusionConfig,
    /// The box around the vehicle, in which returns are removed; `None` removes none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub body: Option<BodyConfig>,
    /// Which layers are made, and how.
    #[serde(default)]
    pub maps: MapsConfig,
}

impl VehicleConfig {
    /// A vehicle with these sensors and the defaults of all other values.
    pub fn new(name: impl Into<String>, sensors: Vec<SensorConfig>) -> Self {
        let (time, fusion, maps) = (TimeConfig::default(), FusionConfig::default(), MapsConfig::default());
        Self { name: name.into(), sensors, time, fusion, body: None, maps }
    }

    /// Checks every value, in the order of the file.
    ///
    /// # Errors
    /// [`ConfigValueError`] for the first value that is not allowed.
    pub fn validate(&self) -> Result<(), ConfigValueError> {
        check_name("vehicle.name", &self.name)?;
        if !(1..=SENSORS_MAX).contains(&self.sensors.len()) {
            let tables = format!("{} tables", self.sensors.len());
            return Err(ConfigValueError::new("vehicle.sensor", tables, "1 to 32 [[vehicle.sensor]] a vehicle"));
        }
        for index in 0..self.sensors.len() {
            self.check_sensor(index, &self.sensors[index])?;
        }
        if self.reference_sensor().is_none() {
            let (key, name) = ("vehicle.fusion.reference_sensor", &self.fusion.reference_sensor);
            return Err(ConfigValueError::new(key, name, "the name of one of the sensors"));
        }
        self.time.validate()?;
        self.fusion.validate()?;
        self.body.iter().try_for_each(BodyConfig::validate)?;
        self.maps.validate()
    }

    /// Index of the sensor whose scans make the maps; `None` if no sensor has the configured name.
    pub fn reference_sensor(&self) -> Option<usize> {
        if self.fusion.reference_sensor.is_empty() {
            return Some(0);
        }
        self.sensors.iter().position(|sensor| sensor.name == self.fusion.reference_sensor)
    }

    /// Adds a sensor that the file does not contain, as sensor number `index`, which no sensor has. A repeated
    /// declaration changes nothing, so that a sender may declare its sensor whenever it connects. Returns the
    /// calibration of a new sensor, if it brings one: its `calibration` is the text of a table and not a path, so that
    /// a replay needs no file.
    ///
    /// # Errors
    /// [`ConfigValueError`] if the index or the name is in use, if a value is not allowed, or if the calibration cannot
    /// be read.
    pub fn declare(&mut self, index: usize, sensor: &SensorConfig) -> Result<Option<Calibration>, ConfigValueError> {
        if self.sensors.get(index) == Some(sensor) {
            return Ok(None);
        }
        if index >= SENSORS_MAX || self.sensors.get(index).is_some_and(|sensor| !sensor.is_withdrawn()) {
            return Err(ConfigValueError::new("vehicle.sensor", index, "an index of no sensor, under 32"));
        }
        self.check_sensor(index, sensor)?;
        let calibration = sensor.declared_calibration().map_err(|error| {
            let allowed = "the text of a ROS YAML table, up to 65536 bytes, of as many lasers as the model has";
            ConfigValueError::new(format!("vehicle.sensor[{index}].calibration"), error, allowed)
        })?;
        self.sensors.resize(self.sensors.len().max(index + 1), SensorConfig::withdrawn());
        self.sensors[index] = sensor.clone();
        Ok(calibration)
    }

    /// Takes back the declaration of the sensor `index`: its name and its index are free. The indices of the others
    /// stay; a free one below them has [`SensorConfig::withdrawn`].
    pub fn withdraw(&mut self, index: usize) {
        if let Some(sensor) = self.sensors.get_mut(index) {
            *sensor = SensorConfig::withdrawn();
        }
        while self.sensors.pop_if(|last| last.is_withdrawn()).is_some() {}
    }

    fn check_sensor(&self, index: usize, sensor: &SensorConfig) -> Result<(), ConfigValueError> {
        let at = format!("vehicle.sensor[{index}]");
        sensor.validate(&at)?;
        match self.sensors.iter().take(index).any(|before| before.name == sensor.name) {
            true => Err(ConfigValueError::new(at + ".name", &sensor.name, "each sensor its own")),
            false => Ok(()),
        }
    }
}
