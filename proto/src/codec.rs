//! The cells of a channel to bytes and back.
//!
//! In: cells, row by row. Out: `Channel.payload` with its encoding, count and CRC. The way back, [`decode`], checks
//! what is claimed before it allocates anything.
//!
//! [`crate::rows`] predicts every row by the one before; [`crate::changes`] tells what differs from an earlier map or
//! from what cells of a class mostly are. A channel is sent as what is smallest; of equals, raw before rows before
//! changes. All are canonical: equal cells (and bases) have equal bytes.
//!
//! There is no general compression on top: over 348 recorded channels, runs of equal cells under zstd (level 3) take 7 %
//! less than rows, but 6 % more for classes, and changes take 20 to 39 % less again where rows would tell a channel by
//! class. That is not worth a library in every client, nor stored bytes that follow its version.

use std::borrow::Cow;

use bytes::Bytes;

use crate::rows::encode_rows;
use crate::v1;

pub use crate::decode::{DecodeError, Limits, decode};

/// Raw cell values, borrowed, in the order of the grid's cell index.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum CellsRef<'a> {
    /// 0 to 255.
    U8(&'a [u8]),
    /// -128 to 127.
    I8(&'a [i8]),
    /// 0 to 65535.
    U16(&'a [u16]),
}

/// Raw cell values, in the order of the grid's cell index.
#[derive(Clone, Debug, PartialEq)]
pub enum Cells {
    /// 0 to 255.
    U8(Vec<u8>),
    /// -128 to 127.
    I8(Vec<i8>),
    /// 0 to 65535.
    U16(Vec<u16>),
}

impl Cells {
    /// Borrows the values.
    pub fn as_ref(&self) -> CellsRef<'_> {
        match self {
            Self::U8(cells) => CellsRef::U8(cells),
            Self::I8(cells) => CellsRef::I8(cells),
            Self::U16(cells) => CellsRef::U16(cells),
        }
    }

    /// Number of cells.
    pub fn len(&self) -> usize {
        self.as_ref().len()
    }

    /// Whether there is no cell.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The raw value of one cell; `None` past the end.
    pub fn get(&self, index: usize) -> Option<i32> {
        match self {
            Self::U8(cells) => cells.get(index).map(|&v| i32::from(v)),
            Self::I8(cells) => cells.get(index).map(|&v| i32::from(v)),
            Self::U16(cells) => cells.get(index).map(|&v| i32::from(v)),
        }
    }
}

impl<'a> CellsRef<'a> {
    /// Number of cells.
    pub fn len(self) -> usize {
        match self {
            Self::U8(cells) => cells.len(),
            Self::I8(cells) => cells.len(),
            Self::U16(cells) => cells.len(),
        }
    }

    /// Whether there is no cell.
    pub fn is_empty(self) -> bool {
        self.len() == 0
    }

    /// The type on the wire.
    pub fn cell_type(self) -> v1::CellType {
        match self {
            Self::U8(_) => v1::CellType::U8,
            Self::I8(_) => v1::CellType::I8,
            Self::U16(_) => v1::CellType::U16,
        }
    }

    /// The cells as they lie in a raw payload: little-endian, one or two bytes a cell.
    pub fn to_le_bytes(self) -> Cow<'a, [u8]> {
        match self {
            Self::U8(cells) => Cow::Borrowed(cells),
            Self::I8(cells) => cells.iter().map(|&v| v as u8).collect::<Vec<u8>>().into(),
            Self::U16(cells) => cells.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>().into(),
        }
    }
}

/// The cells of one channel, encoded.
#[derive(Clone, Debug, PartialEq)]
pub struct Encoded {
    /// Of the cells.
    pub cell_type: v1::CellType,
    /// What was smallest.
    pub encoding: v1::Encoding,
    /// Number of cells.
    pub cell_count: u32,
    /// CRC-32 (IEEE) of the raw little-endian cells.
    pub crc32: u32,
    /// Never longer than the raw cells.
    pub payload: Bytes,
    /// [`v1::Channel::by_class`]; empty where the payload is not of changes from it.
    pub by_class: Bytes,
}

impl Encoded {
    /// The channel message: a cell's value in `unit` is `raw * scale`, and `unknown` is the raw value that means
    /// "nothing is known of this cell".
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

/// Encodes the cells of a grid with rows of `columns` cells: as rows, or raw where rows would not be smaller.
///
/// # Panics
/// With 2³² cells or more: no grid has them, and [`Limits`] refuses far fewer.
pub fn encode_grid(cells: CellsRef<'_>, columns: usize) -> Encoded {
    let columns = columns.max(1);
    let rows = match cells {
        CellsRef::U8(cells) => encode_rows(cells, columns),
        CellsRef::I8(cells) => encode_rows(cells, columns),
        CellsRef::U16(cells) => encode_rows(cells, columns),
    };
    let raw = cells.to_le_bytes();
    let crc32 = crc32fast::hash(&raw);
    let (encoding, payload) = match rows {
        Some(rows) => (v1::Encoding::Rows, Bytes::from(rows)),
        None => (v1::Encoding::Raw, Bytes::from(raw.into_owned())),
    };
    let cell_count = u32::try_from(cells.len()).expect("a grid has fewer than 2^32 cells");
    Encoded { cell_type: cells.cell_type(), encoding, cell_count, crc32, payload, by_class: Bytes::new() }
}

/// A cell as rows and changes write it.
pub(crate) trait Cell: Copy + Default + PartialEq {
    /// Of one, raw.
    const BYTES: usize;
    /// Small magnitudes to small numbers: signed values zigzag (0, -1, 1, -2 are 0, 1, 2, 3).
    fn to_wire(self) -> u16;
    /// The way back; `None` where there is no such cell.
    fn of_wire(value: u64) -> Option<Self>;
    /// From [`Cell::BYTES`] bytes.
    fn of_le_bytes(bytes: &[u8]) -> Self;
    /// Cells of this type.
    fn cells(cells: Vec<Self>) -> Cells;
    /// The way back; `None` for cells of another type.
    fn of_cells(cells: Cells) -> Option<Vec<Self>>;
}

macro_rules! cells {
    ($($cell:ty, $variant:ident, $to_wire:expr, $of_wire:expr;)*) => {$(
        impl Cell for $cell {
            const BYTES: usize = size_of::<$cell>();

            fn to_wire(self) -> u16 {
                $to_wire(self)
            }

            fn of_wire(value: u64) -> Option<Self> {
                value.try_into().ok().map($of_wire)
            }

            fn of_le_bytes(bytes: &[u8]) -> Self {
                let mut own = [0; size_of::<$cell>()];
                own.copy_from_slice(bytes);
                Self::from_le_bytes(own)
            }

            fn cells(cells: Vec<Self>) -> Cells {
                Cells::$variant(cells)
            }

            fn of_cells(cells: Cells) -> Option<Vec<Self>> {
                if let Cells::$variant(cells) = cells { Some(cells) } else { None }
            }
        }
    )*};
}

cells! {
    u8, U8, u16::from, |wire: u8| wire;
    i8, I8, |cell: i8| u16::from(((cell << 1) ^ (cell >> 7)) as u8), |wire: u8| (wire >> 1) as i8 ^ -((wire & 1) as i8);
    u16, U16, |cell| cell, |wire: u16| wire;
}
