//! Drops: ditches, trenches and edges down, between two returns of one azimuth.
//!
//! In: the lowest return of each polar cell. Out: the cells between the last ground before a drop and the first return
//! beyond it. The returns of an azimuth are taken in the order of their elevation, as the lasers of a sensor see them:
//! in the order of their ranges the floor of a trench may lie beside its near edge. Ground goes on as the 2.5 m before
//! it; a return that lies deeper than this line shows a drop. Two of three azimuths must agree. Under the first ring no
//! ground lies before the drop: there the first return counts that lies deeper than the plane under the vehicle, or
//! than its wheels, and the drop may begin at the vehicle. What is found ahead and behind goes on beside it.
//!
//! From a height of 1.8 m a trench of 2 m shows its far side 0.5 m deep at 7 m, and 0.2 m at 15 m: one farther away, or
//! a hole of less than 0.6 m, is not seen.

use crate::ground::Ground;
use crate::ground::polar::{COLUMNS, ROWS, Return, beside, column_directions, row_start_m};
use crate::reach::Reach;
use crate::reach::bits::Bits;
use crate::reach::blind_zone::BlindZone;
use crate::reach::cells::{CELL_M, SIDE, centre_m};

/// Greatest range of the ground before a drop, metres. Ours; see above.
const RANGE_M_MAX: f32 = 13.0;
/// Least and greatest distance between the two returns, metres. Ours: less is the noise of two returns, more a hill.
const GAP_M: std::ops::Range<f32> = 0.3..8.0;
/// Least depth under the line over the vehicle's clearance, metres, and least depth as a share of the distance. Ours:
/// the noise of two returns; and a bend of 10 % is no drop.
const DEPTH_OVER_M: f32 = 0.02;
const DEPTH_SHARE_MIN: f32 = 0.1;
/// Distance over which the slope before the drop is measured, metres, and its greatest slope.
const BACK_M: f32 = 2.5;
const SLOPE_MAX: f32 = 0.2;
/// Heights over the estimate of the ground of returns that may be ground, metres. Ours: lower ones are noise.
const GROUND_M: std::ops::Range<f32> = -1.6..0.25;
/// Least depth of the first return under the plane under the vehicle, metres, and as a share of its range; its greatest
/// range, metres. Ours: a bend of 10 % that begins at the vehicle is no drop.
const FIRST_DEPTH_M_MIN: f32 = 0.3;
const FIRST_SHARE_MIN: f32 = 0.06;
const FIRST_M_MAX: f32 = 10.0;
/// Least depth of the first return under the level of the wheels, metres, and what is added as a share of its range.
/// Ours: where a trench fills the view, the plane lies on its floor; and 10 % down is a slope.
const WHEELS_M_MIN: f32 = 0.25;
const WHEELS_SHARE: f32 = 0.1;
/// How far a drop reaches beyond its two returns, metres. Ours: half a cell, and a cell.
const EDGES_M: [f32; 2] = [0.1, 0.25];
/// Depth of what stands before a drop, and distance of what stands beyond it, metres. Ours; not tuned.
const STANDING_M: f32 = 0.3;
/// Number of steps of a cell's side that are kept of a column: bits of a number.
const STEPS: usize = 128;

/// Finds the cells of drops. It reuses its buffers.
#[derive(Clone)]
pub struct Drops {
    directions: [[f32; 2]; COLUMNS],
    /// The returns of one column, the steepest first.
    returns: Vec<Return>,
    /// By column: one bit for each [`CELL_M`] of range, set in a drop.
    spans: Vec<u128>,
    blind_zone: BlindZone,
    found: Bits,
    /// The cells of drops beside the vehicle, between those ahead and behind.
    beside: Bits,
}

impl Drops {
    /// No drops.
    pub fn new() -> Self {
        Self {
            directions: column_directions(),
            returns: Vec::new(),
            spans: vec![0; COLUMNS],
            blind_zone: BlindZone::new(),
            found: Bits::square(SIDE),
            beside: Bits::square(SIDE),
        }
    }

    /// Finds the drops of the newest map, seen from a sensor at this height over the ground, metres.
    pub fn find(&mut self, ground: &Ground, reach: &Reach, sensor_m: f32) -> &Bits {
        for column in 0..COLUMNS {
            self.sort_returns(ground, column, sensor_m);
            self.spans[column] = self.span(ground, reach, column);
        }
        self.mark(reach);
        let Self { found, beside, blind_zone, .. } = self;
        beside.clear();
        let confidences = ground.confidences();
        blind_zone.find(found, |cell| reach.obstacles().height_m(cell), confidences, |ix, iy| beside.set(ix, iy));
        found.add(beside);
        found
    }

    fn sort_returns(&mut self, ground: &Ground, column: usize, sensor_m: f32) {
        self.returns.clear();
        let rows = (0..ROWS).take_while(|row| row_start_m(*row) < RANGE_M_MAX + GAP_M.end);
        for cell in rows.map(|row| row * COLUMNS + column) {
            let height_m = ground.surface_m(cell);
            let of_ground = |found: &Return| {
                let over_m = found.z_m - height_m;
                GROUND_M.contains(&over_m) && !ground.is_mirrored(column, found, over_m, sensor_m)
            };
            self.returns.extend(ground.cells().lowest(cell).find(of_ground));
        }
        let fall = |found: &Return| (sensor_m - found.z_m) / found.range_m;
        self.returns.sort_by(|one, other| fall(other).total_cmp(&fall(one)));
    }

    /// The bits of a column's drops.
    fn span(&self, ground: &Ground, reach: &Reach, column: usize) -> u128 {
        let depth_m_min = reach.config().clearance_m + DEPTH_OVER_M;
        let first = self.returns.first().filter(|first| is_below_vehicle(ground, self.directions[column], first));
        let mut span = first.map_or(0, |first| bits(0.0, first.range_m + EDGES_M[1]));
        for (at, pair) in self.returns.windows(2).enumerate() {
            let [before, after] = [pair[0], pair[1]];
            let gap_m = after.range_m - before.range_m;
            if before.range_m >= RANGE_M_MAX || !GAP_M.contains(&gap_m) {
                continue;
            }
            let line_m = before.z_m + self.slope(at) * gap_m;
            let is_deep = line_m - after.z_m > depth_m_min.max(DEPTH_SHARE_MIN * gap_m);
            if is_deep && !is_hidden(reach, column, [before, after]) {
                span |= bits(before.range_m + EDGES_M[0], after.range_m + EDGES_M[1]);
            }
        }
        span
    }

    /// Slope of the ground before a return of the column.
    fn slope(&self, at: usize) -> f32 {
        let Return { range_m, z_m } = self.returns[at];
        let mut back = self.returns[..at].iter().rev().filter(|back| range_m - back.range_m >= BACK_M / 5.0);
        let far = back.clone().find(|back| range_m - back.range_m >= BACK_M);
        let slope = |back: &Return| (z_m - back.z_m) / (range_m - back.range_m);
        far.or_else(|| back.next_back()).map_or(0.0, slope).clamp(-SLOPE_MAX, SLOPE_MAX)
    }

    fn mark(&mut self, reach: &Reach) {
        self.found.clear();
        let agreed = |column: usize| {
            let [left, own, right] = [-1, 0, 1].map(|offset| self.spans[beside(column, offset)]);
            left & own | own & right | left & right
        };
        // The sides of a trench fill a part of their columns only.
        let wide =
            |column: usize| [-1, 0, 1].map(|offset| agreed(beside(column, offset))).into_iter().fold(0, |a, b| a | b);
        let spans: [u128; COLUMNS] = std::array::from_fn(wide);
        if spans.iter().all(|span| *span == 0) {
            return;
        }
        let half = ((RANGE_M_MAX + GAP_M.end) / CELL_M) as usize;
        let near = SIDE / 2 - half..SIDE / 2 + half;
        for (ix, iy) in near.clone().flat_map(|iy| near.clone().map(move |ix| (ix, iy))) {
            let cell = iy * SIDE + ix;
            let Some(polar) = reach.polar(cell).index() else { continue };
            let span = spans[polar % COLUMNS];
            let [x, y] = centre_m(cell);
            if span != 0 && span >> ((x * x + y * y).sqrt() / CELL_M) as u32 & 1 != 0 {
                self.found.set(ix, iy);
            }
        }
    }
}

/// True if the first return of a column is near, and lies deeper than the ground under the vehicle.
fn is_below_vehicle(ground: &Ground, [cos, sin]: [f32; 2], first: &Return) -> bool {
    let (plane, Return { range_m, z_m }) = (ground.near_plane(), *first);
    let depth_m = plane.height_m(range_m * cos, range_m * sin) - z_m;
    let is_below_plane = plane.is_seen && depth_m > FIRST_DEPTH_M_MIN.max(FIRST_SHARE_MIN * range_m);
    range_m < FIRST_M_MAX && (is_below_plane || -z_m > WHEELS_M_MIN + WHEELS_SHARE * range_m)
}

/// True if an obstacle stands on the way from one return to the next: what looks like ground before a drop may be a
/// part of the obstacle, such as the front of a car, beside which the next ray passes.
fn is_hidden(reach: &Reach, column: usize, [before, after]: [Return; 2]) -> bool {
    let way = before.range_m - STANDING_M..after.range_m - STANDING_M;
    let rows = (0..ROWS).filter(|row| way.start < row_start_m(*row + 1) && row_start_m(*row) < way.end);
    rows.map(|row| row * COLUMNS + column).any(|cell| reach.has_obstacle()[cell])
}

/// The bits from one range to another one.
fn bits(from_m: f32, to_m: f32) -> u128 {
    let [from, to] = [from_m, to_m].map(|metres| ((metres / CELL_M).max(0.0) as usize).min(STEPS - 1));
    (u128::MAX >> (STEPS - 1 - to)) & (u128::MAX << from)
}
