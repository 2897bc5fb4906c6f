//! The table `[[vehicle.sensor]]`.

use nalgebra::{Isometry3, Translation3, UnitQuaternion};
use serde::{Deserialize, Serialize};

use clearway_lidar::calibration::{Calibration, CalibrationError};
use clearway_lidar::model::Model;

use crate::value_check::{ConfigValueError, check, check_name};

/// Greatest length of a calibration that a declared sensor brings, bytes. Ours: half as much again as the longest table
/// of any model, the table of a VLS-128.
const CALIBRATION_BYTES_MAX: usize = 64 << 10;
/// Greatest number of blind sectors of one sensor. Ours.
pub const BLIND_MAX: usize = 16;
/// Greatest number of lasers of a sensor that sends scans. Ours: the largest sensors have 128.
pub const RINGS_MAX: usize = 256;

/// One sensor of a vehicle.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SensorConfig {
    /// Name of the sensor, unique within the vehicle: `[a-z0-9_-]+`.
    pub name: String,
    /// Model of the sensor; `None` finds it from the data. For a sensor that sends scans: the model whose elevations
    /// define the rows of radial maps.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub model: Option<Model>,
    /// Rotation rate, revolutions a minute; `None` finds it from the data.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rpm: Option<f32>,
    /// Path of the sensor's calibration table, ROS YAML or Velodyne XML; for a declared sensor the text of a ROS YAML
    /// table. `None` selects the factory's table.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub calibration: Option<String>,
    /// Encoder angle at which a revolution begins and ends, degrees; 180 is behind the vehicle.
    #[serde(default = "default_cut_azimuth_deg")]
    pub cut_azimuth_deg: f32,
    /// Least range of a return, metres. Nearer returns are the vehicle itself and are removed.
    #[serde(default = "default_range_m_min")]
    pub range_m_min: f32,
    /// Sectors in which the sensor sees only the vehicle or its own mount: `[from, to]` in degrees clockwise from the
    /// sensor's x axis, seen from above. If `to` is less than `from`, the sector contains 0. Returns there are removed,
    /// and the cells there stay unknown.
    #[serde(default)]
    pub blind_deg: Vec<[f32; 2]>,
    /// Greatest difference between GPS time and arrival, days. If GPS time is older, or ahead of arrival by as much
    /// less six hours, the stamps of the sensor follow the host's clock: then a capture is played live, or the
    /// receiver's date is wrong.
    #[serde(default = "default_gps_late_days_max")]
    pub gps_late_days_max: f64,
    /// Elevation of each laser, degrees; for a sensor that sends scans. They come before the elevations of the model.
    /// Without either, the elevations are measured from the rings of the first scan; if that has no rings, from the
    /// order and the elevations of its points; if these show no lasers, the rows of radial maps that this sensor
    /// defines have the same depth.
    #[serde(default)]
    pub elevations_deg: Vec<f32>,
    /// Standard deviation of the sensor's range noise, metres; the roughness of the ground is measured without it.
    /// `None` selects the value of the model's manual; for scans without a model 0.02, the value of an HDL-64E.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub range_noise_m: Option<f32>,
    /// Position and orientation of the sensor on the vehicle.
    pub extrinsics: Extrinsics,
}

/// Default cut of a revolution, degrees. Ours: behind the vehicle, where a step between two revolutions matters least.
fn default_cut_azimuth_deg() -> f32 {
    180.0
}

/// Default least range, metres. Ours: within it a roof-mounted sensor sees roof, rails and bonnet, and no ground,
/// because it is mounted higher than 1 m.
fn default_range_m_min() -> f32 {
    2.0
}

/// Default greatest age of GPS time, days. Ours: the clocks of hosts are wrong by hours and not by days.
fn default_gps_late_days_max() -> f64 {
    1.0
}

/// Position and orientation of a sensor on its vehicle: `ego_from_sensor`, with the rotation Rz(yaw) Ry(pitch)
/// Rx(roll).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Extrinsics {
    /// Distance forward of the ego origin, metres.
    pub x_m: f64,
    /// Distance to the left of the ego origin, metres.
    pub y_m: f64,
    /// Height over the ground, metres.
    pub z_m: f64,
    /// Rotation about x, degrees.
    pub roll_deg: f64,
    /// Rotation about y, degrees; a positive value tilts the sensor down.
    pub pitch_deg: f64,
    /// Rotation about z, degrees, counter-clockwise.
    pub yaw_deg: f64,
}

impl Extrinsics {
    /// Transform from the sensor frame to the ego frame.
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

/// A calibration in the declaration of a sensor that cannot be used.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub(crate) enum DeclaredCalibrationError {
    /// The text is too long.
    #[error("{bytes} bytes")]
    Length {
        /// Length of the text, bytes.
        bytes: usize,
    },
    /// The text is not a table, or a table of another number of lasers than the model has.
    #[error(transparent)]
    Table(#[from] CalibrationError),
}

impl SensorConfig {
    /// A sensor with the defaults of all other values.
    pub fn new(name: impl Into<String>, extrinsics: Extrinsics) -> Self {
        Self {
            name: name.into(),
            model: None,
            rpm: None,
            calibration: None,
            cut_azimuth_deg: default_cut_azimuth_deg(),
            range_m_min: default_range_m_min(),
            blind_deg: Vec::new(),
            gps_late_days_max: default_gps_late_days_max(),
            elevations_deg: Vec::new(),
            range_noise_m: None,
            extrinsics,
        }
    }

    /// What stands at the index of a declared sensor that was withdrawn, until another one is declared there.
    pub(crate) fn withdrawn() -> Self {
        Self::new("", Extrinsics { x_m: 0.0, y_m: 0.0, z_m: 0.0, roll_deg: 0.0, pitch_deg: 0.0, yaw_deg: 0.0 })
    }

    /// True if no sensor has this index at present. Sensors have names.
    pub fn is_withdrawn(&self) -> bool {
        self.name.is_empty()
    }

    /// Configuration of the sensor's decoder, with the sensor's calibration table. `ahead_ns_max`:
    /// [`clearway_lidar::SensorConfig::ahead_ns_max`].
    pub fn lidar(&self, calibration: Option<Calibration>, ahead_ns_max: i64) -> clearway_lidar::SensorConfig {
        clearway_lidar::SensorConfig {
            model: self.model,
            rpm: self.rpm,
            calibration,
            cut_azimuth_deg: self.cut_azimuth_deg,
            gps_late_ns_max: (self.gps_late_days_max * 86_400e9) as i64,
            ahead_ns_max,
        }
    }

    /// The calibration that a declaration brings as text; `None` if it brings none.
    pub(crate) fn declared_calibration(&self) -> Result<Option<Calibration>, DeclaredCalibrationError> {
        let Some(text) = &self.calibration else { return Ok(None) };
        if text.len() > CALIBRATION_BYTES_MAX {
            return Err(DeclaredCalibrationError::Length { bytes: text.len() });
        }
        let table = Calibration::from_yaml(text)?;
        self.model.map_or(Ok(()), |model| table.fits(model))?;
        Ok(Some(table))
    }

    pub(crate) fn validate(&self, at: &str) -> Result<(), ConfigValueError> {
        check_name(&format!("{at}.name"), &self.name)?;
        if let Some(rpm) = self.rpm {
            // The manuals state 300 to 1200; some hosts set a little less or more.
            check(f64::from(rpm), 60.0..=2400.0, || format!("{at}.rpm"), "60 to 2400")?;
        }
        check(f64::from(self.cut_azimuth_deg), 0.0..=360.0, || format!("{at}.cut_azimuth_deg"), "0 to 360")?;
        check(f64::from(self.range_m_min), 0.0..=20.0, || format!("{at}.range_m_min"), "0 to 20")?;
        if self.blind_deg.len() > BLIND_MAX {
            let given = format!("{} sectors", self.blind_deg.len());
            return Err(ConfigValueError::new(format!("{at}.blind_deg"), given, "at most 16"));
        }
        for &end in self.blind_deg.as_flattened() {
            check(f64::from(end), 0.0..=360.0, || format!("{at}.blind_deg"), "0 to 360")?;
        }
        // At most a century: stamps of 64 bits end in the year 2262.
        check(self.gps_late_days_max, 0.0..=36_525.0, || format!("{at}.gps_late_days_max"), "0 to 36525")?;
        if self.elevations_deg.len() > RINGS_MAX {
            let given = format!("{} elevations", self.elevations_deg.len());
            return Err(ConfigValueError::new(format!("{at}.elevations_deg"), given, "at most 256"));
        }
        for &elevation in &self.elevations_deg {
            check(f64::from(elevation), -90.0..=90.0, || format!("{at}.elevations_deg"), "-90 to 90")?;
        }
        if let Some(noise_m) = self.range_noise_m {
            check(f64::from(noise_m), 0.0..=1.0, || format!("{at}.range_noise_m"), "0 to 1")?;
        }
        let extrinsics = &self.extrinsics;
        for (key, value) in [("x_m", extrinsics.x_m), ("y_m", extrinsics.y_m)] {
            check(value, -20.0..=20.0, || format!("{at}.extrinsics.{key}"), "-20 to 20")?;
        }
        // The radii of the rows follow from the height, so the sensor must be above the ground.
        check(extrinsics.z_m, 0.1..=20.0, || format!("{at}.extrinsics.z_m"), "0.1 to 20")?;
        let angles =
            [("roll_deg", extrinsics.roll_deg), ("pitch_deg", extrinsics.pitch_deg), ("yaw_deg", extrinsics.yaw_deg)];
        for (key, value) in angles {
            check(value, -360.0..=360.0, || format!("{at}.extrinsics.{key}"), "-360 to 360")?;
        }
        Ok(())
    }
}
