//! Obstacles: returns that are too high over the ground to drive over, and too low to drive under.
//!
//! In: cells of returns, and their heights over the ground, metres. Out: the cells with such a return, and the heights
//! that the returns of each span.

use super::cells::SIDE;

/// Span of a cell without an obstacle.
const EMPTY: [f32; 2] = [f32::INFINITY, f32::NEG_INFINITY];

/// The cells with an obstacle.
#[derive(Clone)]
pub struct Obstacles {
    /// By cell: lowest and highest height of its returns over the ground, metres.
    spans_m: Vec<[f32; 2]>,
    /// Indices of the cells with an obstacle.
    found: Vec<u32>,
}

impl Obstacles {
    /// No obstacles.
    pub fn new() -> Self {
        Self { spans_m: vec![EMPTY; SIDE * SIDE], found: Vec::new() }
    }

    /// Removes all obstacles.
    pub fn clear(&mut self) {
        for cell in self.found.drain(..) {
            self.spans_m[cell as usize] = EMPTY;
        }
    }

    /// Adds a return from an obstacle, at a height over the ground that is a number, metres.
    #[inline(always)]
    pub fn add_point(&mut self, cell: u32, height_m: f32) {
        let span = &mut self.spans_m[cell as usize];
        if *span == EMPTY {
            self.found.push(cell);
        }
        let [low, high] = *span;
        *span = [if height_m < low { height_m } else { low }, if height_m > high { height_m } else { high }];
    }

    /// Height that the returns of a cell's obstacle span, metres; negative without an obstacle.
    pub fn height_m(&self, cell: usize) -> f32 {
        self.spans_m[cell][1] - self.spans_m[cell][0]
    }

    /// Lowest and highest height over the ground that the obstacle of a cell spans, metres; `None` without one.
    pub fn span_m(&self, cell: usize) -> Option<[f32; 2]> {
        Some(self.spans_m[cell]).filter(|[low, high]| low <= high)
    }

    /// The cells with an obstacle, and the heights over the ground that it spans, metres.
    pub fn cells(&self) -> impl Iterator<Item = (usize, [f32; 2])> {
        self.found.iter().map(|cell| (*cell as usize, self.spans_m[*cell as usize]))
    }
}
