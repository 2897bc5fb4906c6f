//! A channel's payload back to its cells.
//!
//! In: a `Channel` from anywhere, hostile or not. Out: its cells, or what is wrong with it, by name and numbers. What it
//! claims is checked before any cell is made.

use crate::changes::decode_changes;
use crate::codec::{Cell, Cells};
use crate::rows::decode_rows;
use crate::v1;

/// What a decoder accepts before it allocates.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Limits {
    /// Cells of one channel. 4 Mi: a 400 m square at 0.2 m, with the cells in one or two bytes.
    pub channel_cells: u32,
    /// Cells of all channels of a map together; bounds what a small payload can claim.
    pub map_cells: u64,
    /// Bytes of one encoded map. 4 MiB: what gRPC receives by default; ours have under 64 KiB.
    pub map_bytes: usize,
    /// Layers, channels, planes, sensors and names of one map together. 64 Ki: as many planes as a map can have
    /// segments; a part takes some hundred bytes of memory.
    pub map_parts: usize,
}

impl Default for Limits {
    fn default() -> Self {
        Self { channel_cells: 4 << 20, map_cells: 16 << 20, map_bytes: 4 << 20, map_parts: 1 << 16 }
    }
}

/// Why the cells of a channel were refused.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum DecodeError {
    /// More cells claimed than the reader allows.
    #[error("{cell_count} cells; at most {allowed} are allowed")]
    TooManyCells {
        /// Claimed.
        cell_count: u32,
        /// [`Limits::channel_cells`].
        allowed: u32,
    },
    /// The cell type is none that exists.
    #[error("cell type {value}; 1 (u8), 2 (i8) and 3 (u16) exist")]
    CellType {
        /// On the wire.
        value: i32,
    },
    /// The encoding is none that exists.
    #[error("encoding {value}; 1 (raw), 2 (rows) and 3 (changes) exist")]
    Encoding {
        /// On the wire.
        value: i32,
    },
    /// A raw payload with the wrong length.
    #[error("raw payload of {length} bytes; {cell_count} cells take {expected}")]
    RawLength {
        /// Bytes of the payload.
        length: usize,
        /// Claimed.
        cell_count: u32,
        /// Bytes these cells take.
        expected: u64,
    },
    /// Rows or changes that should have been sent raw.
    #[error("payload of {length} bytes; rows and changes must be smaller than the {raw} bytes of the raw cells")]
    NotSmaller {
        /// Bytes of the payload.
        length: usize,
        /// Bytes of the raw cells.
        raw: u64,
    },
    /// Changes in a whole layer, of a channel that is not told by class.
    #[error("changes from nothing: the layer is whole, and by_class is empty")]
    NothingToChange,
    /// The payload ends before the cells do.
    #[error("payload ends at byte {offset}, inside the cells")]
    Truncated {
        /// Bytes of the payload.
        offset: usize,
    },
    /// A number that is longer than any here.
    #[error("overlong number at byte {offset}")]
    Overlong {
        /// Where it starts.
        offset: usize,
    },
    /// A value the cell type does not hold.
    #[error("value {value} at byte {offset}; at most {allowed} on the wire for this cell type")]
    ValueTooLarge {
        /// Where it starts.
        offset: usize,
        /// On the wire (zigzag where signed).
        value: u64,
        /// Largest on the wire.
        allowed: u64,
    },
    /// The first cell is said to be as the one before it.
    #[error("the first cell, at byte {offset}, is said to be as the one before it")]
    NothingBefore {
        /// Where it is said.
        offset: usize,
    },
    /// Not the canonical form: a value that the cell would have had without it, or a run that goes on in the next.
    #[error("the value {value} on the wire, at byte {offset}, need not be told")]
    Repeated {
        /// Where it starts.
        offset: usize,
        /// On the wire (zigzag where signed).
        value: u64,
    },
    /// A run longer than the cells that are left.
    #[error("the run at byte {offset} has {length} cells; {left} are left")]
    RunTooLong {
        /// Where it starts.
        offset: usize,
        /// Of the run.
        length: u64,
        /// Cells without a run so far.
        left: u64,
    },
    /// Bytes after the last cell.
    #[error("{left} bytes follow the last cell, which ends at byte {offset}")]
    TrailingBytes {
        /// Where the last cell ends.
        offset: usize,
        /// Bytes after it.
        left: usize,
    },
    /// The cells are not those that were encoded.
    #[error("CRC-32 of the cells is {computed:08x}; the channel says {stated:08x}")]
    Crc {
        /// In the channel.
        stated: u32,
        /// Of the cells.
        computed: u32,
    },
}

impl DecodeError {
    /// The name in the golden vectors, the same in every client language: but for too many, whatever is wrong with cells is "cells".
    pub fn name(&self) -> &'static str {
        if matches!(self, Self::TooManyCells { .. }) { "too_many_cells" } else { "cells" }
    }
}

/// Decodes the cells of a channel of a whole layer with rows of `columns` cells, not told by class. No more is
/// allocated than cells of a count within the limits take.
///
/// # Errors
/// [`DecodeError`], naming the first thing found wrong; a raw payload is accepted even where rows would be smaller.
pub fn decode(channel: &v1::Channel, columns: usize, limits: &Limits) -> Result<Cells, DecodeError> {
    check_count(channel, limits)?;
    decode_on(channel, columns, None)
}

/// Whether so many cells are accepted.
pub(crate) fn check_count(channel: &v1::Channel, limits: &Limits) -> Result<(), DecodeError> {
    let (cell_count, allowed) = (channel.cell_count, limits.channel_cells);
    if cell_count > allowed { Err(DecodeError::TooManyCells { cell_count, allowed }) } else { Ok(()) }
}

/// Decodes the cells of a channel whose count is checked; `base`, as many cells of its type: what changes change.
pub(crate) fn decode_on(channel: &v1::Channel, columns: usize, base: Option<Cells>) -> Result<Cells, DecodeError> {
    let cells = match v1::CellType::try_from(channel.cell_type) {
        Ok(v1::CellType::U8) => cells::<u8>(channel, columns.max(1), base)?,
        Ok(v1::CellType::I8) => cells::<i8>(channel, columns.max(1), base)?,
        Ok(v1::CellType::U16) => cells::<u16>(channel, columns.max(1), base)?,
        Ok(v1::CellType::Unspecified) | Err(_) => return Err(DecodeError::CellType { value: channel.cell_type }),
    };
    match crc32fast::hash(&cells.as_ref().to_le_bytes()) {
        computed if computed == channel.crc32 => Ok(cells),
        computed => Err(DecodeError::Crc { stated: channel.crc32, computed }),
    }
}

fn cells<T: Cell>(channel: &v1::Channel, columns: usize, base: Option<Cells>) -> Result<Cells, DecodeError> {
    let (payload, cell_count) = (&channel.payload[..], channel.cell_count);
    let (length, raw) = (payload.len(), u64::from(cell_count) * T::BYTES as u64);
    let encoding = v1::Encoding::try_from(channel.encoding).unwrap_or_default();
    if encoding == v1::Encoding::Raw && length as u64 != raw {
        return Err(DecodeError::RawLength { length, cell_count, expected: raw });
    }
    if matches!(encoding, v1::Encoding::Rows | v1::Encoding::Changes) && length as u64 >= raw {
        return Err(DecodeError::NotSmaller { length, raw });
    }
    Ok(T::cells(match encoding {
        v1::Encoding::Raw => payload.chunks_exact(T::BYTES).map(T::of_le_bytes).collect(),
        v1::Encoding::Rows => decode_rows(payload, cell_count as usize, columns)?,
        v1::Encoding::Changes => {
            let base = base.and_then(T::of_cells).ok_or(DecodeError::NothingToChange)?;
            decode_changes(payload, base, columns)?
        }
        v1::Encoding::Unspecified => return Err(DecodeError::Encoding { value: channel.encoding }),
    }))
}
