//! What a sender observes beside datagrams: scans and ego poses.

use clearway_lidar::revolution::Revolution;
use nalgebra::Isometry3;

use crate::error::{EventError, check_stamp_range};

/// Greatest coordinate of a position, metres. Ours: no sensor of the family reaches half as far.
pub(crate) const POSITION_M_MAX: f32 = 1000.0;
/// Squared length of a no-return direction. Ours: senders round to single precision or coarser, and an error of a
/// thousandth is one of length alone, which no layer uses.
const SQUARED_UNIT: std::ops::RangeInclusive<f32> = 0.998..=1.002;

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

impl Scan {
    /// Stamp of the first point, ns since the Unix epoch; the scan's stamp without times of points.
    pub(crate) fn start_ns(&self) -> i64 {
        self.stamp_ns.saturating_add(i64::from(self.offset_ns.iter().min().copied().unwrap_or(0)))
    }

    /// Checks the values of the scan.
    ///
    /// # Errors
    /// [`EventError`] with the value that is not allowed.
    pub(crate) fn check(&self) -> Result<(), EventError> {
        let (x, y, z, intensity) = (self.x.len(), self.y.len(), self.z.len(), self.intensity.len());
        if x != y || x != z || x != intensity {
            return Err(EventError::ScanLengths { x, y, z, intensity });
        }
        for (list, length) in [("ring", self.ring.len()), ("offset_ns", self.offset_ns.len())] {
            if length != 0 && length != x {
                return Err(EventError::ScanList { list, length, points: x });
            }
        }
        if let Some(&offset_ns) = self.offset_ns.iter().max().filter(|offset_ns| **offset_ns > 0) {
            return Err(EventError::ScanOffset { offset_ns });
        }
        // NaN is in no range.
        let is_unit = |ray: &[f32; 3]| SQUARED_UNIT.contains(&ray.iter().map(|v| v * v).sum::<f32>());
        match self.no_returns.iter().find(|ray| !is_unit(ray)) {
            Some(&direction) => return Err(EventError::NoReturn { direction }),
            None => check_stamp_range(self.stamp_ns)?,
        }
        let points = self.x.iter().zip(&self.y).zip(&self.z).map(|((&x, &y), &z)| [x, y, z]);
        nearest_beyond_reach(points).map_or(Ok(()), |nearest_m| Err(EventError::ScanFar { nearest_m }))
    }
}

/// Distance of the nearest return from the sensor, metres, if all returns are beyond its reach; `None` without returns.
pub(crate) fn nearest_beyond_reach(points: impl Iterator<Item = [f32; 3]>) -> Option<f64> {
    let squared = |point: [f32; 3]| point.iter().map(|v| f64::from(*v) * f64::from(*v)).sum::<f64>();
    let mut nearest = f64::INFINITY;
    for range in points.map(squared).filter(|range| *range > 0.0) {
        nearest = nearest.min(range);
        // Nearly every scan ends here, at its first return.
        if nearest <= f64::from(POSITION_M_MAX) * f64::from(POSITION_M_MAX) {
            return None;
        }
    }
    nearest.is_finite().then(|| libm::sqrt(nearest))
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
