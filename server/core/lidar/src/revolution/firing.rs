//! One pass of all lasers of a sensor.

use std::f32::consts::TAU;

use crate::model::AZIMUTHS_PER_REVOLUTION;

/// One pass of all lasers.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Firing {
    /// Encoder angle, in rad in [0, 2π), clockwise from the sensor's x axis seen from above, as Velodyne counts it.
    pub azimuth_rad: f32,
    /// Time since the revolution's `start_ns`, in ns.
    pub offset_ns: u32,
}

impl Firing {
    /// A firing at `azimuth` hundredths of a degree.
    pub(crate) fn new(azimuth: u32, offset_ns: u32) -> Self {
        Self { azimuth_rad: azimuth as f32 * (TAU / AZIMUTHS_PER_REVOLUTION as f32), offset_ns }
    }
}
