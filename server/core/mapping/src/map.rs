//! What a map is: a header, the state of every sensor, and layers. Class 0 of every layer means unknown; an unknown
//! cell is never free.

use nalgebra::Isometry3;

use crate::layer::Layer;
use crate::sensor::motion::Compensation;

pub use crate::sensor::state::{Contribution, ElevationSource, OtherClock, SensorState};

/// The map of one vehicle, made from the scan of one sensor (its source) and the newest scans of the others.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Map {
    /// Number of the map: the first of a vehicle is 0, the next ones count up without gaps.
    pub sequence: u64,
    /// Stamp of the earliest first firing of all contributing scans, ns since the Unix epoch.
    pub capture_start_ns: i64,
    /// Stamp of the source's last firing, ns since the Unix epoch. All points are expressed in the ego frame of this
    /// stamp, and the age of the map counts from it.
    pub capture_end_ns: i64,
    /// Number of the epoch of `capture_end_ns`: how often it was not later than the `capture_end_ns` of the map before.
    /// Within an epoch it rises.
    pub epoch: u32,
    /// Arrival of the event that completed the map, ns since the Unix epoch, host clock.
    pub completed_ns: i64,
    /// Ego frame in the world frame at `capture_end_ns`, interpolated; `None` if no pose is near enough.
    pub map_from_ego: Option<Isometry3<f64>>,
    /// Forward speed at `capture_end_ns`; `None` if it is unknown.
    pub speed_mps: Option<f64>,
    /// What moved the points to `capture_end_ns`; the weakest of all contributing sensors.
    pub compensation: Compensation,
    /// Index of the sensor whose scan made the map: the reference sensor, or a sensor that replaces it.
    pub source: u16,
    /// Index of the reference sensor: the configured sensor, else the chosen sensor.
    pub reference_sensor: u16,
    /// Every sensor of the vehicle by index, whether it contributes or not. One without a name was withdrawn.
    pub sensors: Vec<SensorState>,
    /// The active layers, in the order of the configuration.
    pub layers: Vec<Layer>,
}

impl Map {
    /// The sensors without the withdrawn sensors.
    pub fn present_sensors(&self) -> impl Iterator<Item = &SensorState> {
        self.sensors.iter().filter(|sensor| !sensor.name.is_empty())
    }
}
