//! The cells of a channel <-> a `Channel` message.
//!
//! In: cells, row by row. Out: `Channel.payload` with its encoding, count and CRC; and back. [`decode`] accepts a
//! channel from any source, also a hostile one: it checks what the channel claims before it allocates memory for the
//! cells.
//!
//! A channel is sent in the smallest encoding; of equal sizes, raw precedes rows, and rows precede changes. All
//! encodings are canonical: equal cells (and bases) give equal bytes.
//!
//! There is no general compression on top. Measured over 348 recorded channels: runs of equal cells compressed with
//! zstd (level 3) need 7 % less than rows, but 6 % more for classes, and changes need 20 to 39 % less than rows where
//! rows would encode a channel with a class table. That gain is not worth a library in every client, nor stored bytes
//! that depend on its version.

use bytes::Bytes;

use crate::channel::cells::Cell;
use crate::channel::changes::decode_changes;
use crate::channel::rows::{decode_rows, encode_rows};
use crate::v1;

pub use crate::channel::cells::{Cells, CellsRef};
pub use crate::channel::error::DecodeError;
pub use crate::limits::Limits;

/// The cells of one channel, encoded.
#[derive(Clone, Debug, PartialEq)]
pub struct Encoded {
    /// Type of the cells.
    pub cell_type: v1::CellType,
    /// Encoding of the payload.
    pub encoding: v1::Encoding,
    /// Number of cells.
    pub cell_count: u32,
    /// CRC-32 (IEEE) of the raw little-endian cells.
    pub crc32: u32,
    /// The encoded cells; never longer than the raw cells.
    pub payload: Bytes,
    /// Class table ([`v1::Channel::by_class`]); empty if the payload does not hold changes from it.
    pub by_class: Bytes,
}

impl Encoded {
    /// The channel message. A cell's value in `unit` is `raw * scale`; `unknown` is the raw value of an unknown cell.
    pub fn into_channel(self, name: &str, unit: &str, scale: f32, unknown: i32) -> v1::Channel {
        v1::Channel {
            name: name.into(),
            unit: unit.into(),
            scale,
            cell_type: self.cell_type.into(),
            unknown,
            encoding: self.encoding.into(),
            cell_count: self.cell_count,
            crc32: self.crc32,
            payload: self.payload,
            by_class: self.by_class,
        }
    }
}

/// Encodes the cells of a grid with rows of `columns` cells: as rows, or raw if rows would not be smaller.
///
/// # Panics
/// If there are 2³² cells or more. No grid has so many, and [`Limits`] refuses far fewer.
pub fn encode_grid(cells: CellsRef<'_>, columns: usize) -> Encoded {
    encode_smallest(cells, columns, None)
}

/// Encodes the cells of a grid with rows of `columns` cells in the smallest encoding; `changes` are a class table and
/// the changes from it.
pub(crate) fn encode_smallest(cells: CellsRef<'_>, columns: usize, changes: Option<(Bytes, Vec<u8>)>) -> Encoded {
    let columns = columns.max(1);
    let raw = cells.to_le_bytes();
    let changes_length = changes.as_ref().map_or(usize::MAX, |(by_class, changes)| by_class.len() + changes.len());
    // Of equal lengths, raw precedes rows, and rows precede changes.
    let length_max = raw.len().min(changes_length.saturating_add(1));
    let rows = match cells {
        CellsRef::U8(cells) => encode_rows(cells, columns, length_max),
        CellsRef::I8(cells) => encode_rows(cells, columns, length_max),
        CellsRef::U16(cells) => encode_rows(cells, columns, length_max),
    };
    let crc32 = crc32fast::hash(&raw);
    let (encoding, payload, by_class) = match (rows, changes) {
        (Some(rows), _) => (v1::Encoding::Rows, Bytes::from(rows), Bytes::new()),
        (None, Some((by_class, changes))) if changes_length < raw.len() => {
            (v1::Encoding::Changes, Bytes::from(changes), by_class)
        }
        (None, _) => (v1::Encoding::Raw, Bytes::from(raw.into_owned()), Bytes::new()),
    };
    let cell_count = u32::try_from(cells.len()).expect("a grid has fewer than 2^32 cells");
    Encoded { cell_type: cells.cell_type(), encoding, cell_count, crc32, payload, by_class }
}

/// Decodes the cells of a channel of a whole layer, with rows of `columns` cells and without a class table. It
/// allocates at most what the cells need, and only if their number is within the limits.
///
/// # Errors
/// Names the first fault found: [`DecodeError::TooManyCells`] if the count is over the limit,
/// [`DecodeError::NothingToChange`] if the payload holds changes, [`DecodeError::Crc`] if the cells differ from the
/// encoded cells, and the other variants if the payload is malformed or not canonical. A raw payload is accepted even
/// if rows would be smaller.
pub fn decode(channel: &v1::Channel, columns: usize, limits: &Limits) -> Result<Cells, DecodeError> {
    check_count(channel, limits)?;
    decode_on(channel, columns, None)
}

/// Checks that the number of cells is within the limits.
pub(crate) fn check_count(channel: &v1::Channel, limits: &Limits) -> Result<(), DecodeError> {
    let (cell_count, allowed) = (channel.cell_count, limits.channel_cells);
    if cell_count > allowed { Err(DecodeError::TooManyCells { cell_count, allowed }) } else { Ok(()) }
}

/// Decodes the cells of a channel whose count is checked. `base`: as many cells of the same type, for changes.
pub(crate) fn decode_on(channel: &v1::Channel, columns: usize, base: Option<Cells>) -> Result<Cells, DecodeError> {
    let cells = match v1::CellType::try_from(channel.cell_type) {
        Ok(v1::CellType::U8) => decode_cells::<u8>(channel, columns.max(1), base)?,
        Ok(v1::CellType::I8) => decode_cells::<i8>(channel, columns.max(1), base)?,
        Ok(v1::CellType::U16) => decode_cells::<u16>(channel, columns.max(1), base)?,
        Ok(v1::CellType::Unspecified) | Err(_) => return Err(DecodeError::CellType { value: channel.cell_type }),
    };
    match crc32fast::hash(&cells.as_ref().to_le_bytes()) {
        computed if computed == channel.crc32 => Ok(cells),
        computed => Err(DecodeError::Crc { stated: channel.crc32, computed }),
    }
}

fn decode_cells<T: Cell>(channel: &v1::Channel, columns: usize, base: Option<Cells>) -> Result<Cells, DecodeError> {
    let (payload, cell_count) = (&channel.payload[..], channel.cell_count);
    let (length, raw) = (payload.len(), u64::from(cell_count) * T::BYTES as u64);
    let encoding = v1::Encoding::try_from(channel.encoding).unwrap_or_default();
    if encoding == v1::Encoding::Raw && length as u64 != raw {
        return Err(DecodeError::RawLength { length, cell_count, expected: raw });
    }
    if matches!(encoding, v1::Encoding::Rows | v1::Encoding::Changes) && length as u64 >= raw {
        return Err(DecodeError::NotSmaller { length, raw });
    }
    Ok(T::into_cells(match encoding {
        v1::Encoding::Raw => payload.chunks_exact(T::BYTES).map(T::from_le_bytes).collect(),
        v1::Encoding::Rows => decode_rows(payload, cell_count as usize, columns)?,
        v1::Encoding::Changes => {
            let base = base.and_then(T::from_cells).ok_or(DecodeError::NothingToChange)?;
            decode_changes(payload, base, columns)?
        }
        v1::Encoding::Unspecified => return Err(DecodeError::Encoding { value: channel.encoding }),
    }))
}
