//! The configuration of a sensor.

use crate::calibration::Calibration;
use crate::model::Model;
use crate::time::clock::AHEAD_NS_MAX;
use crate::time::gps::GPS_LATE_NS_MAX;

/// Properties of a sensor that are known before its first datagram. The default finds everything in the data and cuts
/// revolutions at azimuth 180 degrees, behind the vehicle.
#[derive(Clone, Debug, PartialEq)]
pub struct SensorConfig {
    /// Model of the sensor; `None` to find it in the data.
    pub model: Option<Model>,
    /// Rate of rotation, in revolutions per minute; `None` to measure it.
    pub rpm: Option<f32>,
    /// Per-laser corrections of the sensor; `None` to use the factory table, or that in the status bytes of an HDL-64E.
    pub calibration: Option<Calibration>,
    /// Encoder angle at which revolutions are cut, in degrees.
    pub cut_azimuth_deg: f32,
    /// Greatest age of GPS time at its arrival, in ns; older GPS time is ignored, and GPS time that is as far ahead of
    /// its arrival, less six hours ([`crate::clock`]).
    pub gps_late_ns_max: i64,
    /// Greatest time, in ns, by which stamps may be ahead of the clock that they follow; if they are ahead by more,
    /// they go back and a new epoch begins. 0: stamps never go back ([`crate::clock`]).
    pub ahead_ns_max: i64,
}

impl Default for SensorConfig {
    fn default() -> Self {
        Self {
            model: None,
            rpm: None,
            calibration: None,
            cut_azimuth_deg: 180.0,
            gps_late_ns_max: GPS_LATE_NS_MAX,
            ahead_ns_max: AHEAD_NS_MAX,
        }
    }
}
