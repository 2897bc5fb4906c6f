//! The plane on which the vehicle stands, from the points of one revolution.
//!
//! In: points, sensor frame, metres. Out: a [`PlaneEstimate`]. Candidates are planes through three of the lowest points
//! of cells, drawn with a fixed seed; the plane with the most weight of cells is refined by weighted least squares with
//! Tukey's loss. The uncertainty is found by the jackknife: how much the plane moves if all points of one of twelve
//! directions are left out.

use nalgebra::{Matrix3, Vector3};

use super::median::{STD_OF_MEDIAN, weighted_median};

/// Least range of a point, metres. Ours: nearer returns are the vehicle itself.
const RANGE_M_MIN: f32 = 2.5;
/// Greatest coordinate of a point, metres. Ours: the lowest ring of a VLP-16 that is mounted 6 m high meets the ground
/// at 22 m. Near points have most weight, so a lower sensor loses nothing.
const RADIUS_M_MAX: f32 = 30.0;
/// Heights of a sensor over the ground, metres. Ours: from a cargo bike to a haul truck.
const HEIGHT_M: std::ops::RangeInclusive<f64> = 0.3..=6.0;
/// Greatest slope of the ground in the sensor frame: the tangent of 20 degrees. Ours: a sensor that is tilted more does
/// not scan around its vehicle.
const SLOPE_MAX: f64 = 0.364;
/// Side of a cell, metres. Ours: one sample a cell keeps dense near rings from outweighing far ones.
const CELL_M: f32 = 0.5;
const CELLS_ACROSS: usize = (2.0 * RADIUS_M_MAX / CELL_M) as usize;
/// Range at which a cell has half the weight of the nearest, metres. Ours: about the range of the innermost ring.
const NEAR_M: f64 = 4.0;
/// Distance from the vehicle's path at which a cell has half the weight, metres: half of a car's width, so that the
/// strips under the wheels have the most. Measured on 13 frames of one car: with 1 m the roll spreads over 1.1 degrees,
/// with 2 m over 1.5, without this weight over 2.3.
const PATH_M: f64 = 1.0;
/// Greatest distance of a point on a candidate plane, metres: thrice a Velodyne's noise on asphalt.
const CANDIDATE_M: f64 = 0.05;
/// Greatest distance of a point that is used in the refinement, metres. Ours: less than the height of a kerb, and more
/// than a lane's own slope makes over its width.
const REFINED_M: f64 = 0.1;
/// Number of candidate planes. If 40 % of the samples are ground, all candidates fail once in 10^14 estimates.
const CANDIDATES: usize = 500;
/// Number of refinements. After eight the plane moves by a fraction of a millimetre.
const REFINEMENTS: usize = 8;
/// Least number of cells whose lowest point lies on the best candidate. Measured: a VLP-16 on a road gives some 500;
/// indoors, or with half its view blocked, floors and chance give fewer than 60.
pub(super) const INLIERS_MIN: usize = 100;
/// Least number of directions, of 12, in which the ground plane has points. Ours: a floor on one side is not the
/// ground.
const SECTORS_MIN: u32 = 4;
const SECTORS: usize = 12;
/// Tukey's constant, in standard deviations: 95 % efficiency for normally distributed distances.
const TUKEY: f64 = 4.685;
/// Least standard deviation of the distances, metres: a Velodyne's noise on asphalt, averaged over a cell.
const RESIDUAL_M_MIN: f64 = 0.01;
/// Least standard deviation of the estimated height, metres, and of its slopes (0.05 degrees). Ours: tyres and springs
/// move the vehicle by as much.
const HEIGHT_STD_M_MIN: f64 = 0.005;
const SLOPE_STD_MIN: f64 = 0.0009;

/// The plane z = slope · (x, y) - `height_m` / cos, sensor frame, in which `height_m` is the distance from the sensor.
#[derive(Clone, Copy, Debug)]
pub(super) struct PlaneEstimate {
    /// Distance of the sensor from the plane, metres.
    pub height_m: f64,
    /// Slopes along x and y.
    pub slope: [f64; 2],
    /// Standard deviation of the height, metres.
    pub height_std_m: f64,
    /// Standard deviations of the slopes.
    pub slope_std: [f64; 2],
    /// Number of cells whose lowest point lies on the best candidate.
    pub inliers: usize,
    /// Number of cells with points.
    pub samples: usize,
    /// Standard deviation of the distances of the weighted cells from the plane, metres.
    pub residual_m: f64,
}

/// No plane can be the ground.
#[derive(Clone, Copy, Debug)]
pub(super) struct PlaneError {
    pub inliers: usize,
    pub samples: usize,
    pub sectors: u32,
}

/// Finds the plane.
///
/// # Errors
/// [`PlaneError`] if too few cells lie on the best plane, if they lie in too few directions, or if the plane is too
/// high, too low or too steep.
pub(super) fn estimate(points: &[[f32; 3]]) -> Result<PlaneEstimate, PlaneError> {
    let near = near_points(points);
    let lowest = lowest_points(&near);
    let samples = lowest.len();
    let error = |inliers, sectors| PlaneError { inliers, samples, sectors };
    let candidate = best_candidate(&lowest).ok_or(error(0, 0))?;
    let is_on = |p: &&Vector3<f64>| candidate.distance(p).abs() <= CANDIDATE_M;
    let (inliers, sectors) = (lowest.iter().filter(is_on).count(), sectors(lowest.iter().filter(is_on)));
    if inliers < INLIERS_MIN || sectors < SECTORS_MIN {
        return Err(error(inliers, sectors));
    }
    let (mut plane, mut refined) = (candidate, Refined::default());
    for _ in 0..REFINEMENTS {
        // The noise puts the lowest points under the ground, so each fit uses the mean of each cell's points.
        refined = Refined::new(&plane, &near);
        plane = match refined.plane_without(SECTORS) {
            Some(plane) if plane.is_plausible() => plane,
            _ => return Err(error(inliers, sectors)),
        };
    }
    let [height_std_m, x_std, y_std] = refined.jackknife();
    Ok(PlaneEstimate {
        height_m: plane.height_m(),
        slope: [plane.0.x, plane.0.y],
        height_std_m: height_std_m.max(HEIGHT_STD_M_MIN),
        slope_std: [x_std, y_std].map(|std| std.max(SLOPE_STD_MIN)),
        inliers,
        samples,
        residual_m: refined.residual_m,
    })
}

/// The plane z = a x + b y + c, sensor frame, metres.
#[derive(Clone, Copy, Debug)]
struct Plane(Vector3<f64>);

impl Plane {
    /// Height of a point over the plane, along z, metres.
    fn distance(&self, p: &Vector3<f64>) -> f64 {
        p.z - (self.0.x * p.x + self.0.y * p.y + self.0.z)
    }

    /// Distance of the sensor from the plane, metres.
    fn height_m(&self) -> f64 {
        -self.0.z / (1.0 + self.0.x * self.0.x + self.0.y * self.0.y).sqrt()
    }

    fn is_plausible(&self) -> bool {
        // NaN fails both comparisons.
        HEIGHT_M.contains(&self.height_m()) && libm::hypot(self.0.x, self.0.y) <= SLOPE_MAX
    }
}

/// Weighted sums of the cells near a plane, for each direction, and the spread of their distances.
#[derive(Default)]
struct Refined {
    /// Sums of w r rᵀ and w r z with r = (x, y, 1), by direction.
    sums: [(Matrix3<f64>, Vector3<f64>); SECTORS],
    residual_m: f64,
}

impl Refined {
    fn new(plane: &Plane, points: &[[f32; 3]]) -> Self {
        let cells = means_near(plane, points);
        let mut distances: Vec<[f64; 2]> =
            cells.iter().map(|cell| [plane.distance(cell).abs(), path_weight(cell)]).collect();
        distances.sort_by(|a, b| a[0].total_cmp(&b[0]));
        let median = weighted_median(&distances);
        let mut refined = Self { residual_m: (STD_OF_MEDIAN * median).max(RESIDUAL_M_MIN), ..Self::default() };
        for cell in &cells {
            let scaled = plane.distance(cell) / (TUKEY * refined.residual_m);
            let loss = 1.0 - (scaled * scaled).min(1.0);
            let (weight, row) = (loss * loss * path_weight(cell), Vector3::new(cell.x, cell.y, 1.0));
            let (matrix, vector) = &mut refined.sums[sector(cell)];
            *matrix += row * row.transpose() * weight;
            *vector += row * (cell.z * weight);
        }
        refined
    }

    /// The plane of least squares without the cells of one direction; without none if there is no such direction.
    fn plane_without(&self, left_out: usize) -> Option<Plane> {
        let (mut matrix, mut vector) = (Matrix3::zeros(), Vector3::zeros());
        for (_, (m, v)) in self.sums.iter().enumerate().filter(|(sector, _)| *sector != left_out) {
            matrix += m;
            vector += v;
        }
        matrix.cholesky().map(|cholesky| Plane(cholesky.solve(&vector)))
    }

    /// Standard deviations of the height and the two slopes: the jackknife's.
    fn jackknife(&self) -> [f64; 3] {
        let used = (0..SECTORS).filter(|sector| self.sums[*sector].0[(2, 2)] > 0.0);
        let without: Vec<Vector3<f64>> = used.filter_map(|sector| Some(self.plane_without(sector)?.0)).collect();
        let count = without.len() as f64;
        let mean = without.iter().sum::<Vector3<f64>>() / count;
        let squares: Vector3<f64> = without.iter().map(|plane| (plane - mean).map(|v| v * v)).sum();
        let std = squares.map(|sum| (sum * (count - 1.0) / count).max(0.0).sqrt());
        [std.z, std.x, std.y]
    }
}

/// Weight of a cell by its range.
fn near_weight(p: &Vector3<f64>) -> f64 {
    1.0 / (p.x * p.x + p.y * p.y + NEAR_M * NEAR_M)
}

/// Weight of a cell by its range and by its distance from the vehicle's path.
fn path_weight(p: &Vector3<f64>) -> f64 {
    let squared = (p.y / PATH_M) * (p.y / PATH_M);
    near_weight(p) / (1.0 + squared * squared)
}

/// The points around the sensor in which the ground is searched.
fn near_points(points: &[[f32; 3]]) -> Vec<[f32; 3]> {
    let is_near = |[x, y, z]: &[f32; 3]| {
        // NaN fails these comparisons. The bound of z removes stray returns far under the ground.
        let near = x.abs() < RADIUS_M_MAX && y.abs() < RADIUS_M_MAX && z.abs() < RADIUS_M_MAX;
        near && x * x + y * y + z * z >= RANGE_M_MIN * RANGE_M_MIN
    };
    points.iter().copied().filter(is_near).collect()
}

/// Index of the cell of a point.
fn cell([x, y, _]: &[f32; 3]) -> usize {
    let index = |v: f32| (((v + RADIUS_M_MAX) / CELL_M) as usize).min(CELLS_ACROSS - 1);
    index(*x) * CELLS_ACROSS + index(*y)
}

/// The lowest point of every cell of half a metre, in the order of the cells.
fn lowest_points(points: &[[f32; 3]]) -> Vec<Vector3<f64>> {
    let mut lowest: Vec<Option<[f32; 3]>> = vec![None; CELLS_ACROSS * CELLS_ACROSS];
    for point in points {
        let cell_lowest = &mut lowest[cell(point)];
        if cell_lowest.is_none_or(|before| point[2] < before[2]) {
            *cell_lowest = Some(*point);
        }
    }
    lowest.into_iter().flatten().map(|p| Vector3::from(p.map(f64::from))).collect()
}

/// The mean of each cell's points near a plane, in the order of the cells.
fn means_near(plane: &Plane, points: &[[f32; 3]]) -> Vec<Vector3<f64>> {
    let mut sums = vec![(0.0, Vector3::zeros()); CELLS_ACROSS * CELLS_ACROSS];
    for point in points {
        let position = Vector3::from(point.map(f64::from));
        if plane.distance(&position).abs() <= REFINED_M {
            let (count, sum) = &mut sums[cell(point)];
            *count += 1.0;
            *sum += position;
        }
    }
    sums.into_iter().filter(|(count, _)| *count > 0.0).map(|(count, sum)| sum / count).collect()
}

/// The plausible plane through three samples on which the samples of the greatest weight lie.
fn best_candidate(samples: &[Vector3<f64>]) -> Option<Plane> {
    if samples.is_empty() {
        return None;
    }
    let weighted: Vec<(Vector3<f64>, f64)> = samples.iter().map(|p| (*p, near_weight(p))).collect();
    let mut random = RandomIndices(0x2545_f491_4f6c_dd1d);
    let candidates = (0..CANDIDATES).filter_map(|_| {
        let [a, b, c] = [(); 3].map(|()| samples[random.below(samples.len())]);
        let normal = (b - a).cross(&(c - a)).try_normalize(1e-6)?;
        let [slope_x, slope_y] = [-normal.x / normal.z, -normal.y / normal.z];
        let plane = Plane(Vector3::new(slope_x, slope_y, a.z - slope_x * a.x - slope_y * a.y));
        let is_on = |(p, _): &&(Vector3<f64>, f64)| plane.distance(p).abs() <= CANDIDATE_M;
        let weight = || weighted.iter().filter(is_on).map(|(_, weight)| weight).sum::<f64>();
        plane.is_plausible().then(|| (weight(), plane))
    });
    // The first of several equally good candidates.
    candidates
        .fold(None, |best: Option<(f64, Plane)>, next| match best {
            Some(before) if before.0 >= next.0 => Some(before),
            _ => Some(next),
        })
        .map(|(_, plane)| plane)
}

/// Direction of a point: 0 to 11, counter-clockwise.
fn sector(p: &Vector3<f64>) -> usize {
    ((libm::atan2(p.y, p.x) / std::f64::consts::TAU).rem_euclid(1.0) * SECTORS as f64) as usize % SECTORS
}

/// Number of directions in which there are points.
fn sectors<'a>(points: impl Iterator<Item = &'a Vector3<f64>>) -> u32 {
    points.fold(0u32, |seen, p| seen | 1 << sector(p)).count_ones()
}

/// A generator of pseudo-random numbers (xorshift64*) with a fixed seed, so that the estimate is a function of the
/// points.
struct RandomIndices(u64);

impl RandomIndices {
    /// The next number from 0 to n - 1.
    fn below(&mut self, n: usize) -> usize {
        self.0 ^= self.0 >> 12;
        self.0 ^= self.0 << 25;
        self.0 ^= self.0 >> 27;
        ((self.0.wrapping_mul(0x2545_f491_4f6c_dd1d) >> 33) as usize) % n
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_best_candidate_is_the_plane_that_most_points_lie_on() {
        for plane in [[0.0, 0.0, -1.8], [0.2, -0.25, -1.5], [-0.05, 0.3, -2.0]] {
            let expected = Vector3::from(plane);
            let place = |i: usize| ((i % 20) as f64 - 9.7, (i / 20) as f64 - 9.6);
            // A third of the points are on objects over the plane.
            let on_object = |i: usize| if i.is_multiple_of(3) { 0.3 + i as f64 * 0.01 } else { 0.0 };
            let samples: Vec<_> = (0..400)
                .map(|i| (place(i), on_object(i)))
                .map(|((x, y), over_m)| Vector3::new(x, y, plane[0] * x + plane[1] * y + plane[2] + over_m))
                .collect();
            let found = best_candidate(&samples).unwrap();
            assert!((found.0 - expected).amax() < 1e-9, "{plane:?}: {found:?}");
            assert!(samples.iter().enumerate().all(|(i, p)| (found.distance(p) - on_object(i)).abs() < 1e-9));
            let up = Vector3::new(-plane[0], -plane[1], 1.0).normalize();
            assert!((found.height_m() + plane[2] * up.z).abs() < 1e-9, "{plane:?}");
        }
    }
}
