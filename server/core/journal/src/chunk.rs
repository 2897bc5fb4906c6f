//! One MCAP chunk -> its records. Damage of any kind is an error and never a panic.
//!
//! The crate `mcap` reads records, not chunks: its `LinearReader` fills memory of the size that a chunk claims before
//! it has decompressed a byte (100 chunks that claim 64 MiB, a file of 6 kB: 15 s, here 0.1 s), reads lz4 through a C
//! library, and its `ChunkReader` aborts at a damaged length.

use std::borrow::Cow;
use std::io::Read;

use mcap::records::{ChunkHeader, MessageIndexEntry, Record, op};
use mcap::{McapError, parse_record};

/// Greatest length of a record, and of a decompressed chunk or message, in bytes. Ours: our chunks have a few MiB, a
/// cloud or an image less than 40; a greater length is damage, refused before it is allocated. A reader holds up to
/// four times as much.
pub(super) const RECORD_BYTES_MAX: usize = 64 << 20;
/// Most bytes that a file may decompress to for each of its bytes, beside [`RECORD_BYTES_MAX`]. Ours: recorded drives
/// have 2 to 20.
const COMPRESSION_MAX: u64 = 200;
/// Length of the head of a record: its kind (one byte) and its length (eight bytes).
pub(super) const RECORD_HEAD_BYTES: usize = 9;
/// Length of the fields of a chunk before its data, without the name of its compression.
const CHUNK_FIELDS_BYTES: usize = 40;
/// Length of the head of a message, its channel (two bytes), its sequence number (four) and its log time (eight).
const MESSAGE_START_BYTES: usize = RECORD_HEAD_BYTES + 14;

/// True if the first `file_bytes` of a file may decompress to so many bytes: a small file does not keep a command busy
/// for minutes.
pub(super) fn may_decompress(bytes: u64, file_bytes: u64) -> bool {
    bytes <= (RECORD_BYTES_MAX as u64).saturating_add(COMPRESSION_MAX.saturating_mul(file_bytes))
}

/// Decompresses a chunk and checks its length and, if it has one, its CRC. `before`: bytes of the chunks before it,
/// decompressed; `end`: position of its end in the file.
pub(super) fn decompress<'a>(
    header: &ChunkHeader,
    data: &'a [u8],
    before: u64,
    end: u64,
) -> Result<Cow<'a, [u8]>, McapError> {
    let size = usize::try_from(header.uncompressed_size).ok().filter(|size| *size <= RECORD_BYTES_MAX);
    let size = size.ok_or(McapError::ChunkTooLarge(header.uncompressed_size))?;
    if !may_decompress(before + size as u64, end) {
        return Err(McapError::DecompressionError("the file decompresses to far too much".into()));
    }
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

/// Parses a record, and refuses one whose fields do not fill it, because its kind or its length is damaged.
pub(super) fn parse_strictly(opcode: u8, body: &[u8]) -> Result<Record<'_>, McapError> {
    let record = parse(opcode, body)?;
    let length = match &record {
        Record::Footer(_) => 20,
        Record::DataEnd(_) => 4,
        Record::MessageIndex(index) => 6 + 16 * index.records.len(),
        Record::Chunk { header, data } => CHUNK_FIELDS_BYTES + header.compression.len() + data.len(),
        _ => body.len(),
    };
    if length == body.len() { Ok(record) } else { Err(McapError::UnexpectedEof) }
}

/// True if an entry of a chunk's index leads to a message of this channel with the entry's time.
pub(super) fn is_message(content: &[u8], channel_id: u16, entry: &MessageIndexEntry) -> bool {
    let at = usize::try_from(entry.offset).ok();
    let Some(head) = at.and_then(|at| content.get(at..)?.first_chunk::<MESSAGE_START_BYTES>()) else { return false };
    head[0] == op::MESSAGE
        && head[RECORD_HEAD_BYTES..RECORD_HEAD_BYTES + 2] == channel_id.to_le_bytes()
        && head[RECORD_HEAD_BYTES + 6..] == entry.log_time.to_le_bytes()
}

/// The name of an attachment, from the body of its record; `None` if it has none that can be read.
pub(super) fn attachment_name(body: &[u8]) -> Option<String> {
    let length = u32::from_le_bytes(body.get(16..20)?.try_into().ok()?) as usize;
    let name = body.get(20..)?.get(..length)?;
    Some(String::from_utf8_lossy(name).into_owned())
}

/// Parses a record. Refuses an attachment that ends before its CRC, at which `mcap` would panic.
fn parse(opcode: u8, body: &[u8]) -> Result<Record<'_>, McapError> {
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
        let decompress = |size, crc| decompress(&header("lz4", size, crc), &data, 0, 0).map(Cow::into_owned);
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
            assert!(decompress(&header("lz4", 10, 0), data, 0, 0).is_err(), "{data:?}");
        }
        assert!(matches!(decompress(&header("lzma", 10, 0), b"", 0, 0), Err(McapError::UnsupportedCompression(_))));
    }
}
