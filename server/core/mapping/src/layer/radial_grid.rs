//! The r-θ grid (UT Austin thesis, section IV.1): rows are ranges, columns are azimuths.
//!
//! In: the lasers' elevations, the sensor's position, the number of columns; then points, ego frame, metres. Out: the
//! cell of each point, `row * columns + column`. The rows follow from the sensor: their radii (`r_bench` in the thesis)
//! separate the rings that its lasers draw on level ground. The rows are circles about the sensor, as the rings are; in
//! the thesis, the sensor is above the origin.

use std::f32::consts::{FRAC_PI_2, TAU};
use std::sync::Arc;

use clearway_lidar::calibration::{Calibration, LaserCalibration};

use crate::layer::grid::Geometry;
use crate::sensor::sweep::Sweep;

/// Number of points that are processed together. Ours: their cells fit into the first-level cache.
const CHUNK: usize = 1024;

/// Bits of a squared range that do not select a bucket of the row table. Ours: 256 buckets an octave, each 0.2 % of the
/// range wide.
const BUCKET_SHIFT: u32 = 15;

/// 2²³: floats from here on are whole numbers, one apart.
const WHOLE_FROM: f32 = 8_388_608.0;

/// Least distance between two rings with a row each, metres. Ours: an HDL-64E's range noise of 2 cm mixes nearer rings.
const RING_SPACING_M_MIN: f32 = 0.02;

/// Depth of a row if fewer than two rings meet the ground, metres. Ours: near ground must
/// not free a cell that reaches far beyond it.
const ROW_DEPTH_M: f32 = 1.0;

/// Grid of range and azimuth about a sensor.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RadialGrid {
    /// Position (x, y) of the sensor, ego frame, metres.
    centre_m: [f32; 2],
    /// Outer radius of each row, metres, ascending; the last is the largest range.
    row_radius_m: Vec<f32>,
    /// The same squared, then infinity for the row beyond the grid.
    row_radius_squared: Vec<f32>,
    /// First row that may contain a squared range, by the upper bits of the float, starting with `first_bucket`. The
    /// last bucket lies beyond the grid.
    row_of_bucket: Vec<u16>,
    first_bucket: u32,
    /// Largest number of row borders within one bucket.
    borders_a_bucket: usize,
    azimuths: AzimuthColumns,
    /// The lasers and the sensor height that the rows were computed from.
    made_from: Option<(Arc<Calibration>, f32)>,
}

impl RadialGrid {
    /// A grid about a position (x, y) of the ego frame, metres, with these rows (outer radii, metres, positive,
    /// ascending) and columns.
    pub fn new(centre_m: [f32; 2], row_radius_m: Vec<f32>, columns: u16) -> Self {
        let mut row_radius_squared: Vec<f32> = row_radius_m.iter().map(|r| r * r).collect();
        let innermost = row_radius_squared.first().copied().unwrap_or(1.0);
        let outermost = row_radius_squared.last().copied().unwrap_or(1.0);
        let first_bucket = innermost.to_bits() >> BUCKET_SHIFT;
        // One more bucket lies beyond the outermost row.
        let buckets = (outermost.to_bits() >> BUCKET_SHIFT) - first_bucket + 2;
        let first_row = |bucket: u32| {
            let least = f32::from_bits((first_bucket + bucket) << BUCKET_SHIFT);
            row_radius_squared.partition_point(|radius| *radius < least)
        };
        let borders_a_bucket = (0..buckets).map(|bucket| first_row(bucket + 1) - first_row(bucket)).max().unwrap_or(0);
        let row_of_bucket = (0..buckets).map(|bucket| first_row(bucket) as u16).collect();
        row_radius_squared.push(f32::INFINITY);
        let azimuths = AzimuthColumns::new(columns);
        Self {
            centre_m,
            row_radius_m,
            row_radius_squared,
            row_of_bucket,
            first_bucket,
            borders_a_bucket,
            azimuths,
            made_from: None,
        }
    }

    /// Computes the rows again if the sensor of `sweep` differs from the last one.
    pub fn update_rows(&mut self, sweep: &Sweep, range_m_max: f32, columns: u16) {
        let Some(calibration) = &sweep.calibration else {
            // The rings are not known, and no cell will be: one row to the largest range.
            *self = Self::new(sweep.mount_m, vec![range_m_max], columns);
            return;
        };
        let height = sweep.mount_height_m;
        // All revolutions of a sensor share its table, so that comparing the pointers mostly suffices.
        if let Some((known, known_height)) = &self.made_from
            && *known_height == height
            && self.centre_m == sweep.mount_m
            && (Arc::ptr_eq(known, calibration) || known == calibration)
        {
            return;
        }
        let rings = ring_radii_m(calibration, height, range_m_max);
        *self = Self::new(sweep.mount_m, row_radii_m(&rings, range_m_max), columns);
        self.made_from = Some((Arc::clone(calibration), height));
    }

    /// Number of rows.
    pub fn rows(&self) -> usize {
        self.row_radius_m.len()
    }

    /// Number of columns.
    pub fn columns(&self) -> usize {
        usize::from(self.azimuths.columns)
    }

    /// Number of cells.
    pub fn cells(&self) -> usize {
        self.rows() * self.columns()
    }

    /// True if the centre is the ego origin.
    fn is_about_origin(&self) -> bool {
        self.centre_m == [0.0; 2]
    }

    /// Inner and outer radius of a row, metres.
    pub fn row_span_m(&self, row: usize) -> (f32, f32) {
        let inner = if row == 0 { 0.0 } else { self.row_radius_m[row - 1] };
        (inner, self.row_radius_m[row])
    }

    /// Writes the centre, rows and columns into `geometry`, reusing its memory.
    pub fn write_geometry(&self, geometry: &mut Geometry) {
        if !matches!(geometry, Geometry::Radial { .. }) {
            *geometry = Geometry::radial(self.azimuths.columns);
        }
        if let Geometry::Radial { centre_m, row_radius_m, columns } = geometry {
            (*centre_m, *columns) = (self.centre_m, self.azimuths.columns);
            row_radius_m.clone_from(&self.row_radius_m);
        }
    }

    /// The cell that contains a position; `None` beyond the last row.
    pub fn cell(&self, x: f32, y: f32) -> Option<usize> {
        let [x, y] = [x - self.centre_m[0], y - self.centre_m[1]];
        let row = self.row(self.clamped(x * x + y * y));
        (row < self.rows()).then(|| row * self.columns() + self.azimuths.column(x, y) as usize)
    }

    /// Calls `visit(first_point, cells)` for each chunk of the sweep. A point beyond the last row falls into the row
    /// after it: its cell is `self.cells()` or more, and less than `self.cells() + self.columns()`. If the sweep's
    /// rings are not known, there is no call. `azimuths` are those of the points about the ego origin in columns of two
    /// degrees, if they are known.
    pub fn for_each_chunk(&self, sweep: &Sweep, azimuths: Option<&[f32]>, mut visit: impl FnMut(usize, &[u32])) {
        if sweep.calibration.is_none() {
            return;
        }
        let mut ranges_squared = [0.0f32; CHUNK];
        let mut cells = [0u32; CHUNK];
        let columns = self.columns() as u32;
        let ratio = f32::from(self.azimuths.columns) / f32::from(AzimuthColumns::TWO_DEGREES);
        // The product with a power of two is exact, so that the columns are those of the position itself.
        let azimuths = azimuths.filter(|_| ratio.to_bits() & 0x007f_ffff == 0 && self.is_about_origin());
        let [centre_x, centre_y] = self.centre_m;
        for (index, (x, y)) in sweep.x.chunks(CHUNK).zip(sweep.y.chunks(CHUNK)).enumerate() {
            let n = x.len();
            // The first loops are arithmetic alone, so that the compiler vectorises them; the last reads the tables.
            for ((range_squared, &x), &y) in ranges_squared.iter_mut().zip(x).zip(y) {
                let (x, y) = (x - centre_x, y - centre_y);
                *range_squared = self.clamped(x * x + y * y);
            }
            match azimuths {
                Some(azimuths) => {
                    for (cell, azimuth) in cells.iter_mut().zip(&azimuths[index * CHUNK..][..n]) {
                        *cell = floor_to_whole(azimuth * ratio);
                    }
                }
                None => {
                    for ((cell, &x), &y) in cells.iter_mut().zip(x).zip(y) {
                        *cell = self.azimuths.column(x - centre_x, y - centre_y);
                    }
                }
            }
            for (cell, range_squared) in cells[..n].iter_mut().zip(&ranges_squared) {
                *cell += self.row(*range_squared) as u32 * columns;
            }
            visit(index * CHUNK, &cells[..n]);
        }
    }

    /// The squared range, clamped to the row table: at least the start of the first bucket, at most the start of the
    /// last. NaN becomes the latter.
    #[inline(always)]
    fn clamped(&self, range_squared: f32) -> f32 {
        let least = f32::from_bits(self.first_bucket << BUCKET_SHIFT);
        let beyond = f32::from_bits((self.first_bucket + self.row_of_bucket.len() as u32 - 1) << BUCKET_SHIFT);
        let inside = if range_squared < beyond { range_squared } else { beyond };
        if inside > least { inside } else { least }
    }

    /// First row whose outer radius is at least the range, from a squared range that [`Self::clamped`] returned; the
    /// number of rows if there is none.
    #[inline(always)]
    fn row(&self, range_squared: f32) -> usize {
        let mut row =
            usize::from(self.row_of_bucket[((range_squared.to_bits() >> BUCKET_SHIFT) - self.first_bucket) as usize]);
        for _ in 0..self.borders_a_bucket {
            row += usize::from(range_squared > self.row_radius_squared[row]);
        }
        row
    }
}

/// Columns of equal azimuth: position -> column, counter-clockwise from the x axis.
///
/// The position is first rotated into the first quadrant by a multiple of 90 degrees, which is exact. So if 90 degrees
/// are a whole number of columns, a world rotated by 90 degrees gives the same columns, shifted by a quarter. Within
/// the quadrant the error of the angle is less than 2 µrad, a tenth of a millimetre at 60 m.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct AzimuthColumns {
    columns: u16,
    columns_a_rad: f32,
    /// Column in which each quadrant begins.
    first: [u32; 4],
    /// Position of the beginning of each quadrant in that column, 0 to 1.
    offset: [f32; 4],
    /// Largest position within a quadrant, in columns: slightly less than its width, so that rounding does not reach
    /// the next quadrant.
    most: f32,
}

impl AzimuthColumns {
    /// Number of columns of two degrees, in which the local ground is estimated.
    pub(crate) const TWO_DEGREES: u16 = 180;

    /// This many columns in a full circle.
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

    /// The column that contains a position; 0 for the origin.
    #[inline(always)]
    pub(crate) fn column(&self, x: f32, y: f32) -> u32 {
        let (first, within) = self.quadrant(x, y);
        first + floor_to_whole(within)
    }

    /// The azimuth of a position in columns, with a fraction; 0 for the origin. It is less than the number of columns.
    #[inline(always)]
    pub(crate) fn position(&self, x: f32, y: f32) -> f32 {
        let (first, within) = self.quadrant(x, y);
        // The cast of a signed number is one instruction.
        first as i32 as f32 + within
    }

    /// The column in which a position's quadrant begins, and the columns from there to the position.
    #[inline(always)]
    fn quadrant(&self, x: f32, y: f32) -> (u32, f32) {
        // AzimuthColumns are half-open: [0, 90°) has x > 0, y >= 0, and so on around.
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
        // NaN fails the comparison.
        let within = if within < self.most { within } else { self.most };
        (first, within + offset)
    }
}

/// The whole number nearest to a value from 0 to 2²². A cast has range checks, which would prevent vectorisation.
#[inline(always)]
pub(crate) fn round_to_whole(value: f32) -> u32 {
    (value + WHOLE_FROM).to_bits() - WHOLE_FROM.to_bits()
}

/// The whole number at or below a value from 0 to 2²².
#[inline(always)]
pub(crate) fn floor_to_whole(value: f32) -> u32 {
    round_to_whole(value) - u32::from(value + WHOLE_FROM - WHOLE_FROM > value)
}

/// atan2 of two numbers that are not negative, 0 for (0, 0): an odd polynomial of degree 11 on [0, 1], mirrored at 45°.
/// Ours: minimax coefficients by reweighted least squares, error below 1.7e-6.
#[inline(always)]
fn quarter_angle(y: f32, x: f32) -> f32 {
    const ATAN: [f32; 6] = [0.999_977_2, -0.332_622_83, 0.193_540_36, -0.116_426_45, 0.052_647_31, -0.011_719_12];
    let steep = y > x;
    let (small, large) = if steep { (x, y) } else { (y, x) };
    // The lower bound makes 0/0 0.
    let t = small / if large > f32::MIN_POSITIVE { large } else { f32::MIN_POSITIVE };
    let s = t * t;
    let p = ATAN.iter().rev().fold(0.0, |p, c| p * s + c) * t;
    if steep { FRAC_PI_2 - p } else { p }
}

/// Radii at which the lasers meet level ground `height_m` below the sensor, metres, ascending; only those below
/// `range_m_max`. A laser at elevation e, whose origin lies v above the sensor's along the laser's normal, meets the
/// ground at `(height + v cos e) / tan(-e) - v sin e`.
pub fn ring_radii_m(calibration: &Calibration, height_m: f32, range_m_max: f32) -> Vec<f32> {
    let height = f64::from(height_m);
    let radius = |laser: &LaserCalibration| {
        let (sin, cos) = libm::sincos(laser.vert_correction);
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

/// Outer radius of each row, metres, ascending (`r_bench` of the UT Austin thesis, section IV.1). A radius lies midway
/// between neighbouring rings, so that noise does not move a ring over a row border; the last is the largest range.
/// Fewer than two rings separate nothing: then all rows have the same depth.
pub fn row_radii_m(rings_m: &[f32], range_m_max: f32) -> Vec<f32> {
    if rings_m.len() < 2 {
        let rows = (range_m_max / ROW_DEPTH_M).ceil().max(1.0) as u16;
        return (1..=rows).map(|row| range_m_max * f32::from(row) / f32::from(rows)).collect();
    }
    let midway = rings_m.windows(2).map(|pair| (pair[0] + pair[1]) / 2.0);
    midway.chain([range_m_max]).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_ray_of_each_ring_ends_on_the_ground_wherever_its_laser_is_mounted() {
        for offset_m in [-0.2, 0.0, 0.3] {
            let mut calibration = Calibration::factory(clearway_lidar::Model::Hdl64eS2);
            calibration.lasers.truncate(1);
            calibration.lasers[0].vert_offset_correction = offset_m;
            for elevation in [-0.4_f64, -0.2, -0.05] {
                calibration.lasers[0].vert_correction = elevation;
                let [radius_m] = ring_radii_m(&calibration, 1.8, 60.0)[..] else { panic!("{offset_m} {elevation}") };
                // The ray begins at the offset along the normal (-sin, cos), and runs along (cos, sin).
                let (sin, cos) = libm::sincos(elevation);
                let range_m = (f64::from(radius_m) + offset_m * sin) / cos;
                let height_m = range_m * sin + offset_m * cos;
                assert!((height_m + 1.8).abs() < 1e-5, "{offset_m} {elevation}: {height_m}");
            }
        }
    }

    /// The exact column, and the distance from the position to the nearest column border, in columns.
    fn exact(x: f32, y: f32, columns: u16) -> (usize, f64) {
        let turns = libm::atan2(f64::from(y), f64::from(x)) / std::f64::consts::TAU;
        let column = turns.rem_euclid(1.0) * f64::from(columns);
        (column as usize % usize::from(columns), (column - column.round()).abs())
    }

    #[test]
    fn a_position_falls_into_the_column_of_its_azimuth() {
        for columns in [8, 90, 180, 360, 1440] {
            let grid = RadialGrid::new([0.0; 2], vec![100.0], columns);
            for step in 0..200_000 {
                let (angle, range) = (f64::from(step) * 3.141_59e-5, 1.0 + f64::from(step % 97) * 0.7);
                let (x, y) = ((range * libm::cos(angle)) as f32, (range * libm::sin(angle)) as f32);
                let (column, from_border) = exact(x, y, columns);
                // A thousandth of a column at 1440 columns is 4 µrad, a quarter of a millimetre at 60 m.
                if from_border > 1e-3 {
                    assert_eq!(grid.cell(x, y), Some(column), "{columns} columns, ({x}, {y})");
                }
            }
        }
    }

    #[test]
    fn each_axis_lies_in_the_first_column_of_its_quadrant() {
        let grid = RadialGrid::new([0.0; 2], vec![10.0], 360);
        let axes = [([1.0, 0.0], 0), ([0.0, 1.0], 90), ([-1.0, 0.0], 180), ([0.0, -1.0], 270), ([1.0, -1e-7], 359)];
        for ([x, y], column) in axes {
            assert_eq!(grid.cell(x, y), Some(column), "({x}, {y})");
        }
        assert_eq!(grid.cell(0.0, 0.0), Some(0));
        assert_eq!(grid.cell(-0.0, -0.0), Some(0));
    }

    #[test]
    fn a_row_ends_at_its_radius_and_the_table_agrees_with_a_search() {
        let radii = vec![0.5, 3.0, 3.02, 3.05, 9.0, 60.0];
        let grid = RadialGrid::new([0.0; 2], radii.clone(), 8);
        for step in 0..70_000 {
            let range_squared = (step as f32 * 1e-3) * (step as f32 * 1e-3);
            let row = radii.iter().position(|radius| range_squared <= radius * radius);
            assert_eq!(grid.row(grid.clamped(range_squared)), row.unwrap_or(6), "{range_squared}");
        }
        assert_eq!(grid.cell(3.0, 0.0), Some(8), "a range equal to the radius is inside");
        for wild in [f32::NAN, f32::INFINITY, f32::MAX, 60.001] {
            assert_eq!(grid.cell(wild, 0.0), None, "{wild}");
            assert_eq!(grid.cell(0.0, -wild), None, "{wild}");
        }
    }
}
