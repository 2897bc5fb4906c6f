//! Cells beside a step of the ground are joined across the gap between two rings.
//!
//! In: the cells beside a step, and which polar cells have ground that was seen. Out: the cells on straight lines
//! between two of them where nothing was seen in between. Rings lie metres apart far away: a kerb or a ditch that leads
//! away from the vehicle is seen once a ring, as a row of cells, and between two of them no return says that the way is
//! free. Obstacles are not joined: they are so high that more than one ring shows them.

use crate::ground::polar::{CELLS, COLUMNS, PolarIndex, ROWS, beside, row_middles_m};
use crate::ground::surface::Confidence;

use super::bits::Bits;
use super::cells::SIDE;

/// Longest gap, as a share of the range of its outer end. Ours: the gaps that the estimate of the ground bridges.
const GAP_SHARE_MAX: f32 = 0.44;
/// Largest shift of the outer end across the direction from the vehicle, as a share of the gap. Ours: what leads away
/// from the vehicle at a larger angle crosses so many columns that each shows it.
const SHIFT_SHARE_MAX: f32 = 1.0;
/// A polar cell without a step.
const NONE: u32 = u32::MAX;

/// The cells beside a step, by polar cell.
#[derive(Clone)]
pub struct Joins {
    /// By polar cell: index of one of its cells beside a step, or [`NONE`].
    steps: Vec<u32>,
    middles_m: [f32; ROWS],
}

impl Joins {
    /// Joins without a step.
    pub fn new() -> Self {
        Self { steps: vec![NONE; CELLS], middles_m: row_middles_m() }
    }

    /// Calls `mark` with column and row of each cell on a line between two cells beside a step. `polar_of_cell` are
    /// the polar cells of the cells' centres, `confidences` is by polar cell.
    pub fn find(
        &mut self,
        beside_step: &Bits,
        polar_of_cell: &[PolarIndex],
        confidences: &[Confidence],
        mut mark: impl FnMut(usize, usize),
    ) {
        self.steps.fill(NONE);
        beside_step.each(|ix, iy| {
            let cell = iy * SIDE + ix;
            if let Some(polar) = polar_of_cell[cell].index() {
                self.steps[polar] = cell as u32;
            }
        });
        for polar in (0..CELLS).filter(|polar| self.steps[*polar] != NONE) {
            if let Some(outer) = self.next_outward(polar, confidences) {
                draw(self.steps[polar] as usize, outer as usize, &mut mark);
            }
        }
    }

    /// The cell beside a step in the next ring outward from a polar cell; `None` if ground was seen before it.
    fn next_outward(&self, polar: usize, confidences: &[Confidence]) -> Option<u32> {
        let (row, column) = (polar / COLUMNS, polar % COLUMNS);
        for outer in row + 1..ROWS {
            let (gap_m, range_m) = (self.middles_m[outer] - self.middles_m[row], self.middles_m[outer]);
            if gap_m > GAP_SHARE_MAX * range_m {
                return None;
            }
            let column_m = range_m * std::f32::consts::TAU / COLUMNS as f32;
            let most = (SHIFT_SHARE_MAX * gap_m / column_m).ceil() as isize;
            let columns = (0..=most).flat_map(|shift| [shift, -shift]);
            let found = columns.map(|shift| self.steps[outer * COLUMNS + beside(column, shift)]);
            if let Some(found) = found.into_iter().find(|cell| *cell != NONE) {
                return Some(found);
            }
            if confidences[outer * COLUMNS + column] == Confidence::Seen {
                return None;
            }
        }
        None
    }
}

/// Calls `mark` with each cell on the straight line between two cells.
pub fn draw(from: usize, to: usize, mark: &mut impl FnMut(usize, usize)) {
    let [[ax, ay], [bx, by]] = [from, to].map(|cell| [(cell % SIDE) as isize, (cell / SIDE) as isize]);
    let steps = (bx - ax).abs().max((by - ay).abs());
    for step in 1..steps {
        let along = |a: isize, b: isize| (a * 2 * steps + (b - a) * 2 * step + steps).div_euclid(2 * steps) as usize;
        mark(along(ax, bx), along(ay, by));
    }
}

#[cfg(test)]
mod tests {
    use super::super::cells::{cell, centre_m};
    use super::*;

    #[test]
    fn two_steps_are_joined_unless_ground_was_seen_between_them() {
        let polar_of_cell: Vec<PolarIndex> =
            (0..SIDE * SIDE).map(centre_m).map(|[x, y]| PolarIndex::at(x, y)).collect();
        let joined = |to: [f32; 2], seen_m: f32| {
            let mut beside_step = Bits::square(SIDE);
            for [x, y] in [[20.1, 5.1], to] {
                let cell = cell(x, y) as usize;
                beside_step.set(cell % SIDE, cell / SIDE);
            }
            let mut confidences = vec![Confidence::Bridged; CELLS];
            let seen = PolarIndex::at(seen_m, 5.1 * seen_m / 20.1).index();
            seen.into_iter().for_each(|polar| confidences[polar] = Confidence::Seen);
            let mut cells = Vec::new();
            Joins::new().find(&beside_step, &polar_of_cell, &confidences, |ix, iy| cells.push(iy * SIDE + ix));
            cells
        };
        let line = joined([24.1, 5.1], 40.0);
        let from = cell(20.1, 5.1) as usize;
        assert_eq!(line, (from + 1..from + 16).collect::<Vec<_>>(), "the cells between them");
        assert_eq!(joined([24.1, 5.1], 22.0), [], "ground was seen between them");
        assert_eq!(joined([22.1, 16.1], 40.0), [], "too far across");
        assert_eq!(joined([50.1, 12.1], 60.0), [], "too far away");
    }
}
