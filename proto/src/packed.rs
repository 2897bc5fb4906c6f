//! Numbers <-> packed lists, the bytes of a scan's fields: little-endian, one number after the other.
//!
//! The bytes equal a packed `repeated float`, but they are copied as a whole instead of parsed number by number.

use bytes::Bytes;

/// A number of fixed size in a packed list.
pub trait Number: Copy {
    /// Bytes of one number.
    const BYTES: usize;
    /// The number of exactly [`Number::BYTES`] bytes.
    fn from_bytes(bytes: &[u8]) -> Self;
    /// Appends the number to a list.
    fn append_to(self, bytes: &mut Vec<u8>);
}

macro_rules! numbers {
    ($($number:ty),*) => {$(
        impl Number for $number {
            const BYTES: usize = size_of::<$number>();
            fn from_bytes(bytes: &[u8]) -> Self {
                let mut own = [0; size_of::<$number>()];
                own.copy_from_slice(bytes);
                Self::from_le_bytes(own)
            }
            fn append_to(self, bytes: &mut Vec<u8>) {
                bytes.extend_from_slice(&self.to_le_bytes());
            }
        }
    )*};
}

numbers!(f32, i32, i64, u16);

/// Packs numbers into bytes.
pub fn pack<N: Number>(numbers: &[N]) -> Bytes {
    let mut bytes = Vec::with_capacity(numbers.len() * N::BYTES);
    numbers.iter().for_each(|number| number.append_to(&mut bytes));
    bytes.into()
}

/// Unpacks bytes into numbers; `None` if the last number is incomplete.
pub fn unpack<N: Number>(bytes: &[u8]) -> Option<Vec<N>> {
    bytes.len().is_multiple_of(N::BYTES).then(|| bytes.chunks_exact(N::BYTES).map(N::from_bytes).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_unpack_bit_for_bit_and_an_incomplete_number_is_refused() {
        let floats = [0.0, -1.5, f32::NAN, f32::INFINITY, f32::MIN_POSITIVE];
        let back: Vec<f32> = unpack(&pack(&floats)).unwrap();
        let bits = |floats: &[f32]| floats.iter().map(|f| f.to_bits()).collect::<Vec<_>>();
        assert_eq!(bits(&back), bits(&floats));
        assert_eq!(unpack::<i64>(&pack(&[i64::MIN, -1, 7])), Some(vec![i64::MIN, -1, 7]));
        assert_eq!(unpack::<u16>(&[1, 2]), Some(vec![0x0201]));
        assert_eq!(unpack::<u16>(&[1, 2, 3]), None);
        assert_eq!(unpack::<i32>(&[]), Some(vec![]));
    }
}
