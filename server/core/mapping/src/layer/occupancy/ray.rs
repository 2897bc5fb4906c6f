//! A ray through the window, from a sensor outward.
//!
//! In: an origin and a direction, in cells from the window's corner. Out: evidence, step by step, added to the cells
//! that contain the centres of the steps.

use std::ops::Range;

/// Fraction bits of positions on a ray. Ours: with 32 bits no sample lies exactly on a cell edge.
const FRACTION: u32 = 32;

/// A ray through a window, in steps of length 1 (one cell).
pub struct Ray {
    /// Centre of step 0, in fixed-point cells.
    start: [i64; 2],
    /// Direction, in fixed-point cells.
    step: [i64; 2],
    /// Number of cells along a side of the window.
    side: usize,
}

impl Ray {
    /// A ray from an origin, in cells from the window's corner, along a direction of length 1.
    pub fn new(origin: [f64; 2], direction: [f64; 2], side: usize) -> Self {
        let fixed = |cells: f64| (cells * (1_i64 << FRACTION) as f64) as i64;
        let step = direction.map(fixed);
        Self { start: [0, 1].map(|i| fixed(origin[i]) + step[i] / 2), step, side }
    }

    /// Centre of a step, in fixed-point cells.
    fn centre(&self, number: usize) -> [i64; 2] {
        [0, 1].map(|i| self.start[i] + self.step[i] * number as i64)
    }

    /// Number of the first `most` steps whose centres lie in the window.
    pub fn steps(&self, most: usize) -> usize {
        let end = (self.side as i64) << FRACTION;
        let inside = |number: usize| self.centre(number).iter().all(|value| (0..end).contains(value));
        let (mut least, mut most) = (0, most);
        // The window is convex: a ray that leaves it does not come back.
        while least < most {
            let number = least.midpoint(most);
            (least, most) = if inside(number) { (number + 1, most) } else { (least, number) };
        }
        least
    }

    /// Adds the evidence of these steps to the cells that contain their centres.
    #[inline(always)]
    pub fn write_evidence(&self, steps: Range<usize>, of_step: &[u8], of_cell: &mut [u8]) {
        let [mut x, mut y] = self.centre(steps.start);
        for evidence in &of_step[steps] {
            of_cell[(y >> FRACTION) as usize * self.side + (x >> FRACTION) as usize] |= evidence;
            (x, y) = (x + self.step[0], y + self.step[1]);
        }
    }
}
