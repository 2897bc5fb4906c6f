//! The r-θ grid (UT Austin thesis, section IV.1): rows are ranges, columns are azimuths.
//!
//! In: the lasers' elevations, the sensor's position, the number of columns; then points, ego frame, metres. Out: the
//! cell of each point, `row * columns + column`. The rows follow from the sensor: their radii (`r_bench` in the thesis)
//! separate the rings that its lasers draw on level ground. The rows are circles about the sensor, as the rings are; in
//! the thesis, the sensor is above the origin.

use std::sync::Arc;

use clearway_lidar::calibration::{Calibration, LaserCalibration};

use crate::azimuth_columns::{AzimuthColumns, floor_to_whole};
use crate::layer::grid::Geometry;
use crate::sensor::sweep::Sweep;

/// Number of points that are processed together. Ours: their cells fit into the first-level cache.
const CHUNK: usize = 1024;

/// Bits of a squared range that do not select a bucket of the row table. Ours: 256 buckets an octave, each 0.2 % of the
/// range wide.
const BUCKET_SHIFT: u32 = 15;

/// Least distance between two rings with a row each, metres. Ours: an HDL-64E's range noise of 2 cm mixes nearer rings.
const RING_SPACING_M_MIN: f32 = 0.02;

/// Depth of a row if fewer than two rings meet the ground, metres. Ours: near ground must
/// not free a cell that reaches far beyond it.
const ROW_DEPTH_M: f32 = 1.0;

/// Least depth of the first ring's row before the ring, metres. Ours: a degree of pitch moves a ring 4 m away by 0.2 m.
const NEAR_EDGE_M_MIN: f32 = 0.25;

/// Greatest depth of a row before the first ring, metres. Ours: an obstacle beside the vehicle must not mark the cells
/// under it.
const NEAR_ROW_DEPTH_M: f32 = 0.5;

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
    /// Near edge of the first ring's row, metres; 0 if the rings are not known.
    near_edge_m: f32,
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
            near_edge_m: 0.0,
            made_from: None,
        }
    }

    /// Computes the rows again if the sensor of `sweep` differs from the last one.
    pub fn update_rows(&mut self, sweep: &Sweep, range_m_max: f32, columns: u16) {
        let Some(calibration) = &sweep.calibration else {
            // The rings are not known: all rows have the same depth.
            let is_same =
                self.made_from.is_none() && self.azimuths.columns == columns && self.centre_m == sweep.mount_m;
            if !is_same || self.row_radius_m.len() < 2 || self.row_radius_m.last() != Some(&range_m_max) {
                *self = Self::new(sweep.mount_m, row_radii_m(&[], range_m_max), columns);
            }
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
        self.near_edge_m = near_edge_m(&rings);
        self.made_from = Some((Arc::clone(calibration), height));
    }

    /// Number of rows.
    pub fn rows(&self) -> usize {
        self.row_radius_m.len()
    }

    /// Number of rows that begin within the blind zone: before a range, metres, or before the first ring.
    pub(super) fn blind_rows(&self, blind_zone_m: f32) -> usize {
        let begins_m = |row: &usize| self.row_span_m(*row).0;
        (0..self.rows()).take_while(|row| begins_m(row) < blind_zone_m || begins_m(row) <= self.near_edge_m).count()
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

    /// Position (x, y) of the centre, ego frame, metres.
    pub(super) fn centre_m(&self) -> [f32; 2] {
        self.centre_m
    }

    /// Cosine and sine of the middle of one of so many columns.
    pub(super) fn direction(column: usize, columns: usize) -> [f32; 2] {
        let (sin, cos) = libm::sincosf((column as f32 + 0.5) / columns as f32 * std::f32::consts::TAU);
        [cos, sin]
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
    /// after it: its cell is `self.cells()` or more, and less than `self.cells() + self.columns()`. `azimuths` are the
    /// azimuths of the points about the ego origin in columns of two degrees, if they are known.
    pub fn for_each_chunk(&self, sweep: &Sweep, azimuths: Option<&[f32]>, mut visit: impl FnMut(usize, &[u32])) {
        let mut ranges_squared = [0.0f32; CHUNK];
        let mut cells = [0u32; CHUNK];
        let columns = self.columns() as u32;
        let ratio = f32::from(self.azimuths.columns) / f32::from(AzimuthColumns::TWO_DEGREES);
        // The product with a power of two is exact, so that the position itself has the same columns.
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

/// Near edge of the first ring's row of a sweep, metres; 0 if the rings are not known.
pub fn near_edge_of(sweep: &Sweep) -> f32 {
    let rings_m = sweep.calibration.as_ref().map(|table| ring_radii_m(table, sweep.mount_height_m, f32::INFINITY));
    rings_m.map_or(0.0, |rings_m| near_edge_m(&rings_m))
}

/// Near edge of the first ring's row, metres: half the distance to the second ring before the first, and at least
/// [`NEAR_EDGE_M_MIN`]. 0 for fewer than two rings.
pub fn near_edge_m(rings_m: &[f32]) -> f32 {
    let [first_m, second_m, ..] = rings_m else { return 0.0 };
    (first_m - NEAR_EDGE_M_MIN.max((second_m - first_m) / 2.0)).max(0.0)
}

/// Outer radius of each row, metres, ascending (`r_bench` of the UT Austin thesis, section IV.1). A radius lies midway
/// between neighbouring rings, so that noise does not move a ring over a row border; the last is the largest range.
/// Before the first ring, where the vehicle itself stands, rows of one depth follow the range. Fewer than two rings
/// separate nothing: then all rows have the same depth.
pub fn row_radii_m(rings_m: &[f32], range_m_max: f32) -> Vec<f32> {
    if rings_m.len() < 2 {
        return equal_rows_m(range_m_max, ROW_DEPTH_M).collect();
    }
    let before = equal_rows_m(near_edge_m(rings_m), NEAR_ROW_DEPTH_M);
    let midway = rings_m.windows(2).map(|pair| (pair[0] + pair[1]) / 2.0);
    before.chain(midway).chain([range_m_max]).collect()
}

/// Outer radii of as few rows of one depth, at most `depth_m`, as reach to a range, metres; none to 0.
fn equal_rows_m(range_m: f32, depth_m: f32) -> impl Iterator<Item = f32> {
    let rows = (range_m / depth_m).ceil() as u16;
    (1..=rows).map(move |row| range_m * f32::from(row) / f32::from(rows))
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
