//! The polar grid of the ground estimate, and the lowest returns of each of its cells.
//!
//! In: a sweep, ego frame, metres. Out: for each cell its three lowest returns and the height of its highest one. The
//! columns are azimuths about the ego origin. The rows are eight steps to a doubling of the squared range, so that a
//! row follows from the bits of a float without a root or a logarithm. A return is kept as one whole number, so that
//! the order of the points does not matter.

use std::f32::consts::TAU;

use crate::azimuth_columns::{AzimuthColumns, floor_to_whole};
use crate::sensor::sweep::Sweep;
use crate::vehicle_outline::Outline;
use crate::wide::{WideLoop, run_wide};

/// Number of columns: two degrees each. Ours: at 10 m a column is about as wide as a row is deep.
pub const COLUMNS: usize = AzimuthColumns::TWO_DEGREES as usize;
/// Number of rows: ten doublings of the squared range, from 2 to 64 m.
pub const ROWS: usize = 80;
/// Number of cells.
pub const CELLS: usize = ROWS * COLUMNS;
/// Range at which the first row begins, metres. Ours: nearer returns are the vehicle itself.
pub const RANGE_M_MIN: f32 = 2.0;
/// Range at which the last row ends, metres.
pub const RANGE_M_MAX: f32 = 64.0;

/// Bits of a squared range below the number of its row.
const ROW_SHIFT: u32 = 20;
/// Number of returns a cell keeps.
const KEPT: usize = 3;
/// Return of a cell without one.
const NONE: u32 = u32::MAX;
/// A cell without returns.
const EMPTY: PolarCell = PolarCell([NONE; KEPT + 1]);
/// Offset that makes each height positive, metres, plus half a millimetre for rounding.
const OFFSET_M: f32 = 32.0005;
/// Steps of a return's place within its cell, along the range and along the azimuth.
const PLACES: f32 = 256.0;
/// Number of points that are processed together. Ours: their intermediate values fit into the first-level cache.
const CHUNK: usize = 1024;

/// One return of a cell.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Return {
    /// Range, metres.
    pub range_m: f32,
    /// Height in the ego frame, metres.
    pub z_m: f32,
}

/// The returns that are kept of a cell: height in millimetres in the upper 16 bits, then the place within the cell
/// along the range and along the azimuth, 8 bits each. The lowest ones come first, ascending; then the complement of
/// the highest one.
#[derive(Clone, Copy)]
struct PolarCell([u32; KEPT + 1]);

impl PolarCell {
    /// It has no branches: which returns are kept cannot be predicted. Four numbers fill a register.
    #[inline(always)]
    fn add_return(&mut self, key: u32) {
        let [first, second, ..] = self.0;
        let (before, new) = ([0, first, second, 0], [key, key, key, !key]);
        self.0 = std::array::from_fn(|i| self.0[i].min(before[i].max(new[i])));
    }
}

/// The returns of each cell; index `row * COLUMNS + column`.
#[derive(Clone)]
pub struct PolarCells {
    azimuths: AzimuthColumns,
    outline: Outline,
    cells: Vec<PolarCell>,
    /// Row and column coordinate by point of the sweep.
    coordinates: [Vec<f32>; 2],
}

impl PolarCells {
    /// Cells without returns around a vehicle with this outline.
    pub fn new(outline: Outline) -> Self {
        let azimuths = AzimuthColumns::new(COLUMNS as u16);
        Self { azimuths, outline, cells: vec![EMPTY; CELLS], coordinates: Default::default() }
    }

    /// Replaces the returns by the returns of a sweep. A return far above or below the plane under the vehicle (a
    /// gradient of 30 % and 1.5 m) cannot be ground and is left out, and so are the returns of the vehicle itself.
    pub fn sort_points(&mut self, sweep: &Sweep) {
        self.cells.fill(EMPTY);
        self.coordinates.iter_mut().for_each(|axis| axis.resize(sweep.x.len(), 0.0));
        run_wide(SortPoints { cells: self, sweep });
    }

    /// Row and column coordinate of each point of the sweep; see [`coordinates`].
    pub fn point_coordinates(&self) -> [&[f32]; 2] {
        let [rows, turns] = &self.coordinates;
        [rows, turns]
    }

    /// The up to three lowest returns of a cell, lowest first.
    pub fn lowest(&self, cell: usize) -> impl Iterator<Item = Return> {
        let lowest = self.cells[cell].0.into_iter().take(KEPT).take_while(|key| *key != NONE);
        lowest.map(move |key| unpack(cell / COLUMNS, key))
    }

    /// True if the cell has a return.
    pub fn is_seen(&self, cell: usize) -> bool {
        self.cells[cell].0[0] != NONE
    }

    /// Height of the cell's highest return over its lowest one, metres; 0 without returns.
    pub fn span_m(&self, cell: usize) -> f32 {
        let PolarCell([lowest, .., highest]) = self.cells[cell];
        if lowest == NONE { 0.0 } else { ((!highest >> 16) as f32 - (lowest >> 16) as f32) * 1e-3 }
    }

    /// Coordinates of a position; see [`coordinates`].
    #[inline(always)]
    pub fn coordinates(&self, x: f32, y: f32) -> [f32; 2] {
        coordinates(&self.azimuths, x, y)
    }
}

/// Finds the coordinates of each point of a sweep, and adds its return to its cell.
struct SortPoints<'a> {
    cells: &'a mut PolarCells,
    sweep: &'a Sweep,
}

impl WideLoop for SortPoints<'_> {
    #[inline(always)]
    fn run(self) {
        let PolarCells { azimuths, outline, cells: returns, coordinates: [rows, turns] } = self.cells;
        let (mut cells, mut keys) = ([0_u32; CHUNK], [NONE; CHUNK]);
        let Sweep { x, y, z, .. } = self.sweep;
        let chunks = x.chunks(CHUNK).zip(y.chunks(CHUNK)).zip(z.chunks(CHUNK));
        for (((xs, ys), zs), (rows, turns)) in chunks.zip(rows.chunks_mut(CHUNK).zip(turns.chunks_mut(CHUNK))) {
            let n = xs.len().min(CHUNK);
            let (xs, ys, zs, rows, turns) = (&xs[..n], &ys[..n], &zs[..n], &mut rows[..n], &mut turns[..n]);
            // Without a branch or a table, so that the compiler vectorises both.
            for i in 0..n {
                [rows[i], turns[i]] = coordinates(azimuths, xs[i], ys[i]);
            }
            for i in 0..n {
                (cells[i], keys[i]) = cell_and_key(outline, [xs[i], ys[i], zs[i]], [rows[i], turns[i]]);
            }
            for (&cell, &key) in cells.iter().zip(&keys).take(n) {
                if key != NONE {
                    returns[cell as usize].add_return(key);
                }
            }
        }
    }
}

/// Cell and key of a point with these coordinates; [`NONE`] for a point that is left out.
#[inline(always)]
fn cell_and_key(outline: &Outline, [x, y, z]: [f32; 3], [row, turn]: [f32; 2]) -> (u32, u32) {
    let (least, most) = (RANGE_M_MIN * RANGE_M_MIN, RANGE_M_MAX * RANGE_M_MAX);
    let squared = x * x + y * y;
    // NaN fails every comparison.
    let inside = (squared >= least) & (squared < most) & (z * z <= 2.25 + 0.09 * squared);
    // The row of a return right before the end of the last row is rounded up.
    let inside = inside & (row < ROWS as f32) & !outline.contains(x, y);
    let (whole_row, column) = (floor_to_whole(row), floor_to_whole(turn));
    let along = floor_to_whole((row - whole_row as i32 as f32) * PLACES);
    let across = floor_to_whole((turn - column as i32 as f32) * (PLACES - 1.0));
    let height = floor_to_whole(((if inside { z } else { 0.0 }) + OFFSET_M) * 1000.0);
    (whole_row * COLUMNS as u32 + column, if inside { height << 16 | along << 8 | across } else { NONE })
}

/// Computes the coordinates of a position: rows outward from [`RANGE_M_MIN`], columns counter-clockwise, both with a
/// fraction. A nearer position has the row 0, a farther one [`ROWS`].
#[inline(always)]
fn coordinates(azimuths: &AzimuthColumns, x: f32, y: f32) -> [f32; 2] {
    let (least, most) = (RANGE_M_MIN * RANGE_M_MIN, RANGE_M_MAX * RANGE_M_MAX);
    let squared = x * x + y * y;
    let squared = if squared < most { squared } else { most };
    let squared = if squared > least { squared } else { least };
    // The bits of a float grow with its value; the difference fits into a signed number.
    let row = (squared.to_bits() - least.to_bits()) as i32 as f32 * (1.0 / (1_u32 << ROW_SHIFT) as f32);
    [row, azimuths.position(x, y)]
}

/// Index of the polar cell that contains a position; [`PolarIndex::at`] finds it once for a fixed position.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PolarIndex(u16);

impl PolarIndex {
    /// The cell that contains a position, ego frame, metres. Positions nearer than the first row belong to it.
    pub fn at(x: f32, y: f32) -> Self {
        let [row, column] = coordinates(&AzimuthColumns::new(COLUMNS as u16), x, y);
        let cell = floor_to_whole(row) as usize * COLUMNS + floor_to_whole(column) as usize;
        Self(cell.min(CELLS) as u16)
    }

    /// Index of the cell; `None` beyond the last row.
    pub fn index(self) -> Option<usize> {
        Some(usize::from(self.0)).filter(|index| *index < CELLS)
    }

    /// The value of the cell; `None` beyond the last row.
    #[inline(always)]
    pub fn of<T>(self, values: &[T]) -> Option<&T> {
        values.get(usize::from(self.0))
    }
}

/// The return that a key stands for.
fn unpack(row: usize, key: u32) -> Return {
    let steps = (row as u32) << ROW_SHIFT | (key >> 8 & 0xff) << (ROW_SHIFT - 8);
    let squared = f32::from_bits((RANGE_M_MIN * RANGE_M_MIN).to_bits() + steps + (1 << (ROW_SHIFT - 9)));
    Return { range_m: squared.sqrt(), z_m: (key >> 16) as f32 * 1e-3 - 32.0 }
}

/// Range at which a row begins, metres; [`RANGE_M_MAX`] for [`ROWS`].
pub fn row_start_m(row: usize) -> f32 {
    f32::from_bits((RANGE_M_MIN * RANGE_M_MIN).to_bits() + ((row as u32) << ROW_SHIFT)).sqrt()
}

/// Range of the middle of each row, metres.
pub fn row_middles_m() -> [f32; ROWS] {
    std::array::from_fn(|row| (row_start_m(row) + row_start_m(row + 1)) / 2.0)
}

/// Cosine and sine of the middle of each column, rotated by quarters from the first, so that a rotated world gives a
/// rotated ground to the bit.
pub fn column_directions() -> [[f32; 2]; COLUMNS] {
    const QUARTER: usize = COLUMNS / 4;
    std::array::from_fn(|column| {
        let (y, x) = libm::sincosf(((column % QUARTER) as f32 + 0.5) / COLUMNS as f32 * TAU);
        [[x, y], [-y, x], [-x, -y], [y, -x]][column / QUARTER]
    })
}

/// The column `beside` columns counter-clockwise of a column; clockwise if `beside` is negative.
#[inline(always)]
pub fn beside(column: usize, beside: isize) -> usize {
    (column + COLUMNS).wrapping_add_signed(beside) % COLUMNS
}

/// Marks each cell of `marked` and its eight neighbours, and no other cell.
pub fn mark_around(marked: &[bool], around: &mut [bool]) {
    for (row, around) in around.chunks_exact_mut(COLUMNS).enumerate() {
        let (mut in_column, rows) = ([false; COLUMNS], row.saturating_sub(1) * COLUMNS..(row + 2).min(ROWS) * COLUMNS);
        for marked in marked[rows].chunks_exact(COLUMNS) {
            in_column.iter_mut().zip(marked).for_each(|(any, marked)| *any |= marked);
        }
        for (column, around) in around.iter_mut().enumerate() {
            *around = [-1, 0, 1].into_iter().fold(false, |any, offset| any | in_column[beside(column, offset)]);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_cells_around_one_share_a_side_or_a_corner_with_it() {
        let mut around = vec![false; CELLS];
        for (row, column) in [(0, 0), (1, 7), (20, COLUMNS - 1), (ROWS - 1, 100)] {
            let mut marked = vec![false; CELLS];
            marked[row * COLUMNS + column] = true;
            mark_around(&marked, &mut around);
            for (cell, is_around) in around.iter().enumerate() {
                let (other_row, other) = (cell / COLUMNS, cell % COLUMNS);
                let expected = row.abs_diff(other_row) <= 1 && [0, 1, COLUMNS - 1].contains(&column.abs_diff(other));
                assert_eq!(*is_around, expected, "{row} {column}, {other_row} {other}");
            }
        }
    }

    #[test]
    fn returns_right_before_the_end_of_the_last_row_are_in_it_or_left_out() {
        let mut cells = PolarCells::new(Outline { width_m: 2.0, front_m: 3.0, rear_m: 2.0 });
        let mut sweep = Sweep { x: vec![-60.07333], y: vec![22.07249], ..Sweep::default() };
        for step in 0..3600 {
            let (sin, cos) = libm::sincosf(step as f32 * std::f32::consts::TAU / 3600.0);
            for range_m in [RANGE_M_MAX, RANGE_M_MAX.next_down(), RANGE_M_MAX.next_up()] {
                sweep.x.push(range_m * cos);
                sweep.y.push(range_m * sin);
            }
        }
        sweep.z.resize(sweep.x.len(), 0.0);
        cells.sort_points(&sweep);
        assert!((0..CELLS).all(|cell| !cells.is_seen(cell) || cell / COLUMNS == ROWS - 1));
    }
}
