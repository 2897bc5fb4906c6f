//! Numbers as bits, most significant first: what rows and changes are written in (map.proto, `Encoding`).

use crate::codec::Cell;
use crate::decode::DecodeError;

/// Longest number: what a count of cells can be.
const BITS_MAX: u32 = 32;

/// What numbers of one kind were so far, and so how many low bits of the next are written as they are.
#[derive(Clone, Copy, Default)]
pub(crate) struct Mean(u64);

impl Mean {
    fn low_bits(self) -> u32 {
        self.0.max(1).ilog2()
    }

    fn take(&mut self, number: u64) {
        self.0 = (self.0 + number).div_ceil(2);
    }
}

/// Writes numbers.
pub(crate) struct BitWriter {
    bytes: Vec<u8>,
    /// The last `count` bits are not written yet; always fewer than 8.
    held: u64,
    count: u32,
}

impl BitWriter {
    /// With room for so many bytes.
    pub(crate) fn with_capacity(bytes: usize) -> Self {
        Self { bytes: Vec::with_capacity(bytes), held: 0, count: 0 }
    }

    /// Whole bytes so far.
    pub(crate) fn len(&self) -> usize {
        self.bytes.len()
    }

    pub(crate) fn bit(&mut self, bit: bool) {
        self.put(bit.into(), 1);
    }

    /// Exp-Golomb code of a number under 2³².
    pub(crate) fn number(&mut self, number: u64) {
        self.number_of_order(number, 0);
    }

    /// The same of the order that follows from the numbers before.
    pub(crate) fn number_about(&mut self, mean: &mut Mean, number: u64) {
        self.number_of_order(number, mean.low_bits());
        mean.take(number);
    }

    fn number_of_order(&mut self, number: u64, low: u32) {
        let number = number + (1 << low);
        let bits = number.ilog2() + 1;
        self.put(0, bits - 1 - low);
        self.put(number, bits);
    }

    pub(crate) fn finish(mut self) -> Vec<u8> {
        let free = (8 - self.count) % 8;
        self.put(0, free);
        self.bytes
    }

    fn put(&mut self, bits: u64, count: u32) {
        self.held = self.held << count | bits;
        self.count += count;
        while self.count >= 8 {
            self.count -= 8;
            self.bytes.push((self.held >> self.count) as u8);
        }
    }
}

/// Reads numbers, from anywhere, hostile or not.
pub(crate) struct BitReader<'a> {
    payload: &'a [u8],
    /// Next bit.
    at: usize,
}

impl<'a> BitReader<'a> {
    pub(crate) fn new(payload: &'a [u8]) -> Self {
        Self { payload, at: 0 }
    }

    /// Of the byte that holds the next bit.
    pub(crate) fn offset(&self) -> usize {
        self.at / 8
    }

    pub(crate) fn bit(&mut self) -> Result<bool, DecodeError> {
        let byte = self.payload.get(self.at / 8).ok_or(DecodeError::Truncated { offset: self.payload.len() })?;
        let bit = byte >> (7 - self.at % 8) & 1 != 0;
        self.at += 1;
        Ok(bit)
    }

    pub(crate) fn number(&mut self) -> Result<u64, DecodeError> {
        self.number_of_order(0)
    }

    pub(crate) fn number_about(&mut self, mean: &mut Mean) -> Result<u64, DecodeError> {
        let number = self.number_of_order(mean.low_bits())?;
        mean.take(number);
        Ok(number)
    }

    /// A cell, in the order that follows from those before where there are any to go by.
    pub(crate) fn cell<T: Cell>(&mut self, mean: Option<&mut Mean>) -> Result<T, DecodeError> {
        let offset = self.offset();
        let value = match mean {
            Some(mean) => self.number_about(mean)?,
            None => self.number()?,
        };
        let allowed = (1 << (8 * T::BYTES)) - 1;
        T::of_wire(value).ok_or(DecodeError::ValueTooLarge { offset, value, allowed })
    }

    fn number_of_order(&mut self, low: u32) -> Result<u64, DecodeError> {
        let offset = self.offset();
        let mut more = low;
        while !self.bit()? {
            more += 1;
            if more > BITS_MAX {
                return Err(DecodeError::Overlong { offset });
            }
        }
        let mut number = 1_u64;
        for _ in 0..more {
            number = number << 1 | u64::from(self.bit()?);
        }
        Ok(number - (1 << low))
    }

    /// Nothing but zeros to the end of the byte, and no other byte.
    pub(crate) fn finish(mut self) -> Result<(), DecodeError> {
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
