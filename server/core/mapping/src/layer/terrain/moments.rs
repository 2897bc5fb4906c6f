//! Points -> cells, and the sums for a principal component analysis over any region of the division, in O(1).
//!
//! In: a [`Sweep`], ego frame, metres. Out: for each cell with a point its ten moments in whole millimetres, and their
//! running sums in the order of the division. The division cuts a square into four quarters, and each quarter again,
//! down to one cell (Morton order). A region of the division is a range of that order, so its sums are one difference.
//! Only cells with points have an entry ("slot"): a tenth of the cells on real scans.
//!
//! Sums of whole numbers are exact, so that they do not depend on the order of the points.

use crate::sensor::sweep::Sweep;

/// Cell of a point that lies in no cell.
const NOWHERE: u32 = u32::MAX;
/// A value from 2^23 to 2^24, where each f32 is a whole number.
const WHOLE: f32 = 1.5 * 8_388_608.0;
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

/// The cells with points, in the order of the division.
#[derive(Clone, Debug, Default)]
pub struct Cells {
    /// Number of cells from the ego origin to the grid's edge.
    half: i32,
    /// Number of cells from the ego origin to the edge of the division, a power of two.
    root_half: i32,
    cell_m: f32,
    /// Code of each point's cell; after the slots are numbered, its slot.
    cell_of_point: Vec<u32>,
    /// One bit for each cell of the division, by code: set if the cell has a point.
    occupied: Vec<u64>,
    /// Number of occupied cells before each word of `occupied`.
    slots_before: Vec<u32>,
    code_of_slot: Vec<u32>,
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
    pub fn new(range_m_max: f32, cell_m: f32) -> Self {
        let half = half_width(range_m_max, cell_m);
        let root_half = (half as u32).next_power_of_two() as i32;
        Self { half, root_half, cell_m, ..Self::default() }
    }

    /// Assigns the points to cells, and sums them. Points above `overhang_m` or beyond the grid are left out.
    pub fn sort_points(&mut self, sweep: &Sweep, overhang_m: f32) {
        self.find_cells(sweep, overhang_m);
        self.number_slots();
        self.sum(sweep);
    }

    fn find_cells(&mut self, sweep: &Sweep, overhang_m: f32) {
        let (scale, half, root_half) = (1.0 / self.cell_m, self.half as f32, self.root_half);
        self.cell_of_point.resize(sweep.x.len(), NOWHERE);
        for (((code, &x), &y), &z) in self.cell_of_point.iter_mut().zip(&sweep.x).zip(&sweep.y).zip(&sweep.z) {
            let (i, j) = (x * scale, y * scale);
            // NaN fails every comparison.
            let inside = (i >= -half) & (i < half) & (j >= -half) & (j < half) & (z <= overhang_m) & (z > -DEPTH_M_MAX);
            // Far outside the value wraps, and is not used.
            let spread = |value: f32| morton(floor(value).wrapping_add(root_half) as u32);
            let found = spread(i) | spread(j) << 1;
            *code = if inside { found } else { NOWHERE };
        }
    }

    fn number_slots(&mut self) {
        let cells = (4 * self.root_half * self.root_half) as usize;
        self.occupied.clear();
        self.occupied.resize(cells.div_ceil(64), 0);
        for &code in self.cell_of_point.iter().filter(|code| **code != NOWHERE) {
            self.occupied[(code >> 6) as usize] |= 1 << (code & 63);
        }
        self.slots_before.clear();
        self.code_of_slot.clear();
        for (word, &bits) in self.occupied.iter().enumerate() {
            self.slots_before.push(self.code_of_slot.len() as u32);
            let mut left = bits;
            while left != 0 {
                self.code_of_slot.push((word as u32) << 6 | left.trailing_zeros());
                left &= left - 1;
            }
        }
    }

    fn sum(&mut self, sweep: &Sweep) {
        let slots = self.code_of_slot.len();
        self.sums.clear();
        self.sums.resize(slots + 1, Moments::default());
        self.span.clear();
        self.span.resize(slots, [f32::INFINITY, -f32::INFINITY]);
        // Neighbouring points of a laser mostly share a cell, so they are summed before the sums are written.
        let nothing = (Moments::default(), f32::INFINITY, -f32::INFINITY);
        let (mut code, mut slot_of_code, (mut held, mut low, mut high)) = (NOWHERE, NOWHERE, nothing);
        let mut write = |slot: u32, held: &Moments, low: f32, high: f32| {
            if slot != NOWHERE {
                let slot = slot as usize;
                self.sums[slot + 1] = self.sums[slot + 1].plus(held);
                let [lowest, highest] = &mut self.span[slot];
                (*lowest, *highest) = ((*lowest).min(low), (*highest).max(high));
            }
        };
        let points = self.cell_of_point.iter_mut().zip(&sweep.x).zip(&sweep.y).zip(&sweep.z);
        for (((cell, &x), &y), &z) in points {
            if *cell != code {
                write(slot_of_code, &held, low, high);
                (code, (held, low, high)) = (*cell, nothing);
                let inside = code != NOWHERE;
                slot_of_code = if inside { slot(&self.occupied, &self.slots_before, code) as u32 } else { NOWHERE };
            }
            *cell = slot_of_code;
            let [x, y, z] = [x, y, z].map(millimetres);
            held.add([x, y, z]);
            (low, high) = (if z < low { z } else { low }, if z > high { z } else { high });
        }
        write(slot_of_code, &held, low, high);
        let mut running = Moments::default();
        for sums in &mut self.sums {
            running = running.plus(sums);
            *sums = running;
        }
    }

    /// Number of cells along a side of the grid.
    pub fn width(&self) -> usize {
        2 * self.half as usize
    }

    /// Number of cells along a side of the division, a power of two.
    pub fn root_width(&self) -> usize {
        2 * self.root_half as usize
    }

    /// Number of cells between the edges of the grid and of the division, on each side.
    pub fn margin(&self) -> usize {
        (self.root_half - self.half) as usize
    }

    /// Side of a cell, metres.
    pub fn cell_m(&self) -> f32 {
        self.cell_m
    }

    /// Centre of a cell along one axis, ego frame, metres; `index` counts cells of the division.
    pub fn centre_m(&self, index: usize) -> f32 {
        (index as f32 - self.root_half as f32 + 0.5) * self.cell_m
    }

    /// Centre (x, y) of a cell of the grid, ego frame, metres.
    pub fn cell_centre_m(&self, cell: usize) -> [f32; 2] {
        [cell % self.width(), cell / self.width()].map(|index| self.centre_m(index + self.margin()))
    }

    /// Number of slots: of cells with a point.
    pub fn slots(&self) -> usize {
        self.code_of_slot.len()
    }

    /// Number of slots before the cell with this code, occupied or not; the code may be one past the last.
    pub fn slots_before(&self, code: u32) -> usize {
        if (code >> 6) as usize >= self.occupied.len() {
            return self.slots();
        }
        slot(&self.occupied, &self.slots_before, code)
    }

    /// Sums over the slots `from..to`.
    pub fn moments(&self, from: usize, to: usize) -> Moments {
        self.sums[to].minus(&self.sums[from])
    }

    /// Heights of the lowest and highest point of a slot, metres.
    pub fn span_m(&self, slot: usize) -> [f32; 2] {
        self.span[slot].map(|mm| mm * 1e-3)
    }

    /// The slot of the cell with these indices in the division. The cell must have a point.
    pub fn slot_at(&self, x: usize, y: usize) -> usize {
        self.slots_before(morton(x as u32) | morton(y as u32) << 1)
    }

    /// Code of a slot's cell.
    pub fn code(&self, slot: usize) -> u32 {
        self.code_of_slot[slot]
    }

    /// The slot of each point, in the sweep's order; `None` for points that are left out.
    pub fn slot_of_points(&self) -> impl Iterator<Item = Option<usize>> + '_ {
        self.cell_of_point.iter().map(|slot| (*slot != NOWHERE).then_some(*slot as usize))
    }
}

/// Number of occupied cells before the cell with this code.
fn slot(occupied: &[u64], slots_before: &[u32], code: u32) -> usize {
    let word = (code >> 6) as usize;
    let before = occupied[word] & ((1 << (code & 63)) - 1);
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

/// Spreads the lower 16 bits of an index to the even bits.
fn morton(index: u32) -> u32 {
    let mut bits = index & 0xffff;
    bits = (bits | bits << 8) & 0x00ff_00ff;
    bits = (bits | bits << 4) & 0x0f0f_0f0f;
    bits = (bits | bits << 2) & 0x3333_3333;
    (bits | bits << 1) & 0x5555_5555
}

/// Indices (x, y) of a code's cell in the division.
pub fn indices(code: u32) -> (usize, usize) {
    let gather = |code: u32| {
        let mut bits = code & 0x5555_5555;
        bits = (bits | bits >> 1) & 0x3333_3333;
        bits = (bits | bits >> 2) & 0x0f0f_0f0f;
        bits = (bits | bits >> 4) & 0x00ff_00ff;
        ((bits | bits >> 8) & 0xffff) as usize
    };
    (gather(code), gather(code >> 1))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_code_gives_back_its_indices() {
        for (x, y) in [(0, 0), (1, 0), (0, 1), (511, 3), (1023, 1023)] {
            assert_eq!(indices(morton(x) | morton(y) << 1), (x as usize, y as usize));
        }
    }

    #[test]
    fn the_sums_over_a_quarter_are_those_of_its_points() {
        let mut sweep = Sweep::default();
        for k in 0..5000 {
            let (angle, range) = (k as f32 * 0.7, 0.012 * k as f32);
            sweep.x.push(range * angle.cos());
            sweep.y.push(range * angle.sin());
            sweep.z.push(0.1 * angle.sin() - 0.2);
        }
        let mut cells = Cells::new(20.0, 0.25);
        cells.sort_points(&sweep, 2.5);
        assert_eq!((cells.width(), cells.root_width(), cells.margin()), (160, 256, 48));
        for (side, corner) in [(256usize, (0usize, 0usize)), (64, (64, 128)), (8, (120, 136)), (1, (130, 127))] {
            let code = morton(corner.0 as u32) | morton(corner.1 as u32) << 1;
            let (from, to) = (cells.slots_before(code), cells.slots_before(code + (side * side) as u32));
            let mut direct = Moments::default();
            for k in 0..sweep.x.len() {
                let (x, y) = (sweep.x[k], sweep.y[k]);
                let index = |v: f32| (floor(v * 4.0) + 128) as usize;
                let within = |v: f32, first: usize| v.abs() < 20.0 && (first..first + side).contains(&index(v));
                if within(x, corner.0) && within(y, corner.1) {
                    direct.add([x, y, sweep.z[k]].map(millimetres));
                }
            }
            assert_eq!(cells.moments(from, to), direct, "side {side}");
        }
    }
}
