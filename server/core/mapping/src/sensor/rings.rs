//! The lasers of a sensor that sends scans, as far as the rows of radial maps need them: their elevations.
//!
//! In: elevations as configured, or a scan with rings, sensor's frame. Out: a [`Calibration`] with nothing but
//! elevations.

use std::collections::BTreeMap;

use clearway_lidar::calibration::{Calibration, LaserCalibration};

use crate::config::RINGS_MAX;
use crate::event::Scan;
use crate::sensor::sweep::is_return;

/// A table with these elevations, rad.
pub fn table(elevations_rad: impl Iterator<Item = f64>) -> Calibration {
    let laser = |(laser_id, vert_correction)| LaserCalibration { laser_id, vert_correction, ..Default::default() };
    // Of no use here: a scan has metres.
    Calibration { distance_m_per_count: 0.002, lasers: (0..).zip(elevations_rad).map(laser).collect() }
}

/// The elevations a scan's rings lie at: the median of each one's points, in whatever order they come. `None` where the
/// scan tells no rings, or more than any sensor has.
pub fn measured(scan: &Scan) -> Option<Calibration> {
    let mut of_ring: BTreeMap<u16, Vec<f32>> = BTreeMap::new();
    for (((&x, &y), &z), &ring) in scan.x.iter().zip(&scan.y).zip(&scan.z).zip(&scan.ring) {
        if is_return(x, y, z).1 {
            of_ring.entry(ring).or_default().push(z.atan2(x.hypot(y)));
        }
    }
    let median = |elevations: &mut Vec<f32>| {
        let middle = elevations.len() / 2;
        f64::from(*elevations.select_nth_unstable_by(middle, f32::total_cmp).1)
    };
    let known = (1..=RINGS_MAX).contains(&of_ring.len());
    known.then(|| table(of_ring.values_mut().map(median)))
}
