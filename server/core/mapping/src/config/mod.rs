//! One vehicle's sensors and maps, as the configuration file spells them. Units in keys; unknown keys refused.
//!
//! In: the tables `[vehicle]`, `[[vehicle.sensor]]`, `[vehicle.fusion]`, `[vehicle.body]` and `[vehicle.maps.*]`. Out:
//! the same as values, checked by [`VehicleConfig::validate`], whose errors name the key, its value and what is
//! allowed. Lengths are metres, angles degrees here and radians everywhere behind.

use nalgebra::{Isometry3, Translation3, UnitQuaternion};
use serde::{Deserialize, Serialize};

use clearway_lidar::calibration::Calibration;
use clearway_lidar::model::Model;

mod fusion;
mod maps;

pub use fusion::*;
pub use maps::*;
pub(crate) use maps::check_cells;
pub use crate::layer::occupancy::config::OccupancyConfig;
pub use crate::layer::speed::config::{Bonus, SpeedConfig};

/// Sensors of one vehicle, declared ones included: each keeps its newest turn, some megabytes.
pub const SENSORS_MAX: usize = 32;
/// Half as much again as the longest table of any model, a VLS-128's.
const CALIBRATION_BYTES_MAX: usize = 64 << 10;
/// Blind sectors of one sensor.
pub const BLIND_MAX: usize = 16;
/// Lasers of a sensor that sends scans; the largest built have 128.
pub const RINGS_MAX: usize = 256;

/// One vehicle: all the core needs to turn its events into maps.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct VehicleConfig {
    /// Names the vehicle in keys and topics: `[a-z0-9_-]+`.
    pub name: String,
    /// The sensors; an event's source is an index into them.
    #[serde(rename = "sensor")]
    pub sensors: Vec<SensorConfig>,
    /// How one map is made of several sensors.
    #[serde(default)]
    pub fusion: FusionConfig,
    /// Where the vehicle itself is; nothing is taken for it where absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub body: Option<BodyConfig>,
    /// Which maps are made, and how.
    #[serde(default)]
    pub maps: MapsConfig,
}

/// One sensor of a vehicle.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SensorConfig {
    /// Unique within the vehicle.
    pub name: String,
    /// Found from the data where absent; for scans: whose elevations the rows of radial maps come from.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub model: Option<Model>,
    /// Found from the data where absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rpm: Option<f32>,
    /// The sensor's own table: path of a ROS YAML or Velodyne XML file (of a declared sensor: the text of a ROS YAML
    /// one); the factory's where absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub calibration: Option<String>,
    /// Encoder angle at which turns are cut; 180 is behind the vehicle.
    #[serde(default = "behind")]
    pub cut_azimuth_deg: f32,
    /// Returns nearer to the sensor than this are the vehicle itself and are dropped.
    #[serde(default = "own_body")]
    pub range_m_min: f32,
    /// Sectors in which the sensor sees nothing but the vehicle or its own mount: `[from, to]` in degrees clockwise
    /// from the sensor's x axis seen from above; `to` below `from` goes over 0. Returns there are dropped, and stay
    /// unknown.
    #[serde(default)]
    pub blind_deg: Vec<[f32; 2]>,
    /// GPS time older than its arrival by more days is not believed, and the sensor's stamps follow the host's clock:
    /// then a capture is played live, or the receiver has lost count of the weeks.
    #[serde(default = "a_day")]
    pub gps_late_days_max: f64,
    /// For scans of a sensor that is no [`Model`]: elevation of each laser, degrees. Where this is empty too, they are
    /// measured from the rings of its first scan; where that tells none, radial maps led by it are unknown.
    #[serde(default)]
    pub elevations_deg: Vec<f32>,
    /// `ego_from_sensor`: x, y, z in metres, roll, pitch, yaw in degrees.
    pub extrinsics: Extrinsics,
}

fn behind() -> f32 {
    180.0
}

/// A roof-mounted sensor sees roof, rails and bonnet within this range, and no ground: it stands higher than 1 m.
fn own_body() -> f32 {
    2.0
}

/// Hosts' clocks are wrong by hours, not by days.
fn a_day() -> f64 {
    1.0
}

/// `ego_from_sensor`, as people write it. Rotation = Rz(yaw) Ry(pitch) Rx(roll).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Extrinsics {
    /// Forward.
    pub x_m: f64,
    /// Left.
    pub y_m: f64,
    /// Up, over the ground.
    pub z_m: f64,
    /// About x.
    pub roll_deg: f64,
    /// About y; positive looks down.
    pub pitch_deg: f64,
    /// About z, counter-clockwise.
    pub yaw_deg: f64,
}

impl Extrinsics {
    /// The transform that carries points of the sensor's frame into the ego frame.
    pub fn ego_from_sensor(&self) -> Isometry3<f64> {
        Isometry3::from_parts(
            Translation3::new(self.x_m, self.y_m, self.z_m),
            UnitQuaternion::from_euler_angles(
                self.roll_deg.to_radians(),
                self.pitch_deg.to_radians(),
                self.yaw_deg.to_radians(),
            ),
        )
    }
}

/// A value of the configuration that cannot be used.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("{key} = {value}: allowed is {allowed}")]
pub struct ConfigError {
    /// Full path of the key, `vehicle.maps.drivability.columns`.
    pub key: String,
    /// As it was given.
    pub value: String,
    /// What would have been taken.
    pub allowed: &'static str,
}

impl ConfigError {
    pub(crate) fn new(key: impl Into<String>, value: impl ToString, allowed: &'static str) -> Self {
        Self { key: key.into(), value: value.to_string(), allowed }
    }
}

impl VehicleConfig {
    /// A vehicle with these sensors and every default.
    pub fn new(name: impl Into<String>, sensors: Vec<SensorConfig>) -> Self {
        let (fusion, maps) = (FusionConfig::default(), MapsConfig::default());
        Self { name: name.into(), sensors, fusion, body: None, maps }
    }

    /// Checks every value, in the order of the file.
    ///
    /// # Errors
    /// The first value that cannot be used.
    pub fn validate(&self) -> Result<(), ConfigError> {
        check_name("vehicle.name", &self.name)?;
        if !(1..=SENSORS_MAX).contains(&self.sensors.len()) {
            let tables = format!("{} tables", self.sensors.len());
            return Err(ConfigError::new("vehicle.sensor", tables, "1 to 32 [[vehicle.sensor]] a vehicle"));
        }
        for index in 0..self.sensors.len() {
            self.check_sensor(index, &self.sensors[index])?;
        }
        if self.lead().is_none() {
            return Err(ConfigError::new("vehicle.fusion.lead", &self.fusion.lead, "the name of one of the sensors"));
        }
        self.fusion.validate()?;
        self.body.iter().try_for_each(BodyConfig::validate)?;
        self.maps.validate()
    }

    /// Index of the sensor whose turns make the maps; `None` where the name is no sensor's.
    pub fn lead(&self) -> Option<usize> {
        if self.fusion.lead.is_empty() {
            return Some(0);
        }
        self.sensors.iter().position(|sensor| sensor.name == self.fusion.lead)
    }

    /// Takes a sensor that the file does not name as the vehicle's sensor number `index`: the next one. The same again
    /// changes nothing, so that whoever declares it may do so whenever he connects. Gives the new one's table, if it
    /// brings one: its `calibration` is no path but the table's text, so that a replay needs no file.
    ///
    /// # Errors
    /// A wrong index, a name already taken, a value that cannot be used, or a calibration that is none.
    pub fn declare(&mut self, index: usize, sensor: &SensorConfig) -> Result<Option<Calibration>, ConfigError> {
        if self.sensors.get(index) == Some(sensor) {
            return Ok(None);
        }
        if index != self.sensors.len() || index >= SENSORS_MAX {
            return Err(ConfigError::new("vehicle.sensor", index, "the next index, under 32"));
        }
        self.check_sensor(index, sensor)?;
        let calibration = sensor.declared_calibration().map_err(|what| {
            let allowed = "the text of a ROS YAML table, up to 65536 bytes, of as many lasers as the model has";
            ConfigError::new(format!("vehicle.sensor[{index}].calibration"), what, allowed)
        })?;
        self.sensors.push(sensor.clone());
        Ok(calibration)
    }

    fn check_sensor(&self, index: usize, sensor: &SensorConfig) -> Result<(), ConfigError> {
        let at = format!("vehicle.sensor[{index}]");
        sensor.validate(&at)?;
        match self.sensors.iter().take(index).any(|before| before.name == sensor.name) {
            true => Err(ConfigError::new(at + ".name", &sensor.name, "each sensor its own")),
            false => Ok(()),
        }
    }
}

impl SensorConfig {
    /// What the decoder needs to know, with the sensor's own table.
    pub fn lidar(&self, calibration: Option<Calibration>) -> clearway_lidar::SensorConfig {
        clearway_lidar::SensorConfig {
            model: self.model,
            rpm: self.rpm,
            calibration,
            cut_azimuth_deg: self.cut_azimuth_deg,
            gps_late_ns_max: (self.gps_late_days_max * 86_400e9) as i64,
        }
    }

    /// The table that a declaration brings as text; `Err` with what is wrong.
    fn declared_calibration(&self) -> Result<Option<Calibration>, String> {
        let Some(text) = &self.calibration else { return Ok(None) };
        if text.len() > CALIBRATION_BYTES_MAX {
            return Err(format!("{} bytes", text.len()));
        }
        let table = Calibration::from_yaml(text).map_err(|error| error.to_string())?;
        self.model.map_or(Ok(()), |model| table.fits(model)).map_err(|error| error.to_string())?;
        Ok(Some(table))
    }

    /// A sensor with every default.
    pub fn new(name: impl Into<String>, extrinsics: Extrinsics) -> Self {
        Self {
            name: name.into(),
            model: None,
            rpm: None,
            calibration: None,
            cut_azimuth_deg: behind(),
            range_m_min: own_body(),
            blind_deg: Vec::new(),
            gps_late_days_max: a_day(),
            elevations_deg: Vec::new(),
            extrinsics,
        }
    }

    fn validate(&self, at: &str) -> Result<(), ConfigError> {
        check_name(&format!("{at}.name"), &self.name)?;
        if let Some(rpm) = self.rpm {
            // The manuals state 300 to 1200; hosts set a little beyond.
            check(f64::from(rpm), 60.0..=2400.0, || format!("{at}.rpm"), "60 to 2400")?;
        }
        check(f64::from(self.cut_azimuth_deg), 0.0..=360.0, || format!("{at}.cut_azimuth_deg"), "0 to 360")?;
        check(f64::from(self.range_m_min), 0.0..=20.0, || format!("{at}.range_m_min"), "0 to 20")?;
        if self.blind_deg.len() > BLIND_MAX {
            let given = format!("{} sectors", self.blind_deg.len());
            return Err(ConfigError::new(format!("{at}.blind_deg"), given, "at most 16"));
        }
        for &end in self.blind_deg.as_flattened() {
            check(f64::from(end), 0.0..=360.0, || format!("{at}.blind_deg"), "0 to 360")?;
        }
        // A century: i64 stamps end in 2262.
        check(self.gps_late_days_max, 0.0..=36_525.0, || format!("{at}.gps_late_days_max"), "0 to 36525")?;
        if self.elevations_deg.len() > RINGS_MAX {
            let given = format!("{} elevations", self.elevations_deg.len());
            return Err(ConfigError::new(format!("{at}.elevations_deg"), given, "at most 256"));
        }
        for &elevation in &self.elevations_deg {
            check(f64::from(elevation), -90.0..=90.0, || format!("{at}.elevations_deg"), "-90 to 90")?;
        }
        let extrinsics = &self.extrinsics;
        for (key, value) in [("x_m", extrinsics.x_m), ("y_m", extrinsics.y_m)] {
            check(value, -20.0..=20.0, || format!("{at}.extrinsics.{key}"), "-20 to 20")?;
        }
        // The rings' radii follow from the height, so a sensor in the ground has none.
        check(extrinsics.z_m, 0.1..=20.0, || format!("{at}.extrinsics.z_m"), "0.1 to 20")?;
        let angles =
            [("roll_deg", extrinsics.roll_deg), ("pitch_deg", extrinsics.pitch_deg), ("yaw_deg", extrinsics.yaw_deg)];
        for (key, value) in angles {
            check(value, -360.0..=360.0, || format!("{at}.extrinsics.{key}"), "-360 to 360")?;
        }
        Ok(())
    }
}

pub(crate) fn check(
    value: f64,
    allowed: std::ops::RangeInclusive<f64>,
    key: impl FnOnce() -> String,
    said: &'static str,
) -> Result<(), ConfigError> {
    // NaN is in no range, so it is refused too.
    if allowed.contains(&value) { Ok(()) } else { Err(ConfigError::new(key(), value, said)) }
}

type Allowed = (std::ops::RangeInclusive<f64>, &'static str);

/// Checks the values of one table.
pub(crate) fn check_each<const N: usize>(at: &str, values: [(&str, f32, Allowed); N]) -> Result<(), ConfigError> {
    values
        .into_iter()
        .try_for_each(|(key, value, (allowed, said))| check(f64::from(value), allowed, || format!("{at}.{key}"), said))
}

/// Checks how a value stands to another one of its table.
pub(crate) fn check_fits(at: &str, key: &str, value: f32, fits: bool, said: &'static str) -> Result<(), ConfigError> {
    if fits { Ok(()) } else { Err(ConfigError::new(format!("{at}.{key}"), value, said)) }
}

fn check_name(key: &str, name: &str) -> Result<(), ConfigError> {
    let allowed = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '-' || c == '_';
    if !name.is_empty() && name.len() <= 64 && name.chars().all(allowed) {
        Ok(())
    } else {
        Err(ConfigError::new(key, format!("{name:?}"), "1 to 64 of the characters a-z, 0-9, - and _"))
    }
}
