//! A layer as what changed since an earlier map: `Layer.base_sequence` of map.proto, made and taken apart.
//!
//! In: two whole layers, or a delta and the map it stands on. Out: the delta, or the cells it leads to.
//!
//! The base of a cell is what the cell of the same place was: in a radial grid the one of the same row and column, in a
//! Cartesian one the one of the same number, so that a grid may scroll by whole cells, grow and shrink; `unknown` where
//! there was none. Channels whose changes from that are no smaller are as in a whole layer. The CRC is of the cells that
//! come out, so what is put on a wrong base is refused and never a wrong cell.

use crate::changes::encode_changes;
use crate::codec::Cells;
use crate::decode::Limits;
use crate::grid::Grid;
use crate::legend::{encode_legend, is_same_legend};
use crate::map::{Layer, Map, MapError, MapId, decode_layer};
use crate::v1;
use prost::Message;

/// `new` as what has changed since `base`, a layer of the map `base_sequence` of the same vehicle and boot id; both
/// whole. The same layers make the same bytes.
///
/// `None` where `new` has to be sent whole: the grids or channels are not of one kind, a layer is not whole or not
/// within the limits, or the delta is not smaller.
pub fn encode_delta(base: &v1::Layer, base_sequence: u64, new: &v1::Layer, limits: &Limits) -> Option<v1::Layer> {
    let old = decode_layer(base.clone(), None, limits).ok()?;
    let decoded = decode_layer(new.clone(), None, limits).ok()?;
    if old.channels.len() != decoded.channels.len() {
        return None;
    }
    let shift = Shift::new(&old, &decoded.grid).ok()?;
    let columns = decoded.grid.shape().1 as usize;
    let mut delta = v1::Layer { base_sequence: Some(base_sequence), ..new.clone() };
    if is_same_legend(base, new) {
        encode_legend(&mut delta, []);
    }
    for (channel, now) in delta.channels.iter_mut().zip(&decoded.channels) {
        let before =
            old.channel(&now.name).filter(|before| (before.scale, before.unknown) == (now.scale, now.unknown))?;
        let changes = changes(shift.shifted(&before.cells, now.unknown), &now.cells, columns)?;
        if changes.len() < channel.payload.len() + channel.by_class.len() {
            (channel.encoding, channel.payload) = (v1::Encoding::Changes.into(), changes.into());
            channel.by_class.clear();
        }
    }
    let stands_on_base = delta.channels.iter().zip(&new.channels).any(|(channel, whole)| channel != whole);
    (stands_on_base && delta.encoded_len() < new.encoded_len()).then_some(delta)
}

/// `None` for cells of two types.
fn changes(base: Cells, cells: &Cells, columns: usize) -> Option<Vec<u8>> {
    Some(match (base, cells) {
        (Cells::U8(base), Cells::U8(cells)) => encode_changes(cells, base, columns),
        (Cells::I8(base), Cells::I8(cells)) => encode_changes(cells, base, columns),
        (Cells::U16(base), Cells::U16(cells)) => encode_changes(cells, base, columns),
        _ => return None,
    })
}

/// The layer of `base` that a layer of the map `id` stands on; `None` for a whole layer.
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

/// Where the cells of a grid lie in the grid of its base.
pub(crate) struct Shift<'a> {
    base: &'a Layer,
    /// (rows, columns) of the base.
    from: [i128; 2],
    /// (rows, columns) of the grid.
    to: [i128; 2],
    /// Cell (row, column) of the grid is cell (row, column) + `by` of the base.
    by: [i128; 2],
}

impl<'a> Shift<'a> {
    /// `Err` says why no cell of the base tells anything of a cell of the grid.
    pub(crate) fn new(base: &'a Layer, grid: &Grid) -> Result<Self, String> {
        let by = match (&base.grid, grid) {
            (
                Grid::Radial { row_radius_m: before, columns: columns_before },
                Grid::Radial { row_radius_m: now, columns: columns_now },
            ) => {
                if before != now || columns_before != columns_now {
                    return Err("other benches or columns than the base has".into());
                }
                [0, 0]
            }
            (
                Grid::Cartesian { cell_m: before, first_ix: x_before, first_iy: y_before, .. },
                Grid::Cartesian { cell_m: now, first_ix: x_now, first_iy: y_now, .. },
            ) => {
                if before != now {
                    return Err(format!("cells of {now} m; those of the base have {before} m"));
                }
                [(y_now, y_before), (x_now, x_before)].map(|(now, before)| i128::from(*now) - i128::from(*before))
            }
            _ => return Err("one grid is radial, the other Cartesian".into()),
        };
        let shape = |grid: &Grid| <[u32; 2]>::from(grid.shape()).map(i128::from);
        Ok(Self { base, from: shape(&base.grid), to: shape(grid), by })
    }

    /// What the changes of a channel change. `Err` says what the base has not.
    pub(crate) fn base_of(&self, channel: &v1::Channel) -> Result<Cells, String> {
        let name = &channel.name;
        let before = self.base.channel(name).ok_or_else(|| format!("channel {name:?} is not in the base"))?;
        let [here, there] = [channel.cell_type, before.cells.as_ref().cell_type().into()];
        if here != there {
            return Err(format!("channel {name:?} has cell type {here}; in the base {there}"));
        }
        Ok(self.shifted(&before.cells, channel.unknown))
    }

    fn shifted(&self, base: &Cells, unknown: i32) -> Cells {
        match base {
            Cells::U8(base) => Cells::U8(self.cells(base, unknown as u8)),
            Cells::I8(base) => Cells::I8(self.cells(base, unknown as i8)),
            Cells::U16(base) => Cells::U16(self.cells(base, unknown as u16)),
        }
    }

    fn cells<T: Copy>(&self, base: &[T], unknown: T) -> Vec<T> {
        let [rows, columns] = self.to.map(|cells| cells as usize);
        let mut cells = vec![unknown; rows * columns];
        // The rows and columns of the grid that the base has too.
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
