//! The bytes of a section of an MCAP file -> whether they are those of which its CRC was taken; if not, whether only
//! message indexes have changed, which repeat what chunks hold.

use crc32fast::Hasher;

use super::chunk::RECORD_HEAD_BYTES;

/// The CRC of the section that is read.
#[derive(Default)]
pub(super) struct SectionCrc {
    crc: Hasher,
    /// The CRC with each message index as it should be; `None` while all of them agree with their chunks.
    with_indexes: Option<Hasher>,
    /// The bytes of the file that hold the message indexes that do not agree with their chunk.
    wrong_indexes: Vec<(u64, u64)>,
}

/// What the CRC says about a section.
#[derive(Debug, PartialEq)]
pub(super) enum Finding {
    /// No byte has changed, or the section has no CRC.
    Whole,
    /// Only these message indexes have changed: the bytes of the file from the first up to, without, the second.
    Indexes(Vec<(u64, u64)>),
    /// Other bytes have changed; the CRC of the section as it is.
    Changed(u32),
}

impl SectionCrc {
    /// Adds the next bytes of the section.
    pub(super) fn update(&mut self, bytes: &[u8]) {
        self.crc.update(bytes);
        if let Some(crc) = &mut self.with_indexes {
            crc.update(bytes);
        }
    }

    /// Adds a message index that does not agree with its chunk: its record, which starts at `offset` of the file, and
    /// the body that it should have. Only the CRC can tell whether the index is damaged or its writer orders it in
    /// another way.
    pub(super) fn update_wrong_index(&mut self, offset: u64, record: &[u8], body: &[u8]) {
        let crc = self.with_indexes.take().unwrap_or_else(|| self.crc.clone());
        self.crc.update(record);
        let with_indexes = self.with_indexes.insert(crc);
        with_indexes.update(&record[..RECORD_HEAD_BYTES]);
        with_indexes.update(body);
        self.wrong_indexes.push((offset, offset + record.len() as u64));
    }

    /// Compares with the CRC that the file has for the section; 0 is no CRC.
    pub(super) fn compare(&self, saved: u32) -> Finding {
        let crc = self.crc.clone().finalize();
        let with_indexes = self.with_indexes.clone().map(Hasher::finalize);
        match saved {
            0 => Finding::Whole,
            saved if saved == crc => Finding::Whole,
            saved if Some(saved) == with_indexes => Finding::Indexes(self.wrong_indexes.clone()),
            _ => Finding::Changed(crc),
        }
    }
}

/// What is wrong with a section whose bytes have changed.
pub(super) fn wrong_crc(section: &str, calculated: u32, saved: u32) -> String {
    format!(
        "the CRC of the {section} section is {calculated:08x} and should be {saved:08x}: records outside of its chunks \
         have changed"
    )
}
