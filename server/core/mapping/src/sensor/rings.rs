//! Elevations of the lasers of a sensor that sends scans. The rows of radial maps depend on them.
//!
//! In: configured elevations, or a scan with rings, sensor frame. Out: a [`Calibration`] that contains elevations only.

use std::collections::BTreeMap;

use clearway_lidar::calibration::{Calibration, LaserCalibration};

use crate::config::sensor::RINGS_MAX;
use crate::event::Scan;
use crate::sensor::sweep::classify;

/// A calibration with these elevations, radians.
pub fn table(elevations_rad: impl Iterator<Item = f64>) -> Calibration {
    let laser = |(laser_id, vert_correction)| LaserCalibration { laser_id, vert_correction, ..Default::default() };
    // The scale is not used: a scan is in metres.
    Calibration { distance_m_per_count: 0.002, lasers: (0..).zip(elevations_rad).map(laser).collect() }
}

/// A calibration with the elevation of each ring of a scan: the median of its points, whatever their order. `None` if
/// the scan states no rings, or more than [`RINGS_MAX`].
pub fn measured(scan: &Scan) -> Option<Calibration> {
    let mut by_ring: BTreeMap<u16, Vec<f32>> = BTreeMap::new();
    for (((&x, &y), &z), &ring) in scan.x.iter().zip(&scan.y).zip(&scan.z).zip(&scan.ring) {
        if classify(x, y, z).1 {
            by_ring.entry(ring).or_default().push(z.atan2(x.hypot(y)));
        }
    }
    let median = |elevations: &mut Vec<f32>| {
        let middle = elevations.len() / 2;
        f64::from(*elevations.select_nth_unstable_by(middle, f32::total_cmp).1)
    };
    let is_known = (1..=RINGS_MAX).contains(&by_ring.len());
    is_known.then(|| table(by_ring.values_mut().map(median)))
}
