//! The table of corrections of one sensor.
//!
//! In: the corrections of each laser. Out: [`Calibration`], with every laser once, in firing order.

use serde::{Deserialize, Serialize};

use super::error::CalibrationError;
use crate::model::Model;

/// The corrections of all lasers of one sensor. The serialised form is ROS calibration YAML (radians, metres).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Calibration {
    /// Length of one raw distance count, in metres.
    #[serde(rename = "distance_resolution")]
    pub distance_m_per_count: f64,
    /// Corrections of the lasers, in firing order.
    pub lasers: Vec<LaserCalibration>,
}

/// The corrections of one laser, with the field names of ROS `velodyne_pointcloud`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct LaserCalibration {
    /// Index of the laser in firing order.
    pub laser_id: u16,
    /// Elevation of the laser above the xy plane of the sensor, in rad.
    pub vert_correction: f64,
    /// Angle that is subtracted from the encoder angle, in rad. A positive angle turns the ray to the left, as in ROS.
    pub rot_correction: f64,
    /// Length that is added to the range, in m.
    pub dist_correction: f64,
    /// Length that is added to z, in m.
    pub vert_offset_correction: f64,
    /// Distance from the axis of the sensor to the start of the ray, in m, positive to the left.
    pub horiz_offset_correction: f64,
    /// True if the two near-range corrections below are used.
    #[serde(skip_serializing_if = "is_false")]
    pub two_pt_correction_available: bool,
    /// Length that is added to the range of a return 2.4 m to the side of the sensor, in m. At 25.04 m it is
    /// `dist_correction`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub dist_correction_x: Option<f64>,
    /// Length that is added to the range of a return 1.93 m ahead of or behind the sensor, in m.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub dist_correction_y: Option<f64>,
    /// Range of the greatest intensity, in m. It is kept but not applied: intensities stay as the sensor sends them.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub focal_distance: Option<f64>,
    /// Decrease of the intensity around the focal distance. It is kept but not applied.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub focal_slope: Option<f64>,
    /// Least intensity of the laser. It is kept but not applied.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub min_intensity: Option<u8>,
    /// Greatest intensity of the laser. It is kept but not applied.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub max_intensity: Option<u8>,
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "serde hands over references")]
fn is_false(value: &bool) -> bool {
    !value
}

impl Calibration {
    /// Sorts the lasers by id and checks that each of `0..n` is there once. A missing resolution follows from the
    /// number of lasers.
    ///
    /// # Errors
    /// [`CalibrationError::Value`] if an id is missing or occurs twice, or if no model has that number of lasers.
    pub(super) fn from_lasers(
        distance_m_per_count: Option<f64>,
        mut lasers: Vec<LaserCalibration>,
    ) -> Result<Self, CalibrationError> {
        // Tables without a resolution are from drivers that use 4 mm for 128 lasers and 2 mm for all other sensors.
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
        Ok(Self { distance_m_per_count, lasers })
    }

    /// The same table, with the near-range corrections of each laser used (or not) if both are given.
    pub fn with_two_point_corrections(mut self, used: bool) -> Self {
        for laser in &mut self.lasers {
            laser.two_pt_correction_available =
                used && laser.dist_correction_x.is_some() && laser.dist_correction_y.is_some();
        }
        self
    }

    /// Ring of every laser, in firing order: its rank by elevation, 0 lowest. Lasers of equal elevation are ranked in
    /// firing order.
    pub fn rings(&self) -> Vec<u16> {
        let mut by_elevation: Vec<usize> = (0..self.lasers.len()).collect();
        by_elevation.sort_by(|a, b| self.lasers[*a].vert_correction.total_cmp(&self.lasers[*b].vert_correction));
        let mut rings = vec![0; self.lasers.len()];
        for (rank, laser) in by_elevation.into_iter().enumerate() {
            rings[laser] = rank as u16;
        }
        rings
    }

    /// Elevation of every laser, in firing order, in rad.
    pub fn elevations_rad(&self) -> Vec<f64> {
        self.lasers.iter().map(|laser| laser.vert_correction).collect()
    }

    /// Checks that the table has as many lasers as the model.
    ///
    /// # Errors
    /// [`CalibrationError::Lasers`] if the table has more or fewer lasers.
    pub fn fits(&self, model: Model) -> Result<(), CalibrationError> {
        let (found, expected) = (self.lasers.len(), model.spec().lasers);
        if found == expected {
            Ok(())
        } else {
            Err(CalibrationError::Lasers { found, model: model.spec().name, expected })
        }
    }

    /// The first lasers of the table, as many as the model has: VeloView pads its tables to 64 lasers.
    ///
    /// # Errors
    /// [`CalibrationError::Lasers`] if the table has fewer lasers than the model.
    pub fn cut_to(mut self, model: Model) -> Result<Self, CalibrationError> {
        self.lasers.truncate(model.spec().lasers);
        self.fits(model).map(|()| self)
    }
}
