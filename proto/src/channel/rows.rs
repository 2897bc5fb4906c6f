//! Cells <-> bits, each row predicted by the row before: `ENCODING_ROWS` of map.proto.
//!
//! In: cells and the number of columns of their grid. Out: bits that alternate copies (cells equal to the row before)
//! and runs (cells of one other value). A map consists of patches, so most of a row equals the row before it.

use crate::channel::bits::{BitReader, BitWriter};
use crate::channel::cells::{Cell, equal_prefix};
use crate::channel::error::DecodeError;

/// Encodes cells in rows of `columns`; `None` if the result does not have fewer bytes than `length_max`.
pub(crate) fn encode_rows<T: Cell>(cells: &[T], columns: usize, length_max: usize) -> Option<Vec<u8>> {
    let mut bits = BitWriter::with_capacity((cells.len() * T::BYTES / 16).max(16));
    let mut at = 0;
    loop {
        let end = copy_end(cells, columns, at);
        bits.write_number((end - at) as u64);
        if end == cells.len() || bits.len() >= length_max {
            break;
        }
        let repeats_before = end > 0 && cells[end] == cells[end - 1];
        bits.write_bit(repeats_before);
        if !repeats_before {
            bits.write_number(cells[end].to_wire().into());
        }
        at = end + 1 + equal_prefix(&cells[end + 1..], &cells[end..]);
        bits.write_number((at - end - 1) as u64);
        if at == cells.len() {
            break;
        }
    }
    let rows = bits.finish();
    (rows.len() < length_max).then_some(rows)
}

/// Index of the first cell from `start` on that differs from the cell one row before. The row before the first is
/// zeros.
fn copy_end<T: Cell>(cells: &[T], columns: usize, start: usize) -> usize {
    let first = &cells[..columns.min(cells.len())];
    let zeros = first.iter().skip(start).take_while(|cell| **cell == T::default()).count();
    let at = start + zeros;
    if at < first.len() { at } else { at + equal_prefix(&cells[at..], &cells[at - columns.min(at)..]) }
}

/// Decodes `count` cells in rows of `columns`. Refuses a payload that [`encode_rows`] would not write. The lengths are
/// checked before memory for the cells is allocated.
pub(crate) fn decode_rows<T: Cell>(payload: &[u8], count: usize, columns: usize) -> Result<Vec<T>, DecodeError> {
    check_lengths::<T>(payload, count)?;
    let mut bits = BitReader::new(payload);
    let mut cells: Vec<T> = Vec::with_capacity(count);
    let above = |cells: &[T]| cells.len().checked_sub(columns).map_or(T::default(), |above| cells[above]);
    // Value of the run that ends at this cell, if one does.
    let mut run = None;
    while cells.len() < count {
        let offset = bits.offset();
        let end = cells.len() + check_length(bits.read_number()?, count - cells.len(), offset)?;
        let repeated = |value: T| DecodeError::Repeated { offset, value: value.to_wire().into() };
        if cells.len() < end {
            // Canonical: a run does not end before a cell that has its value.
            let value = above(&cells);
            if run.take() == Some(value) {
                return Err(repeated(value));
            }
        }
        while cells.len() < end {
            // Copies up to one row at a time: the source must exist.
            let (at, left) = (cells.len(), end - cells.len());
            match at.checked_sub(columns) {
                Some(above) => cells.extend_from_within(above..above + left.min(columns)),
                None => cells.resize(at + left.min(columns - at), T::default()),
            }
        }
        if cells.len() == count {
            break;
        }
        let before = cells.last().copied();
        let repeats_before = bits.read_bit()?;
        let value = match before {
            Some(before) if repeats_before => before,
            _ if repeats_before => return Err(DecodeError::NothingBefore { offset }),
            _ => bits.read_cell(None)?,
        };
        // Canonical: the value differs from the row before (a copy), from the cell before (the bit) and from the last
        // run.
        if value == above(&cells) || (!repeats_before && before == Some(value)) || run == Some(value) {
            return Err(repeated(value));
        }
        let offset = bits.offset();
        let length = check_length(bits.read_number()? + 1, count - cells.len(), offset)?;
        cells.resize(cells.len() + length, value);
        run = Some(value);
    }
    bits.finish()?;
    Ok(cells)
}

/// Checks that a payload holds copies and runs of `count` cells and nothing else.
fn check_lengths<T: Cell>(payload: &[u8], count: usize) -> Result<(), DecodeError> {
    let (mut bits, mut cells) = (BitReader::new(payload), 0);
    while cells < count {
        let offset = bits.offset();
        cells += check_length(bits.read_number()?, count - cells, offset)?;
        if cells == count {
            break;
        }
        if !bits.read_bit()? {
            bits.read_cell::<T>(None)?;
        }
        let offset = bits.offset();
        cells += check_length(bits.read_number()? + 1, count - cells, offset)?;
    }
    bits.finish()
}

fn check_length(length: u64, left: usize, offset: usize) -> Result<usize, DecodeError> {
    if length <= left as u64 {
        Ok(length as usize)
    } else {
        Err(DecodeError::RunTooLong { offset, length, left: left as u64 })
    }
}
