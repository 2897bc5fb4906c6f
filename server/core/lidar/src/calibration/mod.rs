//! Per-laser corrections: factory tables, ROS YAML, Velodyne XML, and the table an HDL-64E S2 or S3 sends of itself.
//!
//! In: a model, or text. Out: a [`Calibration`]: angles in radians, lengths in metres, lasers in firing order. This
//! crate reads no files: the caller adds the file's name to a [`CalibrationError`].

mod factory;
pub mod unit_table;
mod xml;
mod yaml;

use serde::{Deserialize, Serialize};

use crate::model::Model;

/// Corrections of every laser of one sensor. Serialises as ROS calibration YAML (radians, metres).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Calibration {
    /// Metres a raw distance count.
    #[serde(rename = "distance_resolution")]
    pub distance_m_per_count: f64,
    /// In firing order.
    pub lasers: Vec<LaserCalibration>,
}

/// One laser's corrections, named as ROS `velodyne_pointcloud` names them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct LaserCalibration {
    /// Index in firing order.
    pub laser_id: u16,
    /// Elevation over the sensor's xy plane, rad.
    pub vert_correction: f64,
    /// Subtracted from the encoder angle, rad (ROS sign: positive turns the beam to the left).
    pub rot_correction: f64,
    /// Added to the range, m.
    pub dist_correction: f64,
    /// Added to z, m.
    pub vert_offset_correction: f64,
    /// The beam's start, to the left of the sensor's axis, m.
    pub horiz_offset_correction: f64,
    /// Whether the two near-range corrections below are to be used.
    #[serde(skip_serializing_if = "is_false")]
    pub two_pt_correction_available: bool,
    /// Added to the range 2.4 m to the side of the sensor, m; at 25.04 m `dist_correction` holds.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub dist_correction_x: Option<f64>,
    /// Added to the range 1.93 m ahead of or behind the sensor, m.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub dist_correction_y: Option<f64>,
    /// Range of the greatest intensity, m as files give it. Kept, not applied: intensities stay as the sensor sent
    /// them.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub focal_distance: Option<f64>,
    /// Kept, not applied.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub focal_slope: Option<f64>,
    /// Kept, not applied.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub min_intensity: Option<u8>,
    /// Kept, not applied.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub max_intensity: Option<u8>,
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "serde hands over references")]
fn is_false(value: &bool) -> bool {
    !value
}

/// Why a calibration could not be read.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum CalibrationError {
    /// Not YAML.
    #[error("not YAML: {0}")]
    Yaml(String),
    /// Not XML.
    #[error("not XML: {0}")]
    Xml(String),
    /// Neither YAML nor XML.
    #[error("{0}; ROS YAML or Velodyne XML is allowed")]
    Format(String),
    /// A key that must be there is not.
    #[error("{key}: missing; it must be {allowed}")]
    Missing {
        /// With its place, such as `lasers[3].vert_correction`.
        key: String,
        /// What it must be.
        allowed: &'static str,
    },
    /// A value out of bounds or of the wrong kind.
    #[error("{key}: {value} is not allowed; it must be {allowed}")]
    Value {
        /// With its place, such as `lasers[3].vert_correction`.
        key: String,
        /// As it was written.
        value: String,
        /// What it must be.
        allowed: &'static str,
    },
    /// The same key twice with different values.
    #[error("{key}: given twice, as {first} and {second}")]
    Twice {
        /// With its place.
        key: String,
        /// As it was written first.
        first: String,
        /// As it was written then.
        second: String,
    },
    /// A table for another sensor.
    #[error("lasers: {found} of them, but a {model} has {expected}")]
    Lasers {
        /// In the table.
        found: usize,
        /// The sensor.
        model: &'static str,
        /// What the sensor has.
        expected: usize,
    },
}

impl Calibration {
    /// The nominal table of a model. An HDL-64E's is a stand-in for the unit's own.
    pub fn factory(model: Model) -> Self {
        factory::factory(model)
    }

    /// Reads ROS YAML or Velodyne XML, whichever the text is.
    ///
    /// # Errors
    /// [`CalibrationError`], naming key, value and what is allowed.
    pub fn load_str(text: &str) -> Result<Self, CalibrationError> {
        match text.trim_start_matches('\u{feff}').trim_start().chars().next() {
            Some('<') => Self::from_xml(text),
            Some(_) => Self::from_yaml(text),
            None => Err(CalibrationError::Format("an empty text".into())),
        }
    }

    /// Reads ROS `velodyne_pointcloud` YAML; missing corrections are 0, a missing resolution follows from the lasers.
    ///
    /// # Errors
    /// [`CalibrationError`], naming key, value and what is allowed.
    pub fn from_yaml(text: &str) -> Result<Self, CalibrationError> {
        yaml::read(text)
    }

    /// Reads Velodyne's `db.xml` (degrees and centimetres). It has no flag for the two near-range corrections and
    /// VeloView, whose format it is, does not use them: nor does this table, unless
    /// [`Calibration::with_two_point_corrections`] says so.
    ///
    /// # Errors
    /// [`CalibrationError`], naming key, value and what is allowed.
    pub fn from_xml(text: &str) -> Result<Self, CalibrationError> {
        xml::read(text.trim_start_matches('\u{feff}').trim_start())
    }

    /// ROS YAML; reading it again gives the same table to the last bit.
    pub fn to_yaml(&self) -> String {
        yaml::write(self)
    }

    /// The same table with the near-range corrections used (or not) where both are given.
    pub fn with_two_point_corrections(mut self, used: bool) -> Self {
        for laser in &mut self.lasers {
            laser.two_pt_correction_available =
                used && laser.dist_correction_x.is_some() && laser.dist_correction_y.is_some();
        }
        self
    }

    /// Rank of every laser by elevation, 0 the lowest; lasers of one elevation in firing order.
    pub fn rings(&self) -> Vec<u16> {
        let mut by_elevation: Vec<usize> = (0..self.lasers.len()).collect();
        by_elevation.sort_by(|a, b| self.lasers[*a].vert_correction.total_cmp(&self.lasers[*b].vert_correction));
        let mut rings = vec![0; self.lasers.len()];
        for (rank, laser) in by_elevation.into_iter().enumerate() {
            rings[laser] = rank as u16;
        }
        rings
    }

    /// Elevation of every laser in firing order, rad.
    pub fn elevations_rad(&self) -> Vec<f64> {
        self.lasers.iter().map(|laser| laser.vert_correction).collect()
    }

    /// Whether the table can belong to a model.
    ///
    /// # Errors
    /// [`CalibrationError::Lasers`].
    pub fn fits(&self, model: Model) -> Result<(), CalibrationError> {
        let (found, expected) = (self.lasers.len(), model.spec().lasers);
        if found == expected {
            Ok(())
        } else {
            Err(CalibrationError::Lasers { found, model: model.spec().name, expected })
        }
    }

    /// The same table for a sensor with fewer lasers, as VeloView pads its tables to 64.
    ///
    /// # Errors
    /// [`CalibrationError::Lasers`] if the table is too short.
    pub fn cut_to(mut self, model: Model) -> Result<Self, CalibrationError> {
        self.lasers.truncate(model.spec().lasers);
        self.fits(model).map(|()| self)
    }
}

/// Sorts lasers by id and asks for each of `0..n` once, with sound values.
fn complete(
    distance_m_per_count: Option<f64>,
    mut lasers: Vec<LaserCalibration>,
) -> Result<Calibration, CalibrationError> {
    // Tables without a resolution come from drivers that took 2 mm for every sensor but those with 4 mm.
    let usual = if lasers.len() == 128 { 0.004 } else { 0.002 };
    let distance_m_per_count = distance_m_per_count.unwrap_or(usual);
    lasers.sort_by_key(|laser| laser.laser_id);
    for (expected, laser) in lasers.iter().enumerate() {
        if usize::from(laser.laser_id) != expected {
            return Err(CalibrationError::Value {
                key: format!("lasers[{expected}].laser_id"),
                value: laser.laser_id.to_string(),
                allowed: "each of 0 to the number of lasers less one, once",
            });
        }
    }
    if !matches!(lasers.len(), 16 | 32 | 64 | 128) {
        return Err(CalibrationError::Value {
            key: "lasers".into(),
            value: format!("{} of them", lasers.len()),
            allowed: "16, 32, 64 or 128 lasers",
        });
    }
    Ok(Calibration { distance_m_per_count, lasers })
}

/// A number as it was read, within the bounds of its key.
fn bounded(
    key: impl Fn() -> String,
    value: f64,
    (low, high): (f64, f64),
    allowed: &'static str,
) -> Result<f64, CalibrationError> {
    if (low..=high).contains(&value) {
        Ok(value)
    } else {
        Err(CalibrationError::Value { key: key(), value: value.to_string(), allowed })
    }
}

/// What every number of a table may be. Bounds are wide: they catch degrees read as radians, not odd sensors.
const ANGLE_RAD: ((f64, f64), &str) = ((-1.6, 1.6), "an angle in radians, -1.6 to 1.6");
const LENGTH_M: ((f64, f64), &str) = ((-10.0, 10.0), "a length in metres, -10 to 10");
const FOCAL: ((f64, f64), &str) = ((-1e6, 1e6), "a finite number");
const RESOLUTION_M: ((f64, f64), &str) = ((1e-4, 0.1), "metres a count, 0.0001 to 0.1");
