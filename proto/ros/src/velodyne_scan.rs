//! One `velodyne_msgs/msg/VelodyneScan` message.
//!
//! In: the bytes of a message. Out: header and packets, without a copy. Layout: header; packets (count u32, then for
//! each a stamp and 1,206 bytes).

use crate::cdr::{MessageError, Reader};

/// Bytes of one data packet.
pub const PACKET_LENGTH: usize = 1206;
/// Bytes of one packet in a message without the padding before it.
const ENTRY_LENGTH: usize = 8 + PACKET_LENGTH;

/// A message whose bytes are borrowed.
#[derive(Clone, Debug)]
pub struct VelodyneScan<'a> {
    /// Frame of the sensor, as written. The header's stamp is not read: each packet has its own.
    pub frame_id: &'a str,
    /// Number of packets.
    pub count: usize,
    reader: Reader<'a>,
}

impl<'a> VelodyneScan<'a> {
    /// Reads the frame and finds the packets.
    ///
    /// # Errors
    /// [`MessageError`] as of [`Reader`]; [`MessageError::Truncated`] also if the message has fewer bytes than the
    /// packets need.
    pub fn new(message: &'a [u8]) -> Result<Self, MessageError> {
        let mut reader = Reader::new(message)?;
        reader.u32("header.stamp")?;
        reader.u32("header.stamp")?;
        let frame_id = reader.text("header.frame_id")?;
        let count = reader.count("packets", ENTRY_LENGTH)?;
        Ok(Self { frame_id, count, reader })
    }

    /// The packets in order, each with its time in ns since the Unix epoch. A wrong time costs its packet alone; the
    /// iterator ends where the message does.
    pub fn packets(&self) -> impl Iterator<Item = Result<(i64, &'a [u8; PACKET_LENGTH]), MessageError>> + use<'a> {
        let (mut reader, mut left) = (self.reader.clone(), self.count);
        std::iter::from_fn(move || {
            left = left.checked_sub(1)?;
            let packet = packet(&mut reader);
            left = if matches!(packet, Err(MessageError::Truncated { .. })) { 0 } else { left };
            Some(packet)
        })
    }
}

fn packet<'a>(reader: &mut Reader<'a>) -> Result<(i64, &'a [u8; PACKET_LENGTH]), MessageError> {
    let stamp_ns = reader.stamp("packets[].stamp");
    let data = reader.read_bytes("packets[].data", PACKET_LENGTH)?;
    Ok((stamp_ns?, data.try_into().expect("1,206 bytes")))
}
