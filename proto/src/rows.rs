//! Cells as rows predicted by the rows before: `ENCODING_ROWS` of map.proto.
//!
//! In: little-endian cells and the columns of their grid. Out: columns, then bits: how many cells are equal to those a
//! row before, then a run of another value, and so on. Maps are patches, so most of a row is the row before it. The way
//! back holds no more than one row until the CRC is known to be right.

use crate::codec::{cell_bits, put_varint, run_end};
use crate::decode::DecodeError;

/// Bounds the row that a decoder holds.
pub(crate) const COLUMNS_MAX: usize = 1 << 14;

/// Rows of `W`-byte little-endian cells; `None` where they are not smaller than the cells themselves.
pub(crate) fn encode_rows<const W: usize>(
    raw: &[u8],
    columns: usize,
    wire_value: impl Fn(u16) -> u64,
) -> Option<Vec<u8>> {
    let mut bits = BitWriter { bytes: Vec::with_capacity((raw.len() / 16).max(16)), held: 0, count: 0 };
    put_varint(&mut bits.bytes, columns as u64);
    let mut at = 0;
    loop {
        let end = copy_end::<W>(raw, columns * W, at);
        bits.number(((end - at) / W) as u64);
        if end == raw.len() || bits.bytes.len() >= raw.len() {
            break;
        }
        let value = cell_bits::<W>(raw, end);
        if end > 0 && value == cell_bits::<W>(raw, end - W) {
            bits.put(1, 1);
        } else {
            bits.put(0, 1);
            bits.number(wire_value(value));
        }
        at = run_end::<W>(raw, end);
        bits.number(((at - end) / W - 1) as u64);
        if at == raw.len() {
            break;
        }
    }
    let rows = bits.finish();
    (rows.len() < raw.len()).then_some(rows)
}

/// Where the cells from `start` on differ from those a row before; before the first row all cells are 0.
fn copy_end<const W: usize>(raw: &[u8], row: usize, start: usize) -> usize {
    let mut at = start;
    while at < row.min(raw.len()) {
        if cell_bits::<W>(raw, at) != 0 {
            return at;
        }
        at += W;
    }
    let (here, above) = (&raw[at..], &raw[at - row..]);
    for (here, above) in here.as_chunks::<8>().0.iter().zip(above.as_chunks::<8>().0) {
        let differing = u64::from_le_bytes(*here) ^ u64::from_le_bytes(*above);
        if differing != 0 {
            return at + differing.trailing_zeros() as usize / 8 / W * W;
        }
        at += 8;
    }
    while at < raw.len() && raw[at..at + W] == raw[at - row..at - row + W] {
        at += W;
    }
    at
}

/// Most significant bit first.
struct BitWriter {
    bytes: Vec<u8>,
    /// The last `count` bits are not written yet; always fewer than 8.
    held: u64,
    count: u32,
}

impl BitWriter {
    fn put(&mut self, bits: u64, count: u32) {
        self.held = self.held << count | bits;
        self.count += count;
        while self.count >= 8 {
            self.count -= 8;
            self.bytes.push((self.held >> self.count) as u8);
        }
    }

    /// Exp-Golomb code of a number under 2³².
    fn number(&mut self, number: u64) {
        let more = (number + 1).ilog2();
        self.put(0, more);
        self.put(number + 1, more + 1);
    }

    fn finish(mut self) -> Vec<u8> {
        let free = (8 - self.count) % 8;
        self.put(0, free);
        self.bytes
    }
}

/// Calls `take(value on the wire, length)` for stretches of equal cells, in order, and checks all there is to check but
/// the CRC: counts, canonical form, range, no trailing byte.
pub(crate) fn for_each_stretch(
    payload: &[u8],
    cell_count: u32,
    value_max: u64,
    mut take: impl FnMut(u16, usize),
) -> Result<(), DecodeError> {
    let mut bits = BitReader::new(payload)?;
    let columns = bits.columns;
    let count = cell_count as usize;
    if !(1..=COLUMNS_MAX.min(count)).contains(&columns) {
        return Err(DecodeError::Columns { columns: columns as u64, allowed: COLUMNS_MAX.min(count) as u64 });
    }
    // The last `columns` cells, cell i at i % columns.
    let mut row = vec![0_u16; columns];
    let (mut cells, mut left, mut run) = (0, None, None);
    while cells < count {
        let offset = bits.offset();
        let copied = bits.number()?;
        let fits = |length: u64| {
            let left = (count - cells) as u64;
            if length <= left { Ok(length as usize) } else { Err(DecodeError::RunTooLong { offset, length, left }) }
        };
        let end = cells + fits(copied)?;
        // A run goes on as long as its value does.
        if cells < end && run == Some(row[cells % columns]) {
            return Err(DecodeError::EqualNeighbours { offset, value: u64::from(row[cells % columns]) });
        }
        while cells < end {
            // Up to the end of the row, in stretches of equal cells.
            let value = row[cells % columns];
            let rest = &row[cells % columns..columns.min(cells % columns + end - cells)];
            let length = rest.iter().position(|cell| *cell != value).unwrap_or(rest.len());
            take(value, length);
            cells += length;
            left = Some(value);
        }
        if cells == count {
            break;
        }
        let offset = bits.offset();
        let same = bits.bit()?;
        let value = if same { left.map_or(u64::MAX, u64::from) } else { bits.number()? };
        if value > value_max {
            return Err(DecodeError::ValueTooLarge { offset, value, allowed: value_max });
        }
        let value = value as u16;
        // As above it would have been copied; as before it would have been said so, or been part of the run.
        if value == row[cells % columns] || (!same && left == Some(value)) || run_goes_on(copied, run, value) {
            return Err(DecodeError::EqualNeighbours { offset, value: u64::from(value) });
        }
        let offset = bits.offset();
        let length = bits.number()? + 1;
        let free = (count - cells) as u64;
        if length > free {
            return Err(DecodeError::RunTooLong { offset, length, left: free });
        }
        let length = length as usize;
        take(value, length);
        (cells..cells + length.min(columns)).for_each(|cell| row[cell % columns] = value);
        cells += length;
        (left, run) = (Some(value), Some(value));
    }
    bits.finish()
}

fn run_goes_on(copied: u64, run: Option<u16>, value: u16) -> bool {
    copied == 0 && run == Some(value)
}

struct BitReader<'a> {
    payload: &'a [u8],
    columns: usize,
    /// Next bit.
    at: usize,
}

impl<'a> BitReader<'a> {
    fn new(payload: &'a [u8]) -> Result<Self, DecodeError> {
        let (mut columns, mut at) = (0_usize, 0);
        loop {
            let Some(&byte) = payload.get(at) else {
                return Err(DecodeError::Truncated { offset: payload.len() });
            };
            if at == 4 || (at > 0 && byte == 0) {
                return Err(DecodeError::OverlongVarint { offset: 0 });
            }
            columns |= usize::from(byte & 0x7f) << (7 * at);
            at += 1;
            if byte < 0x80 {
                return Ok(Self { payload, columns, at: 8 * at });
            }
        }
    }

    /// Of the byte that holds the next bit.
    fn offset(&self) -> usize {
        self.at / 8
    }

    fn bit(&mut self) -> Result<bool, DecodeError> {
        let byte = self.payload.get(self.at / 8).ok_or(DecodeError::Truncated { offset: self.payload.len() })?;
        let bit = byte >> (7 - self.at % 8) & 1 != 0;
        self.at += 1;
        Ok(bit)
    }

    fn number(&mut self) -> Result<u64, DecodeError> {
        let offset = self.offset();
        let mut more = 0;
        while !self.bit()? {
            more += 1;
            // No number here has more than 32 bits.
            if more > 32 {
                return Err(DecodeError::OverlongVarint { offset });
            }
        }
        let mut number = 1;
        for _ in 0..more {
            number = number << 1 | u64::from(self.bit()?);
        }
        Ok(number - 1)
    }

    /// Nothing but zeros to the end of the byte, and no other byte.
    fn finish(mut self) -> Result<(), DecodeError> {
        let offset = self.at.div_ceil(8);
        while !self.at.is_multiple_of(8) {
            if self.bit()? {
                return Err(DecodeError::TrailingBytes { offset: offset - 1, left: 1 });
            }
        }
        match self.payload.len() - offset {
            0 => Ok(()),
            left => Err(DecodeError::TrailingBytes { offset, left }),
        }
    }
}
