//! One `velodyne_msgs/msg/VelodyneScan` message, as ROS 2 writes it (CDR).
//!
//! In: the bytes of a message. Out: header and packets, read in place. Layout: four bytes of encapsulation; stamp (sec
//! i32, nanosec u32); frame_id (length u32, text with its zero); packets (count u32, each stamp and 1,206 bytes). Numbers
//! stand at multiples of their size, counted after the encapsulation.

use crate::packet::PACKET_LENGTH;

/// Bytes of one packet in a message, less the padding before it.
const ENTRY_LENGTH: usize = 8 + PACKET_LENGTH;

/// A message, read in place.
#[derive(Clone, Debug)]
pub struct VelodyneScan<'a> {
    /// The header's stamp, ns since the Unix epoch.
    pub stamp_ns: i64,
    /// The sensor's name in the ROS tree.
    pub frame_id: &'a str,
    /// Packets the message says it has.
    pub count: usize,
    reader: Reader<'a>,
}

/// What is wrong with a message.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum VelodyneScanError {
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
    /// A frame name that is no text.
    #[error("frame_id is not UTF-8 ending in a zero")]
    FrameId,
}

impl<'a> VelodyneScan<'a> {
    /// Reads the header and finds the packets.
    ///
    /// # Errors
    /// [`VelodyneScanError`], also if fewer bytes are left than the packets would take.
    pub fn new(message: &'a [u8]) -> Result<Self, VelodyneScanError> {
        let mut reader = Reader::new(message)?;
        let stamp_ns = reader.stamp("header.stamp")?;
        let length = reader.u32("header.frame_id")? as usize;
        let text = reader.take("header.frame_id", length)?;
        let frame_id = text.strip_suffix(&[0]).and_then(|text| std::str::from_utf8(text).ok());
        let count = reader.u32("packets")? as usize;
        let left = message.len() - reader.at;
        let shortest = count.saturating_mul(ENTRY_LENGTH);
        if shortest > left {
            return Err(reader.truncated("packets", shortest));
        }
        Ok(Self { stamp_ns, frame_id: frame_id.ok_or(VelodyneScanError::FrameId)?, count, reader })
    }

    /// The packets in order, each with its stamp, ns since the Unix epoch. An error ends them.
    pub fn packets(&self) -> impl Iterator<Item = Result<(i64, &'a [u8; PACKET_LENGTH]), VelodyneScanError>> + use<'a> {
        let (mut reader, mut left) = (self.reader.clone(), self.count);
        std::iter::from_fn(move || {
            left = left.checked_sub(1)?;
            let packet = reader.packet();
            left = if packet.is_err() { 0 } else { left };
            Some(packet)
        })
    }
}

#[derive(Clone, Debug)]
struct Reader<'a> {
    message: &'a [u8],
    at: usize,
    little_endian: bool,
}

impl<'a> Reader<'a> {
    const ENCAPSULATION: usize = 4;

    fn new(message: &'a [u8]) -> Result<Self, VelodyneScanError> {
        let mut reader = Self { message, at: 0, little_endian: true };
        let head = reader.take("encapsulation", Self::ENCAPSULATION)?;
        reader.little_endian = match [head[0], head[1]] {
            [0, 0] => false,
            [0, 1] => true,
            found => return Err(VelodyneScanError::Encapsulation { found }),
        };
        Ok(reader)
    }

    fn truncated(&self, what: &'static str, needed: usize) -> VelodyneScanError {
        VelodyneScanError::Truncated { what, needed, at: self.at, length: self.message.len() }
    }

    fn take(&mut self, what: &'static str, length: usize) -> Result<&'a [u8], VelodyneScanError> {
        let end = self.at.checked_add(length).filter(|end| *end <= self.message.len());
        let end = end.ok_or_else(|| self.truncated(what, length))?;
        let bytes = &self.message[self.at..end];
        self.at = end;
        Ok(bytes)
    }

    fn u32(&mut self, what: &'static str) -> Result<u32, VelodyneScanError> {
        // The encapsulation is four bytes, so that counting from it or from the start aligns the same.
        self.at = self.at.next_multiple_of(4);
        let bytes = self.take(what, 4)?.try_into().expect("four bytes");
        Ok(if self.little_endian { u32::from_le_bytes(bytes) } else { u32::from_be_bytes(bytes) })
    }

    fn stamp(&mut self, what: &'static str) -> Result<i64, VelodyneScanError> {
        let seconds = self.u32(what)? as i32;
        Ok(i64::from(seconds) * 1_000_000_000 + i64::from(self.u32(what)?))
    }

    fn packet(&mut self) -> Result<(i64, &'a [u8; PACKET_LENGTH]), VelodyneScanError> {
        let stamp_ns = self.stamp("packets[].stamp")?;
        let data = self.take("packets[].data", PACKET_LENGTH)?;
        Ok((stamp_ns, data.try_into().expect("that many bytes")))
    }
}
