//! A channel's payload back to its cells.
//!
//! In: a `Channel` from anywhere, hostile or not. Out: its cells, or what is wrong with it, by name and numbers.
//! Counts, canonical form and CRC are checked in a first pass that allocates nothing; the second makes the cells.

use crate::codec::{Cells, unzigzag};
use crate::rows::for_each_stretch;
use crate::v1;

/// What a decoder accepts before it allocates.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Limits {
    /// Cells of one channel. 4 Mi: a 400 m square at 0.2 m, with the cells in one or two bytes.
    pub channel_cells: u32,
    /// Cells of all channels of a map together; bounds what a small payload of long runs can claim.
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
    #[error("encoding {value}; 1 (raw), 2 (runs) and 3 (rows) exist")]
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
    /// Runs or rows that should have been sent raw.
    #[error("runs or rows of {length} bytes; they must be smaller than the {raw} bytes of the raw cells")]
    RunsNotSmaller {
        /// Bytes of the payload.
        length: usize,
        /// Bytes of the raw cells.
        raw: u64,
    },
    /// The payload ends inside a run.
    #[error("payload ends at byte {offset}, inside a run")]
    Truncated {
        /// Bytes of the payload.
        offset: usize,
    },
    /// A varint or number that is longer than its value needs, or than any value here.
    #[error("overlong number at byte {offset}")]
    OverlongVarint {
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
    /// Rows of no grid.
    #[error("rows of {columns} columns; 1 to {allowed} are allowed")]
    Columns {
        /// Claimed.
        columns: u64,
        /// As many as there are cells, and as the decoder holds.
        allowed: u64,
    },
    /// Two neighbouring runs with one value, or a run where a row would have been copied.
    #[error("the run at byte {offset} repeats the value before it or a row before ({value} on the wire)")]
    EqualNeighbours {
        /// Where the second starts.
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
    /// The runs end before the cells do.
    #[error("the runs sum to {cells} cells; {cell_count} are claimed")]
    TooFewCells {
        /// Sum of the run lengths.
        cells: u64,
        /// Claimed.
        cell_count: u32,
    },
    /// Bytes after the last run.
    #[error("{left} bytes follow the last run, which ends at byte {offset}")]
    TrailingBytes {
        /// Where the last run ends.
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
    /// The variant's name in the golden vectors, the same in every client language.
    pub fn name(&self) -> &'static str {
        match self {
            Self::TooManyCells { .. } => "too_many_cells",
            Self::CellType { .. } => "cell_type",
            Self::Encoding { .. } => "encoding",
            Self::RawLength { .. } => "raw_length",
            Self::RunsNotSmaller { .. } => "runs_not_smaller",
            Self::Truncated { .. } => "truncated",
            Self::OverlongVarint { .. } => "overlong_varint",
            Self::ValueTooLarge { .. } => "value_too_large",
            Self::EqualNeighbours { .. } => "equal_neighbours",
            Self::RunTooLong { .. } => "run_too_long",
            Self::Columns { .. } => "columns",
            Self::TooFewCells { .. } => "too_few_cells",
            Self::TrailingBytes { .. } => "trailing_bytes",
            Self::Crc { .. } => "crc",
        }
    }
}

/// Decodes the cells of a channel. Nothing is allocated until counts, canonical form and CRC are known to be right.
///
/// # Errors
/// [`DecodeError`], naming the first thing found wrong; a raw payload is accepted even where runs would be smaller.
pub fn decode(channel: &v1::Channel, limits: &Limits) -> Result<Cells, DecodeError> {
    let computed = check(channel, limits)?;
    if computed != channel.crc32 {
        return Err(DecodeError::Crc { stated: channel.crc32, computed });
    }
    make(channel)
}

/// Whether these are the cells that were encoded.
pub(crate) fn check_crc(channel: &v1::Channel, cells: &Cells) -> Result<(), DecodeError> {
    match crc32fast::hash(&cells.as_ref().to_le_bytes()) {
        computed if computed == channel.crc32 => Ok(()),
        computed => Err(DecodeError::Crc { stated: channel.crc32, computed }),
    }
}

/// Decodes what the payload holds, whatever the CRC says: that of differences is of the cells they lead to.
pub(crate) fn decode_differences(channel: &v1::Channel, limits: &Limits) -> Result<Cells, DecodeError> {
    check(channel, limits)?;
    make(channel)
}

/// Checks counts and canonical form, and gives the CRC of the cells without making them.
fn check(channel: &v1::Channel, limits: &Limits) -> Result<u32, DecodeError> {
    let cell_count = channel.cell_count;
    if cell_count > limits.channel_cells {
        return Err(DecodeError::TooManyCells { cell_count, allowed: limits.channel_cells });
    }
    let (width, value_max) = width_and_value_max(channel)?;
    let payload = &channel.payload[..];
    let raw_length = u64::from(cell_count) * width;
    let signed = channel.cell_type() == v1::CellType::I8;
    Ok(match v1::Encoding::try_from(channel.encoding) {
        Ok(v1::Encoding::Raw) => {
            if payload.len() as u64 != raw_length {
                return Err(DecodeError::RawLength { length: payload.len(), cell_count, expected: raw_length });
            }
            crc32fast::hash(payload)
        }
        Ok(v1::Encoding::Runs) => {
            if payload.len() as u64 >= raw_length {
                return Err(DecodeError::RunsNotSmaller { length: payload.len(), raw: raw_length });
            }
            crc_of_runs(payload, cell_count, value_max, signed)?
        }
        Ok(v1::Encoding::Rows) => {
            if payload.len() as u64 >= raw_length {
                return Err(DecodeError::RunsNotSmaller { length: payload.len(), raw: raw_length });
            }
            let mut crc = CrcOfCells::new(value_max, signed);
            for_each_stretch(payload, cell_count, value_max, |value, length| {
                crc.take(u64::from(value), length as u64)
            })?;
            crc.finish()
        }
        Ok(v1::Encoding::Unspecified) | Err(_) => return Err(DecodeError::Encoding { value: channel.encoding }),
    })
}

/// Bytes of a cell, and the largest value of one on the wire.
fn width_and_value_max(channel: &v1::Channel) -> Result<(u64, u64), DecodeError> {
    match v1::CellType::try_from(channel.cell_type) {
        Ok(v1::CellType::U8 | v1::CellType::I8) => Ok((1, 0xff)),
        Ok(v1::CellType::U16) => Ok((2, 0xffff)),
        Ok(v1::CellType::Unspecified) | Err(_) => Err(DecodeError::CellType { value: channel.cell_type }),
    }
}

/// The cells of a channel that is checked.
fn make(channel: &v1::Channel) -> Result<Cells, DecodeError> {
    let (_, value_max) = width_and_value_max(channel)?;
    let payload = &channel.payload[..];
    let raw = channel.encoding() == v1::Encoding::Raw;
    Ok(match channel.cell_type() {
        v1::CellType::U8 if raw => Cells::U8(payload.to_vec()),
        v1::CellType::U8 => Cells::U8(fill(channel, value_max, |value| value as u8)?),
        v1::CellType::I8 if raw => Cells::I8(payload.iter().map(|&v| v as i8).collect()),
        v1::CellType::I8 => Cells::I8(fill(channel, value_max, |value| unzigzag(value as u8))?),
        v1::CellType::U16 if raw => {
            Cells::U16(payload.as_chunks::<2>().0.iter().map(|&v| u16::from_le_bytes(v)).collect())
        }
        v1::CellType::U16 => Cells::U16(fill(channel, value_max, |value| value as u16)?),
        v1::CellType::Unspecified => return Err(DecodeError::CellType { value: channel.cell_type }),
    })
}

/// CRC of cells, from stretches of equal ones.
struct CrcOfCells {
    wide: bool,
    signed: bool,
    block: [u8; 1024],
    filled: usize,
    crc: crc32fast::Hasher,
}

impl CrcOfCells {
    fn new(value_max: u64, signed: bool) -> Self {
        Self { wide: value_max > 0xff, signed, block: [0; 1024], filled: 0, crc: crc32fast::Hasher::new() }
    }

    fn take(&mut self, value: u64, length: u64) {
        let bits = if self.signed { u16::from(unzigzag(value as u8) as u8) } else { value as u16 };
        let [low, high] = bits.to_le_bytes();
        let mut bytes = length as usize * if self.wide { 2 } else { 1 };
        while bytes > 0 {
            let taken = bytes.min(self.block.len() - self.filled);
            let part = &mut self.block[self.filled..self.filled + taken];
            if self.wide {
                part.as_chunks_mut::<2>().0.fill([low, high]);
            } else {
                part.fill(low);
            }
            self.filled += taken;
            bytes -= taken;
            if self.filled == self.block.len() {
                self.crc.update(&self.block);
                self.filled = 0;
            }
        }
    }

    fn finish(mut self) -> u32 {
        self.crc.update(&self.block[..self.filled]);
        self.crc.finalize()
    }
}

/// Checks every run and gives the CRC of the cells they stand for, without making them.
fn crc_of_runs(payload: &[u8], cell_count: u32, value_max: u64, signed: bool) -> Result<u32, DecodeError> {
    let mut crc = CrcOfCells::new(value_max, signed);
    let mut runs = Runs { payload, offset: 0, value_max };
    let mut cells = 0_u64;
    let mut previous = None;
    while cells < u64::from(cell_count) {
        let offset = runs.offset;
        let Some((value, length)) = runs.next()? else {
            return Err(DecodeError::TooFewCells { cells, cell_count });
        };
        if previous == Some(value) {
            return Err(DecodeError::EqualNeighbours { offset, value });
        }
        let left = u64::from(cell_count) - cells;
        if length > left {
            return Err(DecodeError::RunTooLong { offset, length, left });
        }
        previous = Some(value);
        cells += length;
        crc.take(value, length);
    }
    if runs.offset != payload.len() {
        return Err(DecodeError::TrailingBytes { offset: runs.offset, left: payload.len() - runs.offset });
    }
    Ok(crc.finish())
}

/// Makes the cells of runs or rows that the first pass has accepted.
fn fill<T: Clone>(channel: &v1::Channel, value_max: u64, cell: impl Fn(u64) -> T) -> Result<Vec<T>, DecodeError> {
    let payload = &channel.payload[..];
    let mut cells = Vec::with_capacity(channel.cell_count as usize);
    if channel.encoding() == v1::Encoding::Rows {
        for_each_stretch(payload, channel.cell_count, value_max, |value, length| {
            cells.resize(cells.len() + length, cell(u64::from(value)));
        })?;
        return Ok(cells);
    }
    let mut runs = Runs { payload, offset: 0, value_max };
    while let Some((value, length)) = runs.next()? {
        cells.resize(cells.len() + length as usize, cell(value));
    }
    Ok(cells)
}

/// Reads (value on the wire, length) one after the other.
struct Runs<'a> {
    payload: &'a [u8],
    offset: usize,
    value_max: u64,
}

impl Runs<'_> {
    fn next(&mut self) -> Result<Option<(u64, u64)>, DecodeError> {
        if self.offset == self.payload.len() {
            return Ok(None);
        }
        let offset = self.offset;
        let value = self.varint()?;
        if value > self.value_max {
            return Err(DecodeError::ValueTooLarge { offset, value, allowed: self.value_max });
        }
        Ok(Some((value, self.varint()? + 1)))
    }

    fn varint(&mut self) -> Result<u64, DecodeError> {
        let start = self.offset;
        let mut value = 0_u64;
        loop {
            let Some(&byte) = self.payload.get(self.offset) else {
                return Err(DecodeError::Truncated { offset: self.payload.len() });
            };
            let position = self.offset - start;
            // A last byte of zero adds nothing, and no value here needs a sixth.
            if position == 5 || (position > 0 && byte == 0) {
                return Err(DecodeError::OverlongVarint { offset: start });
            }
            self.offset += 1;
            value |= u64::from(byte & 0x7f) << (7 * position);
            if byte < 0x80 {
                return Ok(value);
            }
        }
    }
}
