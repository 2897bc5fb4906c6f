//! Obstacles: returns that are too high over the ground to drive over, and too low to drive under.
//!
//! In: the sweep's points and their heights over the ground, metres. Out: the cells with such a return, and the heights
//! that the returns of each span. Returns of the vehicle itself are left out.

use crate::sensor::sweep::Sweep;

use super::cells::{NOWHERE, SIDE};
use super::config::ReachConfig;

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

    /// Replaces the obstacles by those of a sweep. `cells` are the cells of its points.
    pub fn find(&mut self, sweep: &Sweep, heights_m: &[f32], cells: &[u32], config: &ReachConfig) {
        for cell in self.found.drain(..) {
            self.spans_m[cell as usize] = EMPTY;
        }
        let outline = config.outline();
        for (point, (&cell, &height)) in cells.iter().zip(heights_m).enumerate() {
            if height >= config.obstacle_m_min
                && height <= config.overhang_m
                && cell != NOWHERE
                && !outline.contains(sweep.x[point], sweep.y[point])
            {
                let span = &mut self.spans_m[cell as usize];
                if *span == EMPTY {
                    self.found.push(cell);
                }
                *span = [span[0].min(height), span[1].max(height)];
            }
        }
    }

    /// Height that the returns of a cell's obstacle span, metres; negative without an obstacle.
    pub fn height_m(&self, cell: usize) -> f32 {
        self.spans_m[cell][1] - self.spans_m[cell][0]
    }

    /// The cells with an obstacle, and the heights over the ground that it spans, metres.
    pub fn cells(&self) -> impl Iterator<Item = (usize, [f32; 2])> {
        self.found.iter().map(|cell| (*cell as usize, self.spans_m[*cell as usize]))
    }
}
