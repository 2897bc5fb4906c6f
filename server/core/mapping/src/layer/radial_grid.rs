//! The thesis' r-θ grid (§IV.1): rows are rings of range, columns are azimuth.
//!
//! In: the lasers' elevations, the sensor's height, the number of columns; then points, ego frame, metres. Out: each
//! point's cell, `row * columns + column`. Rows follow the sensor: `r_bench` separates the rings its lasers draw on
//! level ground. The circles are drawn about the ego origin, as in the thesis; the rings lie about the sensor, so the
//! reference point of the ego frame is best chosen under it, or within a metre or two.

use std::f32::consts::{FRAC_PI_2, TAU};
use std::sync::Arc;

use clearway_lidar::calibration::{Calibration, LaserCalibration};

use crate::layer::grid::Geometry;
use crate::sensor::sweep::Sweep;

/// Points are taken in chunks of this many, so that their cells stay in the first cache level.
const CHUNK: usize = 1024;

/// Buckets of the row table: the bits of r² above this one, 256 steps an octave, 0.2 % of r.
const BUCKET_SHIFT: u32 = 15;

/// 2²³: from here on floats are whole numbers, one apart.
const WHOLE_FROM: f32 = 8_388_608.0;

/// Rings nearer to one another than this cannot be told apart under 2 cm of range noise and share a row.
const RING_SPACING_M_MIN: f32 = 0.02;

/// Cells by range and azimuth about the ego origin.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RadialGrid {
    /// Outer radius of each row, ascending; the last is the largest range.
    r_bench_m: Vec<f32>,
    /// The same squared; then, for the row beyond the grid, one that nothing exceeds.
    r_bench_squared: Vec<f32>,
    /// First row that may hold a squared range, by the float's upper bits, from `first_bucket` on; the last bucket lies
    /// beyond the grid.
    row_of_bucket: Vec<u16>,
    first_bucket: u32,
    /// Most borders of rows within one bucket.
    borders_a_bucket: usize,
    quadrants: Quadrants,
    /// What the rows were made from.
    made_from: Option<(Arc<Calibration>, f32)>,
}

impl RadialGrid {
    /// A grid with the rows `r_bench_m` (outer radii, metres, positive, ascending) and `columns`.
    pub fn new(r_bench_m: Vec<f32>, columns: u16) -> Self {
        let mut r_bench_squared: Vec<f32> = r_bench_m.iter().map(|r| r * r).collect();
        let innermost = r_bench_squared.first().copied().unwrap_or(1.0);
        let outermost = r_bench_squared.last().copied().unwrap_or(1.0);
        let first_bucket = innermost.to_bits() >> BUCKET_SHIFT;
        // One more bucket, all of it beyond the outermost bench.
        let buckets = (outermost.to_bits() >> BUCKET_SHIFT) - first_bucket + 2;
        let first_row = |bucket: u32| {
            let least = f32::from_bits((first_bucket + bucket) << BUCKET_SHIFT);
            r_bench_squared.partition_point(|bench| *bench < least)
        };
        let borders_a_bucket = (0..buckets).map(|bucket| first_row(bucket + 1) - first_row(bucket)).max().unwrap_or(0);
        let row_of_bucket = (0..buckets).map(|bucket| first_row(bucket) as u16).collect();
        r_bench_squared.push(f32::INFINITY);
        let quadrants = Quadrants::new(columns);
        Self { r_bench_m, r_bench_squared, row_of_bucket, first_bucket, borders_a_bucket, quadrants, made_from: None }
    }

    /// Sees to it that the rows are those of the sensor that made `sweep`.
    pub fn follow(&mut self, sweep: &Sweep, range_m_max: f32, columns: u16) {
        let Some(calibration) = &sweep.calibration else {
            // Nobody knows its rings: one row to the largest range.
            *self = Self::new(vec![range_m_max], columns);
            return;
        };
        let height = sweep.mount_height_m;
        // The sensor's table is shared by all its revolutions: the pointer is compared first, the table only after.
        if let Some((held, held_height)) = &self.made_from
            && *held_height == height
            && (Arc::ptr_eq(held, calibration) || held == calibration)
        {
            return;
        }
        let rings = ring_radii_m(calibration, height, range_m_max);
        *self = Self::new(r_bench_m(&rings, range_m_max), columns);
        self.made_from = Some((Arc::clone(calibration), height));
    }

    /// Number of rows.
    pub fn rows(&self) -> usize {
        self.r_bench_m.len()
    }

    /// Number of columns.
    pub fn columns(&self) -> usize {
        usize::from(self.quadrants.columns)
    }

    /// Number of cells.
    pub fn cells(&self) -> usize {
        self.rows() * self.columns()
    }

    /// Inner and outer radius of a row, metres.
    pub fn row_span_m(&self, row: usize) -> (f32, f32) {
        let inner = if row == 0 { 0.0 } else { self.r_bench_m[row - 1] };
        (inner, self.r_bench_m[row])
    }

    /// Writes where the cells lie into `geometry`, keeping its buffer.
    pub fn describe(&self, geometry: &mut Geometry) {
        match geometry {
            Geometry::Radial { row_radius_m, columns } => {
                row_radius_m.clone_from(&self.r_bench_m);
                *columns = self.quadrants.columns;
            }
            other => {
                let columns = self.quadrants.columns;
                *other = Geometry::Radial { row_radius_m: self.r_bench_m.clone(), columns };
            }
        }
    }

    /// The cell that holds a position; `None` beyond the last row.
    pub fn cell(&self, x: f32, y: f32) -> Option<usize> {
        let row = self.row(self.reach(x * x + y * y));
        (row < self.rows()).then(|| row * self.columns() + self.quadrants.column(x, y) as usize)
    }

    /// Calls `take(first_point, cells)` for every chunk of the sweep. A point beyond the last row falls into the row
    /// after it: its cell is `self.cells()` or more, and less than `self.cells() + self.columns()`. Where nobody knows
    /// the sweep's rings there are no rows to fall into, and no call.
    pub fn for_each_chunk(&self, sweep: &Sweep, mut take: impl FnMut(usize, &[u32])) {
        if sweep.calibration.is_none() {
            return;
        }
        let mut ranges_squared = [0.0f32; CHUNK];
        let mut cells = [0u32; CHUNK];
        let columns = self.columns() as u32;
        for (index, (x, y)) in sweep.x.chunks(CHUNK).zip(sweep.y.chunks(CHUNK)).enumerate() {
            let n = x.len();
            // Arithmetic alone first, so that it runs four or eight points at a time; the tables after.
            for (((range_squared, cell), &x), &y) in ranges_squared.iter_mut().zip(&mut cells).zip(x).zip(y) {
                *range_squared = self.reach(x * x + y * y);
                *cell = self.quadrants.column(x, y);
            }
            for (cell, range_squared) in cells[..n].iter_mut().zip(&ranges_squared) {
                *cell += self.row(*range_squared) as u32 * columns;
            }
            take(index * CHUNK, &cells[..n]);
        }
    }

    /// The squared range, or where it lies under or over the row table, one that stands for it: the least of the first
    /// bucket, the least of the last. NaN lies over.
    #[inline(always)]
    fn reach(&self, range_squared: f32) -> f32 {
        let least = f32::from_bits(self.first_bucket << BUCKET_SHIFT);
        let beyond = f32::from_bits((self.first_bucket + self.row_of_bucket.len() as u32 - 1) << BUCKET_SHIFT);
        let inside = if range_squared < beyond { range_squared } else { beyond };
        if inside > least { inside } else { least }
    }

    /// First row j with `range <= r_bench[j]`, of a squared range that [`Self::reach`] gave; the number of rows where
    /// there is none.
    #[inline(always)]
    fn row(&self, reach: f32) -> usize {
        let mut row = usize::from(self.row_of_bucket[((reach.to_bits() >> BUCKET_SHIFT) - self.first_bucket) as usize]);
        for _ in 0..self.borders_a_bucket {
            row += usize::from(reach > self.r_bench_squared[row]);
        }
        row
    }
}

/// From position to column, counter-clockwise from the x axis.
///
/// The position is first turned into the first quadrant by whole quarter turns, which is exact; so where a quarter turn
/// is whole columns, a world turned by 90 degrees gives the same columns, a quarter further. Within the quadrant the
/// angle is off by less than 2 µrad, a tenth of a millimetre at 60 m.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Quadrants {
    columns: u16,
    columns_a_rad: f32,
    /// Column that holds each quadrant's beginning, and where in it the quadrant begins, 0 to 1.
    first: [u32; 4],
    offset: [f32; 4],
    /// Columns of a quadrant, less what rounding might carry over its end.
    most: f32,
}

impl Quadrants {
    pub(crate) fn new(columns: u16) -> Self {
        let quarters = [0, 1, 2, 3].map(|quadrant| quadrant * u32::from(columns));
        Self {
            columns,
            columns_a_rad: f32::from(columns) / TAU,
            first: quarters.map(|quarters| quarters / 4),
            offset: quarters.map(|quarters| (quarters % 4) as f32 / 4.0),
            most: f32::from(columns) / 4.0 * (1.0 - 2.0 * f32::EPSILON),
        }
    }

    #[inline(always)]
    pub(crate) fn column(&self, x: f32, y: f32) -> u32 {
        // Quadrants are half-open: [0, 90°) has x > 0, y >= 0, and so on around.
        let second = x <= 0.0 && y > 0.0;
        let third = x < 0.0 && y <= 0.0;
        let fourth = x >= 0.0 && y < 0.0;
        let (mut first, mut offset) = (self.first[0], self.offset[0]);
        (first, offset) = if second { (self.first[1], self.offset[1]) } else { (first, offset) };
        (first, offset) = if third { (self.first[2], self.offset[2]) } else { (first, offset) };
        (first, offset) = if fourth { (self.first[3], self.offset[3]) } else { (first, offset) };
        let (ax, ay) = (x.abs(), y.abs());
        let (along, across) = if second | fourth { (ay, ax) } else { (ax, ay) };
        let within = quarter_angle(across, along) * self.columns_a_rad;
        // NaN fails the comparison too.
        let within = if within < self.most { within } else { self.most };
        first + whole(within + offset)
    }
}

/// The whole number nearest to one from 0 to 2²²: without the checks of a cast, which would take points one at a time.
#[inline(always)]
pub(crate) fn nearest_whole(value: f32) -> u32 {
    (value + WHOLE_FROM).to_bits() - WHOLE_FROM.to_bits()
}

/// The same rounded down.
#[inline(always)]
pub(crate) fn whole(value: f32) -> u32 {
    nearest_whole(value) - u32::from(value + WHOLE_FROM - WHOLE_FROM > value)
}

/// atan2 of two numbers that are not negative, 0 for (0, 0): odd polynomial to degree 11 on [0, 1], mirrored at 45°.
/// Coefficients: minimax by reweighted least squares, error under 1.7e-6.
#[inline(always)]
fn quarter_angle(y: f32, x: f32) -> f32 {
    const ATAN: [f32; 6] = [0.999_977_2, -0.332_622_83, 0.193_540_36, -0.116_426_45, 0.052_647_31, -0.011_719_12];
    let steep = y > x;
    let (small, large) = if steep { (x, y) } else { (y, x) };
    // Keeps 0/0 at 0.
    let t = small / if large > f32::MIN_POSITIVE { large } else { f32::MIN_POSITIVE };
    let s = t * t;
    let p = ATAN.iter().rev().fold(0.0, |p, c| p * s + c) * t;
    if steep { FRAC_PI_2 - p } else { p }
}

/// Radii at which the lasers meet level ground `height_m` under the sensor, metres, ascending: those within
/// `range_m_max`. A laser at elevation e, its origin v above the sensor's along its own normal, meets it at
/// `(height + v cos e) / tan(-e) - v sin e`.
pub fn ring_radii_m(calibration: &Calibration, height_m: f32, range_m_max: f32) -> Vec<f32> {
    let height = f64::from(height_m);
    let radius = |laser: &LaserCalibration| {
        let (sin, cos) = laser.vert_correction.sin_cos();
        let offset = laser.vert_offset_correction;
        let range = (height + offset * cos) / -sin;
        (range * cos - offset * sin) as f32
    };
    let meets_ground = |r: &f32| *r > 0.0 && *r < range_m_max;
    let mut radii: Vec<f32> = calibration.lasers.iter().map(radius).filter(meets_ground).collect();
    radii.sort_by(f32::total_cmp);
    radii.dedup_by(|outer, inner| *outer - *inner < RING_SPACING_M_MIN);
    radii
}

/// `r_bench`: outer radius of each row, metres. A bench lies midway between neighbouring rings, so that noise does not
/// throw a ring over a row border; the last is the largest range.
pub fn r_bench_m(rings_m: &[f32], range_m_max: f32) -> Vec<f32> {
    let midway = rings_m.windows(2).map(|pair| (pair[0] + pair[1]) / 2.0);
    midway.chain([range_m_max]).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The exact column, and how far the position is from a column's border, in columns.
    fn exact(x: f32, y: f32, columns: u16) -> (usize, f64) {
        let turns = f64::from(y).atan2(f64::from(x)) / std::f64::consts::TAU;
        let column = turns.rem_euclid(1.0) * f64::from(columns);
        (column as usize % usize::from(columns), (column - column.round()).abs())
    }

    #[test]
    fn a_position_falls_into_the_column_of_its_azimuth() {
        for columns in [8, 90, 180, 360, 1440] {
            let grid = RadialGrid::new(vec![100.0], columns);
            for step in 0..200_000 {
                let (angle, range) = (f64::from(step) * 3.141_59e-5, 1.0 + f64::from(step % 97) * 0.7);
                let (x, y) = ((range * angle.cos()) as f32, (range * angle.sin()) as f32);
                let (column, from_border) = exact(x, y, columns);
                // A thousandth of a column at 1440 columns is 4 µrad, a quarter of a millimetre at 60 m.
                if from_border > 1e-3 {
                    assert_eq!(grid.cell(x, y), Some(column), "{columns} columns, ({x}, {y})");
                }
            }
        }
    }

    #[test]
    fn the_axes_begin_their_quadrants() {
        let grid = RadialGrid::new(vec![10.0], 360);
        let axes = [([1.0, 0.0], 0), ([0.0, 1.0], 90), ([-1.0, 0.0], 180), ([0.0, -1.0], 270), ([1.0, -1e-7], 359)];
        for ([x, y], column) in axes {
            assert_eq!(grid.cell(x, y), Some(column), "({x}, {y})");
        }
        assert_eq!(grid.cell(0.0, 0.0), Some(0));
        assert_eq!(grid.cell(-0.0, -0.0), Some(0));
    }

    #[test]
    fn a_row_reaches_to_its_bench_and_the_table_agrees_with_the_search() {
        let benches = vec![0.5, 3.0, 3.02, 3.05, 9.0, 60.0];
        let grid = RadialGrid::new(benches.clone(), 8);
        for step in 0..70_000 {
            let range_squared = (step as f32 * 1e-3) * (step as f32 * 1e-3);
            let row = benches.iter().position(|bench| range_squared <= bench * bench);
            assert_eq!(grid.row(grid.reach(range_squared)), row.unwrap_or(6), "{range_squared}");
        }
        assert_eq!(grid.cell(3.0, 0.0), Some(8), "a range equal to the bench is inside");
        for wild in [f32::NAN, f32::INFINITY, f32::MAX, 60.001] {
            assert_eq!(grid.cell(wild, 0.0), None, "{wild}");
            assert_eq!(grid.cell(0.0, -wild), None, "{wild}");
        }
    }
}
