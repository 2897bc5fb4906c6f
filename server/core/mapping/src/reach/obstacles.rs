//! Obstacles: returns that are too high over the ground to drive over, and too low to drive under.
//!
//! In: cells of returns, and their heights over the ground, metres. Out: the cells with such a return, and the heights
//! that the returns of each span.

use super::cells::SIDE;

/// The cells with an obstacle.
#[derive(Clone)]
pub struct Obstacles {
    /// By cell: index of its obstacle in `found`, plus one; 0 without one.
    number_of_cell: Vec<u32>,
    /// Cell of each obstacle, and the lowest and highest height of its returns over the ground, metres.
    found: Vec<(u32, [f32; 2])>,
}

impl Obstacles {
    /// No obstacles.
    pub fn new() -> Self {
        Self { number_of_cell: vec![0; SIDE * SIDE], found: Vec::new() }
    }

    /// Removes all obstacles.
    pub fn clear(&mut self) {
        for (cell, _) in self.found.drain(..) {
            self.number_of_cell[cell as usize] = 0;
        }
    }

    /// Adds a return from an obstacle, at a height over the ground that is a number, metres.
    #[inline(always)]
    pub fn add_point(&mut self, cell: u32, height_m: f32) {
        let number = &mut self.number_of_cell[cell as usize];
        if *number == 0 {
            self.found.push((cell, [height_m; 2]));
            *number = self.found.len() as u32;
        }
        let [low, high] = &mut self.found[*number as usize - 1].1;
        (*low, *high) = (low.min(height_m), high.max(height_m));
    }

    /// Height that the returns of a cell's obstacle span, metres; negative without an obstacle.
    pub fn height_m(&self, cell: usize) -> f32 {
        self.span_m(cell).map_or(f32::NEG_INFINITY, |[low, high]| high - low)
    }

    /// Lowest and highest height over the ground that the obstacle of a cell spans, metres; `None` without one.
    pub fn span_m(&self, cell: usize) -> Option<[f32; 2]> {
        let number = self.number_of_cell[cell].checked_sub(1)?;
        Some(self.found[number as usize].1)
    }

    /// The cells with an obstacle, and the heights over the ground that it spans, metres.
    pub fn cells(&self) -> impl Iterator<Item = (usize, [f32; 2])> {
        self.found.iter().map(|(cell, span_m)| (*cell as usize, *span_m))
    }
}
