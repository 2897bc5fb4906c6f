//! Per-laser corrections: factory tables, ROS YAML, Velodyne XML.

use serde::{Deserialize, Serialize};

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
pub struct LaserCalibration {
    /// Index in firing order.
    pub laser_id: u16,
    /// Elevation over the sensor's xy plane, rad.
    pub vert_correction: f64,
    /// Added to the encoder angle, rad (ROS sign).
    pub rot_correction: f64,
    /// Added to the range, m.
    pub dist_correction: f64,
    /// m.
    pub vert_offset_correction: f64,
    /// m.
    pub horiz_offset_correction: f64,
}
