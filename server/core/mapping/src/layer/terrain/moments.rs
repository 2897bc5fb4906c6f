//! Points -> cells, and the sums for a principal component analysis over any region of the division, in O(1).
//!
//! In: a [`Sweep`], ego frame, metres. Out: for each cell with a point its ten moments in whole millimetres, and their
//! running sums in the order of the [`division`](super::division). A region of the division is a range of that order,
//! so its sums are one difference. Only cells with points have an entry ("slot"): a tenth of the cells on real scans.
//!
//! Sums of whole numbers are exact, so that they do not depend on the order of the points.

use crate::layer::roughness::{NOWHERE, RoughnessSums};
use crate::sensor::deviation::Deviation;
use crate::sensor::sweep::Sweep;
use crate::wide::{WideLoop, run_wide};

use super::division::{Division, Region, cell_of_rank};

/// A value from 2^23 to 2^24, where each f32 is a whole number.
const WHOLE: f32 = 1.5 * 8_388_608.0;
/// Number of points that are processed together. Ours: their intermediate values fit into the first-level cache.
const CHUNK: usize = 1024;
/// Largest depth of a point below the ego origin, metres. Ours: it bounds the sums.
const DEPTH_M_MAX: f32 = 100.0;

/// Sums over the points of a region: number, coordinates in mm, products in mm².
///
/// All are whole numbers. In an `f64` they are exact up to 2^53, the sum of the products of 900,000 points at 100 m,
/// and do not depend on the order of addition.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Moments {
    /// Sums of 1; x, y, z; xx, yy, zz, xy, xz, yz.
    sums: [f64; 10],
}

impl Moments {
    #[inline(always)]
    fn add(&mut self, [x, y, z]: [f32; 3]) {
        let [x, y, z] = [x, y, z].map(f64::from);
        let values = [1.0, x, y, z, x * x, y * y, z * z, x * y, x * z, y * z];
        (0..10).for_each(|i| self.sums[i] += values[i]);
    }

    #[inline(always)]
    fn plus(mut self, other: &Self) -> Self {
        (0..10).for_each(|i| self.sums[i] += other.sums[i]);
        self
    }

    fn minus(mut self, other: &Self) -> Self {
        (0..10).for_each(|i| self.sums[i] -= other.sums[i]);
        self
    }

    /// Number of points.
    pub fn points(&self) -> f64 {
        self.sums[0]
    }

    /// Mean position (x, y, z) of the points, metres. The region must have a point.
    pub fn mean(&self) -> [f64; 3] {
        let [n, x, y, z, ..] = self.sums;
        [x, y, z].map(|sum| sum / n * 1e-3)
    }

    /// Variances xx, yy, zz and covariances xy, xz, yz, m². The region must have a point.
    ///
    /// The rounding error is 1e-12 m² at a distance of 100 m.
    pub fn covariance(&self) -> [f64; 6] {
        let share = 1.0 / self.points();
        let [_, x, y, z, xx, yy, zz, xy, xz, yz] = self.sums.map(|sum| sum * share);
        [xx - x * x, yy - y * y, zz - z * z, xy - x * y, xz - x * z, yz - y * z].map(|mm2| mm2 * 1e-6)
    }

    /// Variance of the height alone, m².
    pub fn variance_z(&self) -> f64 {
        let share = 1.0 / self.points();
        let (z, zz) = (self.sums[3] * share, self.sums[6] * share);
        (zz - z * z) * 1e-6
    }
}

/// Sums over the points of a cell, in two lines of the cache.
#[derive(Clone, Copy, Debug)]
struct CellSums {
    moments: Moments,
    roughness: RoughnessSums,
    /// Heights of the lowest and highest point, mm.
    span: [f32; 2],
}

/// The cells with points, in the order of the division.
#[derive(Clone, Debug, Default)]
pub struct Cells {
    /// Number of cells from the ego origin to the grid's edge.
    half: i32,
    /// Number of cells along a side of the divided square: of the grid, or more.
    side: u32,
    cell_m: f32,
    /// Rank of each cell of the grid in the order of the division.
    rank_of_cell: Vec<u32>,
    /// Index in the grid of the cell of each rank; [`NOWHERE`] for a cell beyond the grid.
    cell_of_rank: Vec<u32>,
    /// Number of each cell of the grid, in the order in which points fell into them; [`NOWHERE`] without points.
    number_of_cell: Vec<u32>,
    /// By number of a cell: the cell.
    numbered: Vec<u32>,
    /// By number of a cell: the sums over its points.
    sums_of_number: Vec<CellSums>,
    /// One bit for each cell of the grid, by rank: set if the cell has a point.
    occupied: Vec<u64>,
    /// Number of occupied cells before each word of `occupied`.
    slots_before: Vec<u32>,
    rank_of_slot: Vec<u32>,
    /// Sums over all slots before; one entry more than slots.
    sums: Vec<Moments>,
    /// Heights of the lowest and highest point of each slot, mm.
    span: Vec<[f32; 2]>,
}

/// Number of cells from the ego origin to the edge of a grid.
pub fn half_width(range_m_max: f32, cell_m: f32) -> i32 {
    // Slightly less, so that 60 / 0.2 gives 300 despite rounding.
    (range_m_max / cell_m - 1e-3).ceil().max(1.0) as i32
}

impl Cells {
    /// A grid that ends `range_m_max` from the ego origin in each direction.
    pub fn new(range_m_max: f32, cell_m: f32, division: Division) -> Self {
        let half = half_width(range_m_max, cell_m);
        let width = 2 * half as u32;
        let side = division.side(width);
        let margin = (side - width) / 2;
        let mut cell_of_rank = cell_of_rank(side);
        let mut rank_of_cell = vec![0; (width * width) as usize];
        for (rank, cell) in (0..).zip(&mut cell_of_rank) {
            let (x, y) = ((*cell % side).wrapping_sub(margin), (*cell / side).wrapping_sub(margin));
            *cell = if x < width && y < width { y * width + x } else { NOWHERE };
            if let Some(of_cell) = rank_of_cell.get_mut(*cell as usize) {
                *of_cell = rank;
            }
        }
        let number_of_cell = vec![NOWHERE; rank_of_cell.len()];
        Self { half, side, cell_m, rank_of_cell, cell_of_rank, number_of_cell, ..Self::default() }
    }

    /// The region with which the division begins.
    pub fn whole(&self) -> Region {
        Region::whole(self.side)
    }

    /// The part of a region that lies in the grid: first column, first row, end of columns, end of rows.
    pub fn extent(&self, region: &Region) -> [u32; 4] {
        let width = 2 * self.half as u32;
        let margin = (self.side - width) / 2;
        let Region { x, y, width: columns, height: rows, .. } = *region;
        [x, y, x + columns, y + rows].map(|index| index.saturating_sub(margin).min(width))
    }

    /// Assigns the points to cells, and sums them. Points that are higher over the ground than `overhang_m`, and points
    /// beyond the grid, are left out. `heights_m` are the heights of the points over the ground, metres; points at the
    /// end without a height are left out too.
    pub fn sort_points(&mut self, sweep: &Sweep, heights_m: &[f32], overhang_m: f32) {
        run_wide(SumCells { cells: self, sweep, heights_m, overhang_m });
        self.number_slots();
        self.sum_slots();
    }

    /// Finds the cell of each point of a chunk. It has no branches, so that the compiler vectorises it.
    #[inline(always)]
    fn find_cells(&self, [xs, ys, heights_m]: [&[f32]; 3], overhang_m: f32, cells: &mut [u32; CHUNK]) {
        let (scale, half) = (1.0 / self.cell_m, self.half as f32);
        let (offset, width) = (self.half, 2 * self.half as u32);
        for (((cell, &x), &y), &height) in cells.iter_mut().zip(xs).zip(ys).zip(heights_m) {
            let (i, j) = (x * scale, y * scale);
            // NaN fails every comparison.
            let inside = (i >= -half)
                & (i < half)
                & (j >= -half)
                & (j < half)
                & (height <= overhang_m)
                & (height > -DEPTH_M_MAX);
            // Far outside the value wraps, and is not used.
            let [i, j] = [i, j].map(|value| floor(value).wrapping_add(offset) as u32);
            let found = j.wrapping_mul(width).wrapping_add(i);
            *cell = if inside { found } else { NOWHERE };
        }
    }

    /// Number of a cell, a new one if no point fell into it before; [`NOWHERE`] for a cell beyond the grid.
    #[inline(always)]
    fn number(&mut self, cell: u32) -> u32 {
        let Some(number) = self.number_of_cell.get_mut(cell as usize) else { return NOWHERE };
        if *number == NOWHERE {
            *number = self.numbered.len() as u32;
            self.numbered.push(cell);
            let (moments, roughness) = (Moments::default(), RoughnessSums::EMPTY);
            self.sums_of_number.push(CellSums { moments, roughness, span: [f32::INFINITY, f32::NEG_INFINITY] });
        }
        *number
    }

    fn number_slots(&mut self) {
        self.occupied.clear();
        self.occupied.resize(self.cell_of_rank.len().div_ceil(64), 0);
        for cell in &self.numbered {
            let rank = self.rank_of_cell[*cell as usize];
            self.occupied[(rank >> 6) as usize] |= 1 << (rank & 63);
        }
        self.slots_before.clear();
        self.rank_of_slot.clear();
        for (word, &bits) in self.occupied.iter().enumerate() {
            self.slots_before.push(self.rank_of_slot.len() as u32);
            let mut left = bits;
            while left != 0 {
                self.rank_of_slot.push((word as u32) << 6 | left.trailing_zeros());
                left &= left - 1;
            }
        }
    }

    /// Adds the cells up in the order of their slots.
    fn sum_slots(&mut self) {
        self.span.clear();
        self.sums.clear();
        let mut running = Moments::default();
        self.sums.push(running);
        for rank in &self.rank_of_slot {
            let number = self.number_of_cell[self.cell_of_rank[*rank as usize] as usize] as usize;
            let CellSums { moments, span, .. } = &self.sums_of_number[number];
            self.span.push(*span);
            running = running.plus(moments);
            self.sums.push(running);
        }
    }

    /// Number of cells along a side of the grid.
    pub fn width(&self) -> usize {
        2 * self.half as usize
    }

    /// Side of a cell, metres.
    pub fn cell_m(&self) -> f32 {
        self.cell_m
    }

    /// Centre of a column or row of cells along its axis, ego frame, metres.
    pub fn centre_m(&self, index: usize) -> f32 {
        (index as f32 - self.half as f32 + 0.5) * self.cell_m
    }

    /// Centre (x, y) of a cell of the grid, ego frame, metres.
    pub fn cell_centre_m(&self, cell: usize) -> [f32; 2] {
        [cell % self.width(), cell / self.width()].map(|index| self.centre_m(index))
    }

    /// Number of slots: of cells with a point.
    pub fn slots(&self) -> usize {
        self.rank_of_slot.len()
    }

    /// Number of slots before the cell of this rank, occupied or not; the rank may be one past the last.
    pub fn slots_before(&self, rank: u32) -> usize {
        if (rank >> 6) as usize >= self.occupied.len() {
            return self.slots();
        }
        slot(&self.occupied, &self.slots_before, rank)
    }

    /// Sums over the slots `from..to`.
    pub fn moments(&self, from: usize, to: usize) -> Moments {
        self.sums[to].minus(&self.sums[from])
    }

    /// Heights of the lowest and highest point of a slot, metres.
    pub fn span_m(&self, slot: usize) -> [f32; 2] {
        self.span[slot].map(|mm| mm * 1e-3)
    }

    /// The slot of a cell of the grid. The cell must have a point.
    pub fn slot_of_cell(&self, cell: usize) -> usize {
        self.slots_before(self.rank_of_cell[cell])
    }

    /// Index of a slot's cell in the grid.
    pub fn cell_of_slot(&self, slot: usize) -> usize {
        self.cell_of_rank[self.rank_of_slot[slot] as usize] as usize
    }

    /// Roughness of a cell of the grid; `None` with fewer deviations than `points_min`. The cell must have a point.
    pub fn roughness(&self, cell: usize, points_min: u16) -> Option<f32> {
        self.sums_of_number[self.number_of_cell[cell] as usize].roughness.roughness(points_min)
    }
}

/// Sums the points of each cell.
struct SumCells<'a> {
    cells: &'a mut Cells,
    sweep: &'a Sweep,
    heights_m: &'a [f32],
    overhang_m: f32,
}

impl WideLoop for SumCells<'_> {
    #[inline(always)]
    fn run(self) {
        let Self { cells: all, sweep, heights_m, overhang_m } = self;
        all.numbered.drain(..).for_each(|cell| all.number_of_cell[cell as usize] = NOWHERE);
        all.sums_of_number.clear();
        let (mut cells, mut points, unknown) = ([NOWHERE; CHUNK], [[0.0; CHUNK]; 3], [Deviation::UNKNOWN; CHUNK]);
        let chunks = sweep.x.chunks(CHUNK).zip(sweep.y.chunks(CHUNK)).zip(sweep.z.chunks(CHUNK));
        // A sweep without deviations has an empty list.
        let mut deviations = sweep.deviation.chunks(CHUNK);
        for (((xs, ys), zs), heights_m) in chunks.zip(heights_m.chunks(CHUNK)) {
            all.find_cells([xs, ys, heights_m], overhang_m, &mut cells);
            for (millimetres_of, metres) in points.iter_mut().zip([xs, ys, zs]) {
                millimetres_of.iter_mut().zip(metres).for_each(|(mm, metres)| *mm = millimetres(*metres));
            }
            let ([xs, ys, zs], deviations) = (&points, deviations.next().unwrap_or(&unknown));
            let positions = xs.iter().zip(ys).zip(zs).take(heights_m.len());
            for ((cell, ((&x, &y), &z)), deviation) in cells.iter().zip(positions).zip(deviations) {
                let number = all.number(*cell);
                if let Some(CellSums { moments, roughness, span: [low, high] }) =
                    all.sums_of_number.get_mut(number as usize)
                {
                    moments.add([x, y, z]);
                    roughness.add(*deviation);
                    (*low, *high) = (if z < *low { z } else { *low }, if z > *high { z } else { *high });
                }
            }
        }
    }
}

/// Number of occupied cells before the cell of this rank.
fn slot(occupied: &[u64], slots_before: &[u32], rank: u32) -> usize {
    let word = (rank >> 6) as usize;
    let before = occupied[word] & ((1 << (rank & 63)) - 1);
    (slots_before[word] + before.count_ones()) as usize
}

/// The nearest whole number of millimetres. It rounds to even, so that a rotated world rounds alike.
#[inline(always)]
fn millimetres(metres: f32) -> f32 {
    (metres * 1e3 + WHOLE) - WHOLE
}

/// The whole number at or below a value within ±2²². A cast has range checks, which would prevent vectorisation.
#[inline(always)]
fn floor(value: f32) -> i32 {
    let nearest = value + WHOLE;
    let whole = (nearest.to_bits() as i32).wrapping_sub(WHOLE.to_bits() as i32);
    whole.wrapping_sub(i32::from(nearest - WHOLE > value))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_sums_over_a_region_are_those_of_its_points() {
        let mut sweep = Sweep::default();
        for k in 0..5000 {
            let (angle, range) = (k as f32 * 0.7, 0.012 * k as f32);
            sweep.x.push(range * libm::cosf(angle));
            sweep.y.push(range * libm::sinf(angle));
            sweep.z.push(0.1 * libm::sinf(angle) - 0.2);
        }
        for (division, side, margin) in [(Division::Halves, 160, 0), (Division::Quarters, 256, 48)] {
            let mut cells = Cells::new(20.0, 0.25, division);
            cells.sort_points(&sweep, &sweep.z, 2.5);
            assert_eq!((cells.width(), cells.whole()), (160, Region::whole(side)));
            let mut region = cells.whole();
            for take_second in
                [false, true, true, false, true, false, true, true, false, false, true, true, false, true]
            {
                let (from, to) = (cells.slots_before(region.rank), cells.slots_before(region.rank + region.cells()));
                let mut direct = Moments::default();
                for k in 0..sweep.x.len() {
                    let (x, y) = (sweep.x[k], sweep.y[k]);
                    let index = |v: f32| (floor(v * 4.0) + 80) as u32 + margin;
                    let within =
                        |v: f32, first: u32, cells: u32| v.abs() < 20.0 && (first..first + cells).contains(&index(v));
                    if within(x, region.x, region.width) && within(y, region.y, region.height) {
                        direct.add([x, y, sweep.z[k]].map(millimetres));
                    }
                }
                assert_eq!(cells.moments(from, to), direct, "{region:?}");
                region = region.halves().unwrap()[usize::from(take_second)];
            }
            for slot in 0..cells.slots() {
                assert_eq!(cells.slot_of_cell(cells.cell_of_slot(slot)), slot);
            }
        }
    }
}
