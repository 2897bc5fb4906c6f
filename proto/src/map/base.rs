//! The base of a delta: the base layer, and where each cell of the delta lies in it (`Layer.base_sequence` of
//! map.proto).
//!
//! The base of a cell is the base layer's cell at the same place: of the same row and column in a radial grid, of the
//! same number in a Cartesian grid, which may scroll by whole cells, grow and shrink. It is `unknown` if the base layer
//! has no such cell.

use crate::channel::cells::Cells;
use crate::map::base_error::BaseError;
use crate::map::error::MapError;
use crate::map::grid::Grid;
use crate::map::id::MapId;
use crate::map::layer::{Layer, Map};
use crate::v1;

/// The base layer of a layer of the map `id`; `None` for a whole layer.
pub(crate) fn base_of<'a>(layer: &v1::Layer, id: MapId, base: Option<&'a Map>) -> Result<Option<&'a Layer>, MapError> {
    let Some(base_sequence) = layer.base_sequence else { return Ok(None) };
    let name = || layer.name.clone();
    let base = base.ok_or_else(|| MapError::NoBase { layer: name(), base_sequence })?;
    let (needed, given) = (MapId { sequence: base_sequence, ..id }, MapId::of(&base.header));
    if needed != given {
        return Err(MapError::OtherBase { layer: name(), needed: Box::new(needed), given: Box::new(given) });
    }
    base.layer(&layer.name).map(Some).ok_or_else(|| MapError::NoBase { layer: name(), base_sequence })
}

/// Where the cells of a grid lie in the grid of its base layer.
pub(crate) struct Shift<'a> {
    base: &'a Layer,
    /// (rows, columns) of the base layer.
    from: [i128; 2],
    /// (rows, columns) of the grid.
    to: [i128; 2],
    /// Cell (row, column) of the grid is cell (row, column) + `by` of the base layer.
    by: [i128; 2],
}

impl<'a> Shift<'a> {
    /// Compares a grid with the grid of its base layer. Refuses grids whose cells are not comparable.
    pub(crate) fn new(base: &'a Layer, grid: &Grid) -> Result<Self, BaseError> {
        let by = match (&base.grid, grid) {
            (
                Grid::Radial { centre_m: centre_before, row_radius_m: before, columns: columns_before },
                Grid::Radial { centre_m: centre_now, row_radius_m: now, columns: columns_now },
            ) => {
                if before != now || columns_before != columns_now || centre_before != centre_now {
                    return Err(BaseError::Rings);
                }
                [0, 0]
            }
            (
                Grid::Cartesian { cell_m: before, first_ix: x_before, first_iy: y_before, .. },
                Grid::Cartesian { cell_m: now, first_ix: x_now, first_iy: y_now, .. },
            ) => {
                if before != now {
                    return Err(BaseError::CellEdge { cell_m: *now, base_cell_m: *before });
                }
                [(y_now, y_before), (x_now, x_before)].map(|(now, before)| i128::from(*now) - i128::from(*before))
            }
            _ => return Err(BaseError::Kind),
        };
        let shape = |grid: &Grid| <[u32; 2]>::from(grid.shape()).map(i128::from);
        Ok(Self { base, from: shape(&base.grid), to: shape(grid), by })
    }

    /// The base of a channel's cells.
    pub(crate) fn base_of(&self, channel: &v1::Channel) -> Result<Cells, BaseError> {
        let name = || channel.name.clone();
        let before = self.base.channel(&channel.name).ok_or_else(|| BaseError::NoChannel { channel: name() })?;
        let base_cell_type = before.cells.as_ref().cell_type().into();
        if channel.cell_type != base_cell_type {
            return Err(BaseError::CellType { channel: name(), cell_type: channel.cell_type, base_cell_type });
        }
        Ok(self.shift(&before.cells, channel.unknown))
    }

    /// Moves cells of the base layer to the places of the grid; `unknown` is the value of cells that the base does not
    /// have.
    pub(crate) fn shift(&self, base: &Cells, unknown: i32) -> Cells {
        match base {
            Cells::U8(base) => Cells::U8(self.shift_typed(base, unknown as u8)),
            Cells::I8(base) => Cells::I8(self.shift_typed(base, unknown as i8)),
            Cells::U16(base) => Cells::U16(self.shift_typed(base, unknown as u16)),
        }
    }

    fn shift_typed<T: Copy>(&self, base: &[T], unknown: T) -> Vec<T> {
        let [rows, columns] = self.to.map(|cells| cells as usize);
        let mut cells = vec![unknown; rows * columns];
        // Rows and columns of the grid that the base layer has too.
        let [shared_rows, shared_columns] = [0, 1].map(|i| {
            let start = (-self.by[i]).clamp(0, self.to[i]);
            start..(self.from[i] - self.by[i]).clamp(start, self.to[i])
        });
        let length = (shared_columns.end - shared_columns.start) as usize;
        if length > 0 {
            for row in shared_rows {
                let to = row as usize * columns + shared_columns.start as usize;
                let from = ((row + self.by[0]) * self.from[1] + shared_columns.start + self.by[1]) as usize;
                cells[to..to + length].copy_from_slice(&base[from..from + length]);
            }
        }
        cells
    }
}
