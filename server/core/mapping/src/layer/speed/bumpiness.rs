//! The height map and what it says of each cell: a step, or how bumpy it is.
//!
//! In: the sweep's points, ego frame, metres. Out: a figure a cell, metres. The paper leaves the measure open ("methods
//! similar to image processing methods"); the reading here:
//!
//! - the floor about a block of 4 × 4 cells is the lowest height in the 3 × 3 blocks, unless it lies further under a
//!   few cells more than the ground may fall there: mirrored returns lie metres under the ground, a few cells of them
//!   side by side, and are outvoted. What lies under the floor is forgotten, and the rest of such a cell is its highest
//!   point;
//! - a cell is an obstacle if its highest point rises by more than a step and what the grade explains over the lowest
//!   point of the 3 × 3 cells around it, or over the floor, so that a roof is not taken for ground because no ground
//!   was seen right beside it;
//! - its bumpiness is the larger of the heights' standard deviation within it, less what the slope of its neighbours
//!   explains, and half the second difference of the heights across it.
//!
//! Heights are summed in whole millimetres, so their order says nothing.

use crate::layer::speed::config::SpeedConfig;
use crate::layer::radial_grid::floor_to_whole;
use crate::sensor::sweep::Sweep;

/// Bumpiness of an obstacle.
pub const OBSTACLE_BUMPINESS: f32 = f32::INFINITY;

/// Points lower than this are no ground a vehicle at 0 gets to; ±20 m keep millimetres in 16 bits.
const LOWEST_M: f32 = -20.0;
/// Makes every height positive, and half a millimetre to round with.
const OFFSET_MM: f32 = 20_000.5;
/// Points are taken in chunks of this many, so that what is worked out of them stays in the first cache level.
const CHUNK: usize = 256;
/// Of a point that lies in no cell.
const NOWHERE: u32 = u32::MAX;
/// Cells a side of a block.
const BLOCK: usize = 4;
/// So many cells of 3 × 3 blocks are outvoted: the largest ghosts of the recorded drives cover six.
const OUTVOTED_CELLS: usize = 8;
/// Where few cells were seen, no more than one of so many.
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
    fn take(&mut self, millimetres: i16) {
        let wide = i64::from(millimetres);
        self.highest = self.highest.max(millimetres);
        self.lowest = self.lowest.min(millimetres);
        self.points += 1;
        self.sum += wide;
        self.squares += wide * wide;
    }

    #[inline(always)]
    fn add(&mut self, other: &Self) {
        self.highest = self.highest.max(other.highest);
        self.lowest = self.lowest.min(other.lowest);
        self.points += other.points;
        self.sum += other.sum;
        self.squares += other.squares;
    }
}

const EMPTY: Cell = Cell { highest: i16::MIN, lowest: i16::MAX, points: 0, sum: 0, squares: 0 };

/// Heights by cell, row by row, `side` cells along x and y; the vehicle stands in the middle.
#[derive(Clone, Debug, PartialEq)]
pub struct HeightMap {
    side: usize,
    cells: Vec<Cell>,
    /// Cells that hold a point, in the order they were first met.
    met: Vec<u32>,
    /// Lowest height of each cell, block by block; [`EMPTY`]'s in cells without a point.
    lowest_of_block: Vec<[i16; BLOCK * BLOCK]>,
    /// By block: the lowest height about it that is not outvoted.
    floors: Vec<i16>,
    /// Mean height of each cell, metres; NaN without points.
    means_m: Vec<f32>,
    bumpiness_m: Vec<f32>,
}

impl HeightMap {
    /// An empty map.
    pub fn new(side: usize) -> Self {
        Self {
            side,
            cells: vec![EMPTY; side * side],
            met: Vec::new(),
            lowest_of_block: Vec::new(),
            floors: Vec::new(),
            means_m: vec![f32::NAN; side * side],
            bumpiness_m: vec![f32::NAN; side * side],
        }
    }

    /// Cells along x, and along y.
    pub fn side(&self) -> usize {
        self.side
    }

    /// By cell: NaN where nothing was seen, [`OBSTACLE_BUMPINESS`] for an obstacle.
    pub fn bumpiness_m(&self) -> &[f32] {
        &self.bumpiness_m
    }

    /// Cells of which something is known: that hold a point, ghosts left out.
    pub fn known(&self) -> impl ExactSizeIterator<Item = usize> {
        self.met.iter().map(|cell| *cell as usize)
    }

    /// Takes the points of a sweep, in place of those before.
    pub fn fill(&mut self, sweep: &Sweep, config: &SpeedConfig) {
        for &cell in &self.met {
            self.cells[cell as usize] = EMPTY;
            self.means_m[cell as usize] = f32::NAN;
            self.bumpiness_m[cell as usize] = f32::NAN;
        }
        self.met.clear();
        let (mut cells, mut millimetres) = ([NOWHERE; CHUNK], [0; CHUNK]);
        // A laser's neighbouring points mostly share a cell: they are summed before they are written.
        let (mut index, mut held) = (NOWHERE, EMPTY);
        let chunks = sweep.x.chunks(CHUNK).zip(sweep.y.chunks(CHUNK)).zip(sweep.z.chunks(CHUNK));
        for ((xs, ys), zs) in chunks {
            self.find_cells([xs, ys, zs], config, &mut cells, &mut millimetres);
            for (&next, &millimetres) in cells.iter().zip(&millimetres).take(xs.len()) {
                if next != index {
                    self.add(index, &held);
                    (index, held) = (next, EMPTY);
                }
                held.take(millimetres as i16);
            }
        }
        self.add(index, &held);
    }

    #[inline(always)]
    fn add(&mut self, index: u32, held: &Cell) {
        if index != NOWHERE {
            let cell = &mut self.cells[index as usize];
            if cell.points == 0 {
                self.met.push(index);
            }
            cell.add(held);
        }
    }

    /// Cell and height of each point. Free of branches and tables, so that it runs four points at a time.
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
            let [ix, iy, z] = [ix, iy, z * 1000.0 + OFFSET_MM].map(|value| floor_to_whole(if inside { value } else { 0.0 }));
            cells[i] = if inside { iy * self.side as u32 + ix } else { NOWHERE };
            // Positive first, so that cutting off rounds.
            millimetres[i] = z as i32 - OFFSET_MM as i32;
        }
    }

    /// Judges every cell that holds a point.
    pub fn judge(&mut self, config: &SpeedConfig) {
        let over = |distance_m: f32| ((config.step_m_max + config.grade_max * distance_m) * 1000.0) as i32;
        // From the middle of a cell or block to the far side of its neighbour.
        let (over_cells, over_floor) = (over(1.5 * config.cell_m), over(1.5 * BLOCK as f32 * config.cell_m));
        self.find_floors(over_floor);
        self.forget_ghosts();
        for &index in &self.met {
            let cell = &self.cells[index as usize];
            self.means_m[index as usize] = (cell.sum as f64 / f64::from(cell.points) * 1e-3) as f32;
        }
        for &index in &self.met {
            let (index, cell) = (index as usize, self.cells[index as usize]);
            let (ix, iy) = (index % self.side, index / self.side);
            let near = around(ix, iy, self.side).map(|i| self.cells[i].lowest).min().unwrap_or(cell.lowest);
            let floor = self.floors[self.block(index)];
            let highest = i32::from(cell.highest);
            let obstacle = highest - i32::from(near) > over_cells || highest - i32::from(floor) > over_floor;
            self.bumpiness_m[index] = if obstacle { OBSTACLE_BUMPINESS } else { self.bumpiness(ix, iy) };
        }
    }

    fn block(&self, cell: usize) -> usize {
        cell / self.side / BLOCK * self.side.div_ceil(BLOCK) + cell % self.side / BLOCK
    }

    fn find_floors(&mut self, over_floor: i32) {
        let blocks_a_side = self.side.div_ceil(BLOCK);
        let blocks = blocks_a_side * blocks_a_side;
        self.lowest_of_block.clear();
        self.lowest_of_block.resize(blocks, [EMPTY.lowest; BLOCK * BLOCK]);
        for &cell in &self.met {
            let (block, cell) = (self.block(cell as usize), cell as usize);
            let place = cell / self.side % BLOCK * BLOCK + cell % self.side % BLOCK;
            self.lowest_of_block[block][place] = self.cells[cell].lowest;
        }
        self.floors.clear();
        self.floors.resize(blocks, i16::MIN);
        let holds = |height: &i16| *height != EMPTY.lowest;
        let is_met = |block: &usize| self.lowest_of_block[*block].iter().any(holds);
        let mut heights = Vec::with_capacity(9 * BLOCK * BLOCK);
        for block in (0..blocks).filter(is_met) {
            heights.clear();
            for near in around(block % blocks_a_side, block / blocks_a_side, blocks_a_side) {
                heights.extend_from_slice(&self.lowest_of_block[near]);
            }
            self.floors[block] = floor(&mut heights, over_floor / 2);
        }
    }

    /// Drops what lies under the floor; a cell of nothing else holds no point.
    fn forget_ghosts(&mut self) {
        let mut met = std::mem::take(&mut self.met);
        met.retain(|&index| {
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
        self.met = met;
    }

    fn bumpiness(&self, ix: usize, iy: usize) -> f32 {
        let index = iy * self.side + ix;
        let here = self.means_m[index];
        let mean =
            |inside: bool, at: isize| if inside { self.means_m[index.wrapping_add_signed(at)] } else { f32::NAN };
        let row = self.side as isize;
        let (back, ahead) = (mean(ix > 0, -1), mean(ix + 1 < self.side, 1));
        let (right, left) = (mean(iy > 0, -row), mean(iy + 1 < self.side, row));
        // What is not known on both sides is NaN, and NaN is neither larger nor explains anything.
        let bend = f32::max(0.0, (back - 2.0 * here + ahead).abs() / 2.0).max((right - 2.0 * here + left).abs() / 2.0);
        let rise_squared = |rise: f32| if rise.is_nan() { 0.0 } else { rise * rise };
        // Twice the rise across one cell.
        let rises = rise_squared(ahead - back) + rise_squared(left - right);
        // A plane that rises by h across a cell has the variance h²/12 in it.
        let explained = rises / 4.0 / 12.0;
        let cell = &self.cells[index];
        let points = f64::from(cell.points);
        let mean_mm = cell.sum as f64 / points;
        let variance = ((cell.squares as f64 / points - mean_mm * mean_mm) * 1e-6) as f32;
        bend.max((variance - explained).max(0.0).sqrt())
    }
}

/// The lowest of the heights that lies no more than `ghost_mm` under what a few of them outvote. One at least is no
/// [`EMPTY`]'s.
fn floor(heights: &mut Vec<i16>, ghost_mm: i32) -> i16 {
    let lowest = heights.iter().copied().min().expect("a height");
    let held = heights.iter().filter(|height| **height != EMPTY.lowest).count();
    let outvoted = (held / OUTVOTED_SHARE).min(OUTVOTED_CELLS);
    // Mostly more of them lie about the lowest than could be outvoted.
    let about = (i32::from(lowest) + ghost_mm).min(i32::from(EMPTY.lowest) - 1) as i16;
    if heights.iter().filter(|height| **height <= about).count() > outvoted {
        return lowest;
    }
    heights.retain(|height| *height != EMPTY.lowest);
    let voted = i32::from(*heights.select_nth_unstable(outvoted).1);
    let floor = heights.iter().filter(|height| voted - i32::from(**height) <= ghost_mm).min();
    *floor.expect("the voted height is none")
}

/// Indices of the 3 × 3 cells or blocks around (ix, iy), as many as there are.
fn around(ix: usize, iy: usize, side: usize) -> impl Iterator<Item = usize> {
    let near = move |i: usize| i.saturating_sub(1)..(i + 2).min(side);
    near(iy).flat_map(move |y| near(ix).map(move |x| y * side + x))
}
