//! The number of parts that an encoded map claims, counted before any is decoded.
//!
//! In: an encoded `clearway.v1.Map`. Out: its layers, channels, planes, sensors and names together. Two bytes can claim
//! an empty layer, which needs a hundred times as many in memory; so the fields are counted before they are decoded.

use prost::encoding::{DecodeContext, WireType, decode_key, decode_varint, skip_field};

/// Fields of `Map` whose parts repeat: `header` and `layers`.
const NESTING: [u32; 2] = [1, 2];

/// Number of length-delimited fields of a map, of its header and of its layers, up to the first byte that is not
/// protobuf: there the decoder stops too.
pub(crate) fn count(map: &[u8]) -> usize {
    Parts(map).map(|(tag, content)| 1 + if NESTING.contains(&tag) { Parts(content).count() } else { 0 }).sum()
}

/// Tag and content of every length-delimited field of a message.
struct Parts<'a>(&'a [u8]);

impl<'a> Iterator for Parts<'a> {
    type Item = (u32, &'a [u8]);

    fn next(&mut self) -> Option<Self::Item> {
        while !self.0.is_empty() {
            let (tag, wire_type) = decode_key(&mut self.0).ok()?;
            if wire_type == WireType::LengthDelimited {
                let length = usize::try_from(decode_varint(&mut self.0).ok()?).ok()?;
                let (content, rest) = self.0.split_at_checked(length)?;
                self.0 = rest;
                return Some((tag, content));
            }
            skip_field(wire_type, tag, &mut self.0, DecodeContext::default()).ok()?;
        }
        None
    }
}
