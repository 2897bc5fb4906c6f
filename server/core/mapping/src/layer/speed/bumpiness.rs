//! The height map, and the bumpiness of each cell.
//!
//! In: the sweep's points and their heights over the ground, metres. Out: one value for each cell, metres. The paper
//! does not define the measure ("methods similar to image processing methods", Lindström 2005, section 2). Ours:
//!
//! - Obstacle: a cell is an obstacle if its highest point rises by more than a step over the ground, or by more than a
//!   step plus the allowed slope over the lowest point of the 3 × 3 cells around it.
//! - Bumpiness: the larger of two values: the standard deviation of the heights within the cell, without the part that
//!   the slope of its neighbours explains; half the second difference of the mean heights across the cell.
//!
//! Heights are summed in whole millimetres, so that the order of the points does not matter. Points far below the
//! ground are mirror images and are left out.

use crate::azimuth_columns::floor_to_whole;
use crate::layer::maker::Context;
use crate::layer::roughness::{NOWHERE, RoughnessSums};
use crate::sensor::deviation::Deviation;
use crate::sensor::sweep::Sweep;
use crate::wide::{WideLoop, run_wide};

use super::config::{GRADE_MAX, STEP_M_MAX, SpeedConfig};

/// Bumpiness of an obstacle.
pub const OBSTACLE_BUMPINESS: f32 = f32::INFINITY;

/// Lowest height over the local ground of a point that is used, metres. Ours: no ditch within a cell is as deep.
const LOWEST_M: f32 = -0.5;
/// The same over the plane under the vehicle.
const LOWEST_OVER_PLANE_M: f32 = -20.0;
/// Greatest height of a point over or under the ego frame, metres. Ours: ±20 m in millimetres fit into 16 bits.
const HEIGHT_M_MAX: f32 = 20.0;
/// Offset that makes each height positive, plus half a millimetre for rounding, mm.
const OFFSET_MM: f32 = 20_000.5;
/// Number of points that are processed together. Ours: their intermediate values fit into the first-level cache.
const CHUNK: usize = 256;
/// Height of a point that lies too low for a height map, mm.
const NOT_USED: i32 = i32::MIN;
/// Sums of one cell's heights, mm.
#[derive(Clone, Copy, Debug, PartialEq)]
struct BumpinessCell {
    highest: i16,
    lowest: i16,
    /// Largest height over the ground.
    highest_over_ground: i16,
    points: u32,
    sum: i64,
    squares: i64,
    /// Also of the points that lie too low for a height map.
    roughness: RoughnessSums,
}

impl BumpinessCell {
    #[inline(always)]
    fn add_point(&mut self, [millimetres, over_ground]: [i16; 2]) {
        let wide = i64::from(millimetres);
        self.highest = self.highest.max(millimetres);
        self.lowest = self.lowest.min(millimetres);
        self.highest_over_ground = self.highest_over_ground.max(over_ground);
        self.points += 1;
        self.sum += wide;
        self.squares += wide * wide;
    }
}

const EMPTY: BumpinessCell = BumpinessCell {
    highest: i16::MIN,
    lowest: i16::MAX,
    highest_over_ground: i16::MIN,
    points: 0,
    sum: 0,
    squares: 0,
    roughness: RoughnessSums::EMPTY,
};

/// Heights of a grid of `side` cells along x and y with the vehicle in the middle: index = iy * side + ix.
#[derive(Clone, Debug, PartialEq)]
pub struct HeightMap {
    side: usize,
    cell_m: f32,
    cells: Vec<BumpinessCell>,
    /// Indices of the cells with a point, in the order in which points fell into them; of those with a roughness alone.
    seen: Vec<u32>,
    only_rough: Vec<u32>,
    /// By cell: mean height, metres; NaN without points.
    means_m: Vec<f32>,
    bumpiness_m: Vec<f32>,
}

impl HeightMap {
    /// An empty map with cells of this size.
    pub fn new(side: usize, cell_m: f32) -> Self {
        Self {
            side,
            cell_m,
            cells: vec![EMPTY; side * side],
            seen: Vec::new(),
            only_rough: Vec::new(),
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

    /// Indices of the cells with a point.
    pub fn known(&self) -> impl ExactSizeIterator<Item = usize> {
        self.seen.iter().map(|cell| *cell as usize)
    }

    /// The deviations in a cell with a point.
    pub fn roughness(&self, cell: usize) -> &RoughnessSums {
        &self.cells[cell].roughness
    }

    /// Replaces the points by the points of a sweep.
    pub fn update(&mut self, sweep: &Sweep, context: &Context<'_>, config: &SpeedConfig) {
        self.only_rough.drain(..).for_each(|cell| self.cells[cell as usize] = EMPTY);
        for &cell in &self.seen {
            self.cells[cell as usize] = EMPTY;
            self.means_m[cell as usize] = f32::NAN;
            self.bumpiness_m[cell as usize] = f32::NAN;
        }
        self.seen.clear();
        let (mut cells, mut millimetres, mut over_ground) = ([NOWHERE; CHUNK], [0; CHUNK], [0; CHUNK]);
        let unknown = [Deviation::UNKNOWN; CHUNK];
        let lowest_m = if context.ground.is_some() { LOWEST_M } else { LOWEST_OVER_PLANE_M };
        // A sweep without deviations has an empty list.
        let mut deviations = sweep.deviation.chunks(CHUNK);
        let heights_m = context.heights_m(sweep).chunks(CHUNK);
        let chunks = sweep.x.chunks(CHUNK).zip(sweep.y.chunks(CHUNK)).zip(sweep.z.chunks(CHUNK));
        for (((xs, ys), zs), heights) in chunks.zip(heights_m) {
            run_wide(FindCells {
                map: self,
                points: [xs, ys, zs, heights],
                used_m: [lowest_m, config.overhang_m],
                cells: &mut cells,
                heights_mm: [&mut millimetres, &mut over_ground],
            });
            let heights = millimetres.iter().zip(&over_ground).take(xs.len());
            let points = cells.iter().zip(deviations.next().unwrap_or(&unknown)).zip(heights);
            for ((&index, &deviation), (&millimetres, &over_ground)) in points {
                let Some(cell) = self.cells.get_mut(index as usize) else { continue };
                if over_ground != NOT_USED {
                    if cell.points == 0 {
                        self.seen.push(index);
                    }
                    cell.add_point([millimetres as i16, over_ground as i16]);
                } else if cell.points == 0 {
                    self.only_rough.push(index);
                }
                cell.roughness.add(deviation);
            }
        }
    }

    /// Computes the bumpiness of each cell with a point.
    pub fn judge(&mut self, context: &Context<'_>, config: &SpeedConfig) {
        let over = |distance_m: f32| ((STEP_M_MAX + GRADE_MAX * distance_m) * 1000.0) as i32;
        // The distance is from the centre of a cell to the far side of its neighbour.
        let (over_cells, over_ground) = (over(1.5 * config.cell_m), over(0.0));
        for &index in &self.seen {
            let cell = &self.cells[index as usize];
            self.means_m[index as usize] = (cell.sum as f64 / f64::from(cell.points) * 1e-3) as f32;
        }
        for &index in &self.seen {
            let (index, cell) = (index as usize, self.cells[index as usize]);
            let (ix, iy) = (index % self.side, index / self.side);
            let near = around(ix, iy, self.side).map(|i| self.cells[i].lowest).min().unwrap_or(cell.lowest);
            let highest = i32::from(cell.highest);
            let over_ground = context.ground.is_some() && i32::from(cell.highest_over_ground) > over_ground;
            let is_obstacle = over_ground || highest - i32::from(near) > over_cells;
            self.bumpiness_m[index] = if is_obstacle { OBSTACLE_BUMPINESS } else { self.bumpiness(ix, iy) };
        }
    }

    /// Centre of a cell, ego frame, metres.
    pub fn centre_m(&self, cell: usize) -> [f32; 2] {
        [cell % self.side, cell / self.side].map(|i| (i as f32 + 0.5 - (self.side / 2) as f32) * self.cell_m)
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

/// Indices of the up to 3 × 3 cells around (ix, iy).
fn around(ix: usize, iy: usize, side: usize) -> impl Iterator<Item = usize> {
    let near = move |i: usize| i.saturating_sub(1)..(i + 2).min(side);
    near(iy).flat_map(move |y| near(ix).map(move |x| y * side + x))
}

/// Finds the cell of each point up to the largest height, and its heights if it is not too low. It has no branches and
/// reads no tables, so that the compiler vectorises it.
struct FindCells<'a> {
    map: &'a HeightMap,
    /// x, y and z, and the heights over the ground.
    points: [&'a [f32]; 4],
    /// The heights over the ground between which a point is used.
    used_m: [f32; 2],
    cells: &'a mut [u32; CHUNK],
    /// z, and the heights over the ground.
    heights_mm: [&'a mut [i32; CHUNK]; 2],
}

impl WideLoop for FindCells<'_> {
    #[inline(always)]
    fn run(self) {
        let Self { map, points: [xs, ys, zs, heights], used_m, cells, heights_mm: [millimetres, over_ground] } = self;
        let (middle, cells_a_m, side) = ((map.side / 2) as f32, 1.0 / map.cell_m, map.side as f32);
        let [lowest_m, highest_m] = used_m;
        let n = xs.len().min(CHUNK);
        let (xs, ys, zs, heights) = (&xs[..n], &ys[..n], &zs[..n], &heights[..n]);
        let (cells, millimetres, over_ground) = (&mut cells[..n], &mut millimetres[..n], &mut over_ground[..n]);
        for i in 0..n {
            let (ix, iy) = (xs[i] * cells_a_m + middle, ys[i] * cells_a_m + middle);
            let (z, height) = (zs[i], heights[i]);
            // NaN fails every comparison.
            let within = (ix >= 0.0) & (ix < side) & (iy >= 0.0) & (iy < side);
            let inside = within & (height <= highest_m);
            let is_used = inside & (height > lowest_m) & (z.abs() < HEIGHT_M_MAX);
            let [ix, iy] = [ix, iy].map(|index| floor_to_whole(if inside { index } else { 0.0 }));
            let [z, height] = [z * 1000.0 + OFFSET_MM, height * 1000.0 + OFFSET_MM]
                .map(|value| floor_to_whole(if is_used { value } else { 0.0 }));
            cells[i] = if inside { iy * map.side as u32 + ix } else { NOWHERE };
            // The value is positive before the cast, so that the cast rounds.
            millimetres[i] = z as i32 - OFFSET_MM as i32;
            over_ground[i] = if is_used { height as i32 - OFFSET_MM as i32 } else { NOT_USED };
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_bumpiness_of_a_cell_alone_is_the_standard_deviation_of_its_heights() {
        let (context, config) = (Context::default(), SpeedConfig::default());
        for (middle_m, spread_m) in [(0.0, 0.02), (-0.3, 0.05), (0.1, 0.0)] {
            let heights = [-1.5, -0.5, 0.5, 1.5].map(|share: f32| middle_m + share * spread_m);
            let mut map = HeightMap::new(80, 0.25);
            for _ in 0..2 {
                let sweep = Sweep { x: vec![5.1; 4], y: vec![-3.1; 4], z: heights.into(), ..Sweep::default() };
                map.update(&sweep, &context, &config);
                map.judge(&context, &config);
            }
            let [cell] = map.known().collect::<Vec<_>>()[..] else { panic!("one cell is known") };
            assert_eq!(map.centre_m(cell), [5.125, -3.125]);
            // The variance of four heights at ±0.5 and ±1.5 is 1.25.
            let found_m = map.bumpiness_m()[cell];
            assert!((found_m - 1.25_f32.sqrt() * spread_m).abs() < 5e-4, "{middle_m} {spread_m}: {found_m}");
        }
    }
}
