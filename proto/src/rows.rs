//! Cells as rows predicted by the rows before: `ENCODING_ROWS` of map.proto.
//!
//! In: cells and the columns of their grid. Out: bits: how many cells are equal to those a row before, then a run of
//! another value, and so on. Maps are patches, so most of a row is the row before it.

use crate::bits::{BitReader, BitWriter};
use crate::codec::Cell;
use crate::decode::DecodeError;

/// The cells; `None` where that is not smaller than they are themselves.
pub(crate) fn encode_rows<T: Cell>(cells: &[T], columns: usize) -> Option<Vec<u8>> {
    let raw_length = cells.len() * T::BYTES;
    let mut bits = BitWriter::with_capacity((raw_length / 16).max(16));
    let mut at = 0;
    loop {
        let end = copy_end(cells, columns, at);
        bits.number((end - at) as u64);
        if end == cells.len() || bits.len() >= raw_length {
            break;
        }
        let as_before = end > 0 && cells[end] == cells[end - 1];
        bits.bit(as_before);
        if !as_before {
            bits.number(cells[end].to_wire().into());
        }
        at = end + 1 + equal(&cells[end + 1..], &cells[end..]);
        bits.number((at - end - 1) as u64);
        if at == cells.len() {
            break;
        }
    }
    let rows = bits.finish();
    (rows.len() < raw_length).then_some(rows)
}

/// Where the cells from `start` on differ from those a row before; before the first row all cells are 0.
fn copy_end<T: Cell>(cells: &[T], columns: usize, start: usize) -> usize {
    let first = &cells[..columns.min(cells.len())];
    let zeros = first.iter().skip(start).take_while(|cell| **cell == T::default()).count();
    let at = start + zeros;
    if at < first.len() { at } else { at + equal(&cells[at..], &cells[at - columns.min(at)..]) }
}

/// How many of the first cells are equal.
fn equal<T: Cell>(cells: &[T], others: &[T]) -> usize {
    // So many are compared at once.
    const STEP: usize = 32;
    let steps = cells.chunks_exact(STEP).zip(others.chunks_exact(STEP)).take_while(|(cells, others)| cells == others);
    let at = STEP * steps.count();
    at + cells[at..].iter().zip(&others[at..]).take_while(|(cell, other)| cell == other).count()
}

/// The way back, which refuses what [`encode_rows`] would not have written. A payload that does not tell `count` cells
/// is refused before there is room for one.
pub(crate) fn decode_rows<T: Cell>(payload: &[u8], count: usize, columns: usize) -> Result<Vec<T>, DecodeError> {
    check_lengths::<T>(payload, count)?;
    let mut bits = BitReader::new(payload);
    let mut cells: Vec<T> = Vec::with_capacity(count);
    let above = |cells: &[T]| cells.len().checked_sub(columns).map_or(T::default(), |above| cells[above]);
    // The value of the run that ends here, if one does.
    let mut run = None;
    while cells.len() < count {
        let offset = bits.offset();
        let end = cells.len() + fits(bits.number()?, count - cells.len(), offset)?;
        let repeated = |value: T| DecodeError::Repeated { offset, value: value.to_wire().into() };
        if cells.len() < end {
            // A run goes on as long as its value does.
            let value = above(&cells);
            if run.take() == Some(value) {
                return Err(repeated(value));
            }
        }
        while cells.len() < end {
            // As much at once as there is above.
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
        let as_before = bits.bit()?;
        let value = match before {
            Some(before) if as_before => before,
            _ if as_before => return Err(DecodeError::NothingBefore { offset }),
            _ => bits.cell(None)?,
        };
        // As above it would have been copied; as before it would have been said so, or been part of the run.
        if value == above(&cells) || (!as_before && before == Some(value)) || run == Some(value) {
            return Err(repeated(value));
        }
        let offset = bits.offset();
        let length = fits(bits.number()? + 1, count - cells.len(), offset)?;
        cells.resize(cells.len() + length, value);
        run = Some(value);
    }
    bits.finish()?;
    Ok(cells)
}

/// Whether a payload holds numbers and values of so many cells, and nothing else.
fn check_lengths<T: Cell>(payload: &[u8], count: usize) -> Result<(), DecodeError> {
    let (mut bits, mut cells) = (BitReader::new(payload), 0);
    while cells < count {
        let offset = bits.offset();
        cells += fits(bits.number()?, count - cells, offset)?;
        if cells == count {
            break;
        }
        if !bits.bit()? {
            bits.cell::<T>(None)?;
        }
        let offset = bits.offset();
        cells += fits(bits.number()? + 1, count - cells, offset)?;
    }
    bits.finish()
}

fn fits(length: u64, left: usize, offset: usize) -> Result<usize, DecodeError> {
    if length <= left as u64 {
        Ok(length as usize)
    } else {
        Err(DecodeError::RunTooLong { offset, length, left: left as u64 })
    }
}
