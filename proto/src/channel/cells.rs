//! The raw cells of a channel, typed, in the order of the grid's cell index.

use std::borrow::Cow;

use crate::v1;

/// Raw cell values, borrowed, in the order of the grid's cell index.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum CellsRef<'a> {
    /// Values from 0 to 255.
    U8(&'a [u8]),
    /// Values from -128 to 127.
    I8(&'a [i8]),
    /// Values from 0 to 65,535.
    U16(&'a [u16]),
}

/// Raw cell values, in the order of the grid's cell index.
#[derive(Clone, Debug, PartialEq)]
pub enum Cells {
    /// Values from 0 to 255.
    U8(Vec<u8>),
    /// Values from -128 to 127.
    I8(Vec<i8>),
    /// Values from 0 to 65,535.
    U16(Vec<u16>),
}

impl Cells {
    /// Borrows the cells without a copy.
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

    /// True if there is no cell.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Raw value of one cell; `None` past the last cell.
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

    /// True if there is no cell.
    pub fn is_empty(self) -> bool {
        self.len() == 0
    }

    /// The type of the cells on the wire.
    pub fn cell_type(self) -> v1::CellType {
        match self {
            Self::U8(_) => v1::CellType::U8,
            Self::I8(_) => v1::CellType::I8,
            Self::U16(_) => v1::CellType::U16,
        }
    }

    /// The cells as a raw payload: little-endian, one or two bytes per cell.
    pub fn to_le_bytes(self) -> Cow<'a, [u8]> {
        match self {
            Self::U8(cells) => Cow::Borrowed(cells),
            Self::I8(cells) => cells.iter().map(|&v| v as u8).collect::<Vec<u8>>().into(),
            Self::U16(cells) => {
                let mut bytes = vec![0; 2 * cells.len()];
                bytes.as_chunks_mut().0.iter_mut().zip(cells).for_each(|(bytes, v)| *bytes = v.to_le_bytes());
                bytes.into()
            }
        }
    }
}

/// A raw cell value of one type.
pub(crate) trait Cell: Copy + Default + PartialEq {
    /// Bytes of one raw cell.
    const BYTES: usize;
    /// The value as a number of 0 or more: the value itself if unsigned; zigzag if signed (0, -1, 1, -2 are 0, 1, 2,
    /// 3).
    fn to_wire(self) -> u16;
    /// The inverse of [`Cell::to_wire`]; `None` if the type has no such value.
    fn from_wire(value: u64) -> Option<Self>;
    /// The value of [`Cell::BYTES`] little-endian bytes.
    fn from_le_bytes(bytes: &[u8]) -> Self;
    /// Wraps cells of this type.
    fn into_cells(cells: Vec<Self>) -> Cells;
    /// Unwraps cells of this type; `None` for cells of another type.
    fn from_cells(cells: Cells) -> Option<Vec<Self>>;
    /// Index of the first of eight cells that differs from the other one at its place; 8 if none does.
    fn first_difference(cells: &[Self; 8], others: &[Self; 8]) -> usize;
}

/// Length of the common prefix.
#[inline]
pub(crate) fn equal_prefix<T: Cell>(cells: &[T], others: &[T]) -> usize {
    let length = cells.len().min(others.len());
    let (cells, others) = (&cells[..length], &others[..length]);
    let mut at = 0;
    // Most prefixes are short, and most cells lie in long ones: these are compared in blocks, as vectors.
    if let (Some(here), Some(there)) = (cells.first_chunk::<8>(), others.first_chunk::<8>()) {
        let first = T::first_difference(here, there);
        if first < 8 {
            return first;
        }
        const BLOCK: usize = 32;
        let blocks = cells.as_chunks::<BLOCK>().0.iter().zip(others.as_chunks::<BLOCK>().0);
        at = BLOCK * blocks.take_while(|(cells, others)| cells == others).count();
        for (here, there) in cells[at..].as_chunks::<8>().0.iter().zip(others[at..].as_chunks::<8>().0) {
            let first = T::first_difference(here, there);
            at += first;
            if first < 8 {
                return at;
            }
        }
    }
    at + cells[at..].iter().zip(&others[at..]).take_while(|(cell, other)| cell == other).count()
}

macro_rules! cells {
    ($($cell:ty, $variant:ident, $to_wire:expr, $from_wire:expr, $first_difference:expr;)*) => {$(
        impl Cell for $cell {
            const BYTES: usize = size_of::<$cell>();

            fn to_wire(self) -> u16 {
                $to_wire(self)
            }

            fn from_wire(value: u64) -> Option<Self> {
                value.try_into().ok().map($from_wire)
            }

            fn from_le_bytes(bytes: &[u8]) -> Self {
                let mut own = [0; size_of::<$cell>()];
                own.copy_from_slice(bytes);
                <$cell>::from_le_bytes(own)
            }

            fn into_cells(cells: Vec<Self>) -> Cells {
                Cells::$variant(cells)
            }

            fn from_cells(cells: Cells) -> Option<Vec<Self>> {
                if let Cells::$variant(cells) = cells { Some(cells) } else { None }
            }

            #[inline(always)]
            fn first_difference(cells: &[Self; 8], others: &[Self; 8]) -> usize {
                $first_difference(cells, others)
            }
        }
    )*};
}

cells! {
    u8, U8, u16::from, |wire: u8| wire, first_different_byte;
    i8, I8, |cell: i8| u16::from(((cell << 1) ^ (cell >> 7)) as u8), |wire: u8| (wire >> 1) as i8 ^ -((wire & 1) as i8),
        |cells: &[i8; 8], others: &[i8; 8]| first_different_byte(&cells.map(|v| v as u8), &others.map(|v| v as u8));
    u16, U16, |cell| cell, |wire: u16| wire, |cells: &[u16; 8], others: &[u16; 8]| {
        let packed = |cells: &[u16; 8]| cells.iter().rev().fold(0_u128, |all, cell| all << 16 | u128::from(*cell));
        (packed(cells) ^ packed(others)).trailing_zeros() as usize / 16
    };
}

#[inline(always)]
fn first_different_byte(bytes: &[u8; 8], others: &[u8; 8]) -> usize {
    (u64::from_le_bytes(*bytes) ^ u64::from_le_bytes(*others)).trailing_zeros() as usize / 8
}
