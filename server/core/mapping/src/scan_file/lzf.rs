//! LZF, the compression of `DATA binary_compressed`.

/// Greatest number of plain bytes for each packed byte: a repetition of 3 bytes stands for up to 264.
const GAIN_MAX: usize = 88;

/// Unpacks LZF: a byte under 32 is the number of plain bytes that follow, minus one; other bytes repeat earlier output.
/// `None` if the bytes are not LZF of exactly `length` plain bytes. No more memory is used than `packed` can fill.
pub(super) fn unpack(mut packed: &[u8], length: usize) -> Option<Vec<u8>> {
    if length > packed.len().saturating_mul(GAIN_MAX) {
        return None;
    }
    let mut plain = Vec::with_capacity(length);
    while let [control, rest @ ..] = packed {
        let control = usize::from(*control);
        if control < 32 {
            let (run, after) = rest.split_at_checked(control + 1)?;
            plain.extend_from_slice(run);
            packed = after;
        } else {
            let (more, rest) = if control >> 5 == 7 { rest.split_first()? } else { (&0, rest) };
            let (low, rest) = rest.split_first()?;
            let repeated = (control >> 5) + 2 + usize::from(*more);
            let start = plain.len().checked_sub(((control & 31) << 8) + usize::from(*low) + 1)?;
            (start..start + repeated).for_each(|at| plain.push(plain[at]));
            packed = rest;
        }
        if plain.len() > length {
            return None;
        }
    }
    (plain.len() == length).then_some(plain)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn runs_and_repetitions_are_unpacked() {
        // "abc", then 5 bytes from 3 before, then 264 bytes from 1 before.
        let packed = [2, b'a', b'b', b'c', 3 << 5, 2, 7 << 5, 255, 0];
        let plain = unpack(&packed, 272).unwrap();
        assert_eq!(&plain[..8], b"abcabcab");
        assert!(plain.len() == 272 && plain[8..].iter().all(|byte| *byte == b'b'));
    }

    #[test]
    fn bytes_that_are_no_lzf_of_this_length_are_refused() {
        let packed = [2, b'a', b'b', b'c', 3 << 5, 2];
        assert!(unpack(&packed, 8).is_some());
        for length in [0, 7, 9, 6 * 88, usize::MAX] {
            assert_eq!(unpack(&packed, length), None, "{length}");
        }
        for cut in 1..packed.len() {
            assert_eq!(unpack(&packed[..cut], 8), None, "cut at {cut}");
        }
        assert_eq!(unpack(&[1 << 5, 0], 3), None, "a repetition of output that does not exist");
    }
}
