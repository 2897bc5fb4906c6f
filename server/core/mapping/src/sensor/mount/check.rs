//! Compares the ground with the configured mount of a sensor, scan after scan.
//!
//! In: the points of each scan, ego frame. With the right mount the ground under the vehicle is the plane z = 0. Out: a
//! [`MountDeviation`]: the medians of height and tilt of the ground over the last scans, and whether they contradict
//! the configuration. A single scan proves little: vehicles pitch and roads bend.

use std::collections::VecDeque;

use nalgebra::{Matrix3, Vector3};

use super::median::{weighted_median, weighted_std};
use crate::sensor::sweep::Sweep;

/// Number of scans whose medians are formed. Ours: ten seconds at 10 Hz, longer than a vehicle brakes.
const SCANS_MAX: usize = 100;
/// Least number of scans with ground before the mount is judged. Ours: two seconds at 10 Hz.
const SCANS_MIN: usize = 20;
/// Least deviation that contradicts the mount: metres, and radians (1.5 degrees). Ours: ground 0.15 m too high is a
/// kerb, and ground tilted by 1.5 degrees is as much too high at 6 m.
const HEIGHT_M: f64 = 0.15;
const TILT_RAD: f64 = 0.026;
/// A deviation also contradicts the mount only beyond this many standard deviations.
const STDS: f64 = 2.0;
/// A contradiction ends below this share of the least deviation, so that it is not reported again and again.
const END_SHARE: f64 = 2.0 / 3.0;

/// Greatest distance of a cell ahead of, behind and beside the vehicle, metres. Ours: the ground of most sensors begins
/// within it, and bends little.
const AHEAD_M: f32 = 12.0;
const BESIDE_M: f32 = 4.0;
/// Greatest height of a cell over the configured ground, metres: 1.5 m of height or 7 degrees of tilt.
const Z_M: f32 = 1.5;
/// The same for a scan without ground within that: the mount is wrong by more. Ours: no sensor of a vehicle is higher.
const FAR_Z_M: f32 = 5.0;
/// Number of points that are read of a scan, about. Ours: a ninth of an HDL-64E's; the cells need no more, and each map
/// waits for the comparison.
const POINTS: usize = 13_000;
/// Side of a cell, metres.
const CELL_M: f32 = 0.5;
const CELLS_AHEAD: usize = (2.0 * AHEAD_M / CELL_M) as usize;
const CELLS_BESIDE: usize = (2.0 * BESIDE_M / CELL_M) as usize;
/// Tolerances of the fits one after the other, metres over and under the plane. The first finds the ground among
/// vehicles and walls, which stand over it; ghosts under it are few.
const TOLERANCES_M: [[f64; 2]; 6] = [[0.3, 1.5], [0.3, 0.9], [0.2, 0.5], [0.15, 0.3], [0.12, 0.15], [0.12, 0.15]];
/// Least number of cells on the plane, and of the cells of each half of the vehicle's surroundings (ahead, behind), so
/// that the pitch is no extrapolation.
const CELLS_MIN: usize = 40;
const HALF_MIN: usize = 8;
/// Weights of a cell: as of [`crate::sensor::mount`].
const NEAR_M: f64 = 4.0;
const PATH_M: f64 = 1.0;

/// How far the ground deviates from the configured mount of a sensor: medians over the last scans.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct MountDeviation {
    /// Height of the sensor over the ground that the scans show, less the configured one, metres.
    pub height_m: f64,
    /// Rotation about the ego frame's y axis that would level the ground, radians.
    pub pitch_rad: f64,
    /// Rotation about the ego frame's x axis that would level the ground, radians.
    pub roll_rad: f64,
    /// Standard deviations of height, pitch and roll from scan to scan, metres and radians.
    pub std: [f64; 3],
    /// Number of scans with ground that the medians are formed of, at most 100.
    pub scans: usize,
    /// True if the ground contradicts the mount: 20 scans or more deviate by more than 0.15 m or 1.5 degrees in the
    /// median, and by more than twice the standard deviation.
    pub contradicts: bool,
}

/// The comparison of one sensor.
#[derive(Clone, Debug, Default)]
pub(crate) struct MountCheck {
    /// Height, pitch and roll of the last scans with ground.
    deviations: VecDeque<[f64; 3]>,
    newest: Option<MountDeviation>,
    cells: Vec<f32>,
    /// Position of the lowest return of each cell that has one, metres.
    lowest_m: Vec<[f64; 3]>,
    /// Height and weight of these, by height.
    heights: Vec<[f64; 2]>,
    /// Those of them that lie on the plane.
    on_plane: Vec<[f64; 3]>,
    /// One value of the last scans with its weight, ascending.
    ascending: Vec<[f64; 2]>,
}

impl MountCheck {
    /// The deviation after the newest scan; `None` before the first scan with ground.
    pub fn deviation(&self) -> Option<MountDeviation> {
        self.newest
    }

    /// Adds a scan of the sensor at `origin_m`, both in the ego frame.
    pub fn push(&mut self, sweep: &Sweep, origin_m: [f32; 3]) {
        let Some(plane) = [Z_M, FAR_Z_M].into_iter().find_map(|z_m| self.ground_plane(sweep, z_m)) else { return };
        let [x, y, _] = origin_m.map(f64::from);
        let normal = Vector3::new(-plane.x, -plane.y, 1.0).normalize();
        let (roll_rad, pitch_rad) =
            (libm::atan2(normal.y, normal.z), -libm::atan2(normal.x, libm::hypot(normal.y, normal.z)));
        if self.deviations.len() == SCANS_MAX {
            self.deviations.pop_front();
        }
        self.deviations.reserve(SCANS_MAX - self.deviations.len());
        self.deviations.push_back([-(plane.x * x + plane.y * y + plane.z), pitch_rad, roll_rad]);
        let [(height_m, height_std), (pitch_rad, pitch_std), (roll_rad, roll_std)] =
            [0, 1, 2].map(|of| median_and_std(self.deviations.iter().map(|values| values[of]), &mut self.ascending));
        let was = self.newest.is_some_and(|newest| newest.contradicts);
        let exceeds = |value: f64, std: f64, least: f64| match was {
            true => value.abs() > END_SHARE * least,
            false => value.abs() > least && value.abs() > STDS * std,
        };
        let contradicts = self.deviations.len() >= SCANS_MIN
            && (exceeds(height_m, height_std, HEIGHT_M)
                || exceeds(pitch_rad, pitch_std, TILT_RAD)
                || exceeds(roll_rad, roll_std, TILT_RAD));
        let std = [height_std, pitch_std, roll_std];
        self.newest =
            Some(MountDeviation { height_m, pitch_rad, roll_rad, std, scans: self.deviations.len(), contradicts });
    }

    /// The plane z = a x + b y + c of the ground near the vehicle's path and within `z_m` of the configured height, as
    /// (a, b, c); `None` if few cells show it.
    fn ground_plane(&mut self, sweep: &Sweep, z_m: f32) -> Option<Vector3<f64>> {
        self.cells.clear();
        self.cells.resize(CELLS_AHEAD * CELLS_BESIDE, f32::INFINITY);
        // An odd step reads all lasers of a firing in turn.
        let step = (sweep.x.len() / POINTS) | 1;
        for ((&x, &y), &z) in sweep.x.iter().zip(&sweep.y).zip(&sweep.z).step_by(step) {
            if x.abs() < AHEAD_M && y.abs() < BESIDE_M && z.abs() < z_m {
                // The sum of a value just below the limit may be rounded to the limit.
                let row = (((x + AHEAD_M) / CELL_M) as usize).min(CELLS_AHEAD - 1);
                let cell = row * CELLS_BESIDE + (((y + BESIDE_M) / CELL_M) as usize).min(CELLS_BESIDE - 1);
                self.cells[cell] = self.cells[cell].min(z);
            }
        }
        let middle = |index: usize, half: f32| f64::from((index as f32 + 0.5) * CELL_M - half);
        let Self { lowest_m: cells, heights, on_plane, .. } = self;
        cells.clear();
        cells.extend(self.cells.iter().enumerate().filter(|(_, z)| z.is_finite()).map(|(cell, z)| {
            let [x, y] = [middle(cell / CELLS_BESIDE, AHEAD_M), middle(cell % CELLS_BESIDE, BESIDE_M)];
            [x, y, f64::from(*z)]
        }));
        // The first plane is level, at the weighted median height.
        heights.clear();
        heights.extend(cells.iter().map(|cell| [cell[2], weight(cell)]));
        heights.sort_by(|a, b| a[0].total_cmp(&b[0]));
        let mut plane = Vector3::new(0.0, 0.0, weighted_median(heights));
        let distance = |plane: &Vector3<f64>, [x, y, z]: &[f64; 3]| z - (plane.x * x + plane.y * y + plane.z);
        for [over_m, under_m] in TOLERANCES_M {
            on_plane.clear();
            on_plane.extend(cells.iter().filter(|cell| (-under_m..=over_m).contains(&distance(&plane, cell))));
            plane = fit(on_plane)?;
        }
        let ahead = on_plane.iter().filter(|cell| cell[0] > 0.0).count();
        let is_seen = on_plane.len() >= CELLS_MIN && ahead >= HALF_MIN && on_plane.len() - ahead >= HALF_MIN;
        is_seen.then_some(plane)
    }
}

/// Weight of a cell by its range and by its distance from the vehicle's path.
fn weight([x, y, _]: &[f64; 3]) -> f64 {
    let squared = (y / PATH_M) * (y / PATH_M);
    1.0 / ((x * x + y * y + NEAR_M * NEAR_M) * (1.0 + squared * squared))
}

/// The plane of weighted least squares; `None` if the cells lie in a line.
fn fit(cells: &[[f64; 3]]) -> Option<Vector3<f64>> {
    let (mut matrix, mut vector) = (Matrix3::zeros(), Vector3::zeros());
    for cell in cells {
        let (row, weight) = (Vector3::new(cell[0], cell[1], 1.0), weight(cell));
        matrix += row * row.transpose() * weight;
        vector += row * (cell[2] * weight);
    }
    matrix.cholesky().map(|cholesky| cholesky.solve(&vector))
}

/// Median and standard deviation of values; `ascending` is a buffer.
fn median_and_std(values: impl Iterator<Item = f64>, ascending: &mut Vec<[f64; 2]>) -> (f64, f64) {
    ascending.clear();
    ascending.reserve(SCANS_MAX);
    ascending.extend(values.map(|value| [value, 1.0]));
    ascending.sort_by(|a, b| a[0].total_cmp(&b[0]));
    (weighted_median(ascending), weighted_std(ascending))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Ground tilted by `slope` along x and raised by `height_m`, with a wall and a car beside the path.
    fn sweep(slope: f32, height_m: f32) -> Sweep {
        let mut sweep = Sweep::default();
        for i in 0..240 * 160 {
            let (x, y) = ((i / 160) as f32 * 0.1 - 12.0, (i % 160) as f32 * 0.1 - 8.0);
            if libm::hypotf(x, y) < 3.0 {
                continue;
            }
            let object = if y > 2.5 || (4.0..8.0).contains(&x) && y.abs() < 0.9 { 1.0 } else { 0.0 };
            sweep.x.push(x);
            sweep.y.push(y);
            sweep.z.push(height_m + slope * x + object);
        }
        sweep
    }

    #[test]
    fn a_wrong_mount_is_reported_after_20_scans_and_a_right_one_never() {
        let origin_m = [1.0, 0.0, 1.8];
        let mut check = MountCheck::default();
        for _ in 0..200 {
            check.push(&sweep(0.0, 0.02), origin_m);
        }
        let right = check.deviation().unwrap();
        assert!(!right.contradicts && right.scans == 100 && (right.height_m + 0.02).abs() < 0.01, "{right:?}");
        for (slope, height_m) in
            [(0.0, -0.3), (0.0, 0.3), (0.05, 0.0), (-0.05, 0.1), (0.0, 1.6), (0.0, 3.1), (0.03, -1.7)]
        {
            let mut check = MountCheck::default();
            for scans in 1..=30 {
                check.push(&sweep(slope, height_m), origin_m);
                let found = check.deviation().unwrap();
                assert_eq!((found.contradicts, found.scans), (scans >= 20, scans), "{slope} {height_m}: {found:?}");
                let height = f64::from(-height_m - slope);
                assert!((found.height_m - height).abs() < 0.03, "{slope} {height_m}: {found:?}");
                assert!((found.pitch_rad - f64::from(slope)).abs() < 0.005 && found.roll_rad.abs() < 0.005);
            }
        }
    }

    #[test]
    fn a_plane_that_leans_in_both_directions_is_found_beside_objects() {
        for [slope_x, slope_y] in [[0.03, 0.08], [-0.02, -0.08], [0.0, 0.1]] {
            let mut leaning = sweep(slope_x, 0.1);
            leaning.z.iter_mut().zip(&leaning.y).for_each(|(z, y)| *z += slope_y * y);
            let mut check = MountCheck::default();
            check.push(&leaning, [0.0, 0.0, 1.8]);
            let found = check.deviation().unwrap();
            let apart = [found.pitch_rad - f64::from(slope_x), found.roll_rad + f64::from(slope_y)].map(f64::abs);
            assert!(apart.iter().all(|apart| *apart < 0.003), "{slope_x} {slope_y}: {found:?}");
            assert!((found.height_m + 0.1).abs() < 0.03, "{slope_x} {slope_y}: {found:?}");
            assert_eq!(
                check.on_plane.len(),
                check
                    .lowest_m
                    .iter()
                    .filter(|[x, y, z]| {
                        let over_m = z - 0.1 - f64::from(slope_x) * x - f64::from(slope_y) * y;
                        over_m.abs() < 0.2
                    })
                    .count(),
                "all cells of the ground and no others"
            );
        }
    }

    #[test]
    fn a_return_just_within_the_last_cell_is_in_it() {
        let mut check = MountCheck::default();
        let corner = Sweep {
            x: vec![AHEAD_M.next_down(), -AHEAD_M.next_down()],
            y: vec![BESIDE_M.next_down(), -BESIDE_M.next_down()],
            z: vec![0.0; 2],
            ..Sweep::default()
        };
        check.push(&corner, [0.0; 3]);
        let seen: Vec<usize> = (0..check.cells.len()).filter(|cell| check.cells[*cell].is_finite()).collect();
        assert_eq!(seen, [0, CELLS_AHEAD * CELLS_BESIDE - 1]);
    }

    #[test]
    fn a_contradiction_ends_below_two_thirds_of_its_beginning() {
        let mut check = MountCheck::default();
        let after = |check: &mut MountCheck, height_m: f32| {
            (0..100).for_each(|_| check.push(&sweep(0.0, height_m), [0.0; 3]));
            check.deviation().unwrap().contradicts
        };
        let reported = [0.12, 0.2, 0.12, 0.08, 0.12].map(|height_m| after(&mut check, height_m));
        assert_eq!(reported, [false, true, true, false, false]);
    }

    #[test]
    fn a_vehicle_that_pitches_and_scans_without_ground_contradict_nothing() {
        let mut check = MountCheck::default();
        for scan in 0..100 {
            check.push(&sweep(if scan % 2 == 0 { 0.04 } else { -0.04 }, 0.0), [0.0; 3]);
        }
        assert!(!check.deviation().unwrap().contradicts, "{:?}", check.deviation());
        let mut blind = MountCheck::default();
        blind.push(&Sweep::default(), [0.0; 3]);
        let ahead = sweep(0.0, 0.5);
        let kept = (0..ahead.x.len()).filter(|i| ahead.x[*i] > 0.0);
        let (x, (y, z)): (Vec<_>, (Vec<_>, Vec<_>)) = kept.map(|i| (ahead.x[i], (ahead.y[i], ahead.z[i]))).unzip();
        blind.push(&Sweep { x, y, z, ..Sweep::default() }, [0.0; 3]);
        assert_eq!(blind.deviation(), None);
    }
}
