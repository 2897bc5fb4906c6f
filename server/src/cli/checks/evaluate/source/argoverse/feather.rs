//! Arrow files (Feather v2) -> columns of bytes, as far as the files of Argoverse 2 use that format.
//!
//! In: the bytes of a file whose columns are fixed-width numbers without gaps. Out: the bytes of each column, little
//! endian. The columns may be compressed in LZ4 frames.

use std::io::Read;

use lz4_flex::frame::FrameDecoder;

/// Greatest length of a column, in bytes. Ours: 4 million values of 8 bytes.
const COLUMN_BYTES_MAX: usize = 32 << 20;
/// Marks the beginning of a message.
const MESSAGE: u32 = 0xffff_ffff;

/// The columns of all record batches, one after the other; `None` if the file is not of this kind.
pub fn columns(file: &[u8]) -> Option<Vec<Vec<u8>>> {
    if file.get(..6)? != b"ARROW1" {
        return None;
    }
    // The schema comes first; every message is a marker, a length, metadata and a body.
    let mut at = 16_usize.checked_add(usize_at(file, 12)?)?;
    let mut all: Vec<Vec<u8>> = Vec::new();
    while u32_at(file, at)? == MESSAGE && usize_at(file, at + 4)? > 0 {
        let body = (at + 8).checked_add(usize_at(file, at + 4)?)?;
        let message = (at + 8).checked_add(usize_at(file, at + 8)?)?;
        let body_length = length_at(file, field(file, message, 3)?)?;
        let batch = follow(file, field(file, message, 2)?)?;
        let buffers = follow(file, field(file, batch, 2)?)?;
        let mut columns = Vec::new();
        for number in 0..usize_at(file, buffers)?.min(1 << 10) {
            let entry = buffers + 4 + 16 * number;
            let (offset, length) = (length_at(file, entry)?, length_at(file, entry + 8)?);
            // The buffers of gaps are empty.
            if length > 0 {
                let start = body.checked_add(offset)?;
                columns.push(column(file.get(start..start.checked_add(length)?)?)?);
            }
        }
        all.resize_with(columns.len().max(all.len()), Vec::new);
        all.iter_mut().zip(columns).for_each(|(column, more)| column.extend(more));
        at = body.checked_add(body_length)?;
    }
    Some(all)
}

/// The values of a column of numbers of N bytes; `None` if its length is not a multiple of N.
pub fn values<const N: usize, T>(column: &[u8], value: impl Fn([u8; N]) -> T) -> Option<Vec<T>> {
    let (values, rest) = column.as_chunks::<N>();
    rest.is_empty().then(|| values.iter().map(|bytes| value(*bytes)).collect())
}

/// A number of 16 bits (IEEE 754 binary16).
pub fn f16(bytes: [u8; 2]) -> f32 {
    let bits = u32::from(u16::from_le_bytes(bytes));
    let (sign, exponent, fraction) = (bits >> 15, bits >> 10 & 31, (bits & 1023) as f32);
    let size = match exponent {
        0 => fraction / 1024.0 * 2f32.powi(-14),
        31 => f32::NAN,
        _ => (1.0 + fraction / 1024.0) * 2f32.powi(exponent as i32 - 15),
    };
    if sign == 1 { -size } else { size }
}

/// Unpacks a buffer: its length, then an LZ4 frame, or the bytes themselves if the length is -1.
fn column(bytes: &[u8]) -> Option<Vec<u8>> {
    let (length, packed) = bytes.split_first_chunk::<8>()?;
    let length = i64::from_le_bytes(*length);
    if length == -1 {
        return Some(packed.to_vec());
    }
    let length = usize::try_from(length).ok().filter(|length| *length <= COLUMN_BYTES_MAX)?;
    let mut out = Vec::new();
    FrameDecoder::new(packed).take(length as u64 + 1).read_to_end(&mut out).ok()?;
    (out.len() == length).then_some(out)
}

fn u32_at(bytes: &[u8], at: usize) -> Option<u32> {
    Some(u32::from_le_bytes(*bytes.get(at..)?.first_chunk()?))
}

fn usize_at(bytes: &[u8], at: usize) -> Option<usize> {
    usize::try_from(u32_at(bytes, at)?).ok()
}

fn length_at(bytes: &[u8], at: usize) -> Option<usize> {
    usize::try_from(i64::from_le_bytes(*bytes.get(at..)?.first_chunk()?)).ok()
}

/// Position that an offset refers to.
fn follow(bytes: &[u8], at: usize) -> Option<usize> {
    at.checked_add(usize_at(bytes, at)?)
}

/// Position of a field of a flatbuffer table.
fn field(bytes: &[u8], table: usize, number: usize) -> Option<usize> {
    let shape = table.checked_sub(usize_at(bytes, table)?)?;
    let slot = bytes.get(shape + 4 + 2 * number..)?.first_chunk()?;
    table.checked_add(usize::from(u16::from_le_bytes(*slot)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn half_floats_have_their_values() {
        let values = [0x3c00_u16, 0xc000, 0x0000, 0x3555, 0x7bff, 0x0001].map(|bits| f16(bits.to_le_bytes()));
        assert_eq!(values[..3], [1.0, -2.0, 0.0]);
        assert!((values[3] - 0.333_25).abs() < 1e-4 && values[4] == 65504.0 && values[5] == 2f32.powi(-24));
        assert!(f16([0, 0x7c]).is_nan());
    }

    #[test]
    fn columns_of_whole_numbers_are_read_and_others_refused() {
        assert_eq!(values(&[1, 0, 2, 0], u16::from_le_bytes), Some(vec![1, 2]));
        assert_eq!(values(&[1, 0, 2], u16::from_le_bytes), None);
    }

    #[test]
    fn a_file_of_another_kind_or_cut_short_is_refused() {
        assert_eq!(columns(b"PARQUET"), None);
        assert_eq!(columns(b"ARROW1\0\0\xff\xff\xff\xff\x10\0\0\0"), None);
    }
}
