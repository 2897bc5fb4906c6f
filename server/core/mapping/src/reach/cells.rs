//! The square cells of the reach stage.

use crate::azimuth_columns::floor_to_whole;

/// Side of a cell, metres. Ours: the cells of Seo 2014.
pub const CELL_M: f32 = 0.25;
/// Number of cells along a side: 64 m to each side, as far as the ground is estimated.
pub const SIDE: usize = 512;

/// Cell of a point beyond the grid.
pub const NOWHERE: u32 = u32::MAX;

/// Index of the cell that contains a position; [`NOWHERE`] beyond the grid.
#[inline(always)]
pub fn cell(x: f32, y: f32) -> u32 {
    let (ix, iy) = (x * (1.0 / CELL_M) + SIDE as f32 / 2.0, y * (1.0 / CELL_M) + SIDE as f32 / 2.0);
    let side = SIDE as f32;
    // NaN fails every comparison.
    let is_inside = (ix >= 0.0) & (ix < side) & (iy >= 0.0) & (iy < side);
    let [ix, iy] = [ix, iy].map(|index| floor_to_whole(if is_inside { index } else { 0.0 }));
    if is_inside { iy * SIDE as u32 + ix } else { NOWHERE }
}

/// Centre of a cell, ego frame, metres.
pub fn centre_m(cell: usize) -> [f32; 2] {
    [cell % SIDE, cell / SIDE].map(|index| (index as f32 + 0.5 - SIDE as f32 / 2.0) * CELL_M)
}
