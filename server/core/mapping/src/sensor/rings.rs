//! Rings and elevations of the lasers of a sensor that sends scans. The rows of radial maps depend on them.
//!
//! In: configured elevations, or a scan, sensor frame. Out: a [`Calibration`] that contains elevations only, or the
//! ring of each point. A scan that states no rings shows them in one of two ways:
//!
//! - Its points are stored ring by ring, as in KITTI's files: the azimuth runs round once for each ring.
//! - Its points are stored in the order of their firings, and their elevations form one narrow cluster for each laser.

use std::collections::BTreeMap;
use std::f32::consts::{PI, TAU};

use clearway_lidar::calibration::{Calibration, LaserCalibration};

use crate::sensor::config::RINGS_MAX;
use crate::sensor::observation::Scan;
use crate::sensor::transform::classify;

/// Least number of rings that are found in a scan without rings. Ours: a rotating sensor has at least 16, and some of
/// them may return nothing.
const RINGS_MIN: usize = 8;
/// Least difference of the elevations of two neighbouring rings, radians: half of the least step of any model, 0.1
/// degrees of a VLS-128.
const STEP_RAD_MIN: f32 = 0.05 * PI / 180.0;
/// Width of a bin of the histogram of elevations, degrees: a fifth of the least step of any model.
const BIN_DEG: f32 = 0.02;
const BINS: usize = (180.0 / BIN_DEG) as usize;
/// A bin belongs to a cluster if it holds one point in this many, and at least [`BIN_POINTS_MIN`]. Ours: 128 lasers
/// share the points, and each laser's points lie in a few bins.
const BIN_PARTS: usize = 5000;
const BIN_POINTS_MIN: usize = 3;
/// Greatest width of a cluster, bins. Measured: 0.08 degrees for an HDL-32E, 0.02 for a VLS-128; the lasers of an
/// HDL-64E sit at two heights, and its clusters flow into each other.
const CLUSTER_BINS_MAX: usize = 10;
/// Least range of a point whose elevation is used, metres. Ours: nearer, the place of a laser in its sensor shows.
const RANGE_M_MIN: f32 = 2.5;

/// A calibration with these elevations, radians.
pub fn table(elevations_rad: impl Iterator<Item = f64>) -> Calibration {
    let laser = |(laser_id, vert_correction)| LaserCalibration { laser_id, vert_correction, ..Default::default() };
    // The scale is not used: a scan is in metres.
    Calibration { distance_m_per_count: 0.002, lasers: (0..).zip(elevations_rad).map(laser).collect() }
}

/// A calibration with the elevation of each ring of a scan: the median of its points, whatever their order. `None` if
/// the scan states no rings, or more than [`RINGS_MAX`].
pub fn measured(scan: &Scan) -> Option<Calibration> {
    let elevations = ring_elevations(scan, &scan.ring)?;
    Some(table(elevations.values().map(|elevation| f64::from(*elevation))))
}

/// A calibration with the elevations that a scan without rings shows; `None` if it shows none.
pub fn estimated(scan: &Scan) -> Option<Calibration> {
    let by_order = || {
        let elevations = ring_elevations(scan, &from_order(scan)?)?;
        Some(table(elevations.values().map(|elevation| f64::from(*elevation))))
    };
    by_order().or_else(|| clusters(scan))
}

/// The rings of a scan as ranks by elevation, 0 the lowest, whatever numbers it states; `None` if it states none, or
/// more than [`RINGS_MAX`]. A ring without a return has rank 0.
pub fn ranked(scan: &Scan) -> Option<Vec<u16>> {
    let elevations = ring_elevations(scan, &scan.ring)?;
    let mut by_elevation: Vec<(u16, f32)> = elevations.into_iter().collect();
    by_elevation.sort_by(|a, b| a.1.total_cmp(&b.1));
    let ranks: BTreeMap<u16, u16> = by_elevation.iter().map(|(ring, _)| *ring).zip(0..).collect();
    Some(scan.ring.iter().map(|ring| ranks.get(ring).copied().unwrap_or(0)).collect())
}

/// The ring of each point of a scan whose points are stored ring by ring, from the lowest up or from the highest down;
/// `None` if they are stored in another order. A ring begins where the azimuth jumps by more than half a circle.
pub fn from_order(scan: &Scan) -> Option<Vec<u16>> {
    let mut pieces = Vec::with_capacity(scan.x.len());
    let (mut piece, mut before) = (0u16, None);
    for ((&x, &y), &z) in scan.x.iter().zip(&scan.y).zip(&scan.z) {
        if classify(x, y, z).1 {
            let azimuth = libm::atan2f(y, x).rem_euclid(TAU);
            if before.replace(azimuth).is_some_and(|before: f32| (azimuth - before).abs() > PI) {
                piece += 1;
            }
            if usize::from(piece) >= RINGS_MAX {
                return None;
            }
        }
        pieces.push(piece);
    }
    let elevations: Vec<f32> = ring_elevations(scan, &pieces)?.into_values().collect();
    let rises = |pair: &[f32]| pair[1] - pair[0] >= STEP_RAD_MIN;
    let falls = |pair: &[f32]| pair[0] - pair[1] >= STEP_RAD_MIN;
    if elevations.len() < RINGS_MIN {
        None
    } else if elevations.windows(2).all(rises) {
        Some(pieces)
    } else if elevations.windows(2).all(falls) {
        Some(pieces.into_iter().map(|ring| piece - ring).collect())
    } else {
        None
    }
}

/// The median elevation of each ring with a return, radians, by ring; `None` without rings, and for more than
/// [`RINGS_MAX`].
fn ring_elevations(scan: &Scan, rings: &[u16]) -> Option<BTreeMap<u16, f32>> {
    let mut by_ring: BTreeMap<u16, Vec<f32>> = BTreeMap::new();
    for (((&x, &y), &z), &ring) in scan.x.iter().zip(&scan.y).zip(&scan.z).zip(rings) {
        if classify(x, y, z).1 {
            by_ring.entry(ring).or_default().push(libm::atan2f(z, libm::hypotf(x, y)));
        }
    }
    let median = |(ring, mut elevations): (u16, Vec<f32>)| {
        let middle = elevations.len() / 2;
        (ring, *elevations.select_nth_unstable_by(middle, f32::total_cmp).1)
    };
    (1..=RINGS_MAX).contains(&by_ring.len()).then(|| by_ring.into_iter().map(median).collect())
}

/// The elevations around which the points of a scan lie; `None` if a tenth of the points lies elsewhere, if a cluster
/// is too wide for one laser, or if there are too few or too many clusters.
fn clusters(scan: &Scan) -> Option<Calibration> {
    let mut histogram = vec![0usize; BINS];
    let mut points = 0;
    for ((&x, &y), &z) in scan.x.iter().zip(&scan.y).zip(&scan.z) {
        if classify(x, y, z).0 && x * x + y * y + z * z >= RANGE_M_MIN * RANGE_M_MIN {
            let degrees = libm::atan2f(z, libm::hypotf(x, y)).to_degrees();
            histogram[(((degrees + 90.0) / BIN_DEG) as usize).min(BINS - 1)] += 1;
            points += 1;
        }
    }
    let least = BIN_POINTS_MIN.max(points / BIN_PARTS);
    let (mut elevations, mut inside) = (Vec::new(), 0);
    let mut cluster: Vec<(usize, usize)> = Vec::new();
    for (bin, &count) in histogram.iter().chain([&0]).enumerate() {
        if count >= least {
            cluster.push((bin, count));
        } else if !cluster.is_empty() {
            let sum: usize = cluster.iter().map(|(_, count)| count).sum();
            let moment: f64 = cluster.iter().map(|(bin, count)| (*bin as f64 + 0.5) * *count as f64).sum();
            elevations.push((moment / sum as f64 * f64::from(BIN_DEG) - 90.0).to_radians());
            inside += sum;
            if cluster.len() > CLUSTER_BINS_MAX {
                return None;
            }
            cluster.clear();
        }
    }
    let is_clear = inside * 10 >= points * 9 && (RINGS_MIN..=RINGS_MAX).contains(&elevations.len());
    is_clear.then(|| table(elevations.into_iter()))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Points of 16 lasers from -15 to 15 degrees in 200 directions at various ranges, ring by ring from the highest
    /// down, or firing by firing.
    fn scan(by_ring: bool) -> Scan {
        let mut scan = Scan::default();
        for i in 0..16 * 200 {
            let (laser, column) = if by_ring { (15 - i / 200, i % 200) } else { (i % 16 * 7 % 16, i / 16) };
            let elevation = (2.0 * laser as f32 - 15.0).to_radians();
            let (azimuth, range) = (0.01 + column as f32 * TAU / 200.0, 5.0 + (i * 37 % 101) as f32 * 0.3);
            scan.x.push(range * libm::cosf(elevation) * libm::cosf(azimuth));
            scan.y.push(range * libm::cosf(elevation) * libm::sinf(azimuth));
            scan.z.push(range * libm::sinf(elevation));
            scan.intensity.push(0.0);
        }
        scan
    }

    fn degrees(calibration: &Calibration) -> Vec<f64> {
        let mut degrees: Vec<f64> = calibration.lasers.iter().map(|l| l.vert_correction.to_degrees()).collect();
        degrees.sort_by(f64::total_cmp);
        degrees
    }

    #[test]
    fn the_order_of_the_points_or_their_elevations_show_the_lasers() {
        assert_eq!(from_order(&scan(false)), None);
        let rings = from_order(&scan(true)).unwrap();
        assert!(rings[0] == 15 && rings[199] == 15 && rings[200] == 14 && rings[3199] == 0);
        for by_ring in [true, false] {
            let found = degrees(&estimated(&scan(by_ring)).unwrap());
            assert_eq!(found.len(), 16, "{by_ring}");
            for (found, laser) in found.iter().zip(0..) {
                assert!((found - (2.0 * f64::from(laser) - 15.0)).abs() < 0.011, "{by_ring}: {found}");
            }
        }
    }

    #[test]
    fn elevations_without_clusters_show_no_lasers() {
        let mut spread = scan(false);
        spread.z.iter_mut().zip(0..).for_each(|(z, i)| *z += (i * 13 % 97) as f32 * 0.01);
        assert_eq!(estimated(&spread), None);
        assert_eq!(estimated(&Scan::default()), None);
    }

    #[test]
    fn rings_with_any_numbers_are_ranked_by_elevation() {
        let mut numbered = scan(true);
        numbered.ring = (0..3200u16).map(|i| 900 + i / 200).collect();
        let ranks = ranked(&numbered).unwrap();
        assert_eq!(Some(ranks), from_order(&numbered));
        numbered.ring = (0..3200).collect();
        assert_eq!(ranked(&numbered), None, "3200 rings");
    }
}
