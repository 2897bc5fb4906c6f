//! Why the cells of a channel are refused.

/// Why the cells of a channel were refused. An offset is a byte of the payload.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum DecodeError {
    /// The channel claims more cells than the reader accepts.
    #[error("{cell_count} cells; at most {allowed} are allowed")]
    TooManyCells {
        /// Number of cells in `Channel.cell_count`.
        cell_count: u32,
        /// Greatest number, [`crate::limits::Limits::channel_cells`].
        allowed: u32,
    },
    /// The cell type does not exist.
    #[error("cell type {value}; 1 (u8), 2 (i8) and 3 (u16) exist")]
    CellType {
        /// The value of `Channel.cell_type`.
        value: i32,
    },
    /// The encoding does not exist.
    #[error("encoding {value}; 1 (raw), 2 (rows) and 3 (changes) exist")]
    Encoding {
        /// The value of `Channel.encoding`.
        value: i32,
    },
    /// A raw payload has another length than its cells.
    #[error("raw payload of {length} bytes; {cell_count} cells have {expected}")]
    RawLength {
        /// Bytes of the payload.
        length: usize,
        /// Number of cells in `Channel.cell_count`.
        cell_count: u32,
        /// Bytes of so many cells.
        expected: u64,
    },
    /// A payload of rows or changes is not smaller than the raw cells.
    #[error("payload of {length} bytes; rows and changes must be smaller than the {raw} bytes of the raw cells")]
    NotSmaller {
        /// Bytes of the payload.
        length: usize,
        /// Bytes of the raw cells.
        raw: u64,
    },
    /// The payload holds changes, but there is no base: the layer is whole and the channel has no class table.
    #[error("changes without a base: the layer is whole, and by_class is empty")]
    NothingToChange,
    /// The payload ends before the last cell.
    #[error("payload ends at byte {offset}, before the last cell")]
    Truncated {
        /// Bytes of the payload.
        offset: usize,
    },
    /// A number has more bits than any number of the format.
    #[error("number at byte {offset} has more than {} bits", crate::limits::NUMBER_BITS_MAX)]
    Overlong {
        /// Where the number starts.
        offset: usize,
    },
    /// The cell type cannot hold a value.
    #[error("value {value} at byte {offset}; at most {allowed} on the wire for this cell type")]
    ValueTooLarge {
        /// Where the value starts.
        offset: usize,
        /// The value on the wire (zigzag if signed).
        value: u64,
        /// Largest value on the wire.
        allowed: u64,
    },
    /// The first cell refers to the cell before it.
    #[error("the first cell, at byte {offset}, repeats the cell before it; there is none")]
    NothingBefore {
        /// Where the cell starts.
        offset: usize,
    },
    /// The payload is not canonical: it writes a value that is predicted, or it splits a run.
    #[error("the value {value} on the wire, at byte {offset}, is redundant")]
    Repeated {
        /// Where the value starts.
        offset: usize,
        /// The value on the wire (zigzag if signed).
        value: u64,
    },
    /// A run is longer than the remaining cells.
    #[error("the run at byte {offset} has {length} cells; {left} are left")]
    RunTooLong {
        /// Where the run starts.
        offset: usize,
        /// Cells of the run.
        length: u64,
        /// Cells after the run before.
        left: u64,
    },
    /// Data follows the last cell.
    #[error("{left} bytes follow the last cell, which ends at byte {offset}")]
    TrailingBytes {
        /// Where the last cell ends.
        offset: usize,
        /// Bytes after the last cell.
        left: usize,
    },
    /// The decoded cells have another CRC than the channel states.
    #[error("CRC-32 of the cells is {computed:08x}; the channel states {stated:08x}")]
    Crc {
        /// The CRC-32 in `Channel.crc32`.
        stated: u32,
        /// CRC-32 of the decoded cells.
        computed: u32,
    },
}

impl DecodeError {
    /// Name of the error in the golden vectors, the same in every client language: `too_many_cells`, or `cells` for all
    /// others.
    pub fn name(&self) -> &'static str {
        if matches!(self, Self::TooManyCells { .. }) { "too_many_cells" } else { "cells" }
    }
}
