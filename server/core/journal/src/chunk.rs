//! One MCAP chunk -> its records. Damage of any kind is an error and never a panic.
//!
//! Chunks are split here, because the reader of the crate `mcap` trusts the length of a record that reaches beyond its
//! chunk.

use std::borrow::Cow;
use std::collections::{BTreeMap, BTreeSet};
use std::io::Read;

use mcap::records::{ChunkHeader, MessageIndexEntry, Record, op};
use mcap::{McapError, parse_record};

/// Greatest length of a record, and of a decompressed chunk, in bytes. Ours: our chunks have a few MiB; a greater
/// length is damage, refused before it is allocated.
pub(super) const RECORD_BYTES_MAX: usize = 256 << 20;
/// Length of the head of a record: its kind (one byte) and its length (eight bytes).
pub(super) const RECORD_HEAD_BYTES: usize = 9;
/// Length of the fields of a chunk before its data, without the name of its compression.
pub(super) const CHUNK_FIELDS_BYTES: usize = 40;
/// Greatest length of fields that a later version of the format adds to a record. Ours.
const ADDED_BYTES_MAX: usize = 1024;
/// Length of the head of a message, its channel (two bytes), its sequence number (four) and its log time (eight).
const MESSAGE_START_BYTES: usize = RECORD_HEAD_BYTES + 14;

/// Decompresses a chunk and checks its length and, if it has one, its CRC.
pub(super) fn decompress<'a>(header: &ChunkHeader, data: &'a [u8]) -> Result<Cow<'a, [u8]>, McapError> {
    let size = usize::try_from(header.uncompressed_size).ok().filter(|size| *size <= RECORD_BYTES_MAX);
    let size = size.ok_or(McapError::ChunkTooLarge(header.uncompressed_size))?;
    let content = match &*header.compression {
        "" => Cow::Borrowed(data),
        "zstd" => zstd::bulk::decompress(data, size)
            .map(Cow::Owned)
            .map_err(|error| McapError::DecompressionError(error.to_string()))?,
        "lz4" => decompress_lz4(data, size).map(Cow::Owned)?,
        other => return Err(McapError::UnsupportedCompression(other.into())),
    };
    if content.len() != size {
        return Err(McapError::UnexpectedEoc);
    }
    let (saved, calculated) = (header.uncompressed_crc, crc32fast::hash(&content));
    if saved != 0 && saved != calculated {
        return Err(McapError::BadChunkCrc { saved, calculated });
    }
    Ok(content)
}

/// Decompresses an LZ4 frame to at most `size` + 1 bytes; the caller refuses any other length than `size`.
fn decompress_lz4(data: &[u8], size: usize) -> Result<Vec<u8>, McapError> {
    let mut content = Vec::new();
    let frame = lz4_flex::frame::FrameDecoder::new(data);
    let read = frame.take(size as u64 + 1).read_to_end(&mut content);
    read.map_err(|error| McapError::DecompressionError(error.to_string()))?;
    Ok(content)
}

/// Splits the first record off the content of a chunk.
pub(super) fn split_record<'a>(content: &mut &'a [u8]) -> Result<Record<'a>, McapError> {
    let (head, rest) = content.split_at_checked(RECORD_HEAD_BYTES).ok_or(McapError::UnexpectedEoc)?;
    let length = u64::from_le_bytes(head[1..].try_into().expect("eight bytes"));
    let length = usize::try_from(length).map_err(|_| McapError::UnexpectedEoc)?;
    let (body, rest) = rest.split_at_checked(length).ok_or(McapError::UnexpectedEoc)?;
    *content = rest;
    parse(head[0], body)
}

/// Parses a record, and refuses one whose length is not that of its fields, because its kind or its length is damaged.
pub(super) fn parse_strictly(opcode: u8, body: &[u8]) -> Result<Record<'_>, McapError> {
    let record = parse(opcode, body)?;
    let fields = fields_bytes(&record);
    if fields.is_some_and(|fields| body.len() > fields + ADDED_BYTES_MAX) {
        return Err(McapError::UnexpectedEof);
    }
    let length = match &record {
        Record::Footer(_) => 20,
        Record::DataEnd(_) => 4,
        Record::SummaryOffset(_) => 17,
        Record::MessageIndex(index) => 6 + 16 * index.records.len(),
        Record::Chunk { header, data } => CHUNK_FIELDS_BYTES + header.compression.len() + data.len(),
        _ => body.len(),
    };
    if length == body.len() { Ok(record) } else { Err(McapError::UnexpectedEof) }
}

/// True if a record of this kind is longer than its known fields: a later version of the format has added some, or its
/// length is damaged.
pub(super) fn has_added_bytes(opcode: u8, body: &[u8]) -> bool {
    let is_extensible = matches!(opcode, op::HEADER | op::SCHEMA | op::CHANNEL | op::METADATA | op::ATTACHMENT);
    let record = is_extensible.then(|| parse_strictly(opcode, body).ok()).flatten();
    record.and_then(|record| fields_bytes(&record)).is_some_and(|fields| body.len() > fields)
}

/// Length of the known fields of a record to whose end a later version of the format may add fields, and which is
/// short.
fn fields_bytes(record: &Record<'_>) -> Option<usize> {
    let texts = |texts: &BTreeMap<String, String>| {
        size_of::<u32>()
            + texts.iter().map(|(key, value)| 2 * size_of::<u32>() + key.len() + value.len()).sum::<usize>()
    };
    match record {
        Record::Header(of) => Some(8 + of.profile.len() + of.library.len()),
        Record::Schema { header, data } => Some(14 + header.name.len() + header.encoding.len() + data.len()),
        Record::Channel(of) => Some(12 + of.topic.len() + of.message_encoding.len() + texts(&of.metadata)),
        Record::Metadata(of) => Some(4 + of.name.len() + texts(&of.metadata)),
        Record::Attachment { header, data, .. } => Some(36 + header.name.len() + header.media_type.len() + data.len()),
        _ => None,
    }
}

/// True if an entry of a chunk's index leads to a message of this channel with the entry's time.
pub(super) fn is_message(content: &[u8], channel_id: u16, entry: &MessageIndexEntry) -> bool {
    let at = usize::try_from(entry.offset).ok();
    let message = at.and_then(|at| content.get(at..)?.get(..MESSAGE_START_BYTES));
    message.is_some_and(|bytes| message_of(bytes) == Some((channel_id, entry.log_time)))
}

/// The body of the index of the messages of this channel, in their order in the chunk.
pub(super) fn index_of(content: &[u8], channel_id: u16) -> Vec<u8> {
    let mut entries = Vec::new();
    for (at, _, log_time) in messages(content).filter(|(_, channel, _)| *channel == channel_id) {
        entries.extend(log_time.to_le_bytes());
        entries.extend((at as u64).to_le_bytes());
    }
    let length = u32::try_from(entries.len()).unwrap_or(u32::MAX);
    [&channel_id.to_le_bytes()[..], &length.to_le_bytes(), &entries].concat()
}

/// The channels of the messages of a chunk.
pub(super) fn channels_of(content: &[u8]) -> BTreeSet<u16> {
    messages(content).map(|(_, channel, _)| channel).collect()
}

/// Position, channel and log time of each message of a chunk.
fn messages(content: &[u8]) -> impl Iterator<Item = (usize, u16, u64)> {
    let mut next = 0_usize;
    let heads = std::iter::from_fn(move || {
        let (at, bytes) = (next, content.get(next..)?.get(..MESSAGE_START_BYTES)?);
        let length = u64::from_le_bytes(bytes[1..RECORD_HEAD_BYTES].try_into().expect("eight bytes"));
        next = at.saturating_add(RECORD_HEAD_BYTES).saturating_add(usize::try_from(length).unwrap_or(usize::MAX));
        Some((at, bytes))
    });
    heads.filter_map(|(at, bytes)| message_of(bytes).map(|(channel, log_time)| (at, channel, log_time)))
}

/// The channel and the log time of the message that starts with these bytes; `None` if it is another record.
fn message_of(bytes: &[u8]) -> Option<(u16, u64)> {
    let fields = bytes.get(RECORD_HEAD_BYTES..).filter(|_| bytes[0] == op::MESSAGE)?;
    let channel_id = u16::from_le_bytes(fields[..2].try_into().ok()?);
    Some((channel_id, u64::from_le_bytes(fields[6..14].try_into().ok()?)))
}

/// The name of an attachment, from the body of its record; `None` if it has none that can be read.
pub(super) fn attachment_name(body: &[u8]) -> Option<String> {
    let length = u32::from_le_bytes(body.get(16..20)?.try_into().ok()?) as usize;
    let name = body.get(20..)?.get(..length)?;
    Some(String::from_utf8_lossy(name).into_owned())
}

/// Parses a record. Refuses an attachment that ends before its CRC, at which `mcap` would panic.
pub(super) fn parse(opcode: u8, body: &[u8]) -> Result<Record<'_>, McapError> {
    let text_end = |at: usize| {
        let length = body.get(at..at.checked_add(4)?)?;
        (at + 4).checked_add(u32::from_le_bytes(length.try_into().ok()?) as usize)
    };
    // Two stamps, a name, a media type, the data's length (8 bytes), the data, its CRC (4).
    let data_from = || text_end(16).and_then(text_end).map(|at| at + 8);
    if opcode == op::ATTACHMENT && data_from().is_some_and(|from| from + 4 > body.len()) {
        return Err(McapError::UnexpectedEof);
    }
    parse_record(opcode, body)
}

/// The number of four bytes at this position.
pub(super) fn u32_at(bytes: &[u8], at: usize) -> u32 {
    u32::from_le_bytes(bytes[at..at + 4].try_into().expect("four bytes"))
}

/// The number of eight bytes at this position.
pub(super) fn u64_at(bytes: &[u8], at: usize) -> u64 {
    u64::from_le_bytes(bytes[at..at + 8].try_into().expect("eight bytes"))
}

#[cfg(test)]
mod tests {
    use std::io::Write;

    use super::*;

    fn header(compression: &str, uncompressed_size: u64, uncompressed_crc: u32) -> ChunkHeader {
        let compression = compression.into();
        let (message_start_time, message_end_time, compressed_size) = (0, 0, 0);
        ChunkHeader {
            message_start_time,
            message_end_time,
            uncompressed_size,
            uncompressed_crc,
            compression,
            compressed_size,
        }
    }

    #[test]
    fn an_lz4_chunk_is_decompressed_and_a_wrong_length_or_crc_is_damage() {
        let content = [7_u8; 5000];
        let mut encoder = lz4_flex::frame::FrameEncoder::new(Vec::new());
        encoder.write_all(&content).unwrap();
        let data = encoder.finish().unwrap();
        let decompress = |size, crc| decompress(&header("lz4", size, crc), &data).map(Cow::into_owned);
        assert_eq!(decompress(5000, crc32fast::hash(&content)).unwrap(), content);
        assert!(matches!(decompress(5000, 1), Err(McapError::BadChunkCrc { .. })));
        for size in [0, 4999, 5001] {
            assert!(matches!(decompress(size, 0), Err(McapError::UnexpectedEoc)), "{size}");
        }
        assert!(matches!(decompress(u64::MAX, 0), Err(McapError::ChunkTooLarge(_))));
    }

    #[test]
    fn bytes_that_are_not_an_lz4_frame_are_damage() {
        for data in [&b""[..], b"abcdefgh", &[0x04, 0x22, 0x4d, 0x18, 0xff, 0xff, 0xff, 0xff, 0xff]] {
            assert!(decompress(&header("lz4", 10, 0), data).is_err(), "{data:?}");
        }
        assert!(matches!(decompress(&header("lzma", 10, 0), b""), Err(McapError::UnsupportedCompression(_))));
    }
}
