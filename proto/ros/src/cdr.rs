//! Bytes of one message <-> numbers, texts, headers: CDR as ROS 2 uses it (XCDR1, OMG DDS-XTypes 1.3, section 7.4.1).
//!
//! Four bytes of encapsulation, then the members one after another. A number stands at a multiple of its size, counted
//! after the encapsulation; a text is its length (u32, with its zero), its bytes and the zero; a sequence is its count
//! and its elements.

/// Bytes before the first member.
const ENCAPSULATION: usize = 4;

/// What is wrong with a message.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum MessageError {
    /// Not plain CDR.
    #[error("encapsulation {found:02x?}; 00 00 (big endian) or 00 01 (little endian) is allowed")]
    Encapsulation {
        /// The first two bytes.
        found: [u8; 2],
    },
    /// The message ends too soon.
    #[error("{what} needs {needed} bytes at {at}, but the message has {length}")]
    Truncated {
        /// What was being read.
        what: &'static str,
        /// Bytes it needs.
        needed: usize,
        /// Where it starts.
        at: usize,
        /// Bytes of the message.
        length: usize,
    },
    /// A text that is none.
    #[error("{what} is not UTF-8 ending in its only zero")]
    Text {
        /// Which member.
        what: &'static str,
    },
    /// A value that makes no sense.
    #[error("{what} = {value}: allowed: {allowed}")]
    Value {
        /// Which member.
        what: &'static str,
        /// What was found.
        value: String,
        /// What may stand there.
        allowed: &'static str,
    },
}

impl MessageError {
    /// The ledger's word for it.
    pub fn reason(&self) -> &'static str {
        match self {
            Self::Encapsulation { .. } => "ros_encapsulation",
            Self::Truncated { .. } => "ros_truncated",
            Self::Text { .. } => "ros_text",
            Self::Value { .. } => "ros_value",
        }
    }

    pub(crate) fn value(what: &'static str, value: impl ToString, allowed: &'static str) -> Self {
        Self::Value { what, value: value.to_string(), allowed }
    }
}

/// `std_msgs/Header`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Header<'a> {
    /// ns since the Unix epoch.
    pub stamp_ns: i64,
    /// The frame in which the rest is told, as written.
    pub frame_id: &'a str,
}

/// A cursor over a message.
#[derive(Clone, Debug)]
pub struct Reader<'a> {
    message: &'a [u8],
    at: usize,
    little_endian: bool,
}

impl<'a> Reader<'a> {
    /// At the first member.
    ///
    /// # Errors
    /// [`MessageError`] where the encapsulation is missing or no plain CDR.
    pub fn new(message: &'a [u8]) -> Result<Self, MessageError> {
        let mut reader = Self { message, at: 0, little_endian: true };
        let head = reader.take("encapsulation", ENCAPSULATION)?;
        reader.little_endian = match [head[0], head[1]] {
            [0, 0] => false,
            [0, 1] => true,
            found => return Err(MessageError::Encapsulation { found }),
        };
        Ok(reader)
    }

    /// The next `length` bytes.
    ///
    /// # Errors
    /// [`MessageError::Truncated`], here and below, where the message ends before.
    pub fn take(&mut self, what: &'static str, length: usize) -> Result<&'a [u8], MessageError> {
        let (at, held) = (self.at, self.message.len());
        let end = at.checked_add(length).filter(|end| *end <= held);
        let end = end.ok_or(MessageError::Truncated { what, needed: length, at, length: held })?;
        self.at = end;
        Ok(&self.message[at..end])
    }

    /// The next number, of `N` bytes, least byte first.
    fn number<const N: usize>(&mut self, what: &'static str) -> Result<[u8; N], MessageError> {
        self.align(N);
        let mut bytes: [u8; N] = self.take(what, N)?.try_into().expect("that many bytes");
        if !self.little_endian {
            bytes.reverse();
        }
        Ok(bytes)
    }

    /// Skips the padding before a member of this size; padding beyond the message is noticed by whoever reads there.
    fn align(&mut self, size: usize) {
        self.at = ENCAPSULATION + (self.at - ENCAPSULATION).next_multiple_of(size);
    }

    /// A byte.
    ///
    /// # Errors
    /// As [`Reader::take`].
    pub fn u8(&mut self, what: &'static str) -> Result<u8, MessageError> {
        Ok(self.take(what, 1)?[0])
    }

    /// A number.
    ///
    /// # Errors
    /// As [`Reader::take`].
    pub fn u32(&mut self, what: &'static str) -> Result<u32, MessageError> {
        self.number(what).map(u32::from_le_bytes)
    }

    /// So many numbers.
    ///
    /// # Errors
    /// As [`Reader::take`].
    pub fn f64s<const N: usize>(&mut self, what: &'static str) -> Result<[f64; N], MessageError> {
        let mut numbers = [0.0; N];
        for number in &mut numbers {
            *number = self.number(what).map(f64::from_le_bytes)?;
        }
        Ok(numbers)
    }

    /// A text without its zero.
    ///
    /// # Errors
    /// As [`Reader::take`], and [`MessageError::Text`].
    pub fn text(&mut self, what: &'static str) -> Result<&'a str, MessageError> {
        let length = self.u32(what)? as usize;
        let text = self.take(what, length)?.strip_suffix(&[0]).filter(|text| !text.contains(&0));
        text.and_then(|text| std::str::from_utf8(text).ok()).ok_or(MessageError::Text { what })
    }

    /// The count of a sequence whose elements take at least `shortest` bytes each.
    ///
    /// # Errors
    /// As [`Reader::take`], also if fewer bytes are left than that many elements would take.
    pub fn count(&mut self, what: &'static str, shortest: usize) -> Result<usize, MessageError> {
        let count = self.u32(what)? as usize;
        let needed = count.saturating_mul(shortest);
        if needed > self.message.len() - self.at {
            return Err(MessageError::Truncated { what, needed, at: self.at, length: self.message.len() });
        }
        Ok(count)
    }

    /// A `builtin_interfaces/Time`, ns since the Unix epoch.
    ///
    /// # Errors
    /// As [`Reader::take`], and [`MessageError::Value`] for more nanoseconds than a second has.
    pub fn stamp(&mut self, what: &'static str) -> Result<i64, MessageError> {
        let seconds = self.u32(what)?.cast_signed();
        match self.u32(what)? {
            nanoseconds @ 0..1_000_000_000 => Ok(i64::from(seconds) * 1_000_000_000 + i64::from(nanoseconds)),
            wrong => Err(MessageError::value(what, format!("{seconds} s {wrong} ns"), "up to 999999999 ns")),
        }
    }

    /// A `std_msgs/Header`.
    ///
    /// # Errors
    /// As its members.
    pub fn header(&mut self) -> Result<Header<'a>, MessageError> {
        Ok(Header { stamp_ns: self.stamp("header.stamp")?, frame_id: self.text("header.frame_id")? })
    }
}

/// A message being written, little-endian.
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
    /// The message.
    pub fn finish(self) -> Vec<u8> {
        self.message
    }

    /// Bytes as they are, without a count.
    pub fn bytes(&mut self, bytes: &[u8]) -> &mut Self {
        self.message.extend_from_slice(bytes);
        self
    }

    /// Signed bytes as they are, without a count.
    pub fn signed_bytes(&mut self, bytes: &[i8]) -> &mut Self {
        self.message.extend(bytes.iter().map(|byte| byte.cast_unsigned()));
        self
    }

    fn number(&mut self, bytes: &[u8]) -> &mut Self {
        let length = (self.message.len() - ENCAPSULATION).next_multiple_of(bytes.len());
        self.message.resize(ENCAPSULATION + length, 0);
        self.bytes(bytes)
    }

    /// A number, or the count of a sequence.
    pub fn u32(&mut self, value: u32) -> &mut Self {
        self.number(&value.to_le_bytes())
    }

    /// Numbers, without a count.
    pub fn f64s(&mut self, values: &[f64]) -> &mut Self {
        values.iter().fold(self, |writer, value| writer.number(&value.to_le_bytes()))
    }

    /// A text without zeros in it; its own is added.
    pub fn text(&mut self, text: &str) -> &mut Self {
        self.u32(length(text.len() + 1)).bytes(text.as_bytes()).bytes(&[0])
    }

    /// A `builtin_interfaces/Time`; seconds beyond its 32 bits (the year 2038) are held at their limit.
    pub fn stamp(&mut self, stamp_ns: i64) -> &mut Self {
        let (seconds, limit) = (stamp_ns.div_euclid(1_000_000_000), i64::from(i32::MAX));
        let seconds = seconds.clamp(-limit - 1, limit) as i32;
        self.u32(seconds.cast_unsigned()).u32(stamp_ns.rem_euclid(1_000_000_000) as u32)
    }

    /// A `std_msgs/Header`.
    pub fn header(&mut self, header: &Header) -> &mut Self {
        self.stamp(header.stamp_ns).text(header.frame_id)
    }
}

/// A length as CDR writes it. Nothing of 4 GiB is written here.
pub(crate) fn length(length: usize) -> u32 {
    u32::try_from(length).expect("shorter than 4 GiB")
}
