//! The message indexes behind a chunk -> whether a part of the file that cannot be read was only some of them.
//!
//! A writer puts an index for each channel of a chunk behind the chunk. An index repeats what the chunk holds, so its
//! loss costs no message.

use std::collections::BTreeSet;

use mcap::records::{MessageIndex, Record, op};

use super::chunk::{RECORD_HEAD_BYTES, channels_of, index_of, is_message, parse_strictly};

/// The indexes that were read since the newest chunk.
#[derive(Default)]
pub(super) struct ChunkIndexes {
    read: BTreeSet<u16>,
}

impl ChunkIndexes {
    /// Adds an index with this body. `None` if it is one of the chunk with this content, else the body that it should
    /// have: of the indexes that the chunk still lacks, the most like it.
    pub(super) fn add(&mut self, index: &MessageIndex, body: &[u8], content: &[u8]) -> Option<Vec<u8>> {
        if index.records.iter().all(|entry| is_message(content, index.channel_id, entry)) {
            self.read.insert(index.channel_id);
            return None;
        }
        let missing = channels_of(content).into_iter().filter(|channel| !self.read.contains(channel));
        let right = missing.map(|channel| index_of(content, channel)).filter(|right| right.len() == body.len());
        let difference = |right: &Vec<u8>| right.iter().zip(body).filter(|(right, found)| right != found).count();
        Some(right.min_by_key(difference).unwrap_or_else(|| body.to_owned()))
    }

    /// True if this body of a record is an index of the chunk with this content.
    pub(super) fn is_index(body: &[u8], content: &[u8]) -> bool {
        let is_message = |index: &MessageIndex| {
            let mut entries = index.records.iter();
            !index.records.is_empty() && entries.all(|entry| is_message(content, index.channel_id, entry))
        };
        !content.is_empty()
            && matches!(parse_strictly(op::MESSAGE_INDEX, body), Ok(Record::MessageIndex(index)) if is_message(&index))
    }

    /// Length of the indexes that a chunk with this content still lacks, in bytes.
    pub(super) fn missing_bytes(&self, content: &[u8]) -> u64 {
        let missing = channels_of(content).into_iter().filter(|channel| !self.read.contains(channel));
        missing.map(|channel| (RECORD_HEAD_BYTES + index_of(content, channel).len()) as u64).sum()
    }
}
