//! Steps of the ground itself: kerbs, ledges and the sides of ditches, which the smooth estimate of the ground follows.
//!
//! In: cells and heights of the returns from the ground, metres. Out: the cells on both sides of a step that is too
//! high and too steep for the vehicle. Two cells at most two cells apart are compared, so that a grade is no step.

use super::bits::Bits;
use super::cells::{CELL_M, SIDE};
use super::config::STEP_SLOPE_MIN;

/// Lowest height over the ground of a return that is used, metres. Ours: lower ones are mirror images.
pub const LOWEST_M: f32 = -1.5;
/// The cells that a cell is compared with: half of those within two cells, because each pair is compared once.
const NEAR: [[isize; 2]; 10] = [[1, 0], [0, 1], [1, 1], [-1, 1], [2, 0], [0, 2], [2, 1], [1, 2], [-1, 2], [-2, 1]];
/// Heights of a cell without a return.
const EMPTY: [i16; 2] = [i16::MAX, i16::MIN];

/// Heights of the lowest and highest return from the ground of each cell.
#[derive(Clone)]
pub struct Steps {
    /// Millimetres, ego frame.
    spans: Vec<[i16; 2]>,
    /// The cells with a return.
    seen: Bits,
}

impl Steps {
    /// Cells without a return.
    pub fn new() -> Self {
        Self { spans: vec![EMPTY; SIDE * SIDE], seen: Bits::square(SIDE) }
    }

    /// Removes all returns.
    pub fn clear(&mut self) {
        self.seen.each(|ix, iy| self.spans[iy * SIDE + ix] = EMPTY);
        self.seen.clear();
    }

    /// Adds a return from the ground of a cell, at this height in the ego frame, millimetres.
    #[inline(always)]
    pub fn add_point(&mut self, cell: u32, millimetres: i16) {
        let span = &mut self.spans[cell as usize];
        // Whether the cell has a return already cannot be predicted.
        self.seen.set(cell as usize % SIDE, cell as usize / SIDE);
        *span = [span[0].min(millimetres), span[1].max(millimetres)];
    }

    /// Calls `mark` with the higher and the lower cell of each step of at least this height, up to `near` cells from
    /// the middle; both are the same for a step within a cell.
    pub fn find(&self, least_m: f32, near: usize, mut mark: impl FnMut(usize, usize)) {
        let least_mm = (least_m * 1000.0) as i32;
        let reaches = NEAR.map(|[dx, dy]| {
            let distance_m = CELL_M * ((dx * dx + dy * dy) as f32).sqrt();
            (dy * SIDE as isize + dx, least_mm.max((STEP_SLOPE_MIN * distance_m * 1000.0) as i32))
        });
        let near = SIDE / 2 - near..SIDE / 2 + near;
        // The outermost cells are compared with fewer others.
        let columns = near.start.max(2)..near.end.min(SIDE - 2);
        self.seen.each_in(near.start..near.end.min(SIDE - 2), |ix, iy| {
            if !columns.contains(&ix) {
                return;
            }
            let cell = iy * SIDE + ix;
            let [low, high] = self.spans[cell].map(i32::from);
            if high - low >= least_mm {
                mark(cell, cell);
            }
            // A cell without a return has no step to any other; few cells have a step.
            let steps = reaches.map(|(offset, least_mm)| {
                let other = cell.wrapping_add_signed(offset);
                let [other_low, other_high] = self.spans[other].map(i32::from);
                (other, high - other_low >= least_mm, other_high - low >= least_mm)
            });
            if steps.iter().fold(false, |any, (_, down, up)| any | down | up) {
                steps.iter().filter(|(_, down, _)| *down).for_each(|(other, ..)| mark(cell, *other));
                steps.iter().filter(|(.., up)| *up).for_each(|(other, ..)| mark(*other, cell));
            }
        });
    }

    /// By cell: lowest and highest return from the ground, millimetres.
    pub fn spans_mm(&self) -> &[[i16; 2]] {
        &self.spans
    }

    /// Height of the lowest return from the ground of a cell, millimetres; the largest number without one.
    pub fn low_mm(&self, cell: usize) -> i16 {
        self.spans[cell][0]
    }

    /// The cells with a return from the ground.
    pub fn seen(&self) -> &Bits {
        &self.seen
    }
}

#[cfg(test)]
mod tests {
    use super::super::cells::cell;
    use super::*;

    #[test]
    fn a_step_is_as_high_as_configured_and_as_steep_as_configured_in_every_direction() {
        for [dx, dy] in NEAR.into_iter().flat_map(|[dx, dy]| [[dx, dy], [-dx, -dy]]) {
            let apart = [dx, dy].map(|cells| CELL_M * cells as f32);
            let least_m = 0.2_f32.max(0.5 * libm::hypotf(apart[0], apart[1]));
            for (height_m, expected) in [(least_m - 0.002, 0), (least_m + 0.002, 2)] {
                let (mut steps, mut marked) = (Steps::new(), std::collections::BTreeSet::new());
                steps.add_point(cell(5.1, 3.1), 0);
                steps.add_point(cell(5.1 + apart[0], 3.1 + apart[1]), (height_m * 1000.0) as i16);
                steps.find(0.2, SIDE / 2, |higher, lower| marked.extend([higher, lower]));
                assert_eq!(marked.len(), expected, "{height_m} m high, {dx} and {dy} cells apart");
            }
        }
    }
}
