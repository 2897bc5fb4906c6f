//! The plane of the ground near the vehicle.
//!
//! In: the lowest returns of the cells, ego frame. Out: a plane z = ax + by + c, metres, found by least squares over
//! the cells near the vehicle, repeated with ever smaller tolerances. Cells are smaller near the vehicle, so near
//! ground weighs most.

use super::polar::{COLUMNS, PolarCells, ROWS, column_directions, row_start_m};

/// Largest range of the cells, metres. Ours: farther ground need not lie in the plane.
const RANGE_M_MAX: f32 = 12.0;
/// By round: how far a return may lie above and below the plane, metres, and how much more a metre of range allows.
/// Ours: the first round allows a mount that is wrong by 0.3 m and 6 degrees, the last the noise and the crown of a
/// road.
const TOLERANCES: [[f32; 3]; 6] = [
    [0.35, 0.6, 0.10],
    [0.35, 0.6, 0.05],
    [0.30, 0.45, 0.02],
    [0.22, 0.30, 0.01],
    [0.17, 0.20, 0.0],
    [0.14, 0.16, 0.0],
];
/// Greatest depth of the plane of most returns under the wheels, at the ego origin, metres, up to which no plane at the
/// level of the wheels is sought. Ours: the noise of a mount.
const DEPTH_M_MAX: f32 = 0.08;
/// Tolerances of a plane at the level of the wheels, and its greatest distance to that level at the ego origin, metres.
/// Ours: a road on a low dam is narrow, and most returns beside it lie on the fields, which are another plane.
const LEVEL_TOLERANCES: [[f32; 3]; 3] = [[0.15, 0.15, 0.01], [0.14, 0.16, 0.0], [0.14, 0.16, 0.0]];
const LEVEL_M_MAX: f32 = 0.15;
/// Least number of cells that define a plane at the level of the wheels. Ours: three rings of a VLP-16 on a road of
/// 6 m.
const LEVEL_CELLS_MIN: usize = 80;
/// Least number of cells that define the plane. Ours: one ring of a VLP-16 fills as many; the returns of sensors in the
/// bumper, which see objects and no ground so near, fill a hundred.
const CELLS_MIN: usize = 180;
/// Steepest plane. Ours: no vehicle stands on a steeper one.
const SLOPE_MAX: f32 = 0.3;
/// Least number of directions, of 12, in which the cells lie. Ours: ground on one side does not define the plane.
const DIRECTIONS_MIN: u32 = 4;

/// The plane of the ground near the vehicle.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct NearPlane {
    /// Rise over run along x, rise over run along y, height at the ego origin in metres.
    pub abc: [f32; 3],
    /// True if returns define the plane; else it is the plane z = 0 under the configured mount.
    pub is_seen: bool,
}

impl NearPlane {
    /// Height of the plane, metres.
    #[inline(always)]
    pub fn height_m(&self, x: f32, y: f32) -> f32 {
        let [a, b, c] = self.abc;
        a * x + b * y + c
    }

    /// Fits the plane; the plane z = 0 if too few returns lie near one. `near` is a buffer. Where the vehicle would
    /// stand high over the plane of most returns, it stands on narrower ground, if there is such ground at its wheels.
    pub fn fit(cells: &PolarCells, near: &mut Vec<(usize, usize)>) -> Self {
        let rows = (0..ROWS).take_while(|row| row_start_m(*row) < RANGE_M_MAX).count();
        near.clear();
        let all = (0..rows).flat_map(|row| (0..COLUMNS).map(move |column| (row, column)));
        near.extend(all.filter(|(row, column)| cells.is_seen(row * COLUMNS + column)));
        let of_most = Self::fit_from_level(cells, near, &TOLERANCES, CELLS_MIN);
        if of_most.is_some_and(|plane| plane.abc[2] >= -DEPTH_M_MAX) {
            return of_most.unwrap_or_default();
        }
        let at_wheels = Self::fit_from_level(cells, near, &LEVEL_TOLERANCES, LEVEL_CELLS_MIN);
        at_wheels.filter(|plane| plane.abc[2].abs() <= LEVEL_M_MAX).or(of_most).unwrap_or_default()
    }

    /// Fits a plane to the returns near the level of the wheels, then near the plane of the round before.
    fn fit_from_level(
        cells: &PolarCells,
        near: &[(usize, usize)],
        tolerances: &[[f32; 3]],
        cells_min: usize,
    ) -> Option<Self> {
        let directions = column_directions();
        let mut plane = Self::default();
        for [above, below, a_metre] in tolerances {
            let mut sums = Sums::default();
            for &(row, column) in near {
                let [cos, sin] = directions[column];
                let found = cells.lowest(row * COLUMNS + column).find_map(|point| {
                    let (x, y) = (point.range_m * cos, point.range_m * sin);
                    let over = point.z_m - plane.height_m(x, y);
                    let more = a_metre * point.range_m;
                    (over >= -below - more).then_some((over <= above + more).then_some([x, y, point.z_m]))
                });
                if let Some(Some(point)) = found {
                    sums.add(point, column * 12 / COLUMNS);
                }
            }
            let abc @ [a, b, _] = sums.solve(cells_min)?;
            if a * a + b * b > SLOPE_MAX * SLOPE_MAX {
                return None;
            }
            plane = Self { abc, is_seen: true };
        }
        Some(plane)
    }
}

/// Sums of the normal equations.
#[derive(Clone, Default)]
struct Sums {
    cells: usize,
    directions: u32,
    /// Σx, Σy, Σz, Σxx, Σxy, Σyy, Σxz, Σyz.
    of: [f64; 8],
}

impl Sums {
    fn add(&mut self, point: [f32; 3], direction: usize) {
        let [x, y, z] = point.map(f64::from);
        self.cells += 1;
        self.directions |= 1 << direction;
        let terms = [x, y, z, x * x, x * y, y * y, x * z, y * z];
        self.of.iter_mut().zip(terms).for_each(|(sum, term)| *sum += term);
    }

    /// The plane of least squares; `None` if the returns do not define one, or are fewer cells than these.
    fn solve(&self, cells_min: usize) -> Option<[f32; 3]> {
        if self.cells < cells_min || self.directions.count_ones() < DIRECTIONS_MIN {
            return None;
        }
        let n = self.cells as f64;
        let [x, y, z, xx, xy, yy, xz, yz] = self.of.map(|sum| sum / n);
        let (xx, xy, yy, xz, yz) = (xx - x * x, xy - x * y, yy - y * y, xz - x * z, yz - y * z);
        let determinant = xx * yy - xy * xy;
        // A square metre each way: less does not define the slopes.
        if determinant < 1.0 {
            return None;
        }
        let (a, b) = ((yy * xz - xy * yz) / determinant, (xx * yz - xy * xz) / determinant);
        Some([a as f32, b as f32, (z - a * x - b * y) as f32])
    }
}
