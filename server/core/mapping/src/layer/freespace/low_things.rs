//! Low things: what the vehicle's clearance does not pass over, but what is lower than an obstacle.
//!
//! In: by cell the lowest and the highest return from the ground, millimetres. Out: the low cells. The score of a cell
//! is the height of its highest return over the mean ground in a box on each of two opposite sides, the lesser of the
//! two, the greatest of four axes. On a slope and at a kerb one side is as high as the cell, so that they score
//! nothing; a log or a lying person stands over both. Boxes are small where all sides have returns, else larger. Rough
//! ground, such as grass, scores everywhere; a cell must score more there. A cell that scores little more than it must
//! needs a neighbour.
//!
//! A step of the ground that is higher than the clearance is low too: its higher side. So is a cell without
//! a return right behind a low one: the thing hides its own back.

use crate::azimuth_columns::floor_to_whole;
use crate::reach::Reach;
use crate::reach::bits::Bits;
use crate::reach::cells::{CELL_M, SIDE, cell, centre_m};
use crate::wide::{WideLoop, run_wide};

/// Number of cells along a side of the square in which low things are sought, in the middle of the grid: to 26 m.
const WINDOW: usize = 208;
/// First cell of the window.
const FIRST: usize = (SIDE - WINDOW) / 2;
/// Greatest distance of a low thing and of a low step from the vehicle, metres. Ours: beyond it a ring of 64 lasers
/// passes over a log, and two cells beside each other have no returns.
const RANGE_M_MAX: f32 = 22.0;
const STEP_RANGE_M_MAX: f32 = 16.0;
/// Half the side of a box in cells, and the distance of its middle along an axis and along a diagonal.
const BOXES: [SideBox; 2] = [SideBox { half: 2, along: 5, diagonal: 4 }, SideBox { half: 4, along: 9, diagonal: 6 }];
/// Cells from the border of the window in which boxes do not fit.
const MARGIN: usize = 13;
/// The score of a low thing under the clearance on even ground, and over the clearance on rough ground, millimetres.
/// Ours: the mean of the lowest returns is 30 mm over the ground, and grass scores up to 200 mm.
const EVEN_MM: i16 = 30;
const ROUGH_MM: i16 = 50;
/// Scores of rough ground, millimetres. Ours: noise scores less, things more.
const ROUGH_SCORE_MM: std::ops::Range<i16> = 50..110;
/// Half the side, in cells, of the box in which a share of 10 to 30 % is rough.
const ROUGH_HALF: usize = 8;
/// Bits of the number of cells of a box: the largest has 17 x 17. A sum of heights, at most 32.767 m in 9 x 9 cells,
/// fits into the others.
const CELLS_BITS: u32 = 9;
/// Score over the least one with which a cell needs no neighbour, millimetres.
const ALONE_MM: i16 = 80;
/// The least height of a low step over the clearance, metres. Ours: a step of 0.15 m with the noise of two returns.
const STEP_OVER_M: f32 = 0.0;
/// Score of a cell with too few returns around it.
const NONE: i16 = i16::MIN;

struct SideBox {
    half: usize,
    along: usize,
    diagonal: usize,
}

/// Finds the low cells. It reuses its buffers.
#[derive(Clone)]
pub struct LowThings {
    /// By cell of the window: highest return, millimetres; [`NONE`] without one.
    top: Vec<i16>,
    /// By cell of the window: a [`pair`] of its lowest return, millimetres, and 1; 0 without a return.
    low: Vec<i32>,
    sums: BoxSums,
    /// By cell of the window: mean ground of the box around it; the largest number without returns.
    means: Vec<i16>,
    best: Vec<i16>,
    scores: Vec<i16>,
    things: Bits,
    /// The higher sides of low steps.
    steps: Bits,
}

impl LowThings {
    /// No low things.
    pub fn new() -> Self {
        let cells = WINDOW * WINDOW;
        Self {
            top: vec![NONE; cells],
            low: vec![0; cells],
            sums: BoxSums::new(),
            means: vec![i16::MAX; cells],
            best: vec![NONE; cells],
            scores: vec![NONE; cells],
            things: Bits::square(SIDE),
            steps: Bits::square(SIDE),
        }
    }

    /// Finds the low cells of the newest map: things, then steps.
    pub fn find(&mut self, reach: &Reach) -> [&Bits; 2] {
        run_wide(Score(self, reach.ground_spans_mm()));
        self.judge(reach);
        [&self.things, &self.steps]
    }

    #[inline(always)]
    fn copy_heights(&mut self, spans_mm: &[[i16; 2]]) {
        for iy in 0..WINDOW {
            let spans = &spans_mm[(FIRST + iy) * SIDE + FIRST..][..WINDOW];
            let row = iy * WINDOW..(iy + 1) * WINDOW;
            let heights = self.top[row.clone()].iter_mut().zip(&mut self.low[row]);
            for ((top, low), &[lowest, highest]) in heights.zip(spans) {
                let is_seen = lowest <= highest;
                *top = if is_seen { highest } else { NONE };
                *low = if is_seen { pair(lowest.into(), 1) } else { 0 };
            }
        }
    }

    #[inline(always)]
    fn score(&mut self) {
        self.scores.fill(NONE);
        for SideBox { half, along, diagonal } in BOXES {
            self.sums.add_up(&self.low, half);
            self.means.iter_mut().zip(&self.sums.sums).for_each(|(mean, sums)| {
                let [sum, count] = of_pair(*sums);
                // Towards 0. A cast of a number with a sign has range checks, which would prevent vectorisation.
                let mm = floor_to_whole((sum as f32 / count as f32).abs().min(f32::from(i16::MAX))) as i16;
                *mean = if count == 0 {
                    i16::MAX
                } else if sum < 0 {
                    -mm
                } else {
                    mm
                };
            });
            self.best.fill(NONE);
            let axes = [along, along * WINDOW, diagonal * (WINDOW + 1), diagonal * (WINDOW - 1)];
            let inside = MARGIN * WINDOW..(WINDOW - MARGIN) * WINDOW;
            for offset in axes {
                let [before, after] = [inside.start - offset, inside.start + offset].map(|from| &self.means[from..]);
                let sides = self.top[inside.clone()].iter().zip(before).zip(after);
                for (best, ((top, before), after)) in self.best[inside.clone()].iter_mut().zip(sides) {
                    // A side without returns is as high as a number can be.
                    *best = (*best).max(top.saturating_sub(*before).min(top.saturating_sub(*after)));
                }
            }
            let scores = self.scores.iter_mut().zip(&self.best);
            // Where the small boxes have no returns on two sides, the score is far below any that counts.
            scores.for_each(|(score, best)| *score = if *score > NONE / 2 { *score } else { *best });
        }
    }

    fn judge(&mut self, reach: &Reach) {
        let clearance_mm = (reach.config().clearance_m * 1000.0) as i16;
        let (even_mm, rough_mm) = (clearance_mm - EVEN_MM, clearance_mm + ROUGH_MM);
        // From here on `low` and its sums are pairs of the rough cells and of those with a score.
        self.low.iter_mut().zip(&self.scores).for_each(|(flags, score)| {
            *flags = pair(i32::from(ROUGH_SCORE_MM.contains(score)), i32::from(*score > NONE / 2));
        });
        self.sums.add_up(&self.low, ROUGH_HALF);
        let over = |at: usize, more_mm: i16| {
            let [rough, scored] = of_pair(self.sums.sums[at]);
            let scored = scored.max(1);
            let raised = i32::from(rough_mm - even_mm) * (10 * rough - scored).clamp(0, 2 * scored) / (2 * scored);
            self.scores[at] >= even_mm + more_mm + raised as i16
        };
        self.things.clear();
        self.steps.clear();
        for at in (MARGIN * WINDOW..(WINDOW - MARGIN) * WINDOW).filter(|at| self.scores[*at] >= even_mm) {
            let (ix, iy) = (at % WINDOW, at / WINDOW);
            if !(MARGIN..WINDOW - MARGIN).contains(&ix) || !over(at, 0) || !is_within(ix, iy, RANGE_M_MAX) {
                continue;
            }
            let neighbours = (iy - 1..=iy + 1).flat_map(|iy| (ix - 1..=ix + 1).map(move |ix| iy * WINDOW + ix));
            let mut others = neighbours.filter(|other| *other != at);
            if over(at, ALONE_MM) || others.clone().any(|other| over(other, 0)) {
                self.things.set(FIRST + ix, FIRST + iy);
                // The ends of a thing fill a part of their cells only.
                let ends = others.by_ref().filter(|other| self.scores[*other] >= ROUGH_SCORE_MM.start);
                ends.for_each(|other| self.things.set(FIRST + other % WINDOW, FIRST + other / WINDOW));
            }
        }
        let (steps, sums) = (&mut self.steps, &self.sums.sums);
        let half = (STEP_RANGE_M_MAX / CELL_M) as usize;
        reach.each_step(reach.config().clearance_m + STEP_OVER_M, half, |cell| {
            let (ix, iy) = (cell % SIDE - FIRST, cell / SIDE - FIRST);
            // Grass is full of steps.
            let [rough, scored] = of_pair(sums[iy * WINDOW + ix]);
            let is_even = 3 * rough <= scored;
            if is_even && is_within(ix, iy, STEP_RANGE_M_MAX) {
                steps.set(FIRST + ix, FIRST + iy);
            }
        });
    }
}

struct Score<'a>(&'a mut LowThings, &'a [[i16; 2]]);

impl WideLoop for Score<'_> {
    #[inline(always)]
    fn run(self) {
        self.0.copy_heights(self.1);
        self.0.score();
    }
}

/// Writes the cells without a return right behind low ones.
pub fn find_backs(reach: &Reach, low: &Bits, backs: &mut Bits) {
    backs.clear();
    low.each(|ix, iy| {
        let [x, y] = centre_m(iy * SIDE + ix);
        let farther = 1.0 + CELL_M / libm::hypotf(x, y);
        let behind = cell(x * farther, y * farther) as usize;
        if behind < SIDE * SIDE && !reach.bits().seen.get(behind % SIDE, behind / SIDE) {
            backs.set(behind % SIDE, behind / SIDE);
        }
    });
}

/// True if a cell of the window is within a distance of the vehicle.
fn is_within(ix: usize, iy: usize, range_m: f32) -> bool {
    let [x, y] = centre_m((FIRST + iy) * SIDE + FIRST + ix);
    x * x + y * y < range_m * range_m
}

/// Two sums in one number: a sum, and the number of its cells, which are as many as the largest box has.
#[inline(always)]
fn pair(sum: i32, cells: i32) -> i32 {
    (sum << CELLS_BITS) + cells
}

/// The sum and the number of cells of a [`pair`].
#[inline(always)]
fn of_pair(pair: i32) -> [i32; 2] {
    [pair >> CELLS_BITS, pair & ((1 << CELLS_BITS) - 1)]
}

/// By cell of the window: the sum of the values in a square box around it. Values beyond the window are 0.
#[derive(Clone)]
struct BoxSums {
    /// Sums along the rows.
    along: Vec<i32>,
    sums: Vec<i32>,
    /// Of one row: the sum of all cells before each; as many as a box is wide are added beyond both ends.
    before: Vec<i32>,
    /// One row.
    column_sums: Vec<i32>,
}

impl BoxSums {
    fn new() -> Self {
        let zeros = vec![0; WINDOW * WINDOW];
        Self { along: zeros.clone(), sums: zeros, before: Vec::new(), column_sums: vec![0; WINDOW] }
    }

    /// Replaces the sums by the sums of boxes of `2 * half + 1` cells a side.
    #[inline(always)]
    fn add_up(&mut self, values: &[i32], half: usize) {
        let (before, width) = (&mut self.before, 2 * half + 1);
        before.resize(WINDOW + width, 0);
        before[..=half].fill(0);
        for (row, sums) in values.chunks_exact(WINDOW).zip(self.along.chunks_exact_mut(WINDOW)) {
            let mut sum = 0;
            for (before, value) in before[half + 1..].iter_mut().zip(row) {
                // A sum of a whole row may wrap: a difference is right all the same.
                sum = value.wrapping_add(sum);
                *before = sum;
            }
            before[half + 1 + WINDOW..].fill(sum);
            let ends = before[width..].iter().zip(&before[..WINDOW]);
            sums.iter_mut().zip(ends).for_each(|(sum, (to, from))| *sum = to.wrapping_sub(*from));
        }
        let row = |iy: usize| iy * WINDOW..(iy + 1) * WINDOW;
        self.column_sums.fill(0);
        for iy in 0..WINDOW + half {
            if iy < WINDOW {
                self.column_sums.iter_mut().zip(&self.along[row(iy)]).for_each(|(sum, value)| *sum += value);
            }
            if iy > 2 * half {
                let past = &self.along[row(iy - 2 * half - 1)];
                self.column_sums.iter_mut().zip(past).for_each(|(sum, value)| *sum -= value);
            }
            if iy >= half {
                self.sums[row(iy - half)].copy_from_slice(&self.column_sums);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_sums_are_those_of_all_cells_of_a_box() {
        let values: Vec<i32> =
            (0..(WINDOW * WINDOW) as u32).map(|at| (at.wrapping_mul(2_654_435_761) >> 20) as i32).collect();
        let mut sums = BoxSums::new();
        for half in [2, 4, ROUGH_HALF] {
            sums.add_up(&values, half);
            for (ix, iy) in [(0, 0), (3, 7), (WINDOW - 1, 100), (50, WINDOW - 2), (120, 99)] {
                let near = |at: usize| at.saturating_sub(half)..(at + half + 1).min(WINDOW);
                let expected: i32 = near(iy).map(|iy| near(ix).map(|ix| values[iy * WINDOW + ix]).sum::<i32>()).sum();
                assert_eq!(sums.sums[iy * WINDOW + ix], expected, "{half}: {ix} {iy}");
            }
        }
    }
}
