//! Distance transform: exact Euclidean distances to the nearest cell that is not free, in whole numbers.
//!
//! In: a [`State`] for each cell. Out: for each cell the nearest cell that is not free (its site); for any position in
//! half cells the exact distance to the square of the nearest such cell. The algorithm is from Meijster, Roerdink and
//! Hesselink 2000: first along columns, then along rows as a lower envelope of parabolas; linear in the number of
//! cells.

use super::free_space::State;

/// Row or column of a site that does not exist.
const NONE: u16 = u16::MAX;

/// Distances over a grid of `side` cells along x and y, cell index = iy * side + ix.
#[derive(Clone, Debug, PartialEq)]
pub struct Distances {
    side: usize,
    /// Row of the nearest site in the same column; [`NONE`] if the column has none.
    row_of_site: Vec<u16>,
    /// Column of the nearest site of the grid; [`NONE`] if the grid has none.
    column_of_site: Vec<u16>,
    /// Envelope of one row: column of each parabola, and the first cell at which it is the lowest.
    envelope: Vec<(u16, u16)>,
}

impl Distances {
    /// Distances over a grid without sites.
    pub fn new(side: usize) -> Self {
        let none = vec![NONE; side * side];
        Self { side, row_of_site: none.clone(), column_of_site: none, envelope: Vec::new() }
    }

    /// Number of cells along x, and along y.
    pub fn side(&self) -> usize {
        self.side
    }

    /// Computes all distances.
    pub fn compute(&mut self, states: &[State]) {
        self.along_columns(states);
        for iy in 0..self.side {
            self.along_row(iy);
        }
    }

    fn along_columns(&mut self, states: &[State]) {
        let side = self.side;
        // Upwards: the nearest site at or below each cell.
        for iy in 0..side {
            let (before, here) = self.row_of_site.split_at_mut(iy * side);
            let here = &mut here[..side];
            let states = &states[iy * side..][..side];
            match iy {
                0 => here.fill(NONE),
                _ => here.copy_from_slice(&before[(iy - 1) * side..]),
            }
            for (row, state) in here.iter_mut().zip(states) {
                *row = if state.is_free() { *row } else { iy as u16 };
            }
        }
        // Downwards: the site above it, if that is nearer.
        for iy in (0..side.saturating_sub(1)).rev() {
            let (here, above) = self.row_of_site.split_at_mut((iy + 1) * side);
            for (row, &over) in here[iy * side..].iter_mut().zip(&above[..side]) {
                // NONE is farther than any row.
                let (under_by, over_by) = ((iy as u16).abs_diff(*row), over.abs_diff(iy as u16));
                *row = if over_by < under_by { over } else { *row };
            }
        }
    }

    /// A cell that is not free is its own site and is nearer than all sites beyond it, so that each run of free cells
    /// needs only the sites of its own columns and of the two cells beside it.
    fn along_row(&mut self, iy: usize) {
        let mut from = 0;
        for ix in 0..self.side {
            if usize::from(self.row_of_site[iy * self.side + ix]) == iy {
                self.along_run(iy, from, ix + 1);
                self.column_of_site[iy * self.side + ix] = ix as u16;
                from = ix;
            }
        }
        self.along_run(iy, from, self.side);
    }

    /// Finds the sites of the free cells among `from..end` of a row, from the sites of these columns.
    fn along_run(&mut self, iy: usize, from: usize, end: usize) {
        // Two cells that are not free lie side by side: no cell is between them.
        if end - from <= 2 && from > 0 && end < self.side {
            return;
        }
        let rows = &self.row_of_site[iy * self.side..][..self.side];
        let height_squared = |ix: u16| {
            let height = i32::from(rows[usize::from(ix)]) - iy as i32;
            height * height
        };
        let value = |at: u16, ix: u16| {
            let along = i32::from(at) - i32::from(ix);
            along * along + height_squared(ix)
        };
        self.envelope.clear();
        for ix in from as u16..end as u16 {
            if rows[usize::from(ix)] == NONE {
                continue;
            }
            // A parabola that is not lower at its first cell is nowhere the lowest.
            while self.envelope.last().is_some_and(|&(last, began)| value(began, last) > value(began, ix)) {
                self.envelope.pop();
            }
            match self.envelope.last() {
                None => self.envelope.push((ix, from as u16)),
                Some(&(last, _)) => {
                    let (u, i) = (i32::from(ix), i32::from(last));
                    let meets = (u * u - i * i + height_squared(ix) - height_squared(last)).div_euclid(2 * (u - i));
                    if meets + 1 < end as i32 {
                        self.envelope.push((ix, (meets + 1) as u16));
                    }
                }
            }
        }
        let columns = &mut self.column_of_site[iy * self.side..][..end];
        if self.envelope.is_empty() {
            columns[from..].fill(NONE);
        }
        let mut end = end;
        for &(ix, began) in self.envelope.iter().rev() {
            columns[usize::from(began)..end].fill(ix);
            end = usize::from(began);
        }
    }

    /// The nearest site to a cell, `[ix, iy]`; `None` if all cells are free.
    #[inline]
    pub fn site(&self, ix: usize, iy: usize) -> Option<[i32; 2]> {
        let row = iy * self.side;
        let column = self.column_of_site[row + ix];
        if column == NONE {
            return None;
        }
        Some([i32::from(column), i32::from(self.row_of_site[row + usize::from(column)])])
    }

    /// Squared distance from a position to the square of the nearest cell that is not free; `None` if all cells are
    /// free. Position and distance are in half cells; the centre of cell (ix, iy) is (2 ix, 2 iy). The position must
    /// lie within the grid.
    pub fn clearance_squared(&self, [hx, hy]: [i32; 2]) -> Option<i32> {
        let side = self.side as i32;
        let (row, between_rows) = ((hy / 2) as usize, hy % 2 == 1);
        let rows = &self.row_of_site[row * self.side..][..self.side];
        let above = between_rows.then(|| &self.row_of_site[(row + 1) * self.side..][..self.side]);
        // Distance up or down to the nearest square in a column.
        let height = |ix: i32| {
            let distance = |rows: &[u16], iy: usize| match rows[ix as usize] {
                NONE => None,
                site => Some(i32::from(site.abs_diff(iy as u16))),
            };
            match above {
                // If the column has a site, both rows have one.
                Some(above) => Some(2 * distance(rows, row)?.min(distance(above, row + 1)?)),
                None => Some((2 * distance(rows, row)? - 1).max(0)),
            }
        };
        let mut nearest = None::<i32>;
        let mut visit = |ix: i32| {
            let along = ((2 * ix - hx).abs() - 1).max(0);
            if nearest.is_some_and(|nearest| along * along >= nearest) {
                return false;
            }
            if let Some(height) = height(ix) {
                let squared = along * along + height * height;
                nearest = Some(nearest.map_or(squared, |nearest| nearest.min(squared)));
            }
            true
        };
        let middle = hx / 2;
        for ix in middle..side {
            if !visit(ix) {
                break;
            }
        }
        for ix in (0..middle).rev() {
            if !visit(ix) {
                break;
            }
        }
        nearest
    }
}
