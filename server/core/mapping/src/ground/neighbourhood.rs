//! Weighted means over the cells around each cell of the polar grid.
//!
//! In: a value and a weight by cell. Out: by cell the sum of weights and of weighted values over the 5 x 5 or 3 x 3
//! cells around it. The columns wrap. Rows are stored with copies of the columns beyond both ends, so that a whole row
//! is added to the sums at a time.

use crate::wide::{WideLoop, run_wide};

use super::polar::{COLUMNS, ROWS};

/// Number of copied columns at each end of a row.
const MARGIN: usize = 2;
const WIDTH: usize = COLUMNS + 2 * MARGIN;

/// Values with their weights, and the sums of one row.
#[derive(Clone)]
pub struct Neighbourhood {
    weights: Vec<f32>,
    weighted: Vec<f32>,
    /// By column: sum of the weights around a cell of the row.
    pub weight_sums: [f32; COLUMNS],
    /// By column: sum of the weighted values.
    pub value_sums: [f32; COLUMNS],
}

impl Default for Neighbourhood {
    fn default() -> Self {
        let zeros = vec![0.0; ROWS * WIDTH];
        Self { weights: zeros.clone(), weighted: zeros, weight_sums: [0.0; COLUMNS], value_sums: [0.0; COLUMNS] }
    }
}

impl Neighbourhood {
    /// Replaces the values. `cell(i)` gives value and weight of a cell; a value without weight must be finite.
    pub fn fill(&mut self, cell: impl Fn(usize) -> (f32, f32)) {
        for row in 0..ROWS {
            let (weights, weighted) =
                (&mut self.weights[row * WIDTH..][..WIDTH], &mut self.weighted[row * WIDTH..][..WIDTH]);
            for column in 0..COLUMNS {
                let (value, weight) = cell(row * COLUMNS + column);
                (weights[column + MARGIN], weighted[column + MARGIN]) = (weight, weight * value);
            }
            for list in [weights, weighted] {
                list.copy_within(COLUMNS..COLUMNS + MARGIN, 0);
                list.copy_within(MARGIN..2 * MARGIN, COLUMNS + MARGIN);
            }
        }
    }

    /// Sums the neighbourhoods of a row's cells. The weight of a neighbour is the product of `kernel` along the rows
    /// and along the columns; its middle belongs to the cell itself.
    pub fn sum_around<const N: usize>(&mut self, row: usize, kernel: [f32; N]) {
        run_wide(SumAround { cells: self, row, kernel });
    }
}

struct SumAround<'a, const N: usize> {
    cells: &'a mut Neighbourhood,
    row: usize,
    kernel: [f32; N],
}

impl<const N: usize> WideLoop for SumAround<'_, N> {
    #[inline(always)]
    fn run(self) {
        let Self { cells, row, kernel } = self;
        let reach = N / 2;
        cells.weight_sums.fill(0.0);
        cells.value_sums.fill(0.0);
        for near in row.saturating_sub(reach)..(row + reach + 1).min(ROWS) {
            for (offset, across) in kernel.into_iter().enumerate() {
                let factor = kernel[near + reach - row] * across;
                let first = near * WIDTH + MARGIN + offset - reach;
                let (weights, weighted) = (&cells.weights[first..][..COLUMNS], &cells.weighted[first..][..COLUMNS]);
                for column in 0..COLUMNS {
                    cells.weight_sums[column] += factor * weights[column];
                    cells.value_sums[column] += factor * weighted[column];
                }
            }
        }
    }
}
