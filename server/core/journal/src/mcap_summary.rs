//! The end of an MCAP file -> the schemas and channels that its summary repeats, and the places of its records.

use std::collections::{BTreeMap, BTreeSet};
use std::io::{self, Read, Seek, SeekFrom};

use mcap::MAGIC;
use mcap::records::{Record, op};

use super::chunk::{RECORD_HEAD_BYTES, split_record};

/// Length of the fields of the footer.
const FOOTER_BYTES: usize = 20;
/// Length of the record that ends the data.
const DATA_END_BYTES: usize = RECORD_HEAD_BYTES + 4;
/// The head of the record that ends the data; the CRC of the data follows it.
const DATA_END: [u8; RECORD_HEAD_BYTES] = [op::DATA_END, 4, 0, 0, 0, 0, 0, 0, 0];
/// Greatest length of a summary that is read. Ours: a summary has about 100 bytes for each chunk.
const SUMMARY_BYTES_MAX: u64 = 16 << 20;

/// What the summary of a file says of its records.
#[derive(Default)]
pub(super) struct McapSummary {
    /// The schemas and channels.
    pub(super) described: Vec<Record<'static>>,
    /// The channels with a message; `None` if the summary does not say.
    pub(super) with_messages: Option<BTreeSet<u16>>,
    /// Position and kind of the chunks, message indexes, attachments and metadata, of the end of the data and of the
    /// footer. In a file from which a part was cut, or that has one more, a record may be at none of them.
    pub(super) starts: BTreeMap<u64, u8>,
}

impl McapSummary {
    /// Reads the summary of a file up to the first damage; empty if the file is cut.
    ///
    /// # Errors
    /// If the file cannot be read.
    pub(super) fn read(file: &mut (impl Read + Seek)) -> io::Result<Self> {
        let mut summary = Self::default();
        let length = file.seek(SeekFrom::End(0))?;
        let footer_at = length.saturating_sub((RECORD_HEAD_BYTES + FOOTER_BYTES + MAGIC.len()) as u64);
        let Ok(Record::Footer(footer)) = split_record(&mut &read(file, footer_at, length)?[..]) else {
            return Ok(summary);
        };
        summary.starts.insert(footer_at, op::FOOTER);
        let earliest = footer_at.saturating_sub(SUMMARY_BYTES_MAX);
        // The footer is wrong about where the summary begins if a part of the file was cut out.
        let stated = footer.summary_start.saturating_sub(DATA_END_BYTES as u64);
        for from in [stated, earliest].into_iter().filter(|from| (earliest..footer_at).contains(from)) {
            let tail = read(file, from, footer_at)?;
            let Some(at) = tail.windows(DATA_END.len()).rposition(|bytes| bytes == DATA_END) else { continue };
            let data_end = from + at as u64;
            summary.starts.insert(data_end, op::DATA_END);
            let is_moved_by = (data_end + DATA_END_BYTES as u64).wrapping_sub(footer.summary_start);
            summary.add(tail.get(at + DATA_END_BYTES..).unwrap_or_default(), is_moved_by);
            break;
        }
        Ok(summary)
    }

    /// Adds the records of a summary, which stands so many bytes behind the place that its file states.
    fn add(&mut self, mut records: &[u8], is_moved_by: u64) {
        while let Ok(record) = split_record(&mut records) {
            let mut add = |at: u64, kind| {
                self.starts.extend([(at, kind), (at.wrapping_add(is_moved_by), kind)]);
            };
            match &record {
                Record::ChunkIndex(index) => {
                    add(index.chunk_start_offset, op::CHUNK);
                    index.message_index_offsets.values().for_each(|at| add(*at, op::MESSAGE_INDEX));
                }
                Record::AttachmentIndex(index) => add(index.offset, op::ATTACHMENT),
                Record::MetadataIndex(index) => add(index.offset, op::METADATA),
                Record::Statistics(of) if of.message_count == of.channel_message_counts.values().sum::<u64>() => {
                    let counts = of.channel_message_counts.iter().filter(|(_, count)| **count > 0);
                    self.with_messages = Some(counts.map(|(id, _)| *id).collect());
                }
                Record::Schema { .. } | Record::Channel(_) => self.described.push(record.into_owned()),
                _ => {}
            }
        }
    }
}

/// The bytes of a file from one position to another.
fn read(file: &mut (impl Read + Seek), from: u64, to: u64) -> io::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    file.seek(SeekFrom::Start(from))?;
    file.take(to.saturating_sub(from)).read_to_end(&mut bytes)?;
    Ok(bytes)
}
