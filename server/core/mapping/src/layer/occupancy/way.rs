//! A straight way through the window, from a sensor outward.
//!
//! In: a place and a direction, cells from the window's corner. Out: what a direction tells, step by step, added to the
//! cells in the middles of the steps.

use std::ops::Range;

/// Fraction bits of positions on a trace. So many, because a trace must fall on a border of cells never, not seldom.
const FRACTION: u32 = 32;

/// A way of equal steps, length 1, through a window.
pub struct Way {
    at: [i64; 2],
    step: [i64; 2],
    side: usize,
}

impl Way {
    /// From a place in cells from the window's corner, along a direction of length 1.
    pub fn new(from: [f64; 2], direction: [f64; 2], side: usize) -> Self {
        let fixed = |cells: f64| (cells * (1_i64 << FRACTION) as f64) as i64;
        let step = direction.map(fixed);
        Self { at: [0, 1].map(|i| fixed(from[i]) + step[i] / 2), step, side }
    }

    /// The middle of a step.
    fn middle(&self, number: usize) -> [i64; 2] {
        [0, 1].map(|i| self.at[i] + self.step[i] * number as i64)
    }

    /// How many steps have their middles in the window, of `most`.
    pub fn steps(&self, most: usize) -> usize {
        let end = (self.side as i64) << FRACTION;
        let inside = |number: usize| self.middle(number).iter().all(|at| (0..end).contains(at));
        let (mut least, mut most) = (0, most);
        // The window is convex: a way that has left it does not come back.
        while least < most {
            let number = least.midpoint(most);
            (least, most) = if inside(number) { (number + 1, most) } else { (least, number) };
        }
        least
    }

    /// Adds what is told of these steps to the cells in their middles.
    #[inline(always)]
    pub fn tell(&self, steps: Range<usize>, telling: &[u8], told: &mut [u8]) {
        let [mut x, mut y] = self.middle(steps.start);
        for telling in &telling[steps] {
            told[(y >> FRACTION) as usize * self.side + (x >> FRACTION) as usize] |= telling;
            (x, y) = (x + self.step[0], y + self.step[1]);
        }
    }
}
