//! What a sender observes beside datagrams: scans and ego poses.

use clearway_lidar::revolution::Revolution;
use nalgebra::Isometry3;

/// Points of one revolution, or of one pass over a field of view, in the sensor frame (REP-103). The arrays have one
/// entry a point, except `no_returns`.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Scan {
    /// Stamp of the scan's end, ns since the Unix epoch.
    pub stamp_ns: i64,
    /// Distance forward of the sensor, metres.
    pub x: Vec<f32>,
    /// Distance to the left of the sensor, metres.
    pub y: Vec<f32>,
    /// Distance above the sensor, metres.
    pub z: Vec<f32>,
    /// Intensity, 0 to 1.
    pub intensity: Vec<f32>,
    /// Rank of each point's laser by elevation, 0 the lowest; empty if the sensor does not state it.
    pub ring: Vec<u16>,
    /// Time of each point, ns after `stamp_ns` and so at most 0; empty if all points have the time of the stamp.
    pub offset_ns: Vec<i32>,
    /// Directions (unit vectors, sensor frame) of rays without a return; empty if the sensor does not state them.
    pub no_returns: Vec<[f32; 3]>,
}

/// The points of a revolution in the order of `Revolution::points`, as a client would send them.
impl From<&Revolution> for Scan {
    fn from(revolution: &Revolution) -> Self {
        let mut scan = Scan { stamp_ns: revolution.end_ns, ..Scan::default() };
        for point in revolution.points() {
            scan.x.push(point.x);
            scan.y.push(point.y);
            scan.z.push(point.z);
            scan.intensity.push(f32::from(point.intensity) / 255.0);
            scan.ring.push(point.ring);
        }
        scan
    }
}

/// Pose and speed of the vehicle at one time.
#[derive(Clone, Debug, PartialEq)]
pub struct EgoPose {
    /// Time of the pose, ns since the Unix epoch.
    pub stamp_ns: i64,
    /// Ego frame in the locally fixed world frame.
    pub map_from_ego: Isometry3<f64>,
    /// Forward speed, m/s; negative when the vehicle drives backwards.
    pub speed_mps: f64,
}
