//! The height map, and the bumpiness of each cell.
//!
//! In: the sweep's points, ego frame, metres. Out: one value for each cell, metres. The paper does not define the
//! measure ("methods similar to image processing methods", Lindström 2005, section 2). Ours:
//!
//! - Floor: the floor of a block of 4 × 4 cells is the lowest height in the 3 × 3 blocks around it, unless that height
//!   lies too far below a few others. Mirrored returns lie metres below the ground, in a few adjacent cells, and are
//!   outvoted. Points below the floor are dropped; the rest of such a cell is its highest point.
//! - Obstacle: a cell is an obstacle if its highest point rises by more than a step plus the allowed slope over the
//!   lowest point of the 3 × 3 cells around it, or over the floor. Because of the floor, a roof is an obstacle even if
//!   no ground was seen right beside it.
//! - Bumpiness: the larger of two values: the standard deviation of the heights within the cell, without the part that
//!   the slope of its neighbours explains; half the second difference of the mean heights across the cell.
//!
//! Heights are summed in whole millimetres, so that the order of the points does not matter.

use crate::layer::radial_grid::floor_to_whole;
use crate::sensor::sweep::Sweep;

use super::config::SpeedConfig;

/// Bumpiness of an obstacle.
pub const OBSTACLE_BUMPINESS: f32 = f32::INFINITY;

/// Lowest height of a point that is used, metres. Ours: ±20 m in millimetres fit into 16 bits.
const LOWEST_M: f32 = -20.0;
/// Offset that makes each height positive, plus half a millimetre for rounding, mm.
const OFFSET_MM: f32 = 20_000.5;
/// Number of points that are processed together. Ours: their intermediate values fit into the first-level cache.
const CHUNK: usize = 256;
/// Cell of a point that lies in no cell.
const NOWHERE: u32 = u32::MAX;
/// Number of cells along a side of a block. Ours; not tuned.
const BLOCK: usize = 4;
/// Largest number of outvoted cells in 3 × 3 blocks. Ours: the largest ghosts of the recorded drives cover six cells.
const OUTVOTED_CELLS: usize = 8;
/// Number of seen cells for each outvoted one, if few cells were seen. Ours; not tuned.
const OUTVOTED_SHARE: usize = 8;

/// Sums of one cell's heights, mm.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Cell {
    highest: i16,
    lowest: i16,
    points: u32,
    sum: i64,
    squares: i64,
}

impl Cell {
    #[inline(always)]
    fn add_point(&mut self, millimetres: i16) {
        let wide = i64::from(millimetres);
        self.highest = self.highest.max(millimetres);
        self.lowest = self.lowest.min(millimetres);
        self.points += 1;
        self.sum += wide;
        self.squares += wide * wide;
    }

    #[inline(always)]
    fn add_cell(&mut self, other: &Self) {
        self.highest = self.highest.max(other.highest);
        self.lowest = self.lowest.min(other.lowest);
        self.points += other.points;
        self.sum += other.sum;
        self.squares += other.squares;
    }
}

const EMPTY: Cell = Cell { highest: i16::MIN, lowest: i16::MAX, points: 0, sum: 0, squares: 0 };

/// Heights of a grid of `side` cells along x and y with the vehicle in the middle: index = iy * side + ix.
#[derive(Clone, Debug, PartialEq)]
pub struct HeightMap {
    side: usize,
    cells: Vec<Cell>,
    /// Indices of the cells with a point, in the order in which points fell into them.
    seen: Vec<u32>,
    /// By block: lowest height of each of its cells, mm; that of [`EMPTY`] in cells without a point.
    lowest_of_block: Vec<[i16; BLOCK * BLOCK]>,
    /// By block: the lowest height around it that is not outvoted, mm.
    floors: Vec<i16>,
    /// By cell: mean height, metres; NaN without points.
    means_m: Vec<f32>,
    bumpiness_m: Vec<f32>,
}

impl HeightMap {
    /// An empty map.
    pub fn new(side: usize) -> Self {
        Self {
            side,
            cells: vec![EMPTY; side * side],
            seen: Vec::new(),
            lowest_of_block: Vec::new(),
            floors: Vec::new(),
            means_m: vec![f32::NAN; side * side],
            bumpiness_m: vec![f32::NAN; side * side],
        }
    }

    /// Number of cells along x, and along y.
    pub fn side(&self) -> usize {
        self.side
    }

    /// Bumpiness by cell, metres: NaN if the cell was not seen, [`OBSTACLE_BUMPINESS`] for an obstacle.
    pub fn bumpiness_m(&self) -> &[f32] {
        &self.bumpiness_m
    }

    /// Indices of the known cells: those with a point above the floor.
    pub fn known(&self) -> impl ExactSizeIterator<Item = usize> {
        self.seen.iter().map(|cell| *cell as usize)
    }

    /// Replaces the points by those of a sweep.
    pub fn update(&mut self, sweep: &Sweep, config: &SpeedConfig) {
        for &cell in &self.seen {
            self.cells[cell as usize] = EMPTY;
            self.means_m[cell as usize] = f32::NAN;
            self.bumpiness_m[cell as usize] = f32::NAN;
        }
        self.seen.clear();
        let (mut cells, mut millimetres) = ([NOWHERE; CHUNK], [0; CHUNK]);
        // Neighbouring points of a laser mostly share a cell, so they are summed before the sums are written.
        let (mut index, mut sums) = (NOWHERE, EMPTY);
        let chunks = sweep.x.chunks(CHUNK).zip(sweep.y.chunks(CHUNK)).zip(sweep.z.chunks(CHUNK));
        for ((xs, ys), zs) in chunks {
            self.find_cells([xs, ys, zs], config, &mut cells, &mut millimetres);
            for (&next, &millimetres) in cells.iter().zip(&millimetres).take(xs.len()) {
                if next != index {
                    self.add(index, &sums);
                    (index, sums) = (next, EMPTY);
                }
                sums.add_point(millimetres as i16);
            }
        }
        self.add(index, &sums);
    }

    #[inline(always)]
    fn add(&mut self, index: u32, sums: &Cell) {
        if index != NOWHERE {
            let cell = &mut self.cells[index as usize];
            if cell.points == 0 {
                self.seen.push(index);
            }
            cell.add_cell(sums);
        }
    }

    /// Finds cell and height of each point. It has no branches and reads no tables, so that the compiler vectorises it.
    fn find_cells(
        &self,
        [xs, ys, zs]: [&[f32]; 3],
        config: &SpeedConfig,
        cells: &mut [u32; CHUNK],
        millimetres: &mut [i32; CHUNK],
    ) {
        let (middle, cells_a_m, side) = ((self.side / 2) as f32, 1.0 / config.cell_m, self.side as f32);
        let n = xs.len().min(CHUNK);
        let (xs, ys, zs) = (&xs[..n], &ys[..n], &zs[..n]);
        let (cells, millimetres) = (&mut cells[..n], &mut millimetres[..n]);
        for i in 0..n {
            let (ix, iy, z) = (xs[i] * cells_a_m + middle, ys[i] * cells_a_m + middle, zs[i]);
            // NaN fails every comparison.
            let within = (ix >= 0.0) & (ix < side) & (iy >= 0.0) & (iy < side);
            let inside = within & (z > LOWEST_M) & (z <= config.overhang_m);
            let [ix, iy, z] =
                [ix, iy, z * 1000.0 + OFFSET_MM].map(|value| floor_to_whole(if inside { value } else { 0.0 }));
            cells[i] = if inside { iy * self.side as u32 + ix } else { NOWHERE };
            // The value is positive before the cast, so that the cast rounds.
            millimetres[i] = z as i32 - OFFSET_MM as i32;
        }
    }

    /// Computes the bumpiness of each cell with a point.
    pub fn judge(&mut self, config: &SpeedConfig) {
        let over = |distance_m: f32| ((config.step_m_max + config.grade_max * distance_m) * 1000.0) as i32;
        // The distance is from the centre of a cell or block to the far side of its neighbour.
        let (over_cells, over_floor) = (over(1.5 * config.cell_m), over(1.5 * BLOCK as f32 * config.cell_m));
        self.find_floors(over_floor);
        self.remove_ghosts();
        for &index in &self.seen {
            let cell = &self.cells[index as usize];
            self.means_m[index as usize] = (cell.sum as f64 / f64::from(cell.points) * 1e-3) as f32;
        }
        for &index in &self.seen {
            let (index, cell) = (index as usize, self.cells[index as usize]);
            let (ix, iy) = (index % self.side, index / self.side);
            let near = around(ix, iy, self.side).map(|i| self.cells[i].lowest).min().unwrap_or(cell.lowest);
            let floor = self.floors[self.block(index)];
            let highest = i32::from(cell.highest);
            let obstacle = highest - i32::from(near) > over_cells || highest - i32::from(floor) > over_floor;
            self.bumpiness_m[index] = if obstacle { OBSTACLE_BUMPINESS } else { self.bumpiness(ix, iy) };
        }
    }

    /// Block of a cell.
    fn block(&self, cell: usize) -> usize {
        cell / self.side / BLOCK * self.side.div_ceil(BLOCK) + cell % self.side / BLOCK
    }

    fn find_floors(&mut self, over_floor: i32) {
        let blocks_a_side = self.side.div_ceil(BLOCK);
        let blocks = blocks_a_side * blocks_a_side;
        self.lowest_of_block.clear();
        self.lowest_of_block.resize(blocks, [EMPTY.lowest; BLOCK * BLOCK]);
        for &cell in &self.seen {
            let (block, cell) = (self.block(cell as usize), cell as usize);
            let within = cell / self.side % BLOCK * BLOCK + cell % self.side % BLOCK;
            self.lowest_of_block[block][within] = self.cells[cell].lowest;
        }
        self.floors.clear();
        self.floors.resize(blocks, i16::MIN);
        let is_height = |height: &i16| *height != EMPTY.lowest;
        let is_seen = |block: &usize| self.lowest_of_block[*block].iter().any(is_height);
        let mut heights = Vec::with_capacity(9 * BLOCK * BLOCK);
        for block in (0..blocks).filter(is_seen) {
            heights.clear();
            for near in around(block % blocks_a_side, block / blocks_a_side, blocks_a_side) {
                heights.extend_from_slice(&self.lowest_of_block[near]);
            }
            self.floors[block] = floor(&mut heights, over_floor / 2);
        }
    }

    /// Drops the points below the floor. A cell without other points becomes empty.
    fn remove_ghosts(&mut self) {
        let mut seen = std::mem::take(&mut self.seen);
        seen.retain(|&index| {
            let floor = i32::from(self.floors[self.block(index as usize)]);
            let cell = &mut self.cells[index as usize];
            let is_ghost = |height: i16| i32::from(height) < floor;
            if is_ghost(cell.highest) {
                *cell = EMPTY;
            } else if is_ghost(cell.lowest) {
                let highest = cell.highest;
                let wide = i64::from(highest);
                *cell = Cell { highest, lowest: highest, points: 1, sum: wide, squares: wide * wide };
            }
            cell.points > 0
        });
        self.seen = seen;
    }

    /// Bumpiness of a cell, metres.
    fn bumpiness(&self, ix: usize, iy: usize) -> f32 {
        let index = iy * self.side + ix;
        let here = self.means_m[index];
        let mean =
            |inside: bool, at: isize| if inside { self.means_m[index.wrapping_add_signed(at)] } else { f32::NAN };
        let row = self.side as isize;
        let (back, ahead) = (mean(ix > 0, -1), mean(ix + 1 < self.side, 1));
        let (right, left) = (mean(iy > 0, -row), mean(iy + 1 < self.side, row));
        // Without a neighbour on both sides the difference is NaN; `max` ignores it, and it explains no rise.
        let bend = f32::max(0.0, (back - 2.0 * here + ahead).abs() / 2.0).max((right - 2.0 * here + left).abs() / 2.0);
        let rise_squared = |rise: f32| if rise.is_nan() { 0.0 } else { rise * rise };
        // Each difference is twice the rise across one cell.
        let rises = rise_squared(ahead - back) + rise_squared(left - right);
        // Heights on a plane that rises by h across a cell have the variance h²/12.
        let explained = rises / 4.0 / 12.0;
        let cell = &self.cells[index];
        let points = f64::from(cell.points);
        let mean_mm = cell.sum as f64 / points;
        let variance = ((cell.squares as f64 / points - mean_mm * mean_mm) * 1e-6) as f32;
        bend.max((variance - explained).max(0.0).sqrt())
    }
}

/// Robust minimum: the lowest height within `ghost_mm` below the n-th lowest, where n depends on the number of heights.
/// At least one height must not be that of [`EMPTY`].
fn floor(heights: &mut Vec<i16>, ghost_mm: i32) -> i16 {
    let lowest = heights.iter().copied().min().expect("at least one height");
    let known = heights.iter().filter(|height| **height != EMPTY.lowest).count();
    let outvoted = (known / OUTVOTED_SHARE).min(OUTVOTED_CELLS);
    // In most blocks, more heights lie near the lowest one than could be outvoted.
    let about = (i32::from(lowest) + ghost_mm).min(i32::from(EMPTY.lowest) - 1) as i16;
    if heights.iter().filter(|height| **height <= about).count() > outvoted {
        return lowest;
    }
    heights.retain(|height| *height != EMPTY.lowest);
    let voted = i32::from(*heights.select_nth_unstable(outvoted).1);
    let floor = heights.iter().filter(|height| voted - i32::from(**height) <= ghost_mm).min();
    *floor.expect("the n-th lowest height is within its own distance")
}

/// Indices of the up to 3 × 3 cells or blocks around (ix, iy).
fn around(ix: usize, iy: usize, side: usize) -> impl Iterator<Item = usize> {
    let near = move |i: usize| i.saturating_sub(1)..(i + 2).min(side);
    near(iy).flat_map(move |y| near(ix).map(move |x| y * side + x))
}
