//! Frames of a WebSocket: RFC 6455, section 5.2.

/// Opcode of a text.
pub const TEXT: u8 = 1;
/// Opcode of a ping.
pub const PING: u8 = 9;
/// Opcode of the answer to a ping.
pub const PONG: u8 = 10;

/// A frame of a client, masked with zeros.
pub fn masked(opcode: u8, payload: &[u8]) -> Vec<u8> {
    let length = u16::try_from(payload.len()).expect("a short message");
    let [high, low] = length.to_be_bytes();
    let length = if length < 126 { vec![0x80 | low] } else { vec![0x80 | 126, high, low] };
    [&[0x80 | opcode], &length[..], &[0; 4], payload].concat()
}
