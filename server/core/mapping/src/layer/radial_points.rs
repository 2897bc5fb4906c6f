//! The radial cell of each point of a sweep, found once for all layers whose grids are equal.
//!
//! In: a sweep, ego frame, metres, and which grid. Out: the grid and by point its cell.

use super::radial_grid::RadialGrid;
use crate::sensor::sweep::Sweep;

/// What tells apart the radial grids of the layers of one map; their rows follow from the same sensor.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct RadialSize {
    /// Outer radius of the last row, metres.
    pub range_m_max: f32,
    /// Number of columns.
    pub columns: u16,
}

/// A radial grid, and the cells of a sweep's points in it.
#[derive(Clone, Debug, Default)]
pub struct RadialPoints {
    size: RadialSize,
    grid: RadialGrid,
    cell_of_point: Vec<u32>,
}

impl RadialPoints {
    /// No points yet.
    pub fn new(size: RadialSize) -> Self {
        Self { size, ..Self::default() }
    }

    /// The size that was asked for.
    pub fn size(&self) -> RadialSize {
        self.size
    }

    /// Replaces the points by the points of a sweep. `azimuths`: see [`RadialGrid::for_each_chunk`].
    pub fn find(&mut self, sweep: &Sweep, azimuths: Option<&[f32]>) {
        self.grid.update_rows(sweep, self.size.range_m_max, self.size.columns);
        self.cell_of_point.clear();
        let cell_of_point = &mut self.cell_of_point;
        self.grid.for_each_chunk(sweep, azimuths, |_, cells| cell_of_point.extend_from_slice(cells));
    }

    /// The grid.
    pub fn grid(&self) -> &RadialGrid {
        &self.grid
    }

    /// By point of the sweep: its cell; the cell of a point beyond the last row is at least the number of cells, and
    /// less than one row more.
    pub fn cells(&self) -> &[u32] {
        &self.cell_of_point
    }
}
