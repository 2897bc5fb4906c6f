//! The newest scan of one sensor.
//!
//! [`crate::sensor::pipeline`] writes it; fusion and the layers read it.

use std::sync::Arc;

use nalgebra::Isometry3;

use crate::event_time::EventTime;
use crate::sensor::motion::Compensation;
use crate::sensor::rays::Rays;
use crate::sensor::state::{Contribution, SensorState};
use crate::sensor::sweep::Sweep;

/// The newest scan of one sensor, made from a revolution of its firings or from a scan event.
#[derive(Clone, Default)]
pub(crate) struct SensorScan {
    /// Number of scans that the sensor has completed. While it is 0, all but the origin and the name are defaults.
    pub completed: u64,
    /// Stamp of the first firing or point, ns since the Unix epoch.
    pub start_ns: i64,
    /// Stamp of the last firing or point, ns since the Unix epoch.
    pub end_ns: i64,
    /// Time from the end of the scan before to the end of this one, ns; `None` for the first.
    pub period_ns: Option<i64>,
    /// When the event arrived that completed the scan.
    pub completed_at: EventTime,
    /// True if the scan was made from a revolution, false if it came as a scan event.
    pub is_revolution: bool,
    /// Position of the sensor, ego frame, metres.
    pub origin_m: [f32; 3],
    /// Angle between the sensor's z axis and the vertical, radians.
    pub tilt_rad: f32,
    /// Points, ego frame at `end_ns`.
    pub sweep: Arc<Sweep>,
    /// Memory for the points of the next scan, while a map holds the points of this scan.
    spare: Arc<Sweep>,
    /// Directions (unit vectors) of the rays without a return, ego frame at `end_ns`; empty unless a layer needs them.
    pub no_returns: Vec<[f32; 3]>,
    /// What moved the points to `end_ns`.
    pub compensation: Compensation,
    /// Ego frame in the world frame at `end_ns`; `None` if no pose is near enough.
    pub map_from_ego: Option<Isometry3<f64>>,
    /// Forward speed at `end_ns`; `None` if it is unknown.
    pub speed_mps: Option<f64>,
    /// What a map that contains this scan states about the sensor.
    pub state: SensorState,
}

impl SensorScan {
    /// The scan of a sensor that has completed none yet.
    pub fn new(name: &str, origin_m: [f32; 3], tilt_rad: f32) -> Self {
        Self {
            origin_m,
            tilt_rad,
            state: SensorState { name: name.into(), ..SensorState::default() },
            ..Self::default()
        }
    }

    /// The points of the next scan, to be written in place of the newest.
    pub fn next_sweep(&mut self) -> &mut Sweep {
        std::mem::swap(&mut self.sweep, &mut self.spare);
        Arc::make_mut(&mut self.sweep)
    }

    /// True if the sender has stated a scan without points and rays: it is blind, and shows neither rings nor motion.
    pub fn is_empty(&self) -> bool {
        self.completed > 0 && self.state.contribution == Contribution::Empty
    }

    /// True if no sensor has this index at present: the sensor that had it was withdrawn.
    pub fn is_withdrawn(&self) -> bool {
        self.state.name.is_empty()
    }

    /// The scan as the input of layers that gather evidence; `sensor` is the index of the sensor. Heights are those
    /// over the plane under the vehicle.
    pub fn rays(&self, sensor: u16) -> Rays<'_> {
        Rays {
            sensor,
            stamp_ns: self.end_ns,
            returns: &self.sweep,
            heights_m: &self.sweep.z,
            origin_m: self.origin_m,
            origin_height_m: self.origin_m[2],
            no_returns: &self.no_returns,
            map_from_ego: self.map_from_ego,
            speed_mps: self.speed_mps,
        }
    }
}
