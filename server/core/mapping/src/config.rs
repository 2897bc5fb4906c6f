//! One vehicle's sensors and maps, as the configuration file states them. Keys contain their units; unknown keys are
//! refused.
//!
//! In: the tables of the file. Out: the same as values, checked by [`VehicleConfig::validate`], whose errors name the
//! key, its value and what is allowed. Lengths are in metres. Angles are in degrees here, and in radians in all other
//! modules.
//!
//! Each stage owns its table; this module has the tables of the whole vehicle, and names the tables of the stages.
//!
//! | table | where |
//! |---|---|
//! | `[vehicle]`, `[vehicle.time]` | here |
//! | `[[vehicle.sensor]]` | [`crate::sensor`], `config` |
//! | `[vehicle.body]` | [`crate::sensor::self_filter`] |
//! | `[vehicle.fusion]` | `fusion`, `config` |
//! | `[vehicle.maps.motion]` | [`crate::sensor::motion`] |
//! | `[vehicle.maps.memory]` | [`crate::memory`] |
//! | `[vehicle.maps.ground]` | [`crate::ground`] |
//! | `[vehicle.maps.reach]` | [`crate::reach`] |
//! | `[vehicle.maps]`, and one table for each layer | [`crate::layer`], in the layer's folder |

use clearway_lidar::calibration::Calibration;
use clearway_lidar::clock::AHEAD_NS_MAX;
use serde::{Deserialize, Serialize};

pub use crate::fusion::config::FusionConfig;
pub use crate::ground::config::{GroundConfig, Variant as GroundVariant};
pub use crate::layer::drivability::config::{DrivabilityConfig, DrivabilityVariant, Passage, PlaneTest, Seed};
pub use crate::layer::freespace::config::FreespaceConfig;
pub use crate::layer::height_difference::config::HeightDifferenceConfig;
pub use crate::layer::occupancy::config::{Hits, OccupancyConfig, OccupancyVariant};
pub use crate::layer::registry::MapsConfig;
pub use crate::layer::safe_path::config::SafePathConfig;
pub use crate::layer::speed::config::{Bonus, SpeedConfig};
pub use crate::layer::terrain::config::{TerrainConfig, Variant};
pub use crate::memory::config::MemoryConfig;
pub use crate::reach::config::ReachConfig;
pub use crate::sensor::config::{BLIND_MAX, Extrinsics, RINGS_MAX, SensorConfig};
pub use crate::sensor::motion::MotionConfig;
pub use crate::sensor::self_filter::BodyConfig;
pub use crate::value_check::{ConfigValueError, check_name};

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

const NS_PER_MS: i64 = 1_000_000;
/// Greatest value of `ahead_ms_max`. Ours: a minute ahead, no map is of use to a planner.
const AHEAD_MS_MAX: u32 = 60_000;

/// How the stamps of sensors follow the clocks.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TimeConfig {
    /// Greatest time by which stamps may be ahead of the clock that they follow, milliseconds. If they are ahead by
    /// more, they go back to it and a new epoch begins, which the map states. 0: stamps never go back, and epochs are
    /// not counted.
    pub ahead_ms_max: u32,
}

impl Default for TimeConfig {
    fn default() -> Self {
        Self { ahead_ms_max: (AHEAD_NS_MAX / NS_PER_MS) as u32 }
    }
}

impl TimeConfig {
    /// The rules of recordings that were made before there was this table.
    pub const WITHOUT_EPOCHS: Self = Self { ahead_ms_max: 0 };

    /// [`TimeConfig::ahead_ms_max`] in ns.
    pub fn ahead_ns_max(&self) -> i64 {
        i64::from(self.ahead_ms_max) * NS_PER_MS
    }

    pub(crate) fn validate(&self) -> Result<(), ConfigValueError> {
        let allowed = "0 (stamps never go back), or 20 to 60000";
        match self.ahead_ms_max {
            0 | 20..=AHEAD_MS_MAX => Ok(()),
            other => Err(ConfigValueError::new("vehicle.time.ahead_ms_max", other, allowed)),
        }
    }
}
