//! The distance series of each ring of a scan, and how far each range deviates from its neighbours (Neuhaus 2009,
//! section 2.5).
//!
//! In: a [`Scan`] that states the ring of each point. Out: by point, smoothed range minus measured range, metres. The
//! series of a ring holds the ranges of its points by azimuth, whatever the order of the points. Gaps in azimuth are
//! missing returns; the last valid range replaces them, as in the paper. The smoothed range is the mean of nine ranges;
//! at the two ends of the ring it is the mean of the ranges that exist. A point at the azimuth of the point before is a
//! second echo of the same ray; it is not part of the series.

use crate::sensor::distance_series::REACH;
use crate::sensor::observation::Scan;
use crate::sensor::transform::classify;

/// Least difference between the azimuths of two rays, radians. Ours: a fiftieth of the finest azimuth step of the
/// family, and far above the rounding of coordinates.
const STEP_RAD_MIN: f32 = 2e-5;
/// Share of a ring's azimuth step below which two points belong to one ray. Ours: rays jitter by less than their step.
const SAME_RAY_SHARE: f32 = 0.1;
/// Number of azimuth steps between two rays below which none is missing between them.
const GAP_STEPS_MIN: f32 = 1.4;
/// Least number of points of a ring with a series: as many as one mean has.
const POINTS_MIN: usize = 2 * REACH + 1;

/// Computes the series of one scan after the other and reuses its buffers.
#[derive(Clone, Debug, Default)]
pub struct RingSeries {
    /// Number of points before each ring; one entry more than rings.
    first_of_ring: Vec<u32>,
    /// By point of the scan: a number that rises with the azimuth; NaN if it is no return.
    ranks: Vec<f32>,
    /// Index in `points` of the next point of each ring.
    next_of_ring: Vec<u32>,
    /// Points by ring, as [`key`]s.
    points: Vec<u64>,
    /// Of one ring, by point: x, y and z, metres.
    positions_m: [Vec<f32>; 3],
    /// Of one ring, by point: range, metres.
    point_ranges_m: Vec<f32>,
    /// Of one ring, by point: angle to the point before, radians.
    steps_rad: Vec<f32>,
    /// Bits of the steps of one ring that are no rounding, in any order. They rise with the step.
    candidates: Vec<u32>,
    /// Of one ring: ranges with missing returns replaced, metres.
    ranges_m: Vec<f32>,
    /// Of one ring: index of each measured range in `ranges_m`, and of its point in the scan.
    measured: Vec<(u32, u32)>,
    /// Of one ring: mean of the nine ranges around each of `ranges_m`, metres; the first and last four are not used.
    means_m: Vec<f32>,
    /// Deviation by point, metres.
    deviation_m: Vec<f32>,
}

impl RingSeries {
    /// Deviation of every point of a scan, metres; NaN if the scan states no rings, and for points without a series.
    pub fn deviations(&mut self, scan: &Scan) -> &[f32] {
        self.deviation_m.clear();
        self.deviation_m.resize(scan.x.len(), f32::NAN);
        self.sort_points(scan);
        let mut points = std::mem::take(&mut self.points);
        for ring in 1..self.first_of_ring.len() {
            let of_ring = self.first_of_ring[ring - 1] as usize..self.first_of_ring[ring] as usize;
            if of_ring.len() >= POINTS_MIN {
                let of_ring = &mut points[of_ring];
                sort_by_azimuth(of_ring);
                self.find_steps(scan, of_ring);
                self.fill_gaps(of_ring);
                self.subtract();
            }
        }
        self.points = points;
        &self.deviation_m
    }

    /// Fills `points` and `first_of_ring` with the returns of the scan.
    fn sort_points(&mut self, scan: &Scan) {
        self.ranks.clear();
        let points = scan.x.iter().zip(&scan.y).zip(&scan.z);
        self.ranks.extend(points.map(|((&x, &y), &z)| match classify(x, y, z).1 {
            true => azimuth_rank(x, y),
            false => f32::NAN,
        }));
        let rings = scan.ring.iter().max().map_or(0, |ring| usize::from(*ring) + 1);
        self.first_of_ring.clear();
        self.first_of_ring.resize(rings + 1, 0);
        for (&ring, rank) in scan.ring.iter().zip(&self.ranks) {
            self.first_of_ring[usize::from(ring) + 1] += u32::from(!rank.is_nan());
        }
        for ring in 0..rings {
            self.first_of_ring[ring + 1] += self.first_of_ring[ring];
        }
        self.next_of_ring.clone_from(&self.first_of_ring);
        self.points.resize(self.first_of_ring[rings] as usize, 0);
        for (index, (&ring, &rank)) in (0..).zip(scan.ring.iter().zip(&self.ranks)) {
            if !rank.is_nan() {
                let slot = &mut self.next_of_ring[usize::from(ring)];
                self.points[*slot as usize] = key(rank, index);
                *slot += 1;
            }
        }
    }

    fn find_steps(&mut self, scan: &Scan, of_ring: &[u64]) {
        for (positions_m, from) in self.positions_m.iter_mut().zip([&scan.x, &scan.y, &scan.z]) {
            positions_m.clear();
            positions_m.extend(of_ring.iter().map(|key| from[*key as u32 as usize]));
        }
        let [xs, ys, zs] = &self.positions_m;
        let points = xs.iter().zip(ys).zip(zs);
        self.point_ranges_m.clear();
        self.point_ranges_m.extend(points.map(|((x, y), z)| (x * x + y * y + z * z).sqrt()));
        self.steps_rad.clear();
        self.steps_rad.push(0.0);
        let pairs = xs.iter().zip(ys).zip(xs[1..].iter().zip(&ys[1..]));
        self.steps_rad.extend(pairs.map(|((ax, ay), (bx, by))| {
            let (cross, dot) = (ax * by - ay * bx, ax * bx + ay * by);
            // The tangent is the angle for all but wide gaps.
            if dot > 0.0 { cross / dot } else { f32::INFINITY }
        }));
    }

    /// Fills `ranges_m` and `measured`; both stay empty if the ring has no azimuth step.
    fn fill_gaps(&mut self, of_ring: &[u64]) {
        self.ranges_m.clear();
        self.measured.clear();
        self.candidates.clear();
        self.candidates.extend(self.steps_rad.iter().filter(|step| **step > STEP_RAD_MIN).map(|step| step.to_bits()));
        if self.candidates.is_empty() {
            return;
        }
        let middle = self.candidates.len() / 2;
        let step_rad = f32::from_bits(*self.candidates.select_nth_unstable(middle).1);
        let mut since_last_rad = f32::INFINITY;
        for ((&key, &rad), &range_m) in of_ring.iter().zip(&self.steps_rad).zip(&self.point_ranges_m) {
            since_last_rad += rad;
            if since_last_rad < SAME_RAY_SHARE * step_rad {
                continue;
            }
            // Less than one and a half steps round to one, which no ray misses.
            if since_last_rad > GAP_STEPS_MIN * step_rad
                && let Some(&last_m) = self.ranges_m.last()
            {
                // `as` saturates. A mean reaches four ranges back, so that four missing ones are as good as all.
                let missing = ((since_last_rad / step_rad).round() as usize).saturating_sub(1).min(REACH);
                self.ranges_m.extend(std::iter::repeat_n(last_m, missing));
            }
            self.measured.push((self.ranges_m.len() as u32, key as u32));
            self.ranges_m.push(range_m);
            since_last_rad = 0.0;
        }
    }

    fn subtract(&mut self) {
        let (ranges_m, ranges) = (&self.ranges_m, self.ranges_m.len());
        self.means_m.clear();
        self.means_m.resize(ranges, 0.0);
        // Without a branch, so that the compiler vectorises it.
        for (mean, window) in self.means_m.iter_mut().skip(REACH).zip(ranges_m.array_windows::<{ 2 * REACH + 1 }>()) {
            *mean = window.iter().sum::<f32>() / window.len() as f32;
        }
        for &(at, point) in &self.measured {
            let at = at as usize;
            let mean_m = if at >= REACH && at + REACH < ranges {
                self.means_m[at]
            } else {
                let window = &ranges_m[at.saturating_sub(REACH)..(at + REACH + 1).min(ranges)];
                window.iter().sum::<f32>() / window.len() as f32
            };
            self.deviation_m[point as usize] = mean_m - ranges_m[at];
        }
    }
}

/// A point of a ring: its rank, which is not negative, so that its bits rise with it; then its index in the scan. Of
/// two points of equal azimuth the first in the scan comes first.
fn key(rank: f32, index: u32) -> u64 {
    u64::from(rank.to_bits()) << 32 | u64::from(index)
}

/// Sorts the points of a ring by azimuth. Most rings come by azimuth, rising or falling, from any azimuth on, with few
/// points out of order.
fn sort_by_azimuth(of_ring: &mut [u64]) {
    // A Velodyne turns clockwise.
    let falling = of_ring.windows(2).filter(|pair| pair[0] > pair[1]).count();
    if 2 * falling > of_ring.len() {
        of_ring.reverse();
    }
    // Where the azimuth falls by a half circle, the next one begins.
    let rank = |key: u64| f32::from_bits((key >> 32) as u32);
    if let Some(at) = of_ring.windows(2).position(|pair| rank(pair[0]) - rank(pair[1]) > 2.0) {
        of_ring.rotate_left(at + 1);
    }
    let mut moves = 4 * of_ring.len();
    for at in 1..of_ring.len() {
        let (key, mut to) = (of_ring[at], at);
        while to > 0 && of_ring[to - 1] > key && moves > 0 {
            of_ring[to] = of_ring[to - 1];
            (to, moves) = (to - 1, moves - 1);
        }
        of_ring[to] = key;
        if moves == 0 {
            return of_ring.sort_unstable();
        }
    }
}

/// A number from 0 to 4 that rises with the azimuth of a direction, counter-clockwise from behind.
fn azimuth_rank(x: f32, y: f32) -> f32 {
    let share = y / (x.abs() + y.abs());
    // A point on the axis of rotation has no azimuth.
    let share = if share.is_nan() { 0.0 } else { share };
    if x >= 0.0 {
        2.0 + share
    } else if y < 0.0 {
        -share
    } else {
        4.0 - share
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A ring with these ranges, one each 0.2 degrees from the azimuth 0 on; a range of 0 is a missing return.
    fn ring(ranges_m: &[f32]) -> Scan {
        let mut scan = Scan::default();
        for (number, &range_m) in ranges_m.iter().enumerate().filter(|(_, range_m)| **range_m > 0.0) {
            let (sin, cos) = libm::sincosf((number as f32 * 0.2).to_radians());
            push(&mut scan, [range_m * cos, range_m * sin, 0.0], 3);
        }
        scan
    }

    fn push(scan: &mut Scan, [x, y, z]: [f32; 3], ring: u16) {
        scan.x.push(x);
        scan.y.push(y);
        scan.z.push(z);
        scan.intensity.push(0.0);
        scan.ring.push(ring);
    }

    #[test]
    fn a_bump_deviates_from_the_mean_and_a_gap_repeats_the_last_range() {
        let mut ranges = vec![10.0f32; 40];
        ranges[10] = 9.1;
        ranges[20] = 9.1;
        ranges[21] = 0.0;
        let found = RingSeries::default().deviations(&ring(&ranges)).to_vec();
        assert_eq!(found.len(), 39);
        assert!((found[10] - 0.8).abs() < 1e-4, "{found:?}");
        assert!((found[6] + 0.1).abs() < 1e-4 && found[5].abs() < 1e-4, "{found:?}");
        // The range before the gap counts twice.
        assert!((found[21] + 0.2).abs() < 1e-4, "{found:?}");
        assert!((found[24] + 0.1).abs() < 1e-4 && found[25].abs() < 1e-4, "{found:?}");
    }

    #[test]
    fn the_order_of_the_points_does_not_matter_and_second_echoes_have_no_deviation() {
        let mut scan = ring(&[10.0f32; 1800]);
        let first = RingSeries::default().deviations(&scan).to_vec();
        assert!(first.iter().all(|deviation| deviation.abs() < 1e-4));
        // The second echo of a ray lies behind the first.
        push(&mut scan, [20.0, 0.0, 0.0], 3);
        for list in [&mut scan.x, &mut scan.y, &mut scan.z] {
            list[..1800].reverse();
        }
        let reversed = RingSeries::default().deviations(&scan).to_vec();
        assert!(reversed[1800].is_nan());
        assert!(reversed[..1800].iter().all(|deviation| deviation.abs() < 1e-4));
    }

    #[test]
    fn a_scan_without_rings_and_a_short_ring_have_no_deviations() {
        let mut scan = ring(&[10.0; 8]);
        assert!(RingSeries::default().deviations(&scan).iter().all(|deviation| deviation.is_nan()));
        scan = ring(&[10.0; 80]);
        scan.ring.clear();
        assert!(RingSeries::default().deviations(&scan).iter().all(|deviation| deviation.is_nan()));
        let same_place = Scan { x: vec![5.0; 20], y: vec![0.0; 20], z: vec![0.0; 20], ring: vec![0; 20], ..scan };
        assert!(RingSeries::default().deviations(&same_place).iter().all(|deviation| deviation.is_nan()));
    }
}
