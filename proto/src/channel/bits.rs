//! Numbers <-> bits, most significant bit first: the codes `N` and `A` of map.proto, `Encoding`.

use crate::channel::cells::Cell;
use crate::channel::error::DecodeError;
use crate::limits::NUMBER_BITS_MAX;

/// Running mean of the numbers of one kind, rounded up. It gives the order of the next number's adaptive code.
#[derive(Clone, Copy, Default)]
pub(crate) struct Mean(u64);

impl Mean {
    /// Order k of the exp-Golomb code: how many low bits of the next number are written as they are.
    fn order(self) -> u32 {
        self.0.max(1).ilog2()
    }

    fn update(&mut self, number: u64) {
        self.0 = (self.0 + number).div_ceil(2);
    }
}

/// Writes numbers as bits.
pub(crate) struct BitWriter {
    bytes: Vec<u8>,
    /// The last `count` bits are not yet in `bytes`; `count` is less than 32.
    pending: u64,
    count: u32,
}

impl BitWriter {
    /// A writer that reserves memory for so many bytes.
    pub(crate) fn with_capacity(bytes: usize) -> Self {
        Self { bytes: Vec::with_capacity(bytes), pending: 0, count: 0 }
    }

    /// Number of complete bytes so far.
    pub(crate) fn len(&self) -> usize {
        self.bytes.len() + self.count as usize / 8
    }

    pub(crate) fn write_bit(&mut self, bit: bool) {
        self.write_bits(bit.into(), 1);
    }

    /// Writes a number under 2³² in code `N`.
    pub(crate) fn write_number(&mut self, number: u64) {
        self.write_golomb(number, 0);
    }

    /// Writes a number under 2³² in code `A`, and updates the mean.
    pub(crate) fn write_adaptive(&mut self, mean: &mut Mean, number: u64) {
        self.write_golomb(number, mean.order());
        mean.update(number);
    }

    /// Fills the last byte with zeros and returns the bytes.
    pub(crate) fn finish(mut self) -> Vec<u8> {
        let left = self.count.div_ceil(8);
        let pending = (self.pending << (32 - self.count)) as u32;
        self.bytes.extend_from_slice(&pending.to_be_bytes()[..left as usize]);
        self.bytes
    }

    #[inline]
    fn write_golomb(&mut self, number: u64, order: u32) {
        let number = number + (1 << order);
        let bits = u64::BITS - number.leading_zeros();
        let zeros = bits - 1 - order;
        if zeros + bits <= 32 {
            // Zeros before a number do not change its value.
            self.write_bits(number, zeros + bits);
        } else {
            self.write_long(number, bits, zeros);
        }
    }

    #[cold]
    fn write_long(&mut self, number: u64, bits: u32, zeros: u32) {
        self.write_bits(0, zeros);
        self.write_bits(number >> 16, bits - 16);
        self.write_bits(number & 0xffff, 16);
    }

    /// Writes up to 32 bits.
    #[inline]
    fn write_bits(&mut self, bits: u64, count: u32) {
        self.pending = self.pending << count | bits;
        self.count += count;
        if self.count >= 32 {
            self.count -= 32;
            self.bytes.extend_from_slice(&((self.pending >> self.count) as u32).to_be_bytes());
        }
    }
}

/// Reads numbers from the bits of a payload, which may be hostile.
pub(crate) struct BitReader<'a> {
    payload: &'a [u8],
    /// Index of the next bit.
    at: usize,
}

impl<'a> BitReader<'a> {
    pub(crate) fn new(payload: &'a [u8]) -> Self {
        Self { payload, at: 0 }
    }

    /// Index of the byte that contains the next bit.
    pub(crate) fn offset(&self) -> usize {
        self.at / 8
    }

    pub(crate) fn read_bit(&mut self) -> Result<bool, DecodeError> {
        let byte = self.payload.get(self.at / 8).ok_or(DecodeError::Truncated { offset: self.payload.len() })?;
        let bit = byte >> (7 - self.at % 8) & 1 != 0;
        self.at += 1;
        Ok(bit)
    }

    /// Reads a number in code `N`.
    pub(crate) fn read_number(&mut self) -> Result<u64, DecodeError> {
        self.read_golomb(0)
    }

    /// Reads a number in code `A`, and updates the mean.
    pub(crate) fn read_adaptive(&mut self, mean: &mut Mean) -> Result<u64, DecodeError> {
        let number = self.read_golomb(mean.order())?;
        mean.update(number);
        Ok(number)
    }

    /// Reads a cell value, in code `A` if a mean is given, else in code `N`.
    pub(crate) fn read_cell<T: Cell>(&mut self, mean: Option<&mut Mean>) -> Result<T, DecodeError> {
        let offset = self.offset();
        let value = match mean {
            Some(mean) => self.read_adaptive(mean)?,
            None => self.read_number()?,
        };
        let allowed = (1 << (8 * T::BYTES)) - 1;
        T::from_wire(value).ok_or(DecodeError::ValueTooLarge { offset, value, allowed })
    }

    /// Checks that only zeros follow, up to the end of the byte, and no further byte.
    pub(crate) fn finish(mut self) -> Result<(), DecodeError> {
        let offset = self.at.div_ceil(8);
        while !self.at.is_multiple_of(8) {
            if self.read_bit()? {
                return Err(DecodeError::TrailingBytes { offset: offset - 1, left: 1 });
            }
        }
        match self.payload.len() - offset {
            0 => Ok(()),
            left => Err(DecodeError::TrailingBytes { offset, left }),
        }
    }

    fn read_golomb(&mut self, order: u32) -> Result<u64, DecodeError> {
        let offset = self.offset();
        let mut bits = order;
        while !self.read_bit()? {
            bits += 1;
            if bits > NUMBER_BITS_MAX {
                return Err(DecodeError::Overlong { offset });
            }
        }
        let mut number = 1_u64;
        for _ in 0..bits {
            number = number << 1 | u64::from(self.read_bit()?);
        }
        Ok(number - (1 << order))
    }
}
