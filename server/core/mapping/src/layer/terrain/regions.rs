//! Flat regions (Neuhaus 2009, sections 2.2 and 2.3).
//!
//! In: [`Cells`] with their sums. Out: flat regions with a plane each, and for each cell of the grid its flat region,
//! or that it is an obstacle, or that it is not known. The division starts with the whole square. A region whose local
//! height disturbance h is below the threshold is flat; any other region is divided ([`super::division`]), down to one
//! cell, which then is an obstacle.

use super::class::Shape;
use super::config::{FLATNESS_M2_MAX, GRADE_MAX, NOISE_M, RESIDUAL_M_MAX, TerrainConfig, Variant};
use super::division::Region;
use super::eigen::Principal;
use super::moments::{Cells, Moments};

/// Region of a cell that lies in no region with enough points to be judged.
pub const NOT_JUDGED: u32 = 0;
/// Region of a cell that is not flat.
pub const NOT_FLAT: u32 = 1;
/// Region of the cells of flat region 0; the cells of flat region `i` have `FIRST_FLAT + i`.
pub const FIRST_FLAT: u32 = 2;

/// Plane z = a x + b y + c, ego frame, metres.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Plane(pub [f32; 3]);

impl Plane {
    /// Height at a position, metres.
    pub fn height_m(&self, x: f32, y: f32) -> f32 {
        let [a, b, c] = self.0;
        (a * x + b * y) + c
    }

    /// Rise over run in the steepest direction.
    pub fn grade(&self) -> f32 {
        let [a, b, _] = self.0;
        (a * a + b * b).sqrt()
    }

    /// The plane of least squares through the points. The square of `noise_m` is added to the variances of the
    /// positions, so that a piece of one ring, which does not determine the slope across it, has slope 0 there.
    fn fit(moments: &Moments, noise_m: f32) -> Self {
        let noise_m2 = f64::from(noise_m) * f64::from(noise_m);
        let [mut xx, mut yy, _, xy, xz, yz] = moments.covariance();
        (xx, yy) = (xx + noise_m2, yy + noise_m2);
        let determinant = xx * yy - xy * xy;
        let a = (yy * xz - xy * yz) / determinant;
        let b = (xx * yz - xy * xz) / determinant;
        let [x, y, z] = moments.mean();
        Self([a as f32, b as f32, (z - (a * x + b * y)) as f32])
    }
}

/// Flat regions, and the region of each cell.
#[derive(Clone, Debug, Default)]
pub struct Regions {
    planes: Vec<Plane>,
    /// By flat region: first column, first row, end of columns and end of rows in the grid.
    extents: Vec<[u32; 4]>,
    of_cell: Vec<u32>,
    /// By slot: the cell's index in the grid.
    cell_of_slot: Vec<u32>,
    shape_of_cell: Vec<Shape>,
    /// Regions still to be judged.
    waiting: Vec<Region>,
}

impl Regions {
    /// Divides the cells into flat regions and obstacles.
    pub fn divide(&mut self, cells: &Cells, config: &TerrainConfig) {
        let width = cells.width();
        self.planes.clear();
        self.extents.clear();
        self.of_cell.clear();
        self.of_cell.resize(width * width, NOT_JUDGED);
        self.shape_of_cell.clear();
        self.cell_of_slot.clear();
        self.cell_of_slot.extend((0..cells.slots()).map(|slot| cells.cell_of_slot(slot) as u32));
        match config.variant {
            Variant::Grid => self.judge_cells(cells, config),
            Variant::Paper | Variant::Grounded => self.divide_grid(cells, config),
        }
    }

    /// Judges each cell by itself, with its shape (section 2.2).
    fn judge_cells(&mut self, cells: &Cells, config: &TerrainConfig) {
        self.shape_of_cell.resize(self.of_cell.len(), Shape::Unknown);
        for slot in 0..cells.slots() {
            let moments = cells.moments(slot, slot + 1);
            if moments.points() < f64::from(config.points_min) {
                continue;
            }
            let principal = Principal::from_covariance(moments.covariance());
            let cell = self.cell_of_slot[slot] as usize;
            self.shape_of_cell[cell] = shape(principal.values);
            let flat = principal.height_disturbance() < f64::from(FLATNESS_M2_MAX);
            self.of_cell[cell] = if flat { self.add(&moments) } else { NOT_FLAT };
        }
    }

    /// Divides the grid hierarchically (section 2.3).
    fn divide_grid(&mut self, cells: &Cells, config: &TerrainConfig) {
        self.waiting.clear();
        let division = config.variant.division();
        self.waiting.push(cells.whole());
        while let Some(region) = self.waiting.pop() {
            let (from, to) = (cells.slots_before(region.rank), cells.slots_before(region.rank + region.cells()));
            if from == to {
                continue;
            }
            let moments = cells.moments(from, to);
            // With fewer points no part can be judged either.
            if moments.points() < f64::from(config.points_min) {
                continue;
            }
            if division.judges(&region) && is_flat(&moments, f64::from(FLATNESS_M2_MAX)) {
                let plane = Plane::fit(&moments, NOISE_M);
                if config.variant == Variant::Paper || is_ground_like(&plane, cells, from..to) {
                    self.planes.push(plane);
                    self.paint(cells.width(), cells.extent(&region), FIRST_FLAT + self.planes.len() as u32 - 1);
                    continue;
                }
            }
            match region.halves() {
                // The last region pushed is judged first, so that regions are judged in the order of the division.
                Some([first, second]) => self.waiting.extend([second, first]),
                None => self.of_cell[self.cell_of_slot[from] as usize] = NOT_FLAT,
            }
        }
    }

    /// Adds a flat region; returns the value for its cells.
    fn add(&mut self, moments: &Moments) -> u32 {
        self.planes.push(Plane::fit(moments, NOISE_M));
        FIRST_FLAT + self.planes.len() as u32 - 1
    }

    /// Writes a region into its cells.
    fn paint(&mut self, width: usize, extent: [u32; 4], value: u32) {
        self.extents.push(extent);
        let [left, low, right, high] = extent.map(|index| index as usize);
        for row in low..high {
            self.of_cell[row * width + left..row * width + right].fill(value);
        }
    }

    /// By cell of the grid: [`NOT_JUDGED`], [`NOT_FLAT`], or [`FIRST_FLAT`] plus the flat region's index.
    pub fn of_cell(&self) -> &[u32] {
        &self.of_cell
    }

    /// Planes by flat region.
    pub fn planes(&self) -> &[Plane] {
        &self.planes
    }

    /// By flat region: first column, first row, end of columns and end of rows in the grid.
    pub fn extents(&self) -> &[[u32; 4]] {
        &self.extents
    }

    /// By slot: the cell's index in the grid.
    pub fn cell_of_slot(&self) -> &[u32] {
        &self.cell_of_slot
    }

    /// Shape by cell of the grid; empty unless the variant is [`Variant::Grid`].
    pub fn shape_of_cell(&self) -> &[Shape] {
        &self.shape_of_cell
    }
}

/// True if h is below the threshold. Two bounds decide most regions without their eigenvalues.
fn is_flat(moments: &Moments, flatness_m2_max: f64) -> bool {
    // The squared vertical component of the most vertical of three axes is at least a third, so that h is at most three
    // times the variance of z.
    if 3.0 * moments.variance_z() < flatness_m2_max {
        return true;
    }
    let covariance = moments.covariance();
    // Each eigenvalue is above the threshold if the matrix minus the threshold is positive definite.
    let [xx, yy, zz, xy, xz, yz] = covariance;
    let (x, y, z) = (xx - flatness_m2_max, yy - flatness_m2_max, zz - flatness_m2_max);
    let minor = x * y - xy * xy;
    let determinant = ((x * y) * z + 2.0 * (xy * (xz * yz))) - (x * (yz * yz) + y * (xz * xz)) - z * (xy * xy);
    if x > 0.0 && y > 0.0 && minor > 0.0 && determinant > 0.0 {
        return false;
    }
    Principal::from_covariance(covariance).height_disturbance() < flatness_m2_max
}

/// True if no point of a flat region lies off its plane, and the plane is not too steep. Not in the paper.
fn is_ground_like(plane: &Plane, cells: &Cells, slots: std::ops::Range<usize>) -> bool {
    if plane.grade() > GRADE_MAX {
        return false;
    }
    let [a, b, _] = plane.0;
    let allowed = RESIDUAL_M_MAX + (a.abs() + b.abs()) * cells.cell_m() / 2.0;
    slots.into_iter().all(|slot| {
        let [x, y] = cells.cell_centre_m(cells.cell_of_slot(slot));
        let height = plane.height_m(x, y);
        let [lowest, highest] = cells.span_m(slot);
        highest - height <= allowed && height - lowest <= allowed
    })
}

/// Shape by eigenvalues (Neuhaus 2009, figure 1): one value much larger than the two others is a line, one much smaller
/// is a plane.
fn shape([largest, middle, smallest]: [f64; 3]) -> Shape {
    // Ours, because the paper says "significantly higher" and "very low" without a number.
    const MUCH: f64 = 10.0;
    if largest > MUCH * middle {
        Shape::Line
    } else if middle > MUCH * smallest {
        Shape::Plane
    } else {
        Shape::Scatter
    }
}

#[cfg(test)]
mod tests {
    use super::super::division::Division;
    use super::*;
    use crate::sensor::sweep::Sweep;
    use nalgebra::{Rotation3, Vector3};

    #[test]
    fn the_bounds_of_flatness_decide_as_the_eigenvalues_do() {
        const FLATNESS_M2_MAX: f64 = 0.01;
        let mut state = 1_u64;
        let mut random = move || {
            state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
            (state >> 40) as f32 / (1 << 24) as f32 - 0.5
        };
        let mut flat = 0;
        for _ in 0..2000 {
            // An ellipsoid of points with any axes, some of them about as long as the threshold.
            let axes = [0, 1, 2].map(|_| 0.35 * libm::powf(4.0, 2.0 * random()));
            let turn = Rotation3::from_euler_angles(6.0 * random(), 6.0 * random(), 6.0 * random());
            let mut sweep = Sweep::default();
            for _ in 0..30 {
                let point = turn * Vector3::from(axes.map(|axis| axis * random()));
                sweep.x.push(point.x);
                sweep.y.push(point.y);
                sweep.z.push(point.z);
            }
            let mut cells = Cells::new(5.0, 1.0, Division::Halves);
            cells.sort_points(&sweep, &sweep.z, 10.0);
            let moments = cells.moments(0, cells.slots());
            let expected = Principal::from_covariance(moments.covariance()).height_disturbance() < FLATNESS_M2_MAX;
            assert_eq!(is_flat(&moments, FLATNESS_M2_MAX), expected, "{moments:?}");
            flat += u32::from(expected);
        }
        assert!((300..1700).contains(&flat), "{flat} of 2000 are flat: both answers are common");
    }
}
