//! Steps of the ground itself: kerbs, ledges and the sides of ditches, which the smooth estimate of the ground follows.
//!
//! In: the sweep's points and their heights over the ground, metres. Out: the cells on both sides of a step that is too
//! high and too steep for the vehicle. Two cells at most two cells apart are compared, so that a grade is no step.

use crate::sensor::sweep::Sweep;

use super::cells::{CELL_M, NOWHERE, SIDE};
use super::config::ReachConfig;

/// Lowest height over the ground of a return that is used, metres. Ours: lower ones are mirror images.
const LOWEST_M: f32 = -1.5;
/// The cells that a cell is compared with: half of those within two cells, because each pair is compared once.
const NEAR: [[isize; 2]; 10] = [[1, 0], [0, 1], [1, 1], [-1, 1], [2, 0], [0, 2], [2, 1], [1, 2], [-1, 2], [-2, 1]];
/// Heights of a cell without a return.
const EMPTY: [i16; 2] = [i16::MAX, i16::MIN];

/// Heights of the lowest and highest return from the ground of each cell.
#[derive(Clone)]
pub struct Steps {
    /// Millimetres, ego frame.
    spans: Vec<[i16; 2]>,
    /// Indices of the cells with a return.
    seen: Vec<u32>,
}

impl Steps {
    /// Cells without a return.
    pub fn new() -> Self {
        Self { spans: vec![EMPTY; SIDE * SIDE], seen: Vec::new() }
    }

    /// Calls `mark` with each cell beside a step. `cells` are the cells of the sweep's points.
    pub fn find(
        &mut self,
        sweep: &Sweep,
        heights_m: &[f32],
        cells: &[u32],
        config: &ReachConfig,
        mut mark: impl FnMut(usize),
    ) {
        self.sort_points(sweep, heights_m, cells, config);
        let least_mm = (config.step_m_max * 1000.0) as i32;
        let reaches = NEAR.map(|[dx, dy]| {
            let distance_m = CELL_M * ((dx * dx + dy * dy) as f32).sqrt();
            (dy * SIDE as isize + dx, least_mm.max((config.step_slope_min * distance_m * 1000.0) as i32))
        });
        // The outermost cells are compared with fewer others.
        let is_inside = |cell: usize| {
            let (ix, iy) = (cell % SIDE, cell / SIDE);
            (2..SIDE - 2).contains(&ix) && iy < SIDE - 2
        };
        for &cell in self.seen.iter().filter(|cell| is_inside(**cell as usize)) {
            let cell = cell as usize;
            let [low, high] = self.spans[cell].map(i32::from);
            if high - low >= least_mm {
                mark(cell);
            }
            for (offset, least_mm) in reaches {
                let other = cell.wrapping_add_signed(offset);
                let span = self.spans[other];
                let [other_low, other_high] = span.map(i32::from);
                if span != EMPTY && (high - other_low).max(other_high - low) >= least_mm {
                    mark(cell);
                    mark(other);
                }
            }
        }
    }

    /// Indices of the cells with a return from the ground.
    pub fn seen(&self) -> impl Iterator<Item = usize> {
        self.seen.iter().map(|cell| *cell as usize)
    }

    fn sort_points(&mut self, sweep: &Sweep, heights_m: &[f32], cells: &[u32], config: &ReachConfig) {
        for cell in self.seen.drain(..) {
            self.spans[cell as usize] = EMPTY;
        }
        for ((&cell, &z), &height) in cells.iter().zip(&sweep.z).zip(heights_m) {
            if height < config.obstacle_m_min && height > LOWEST_M && cell != NOWHERE {
                let span = &mut self.spans[cell as usize];
                if *span == EMPTY {
                    self.seen.push(cell);
                }
                // Ground is within 20 m of the vehicle's height; the cast saturates.
                let millimetres = (z * 1000.0) as i16;
                *span = [span[0].min(millimetres), span[1].max(millimetres)];
            }
        }
    }
}
