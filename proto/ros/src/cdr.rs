//! Bytes of one message <-> numbers, texts and headers: CDR as ROS 2 uses it (XCDR1, OMG DDS-XTypes 1.3, section
//! 7.4.1).
//!
//! A message has four bytes of encapsulation, then its members in order. A number is aligned to a multiple of its size,
//! counted from the end of the encapsulation. A text is its length (u32, including the final zero), its bytes and a
//! zero. A sequence is its count (u32) and its elements.

/// Bytes before the first member.
const ENCAPSULATION: usize = 4;

/// Why a message was refused.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum MessageError {
    /// The message is not plain CDR.
    #[error("encapsulation {found:02x?}; 00 00 (big endian) or 00 01 (little endian) is allowed")]
    Encapsulation {
        /// The first two bytes of the message.
        found: [u8; 2],
    },
    /// The message ends before a member does.
    #[error("{what} needs {needed} bytes at {at}, but the message has {length}")]
    Truncated {
        /// Name of the member at which the message ends.
        what: &'static str,
        /// Bytes that the member needs.
        needed: usize,
        /// Offset of the member in bytes.
        at: usize,
        /// Length of the message in bytes.
        length: usize,
    },
    /// A text is not UTF-8, or does not end in its only zero.
    #[error("{what} is not UTF-8 ending in its only zero")]
    Text {
        /// Name of the member with the text.
        what: &'static str,
    },
    /// The value of a member is not allowed.
    #[error("{what} = {value}: allowed: {allowed}")]
    Value {
        /// Name of the member with the value.
        what: &'static str,
        /// The refused value, as text.
        value: String,
        /// The values that are allowed, in words.
        allowed: &'static str,
    },
}

impl MessageError {
    /// Key of the error in the ledger.
    pub fn reason(&self) -> &'static str {
        match self {
            Self::Encapsulation { .. } => "ros_encapsulation",
            Self::Truncated { .. } => "ros_truncated",
            Self::Text { .. } => "ros_text",
            Self::Value { .. } => "ros_value",
        }
    }

    /// A value that is not allowed.
    pub fn value(what: &'static str, value: impl ToString, allowed: &'static str) -> Self {
        Self::Value { what, value: value.to_string(), allowed }
    }
}

/// A part of a message that was refused while the rest of the message is used.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RefusedPart {
    /// The kind of the part: `points`, `field`, `transforms`, `packets`, `twist`.
    pub what: &'static str,
    /// Number of points, transforms or packets; 1 for a field.
    pub count: u64,
    /// The first of the faults in this part.
    pub fault: MessageError,
}

/// A `std_msgs/Header`, borrowed from the message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Header<'a> {
    /// Time of the data, ns since the Unix epoch.
    pub stamp_ns: i64,
    /// Frame of the data, as written.
    pub frame_id: &'a str,
}

/// Reads the members of a message in order.
#[derive(Clone, Debug)]
pub struct Reader<'a> {
    message: &'a [u8],
    at: usize,
    little_endian: bool,
}

impl<'a> Reader<'a> {
    /// A reader at the first member.
    ///
    /// # Errors
    /// [`MessageError::Truncated`] if the encapsulation is missing, [`MessageError::Encapsulation`] if it is not plain
    /// CDR.
    pub fn new(message: &'a [u8]) -> Result<Self, MessageError> {
        let mut reader = Self { message, at: 0, little_endian: true };
        let head = reader.read_bytes("encapsulation", ENCAPSULATION)?;
        reader.little_endian = match [head[0], head[1]] {
            [0, 0] => false,
            [0, 1] => true,
            found => return Err(MessageError::Encapsulation { found }),
        };
        Ok(reader)
    }

    /// Reads the next `length` bytes.
    ///
    /// # Errors
    /// [`MessageError::Truncated`] if the message ends before the last of them.
    pub fn read_bytes(&mut self, what: &'static str, length: usize) -> Result<&'a [u8], MessageError> {
        let (at, available) = (self.at, self.message.len());
        let end = at.checked_add(length).filter(|end| *end <= available);
        let end = end.ok_or(MessageError::Truncated { what, needed: length, at, length: available })?;
        self.at = end;
        Ok(&self.message[at..end])
    }

    /// Reads the next number of `N` bytes, as little-endian bytes.
    fn number<const N: usize>(&mut self, what: &'static str) -> Result<[u8; N], MessageError> {
        self.align(N);
        let mut bytes: [u8; N] = self.read_bytes(what, N)?.try_into().expect("N bytes");
        if !self.little_endian {
            bytes.reverse();
        }
        Ok(bytes)
    }

    /// Skips the padding before a member of this size. If the padding exceeds the message, the next read fails.
    fn align(&mut self, size: usize) {
        self.at = ENCAPSULATION + (self.at - ENCAPSULATION).next_multiple_of(size);
    }

    /// Reads a byte.
    ///
    /// # Errors
    /// As [`Reader::read_bytes`].
    pub fn u8(&mut self, what: &'static str) -> Result<u8, MessageError> {
        Ok(self.read_bytes(what, 1)?[0])
    }

    /// Reads a number.
    ///
    /// # Errors
    /// As [`Reader::read_bytes`].
    pub fn u32(&mut self, what: &'static str) -> Result<u32, MessageError> {
        self.number(what).map(u32::from_le_bytes)
    }

    /// Reads `N` numbers.
    ///
    /// # Errors
    /// As [`Reader::read_bytes`].
    pub fn f64s<const N: usize>(&mut self, what: &'static str) -> Result<[f64; N], MessageError> {
        let mut numbers = [0.0; N];
        for number in &mut numbers {
            *number = self.number(what).map(f64::from_le_bytes)?;
        }
        Ok(numbers)
    }

    /// Reads a text, without its final zero.
    ///
    /// # Errors
    /// As [`Reader::read_bytes`], and [`MessageError::Text`] if it is not UTF-8 with a single, final zero.
    pub fn text(&mut self, what: &'static str) -> Result<&'a str, MessageError> {
        let length = self.u32(what)? as usize;
        let text = self.read_bytes(what, length)?.strip_suffix(&[0]).filter(|text| !text.contains(&0));
        text.and_then(|text| std::str::from_utf8(text).ok()).ok_or(MessageError::Text { what })
    }

    /// Reads the count of a sequence whose elements have at least `shortest` bytes each.
    ///
    /// # Errors
    /// [`MessageError::Truncated`] if the message ends before the count, or has fewer bytes left than the elements
    /// need.
    pub fn count(&mut self, what: &'static str, shortest: usize) -> Result<usize, MessageError> {
        let count = self.u32(what)? as usize;
        let needed = count.saturating_mul(shortest);
        if needed > self.message.len() - self.at {
            return Err(MessageError::Truncated { what, needed, at: self.at, length: self.message.len() });
        }
        Ok(count)
    }

    /// Reads a `builtin_interfaces/Time`, in ns since the Unix epoch.
    ///
    /// # Errors
    /// As [`Reader::read_bytes`], and [`MessageError::Value`] if the nanoseconds exceed a second.
    pub fn stamp(&mut self, what: &'static str) -> Result<i64, MessageError> {
        let seconds = self.u32(what)?.cast_signed();
        match self.u32(what)? {
            nanoseconds @ 0..1_000_000_000 => Ok(i64::from(seconds) * 1_000_000_000 + i64::from(nanoseconds)),
            wrong => Err(MessageError::value(what, format!("{seconds} s {wrong} ns"), "up to 999999999 ns")),
        }
    }

    /// Reads a `std_msgs/Header`.
    ///
    /// # Errors
    /// As [`Reader::stamp`] and [`Reader::text`].
    pub fn header(&mut self) -> Result<Header<'a>, MessageError> {
        Ok(Header { stamp_ns: self.stamp("header.stamp")?, frame_id: self.text("header.frame_id")? })
    }
}

/// Writes the members of a message in order, little-endian.
#[derive(Clone, Debug)]
pub struct Writer {
    message: Vec<u8>,
}

impl Default for Writer {
    fn default() -> Self {
        Self { message: vec![0, 1, 0, 0] }
    }
}

impl Writer {
    /// Returns the bytes of the message, with its CDR header.
    pub fn finish(self) -> Vec<u8> {
        self.message
    }

    /// Writes bytes without a count.
    pub fn bytes(&mut self, bytes: &[u8]) -> &mut Self {
        self.message.extend_from_slice(bytes);
        self
    }

    /// Writes signed bytes without a count.
    pub fn signed_bytes(&mut self, bytes: &[i8]) -> &mut Self {
        self.message.extend(bytes.iter().map(|byte| byte.cast_unsigned()));
        self
    }

    fn number(&mut self, bytes: &[u8]) -> &mut Self {
        let length = (self.message.len() - ENCAPSULATION).next_multiple_of(bytes.len());
        self.message.resize(ENCAPSULATION + length, 0);
        self.bytes(bytes)
    }

    /// Writes a number, or the count of a sequence.
    pub fn u32(&mut self, value: u32) -> &mut Self {
        self.number(&value.to_le_bytes())
    }

    /// Writes numbers without a count.
    pub fn f64s(&mut self, values: &[f64]) -> &mut Self {
        values.iter().fold(self, |writer, value| writer.number(&value.to_le_bytes()))
    }

    /// Writes a text, which contains no zero, and its final zero.
    pub fn text(&mut self, text: &str) -> &mut Self {
        self.u32(length(text.len() + 1)).bytes(text.as_bytes()).bytes(&[0])
    }

    /// Writes a `builtin_interfaces/Time`. Seconds beyond 32 bits (after January 2038) are clamped.
    pub fn stamp(&mut self, stamp_ns: i64) -> &mut Self {
        let (seconds, limit) = (stamp_ns.div_euclid(1_000_000_000), i64::from(i32::MAX));
        let seconds = seconds.clamp(-limit - 1, limit) as i32;
        self.u32(seconds.cast_unsigned()).u32(stamp_ns.rem_euclid(1_000_000_000) as u32)
    }

    /// Appends the members of a `std_msgs/Header`: the stamp, then the frame.
    pub fn header(&mut self, header: &Header) -> &mut Self {
        self.stamp(header.stamp_ns).text(header.frame_id)
    }
}

/// A length as CDR writes it. No message of 4 GiB is written here.
pub(crate) fn length(length: usize) -> u32 {
    u32::try_from(length).expect("shorter than 4 GiB")
}
