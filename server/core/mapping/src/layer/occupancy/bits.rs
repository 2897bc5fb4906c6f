//! Rows of bits in words of 64: set, test and select a range of bits.

/// The bits of one word of a row that lie in `first..end`.
#[inline(always)]
pub fn bits_of_word(word: usize, first: usize, end: usize) -> u64 {
    let (first, end) = (first.max(word * 64), end.min(word * 64 + 64));
    if first >= end { 0 } else { u64::MAX >> (64 - (end - first)) << (first - word * 64) }
}

/// Sets the bits `first..end` of a row.
#[inline(always)]
pub fn set_bits(row: &mut [u64], first: usize, end: usize) {
    if first < end {
        let last = end - 1;
        let (from, to) = (u64::MAX << (first % 64), u64::MAX >> (63 - last % 64));
        if first / 64 == last / 64 {
            row[first / 64] |= from & to;
        } else {
            row[first / 64] |= from;
            row[first / 64 + 1..last / 64].fill(u64::MAX);
            row[last / 64] |= to;
        }
    }
}

/// True if one of the bits `first..end` of a row is set.
#[inline(always)]
pub fn any_bit(row: &[u64], first: usize, end: usize) -> bool {
    first < end && (first / 64..end.div_ceil(64)).any(|word| row[word] & bits_of_word(word, first, end) != 0)
}
