//! The bytes of an MCAP file -> its records, with the records of its chunks, in file order; and the parts of the file
//! that cannot be read.
//!
//! A damaged record costs that record: its length or, if that is damaged too, a search finds the next one. A record
//! found by the search is accepted only if its fields agree with each other and with what follows.

use std::collections::BTreeMap;
use std::io::{self, Read};

use crc32fast::Hasher;
use mcap::records::{MessageIndex, Record, op};
use mcap::{MAGIC, McapError};

use super::chunk::{RECORD_BYTES_MAX, RECORD_HEAD_BYTES, decompress, parse, split_record};

/// Bytes that a search reads at once.
const SEARCH_BYTES: usize = 1 << 20;
/// Length of the fields of a chunk before its data, without the name of its compression.
const CHUNK_FIELDS_BYTES: usize = 40;
/// Least kind of the records that programs define for themselves.
const PRIVATE: u8 = 0x80;
/// Names of the compressions, as chunks have them.
const COMPRESSIONS: [&[u8]; 3] = [b"", b"zstd", b"lz4"];

/// A part of a file that cannot be read.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct LostPart {
    /// The bytes of the file from the first up to, without, the second.
    pub(super) bytes: (u64, u64),
    pub(super) reason: String,
    /// Least and greatest log time of the lost messages, if known; ns since the Unix epoch.
    pub(super) log_ns: Option<(u64, u64)>,
    /// Number of lost messages, by id of the channel, as far as known.
    pub(super) messages: BTreeMap<u16, u64>,
}

/// The records of an MCAP file cannot be read further.
#[derive(Debug)]
pub(super) enum RecordsError {
    Read(io::Error),
    NotMcap,
}

impl From<io::Error> for RecordsError {
    fn from(error: io::Error) -> Self {
        Self::Read(error)
    }
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum Section {
    Start,
    Data,
    Summary,
    Ended,
}

/// An MCAP file while it is read.
pub(super) struct McapRecords {
    source: Box<dyn Read + Send>,
    /// Bytes that are read and not consumed, from `start`.
    buffer: Vec<u8>,
    start: usize,
    /// Position of the first byte that is not consumed.
    offset: u64,
    section: Section,
    /// The rest of the newest chunk's content, from this position.
    chunk: (Vec<u8>, usize),
    /// The bytes of the chunk in the file.
    chunk_bytes: (u64, u64),
    /// CRC of the consumed bytes of the section.
    crc: Hasher,
    /// True if a file that does not start as MCAP files do is searched for records.
    any_start: bool,
    has_chunks: bool,
    /// True while message indexes belong to the newest lost part.
    indexes_are_lost: bool,
    /// The bytes of the newest record, if it is of a private kind. Message indexes behind it say that it was a chunk.
    private: Option<(u64, u64)>,
    has_footer: bool,
    lost: Vec<LostPart>,
}

impl McapRecords {
    /// Reads from `source`. With `any_start`, wrong first bytes are damage and not an error.
    pub(super) fn new(source: impl Read + Send + 'static, any_start: bool) -> Self {
        Self {
            source: Box::new(source),
            buffer: Vec::new(),
            start: 0,
            offset: 0,
            section: Section::Start,
            chunk: (Vec::new(), 0),
            chunk_bytes: (0, 0),
            crc: Hasher::new(),
            any_start,
            has_chunks: false,
            indexes_are_lost: false,
            private: None,
            has_footer: false,
            lost: Vec::new(),
        }
    }

    /// Number of bytes read and consumed so far.
    pub(super) fn offset(&self) -> u64 {
        self.offset
    }

    /// True if the file has its closing records.
    pub(super) fn has_footer(&self) -> bool {
        self.has_footer
    }

    /// The parts so far that cannot be read.
    pub(super) fn lost(&self) -> &[LostPart] {
        &self.lost
    }

    /// The next record; `None` at the end. Chunks are not returned, but their records are.
    pub(super) fn next(&mut self) -> Result<Option<Record<'static>>, RecordsError> {
        loop {
            if let Some(record) = self.next_of_chunk() {
                return Ok(Some(record));
            }
            match self.section {
                Section::Start => self.read_start()?,
                Section::Ended => return Ok(None),
                Section::Data | Section::Summary => {
                    if let Some(record) = self.read_record()? {
                        return Ok(Some(record));
                    }
                }
            }
        }
    }

    /// The next record of the open chunk. A record that reaches beyond its chunk ends the chunk.
    fn next_of_chunk(&mut self) -> Option<Record<'static>> {
        let (content, position) = &mut self.chunk;
        let mut rest = content.get(*position..).filter(|rest| !rest.is_empty())?;
        let record = split_record(&mut rest).map(Record::into_owned);
        *position = content.len() - rest.len();
        match record {
            Ok(record) => Some(record),
            Err(error) => {
                content.clear();
                self.add_lost(self.chunk_bytes, &error);
                None
            }
        }
    }

    fn read_start(&mut self) -> Result<(), RecordsError> {
        self.section = Section::Data;
        if self.fill(MAGIC.len())? && self.bytes().starts_with(MAGIC) {
            self.consume(MAGIC.len());
        } else if self.any_start {
            self.search("the file does not start with the magic bytes")?;
            if self.section == Section::Ended {
                return Err(RecordsError::NotMcap);
            }
        } else {
            return Err(RecordsError::NotMcap);
        }
        Ok(())
    }

    /// Reads the record at the current position. `None` if it was a chunk, damage or the end.
    fn read_record(&mut self) -> Result<Option<Record<'static>>, RecordsError> {
        if !self.fill(RECORD_HEAD_BYTES)? {
            self.section = Section::Ended;
            return Ok(None);
        }
        let (opcode, length) = head(self.bytes());
        let Some(length) = length.filter(|_| is_opcode(opcode)) else {
            self.search("a record has an unknown kind or an impossible length")?;
            return Ok(None);
        };
        let end = RECORD_HEAD_BYTES + length;
        if !self.fill(end)? {
            // Either a crash has cut the file here, or the length is damaged and other records follow.
            self.search("a record reaches beyond the end of the file")?;
            return Ok(None);
        }
        let record = parse_strictly(opcode, &self.bytes()[RECORD_HEAD_BYTES..end]);
        let from = self.offset;
        let read = match record {
            Ok(Record::Chunk { header, data }) => match decompress(&header, &data) {
                Ok(content) => {
                    self.chunk = (content.into_owned(), 0);
                    self.chunk_bytes = (from, from + end as u64);
                    (self.has_chunks, self.indexes_are_lost) = (true, false);
                    Ok(None)
                }
                Err(error) => Err((error, Some((header.message_start_time, header.message_end_time)))),
            },
            Ok(record) => Ok(Some(record.into_owned())),
            Err(error) => Err((error, None)),
        };
        match read {
            Ok(record) => {
                if matches!(record, Some(Record::DataEnd(_) | Record::Footer(_))) {
                    self.check_section(record.as_ref(), end)?;
                } else {
                    self.consume(end);
                }
                let private = self.private.take();
                if let Some(Record::MessageIndex(index)) = &record {
                    private
                        .into_iter()
                        .for_each(|chunk| self.add_lost(chunk, &"a chunk has the kind of other records"));
                    self.add_index(index);
                }
                self.private = Some((from, self.offset)).filter(|_| opcode >= PRIVATE);
                Ok(record)
            }
            Err((error, _)) if !self.head_at(end)? => {
                self.search(&error.to_string())?;
                Ok(None)
            }
            Err((error, log_ns)) => {
                self.consume(end);
                self.add_lost((from, self.offset), &error);
                if let Some(lost) = self.lost.last_mut() {
                    lost.log_ns = log_ns.filter(|(first, last)| first <= last && *last > 0);
                }
                Ok(None)
            }
        }
    }

    /// Checks the CRC of the section that this record ends, and what follows the last record.
    fn check_section(&mut self, record: Option<&Record<'_>>, end: usize) -> Result<(), RecordsError> {
        let (from, is_whole) = (self.offset, self.lost.is_empty());
        let (saved, name) = match record {
            Some(Record::Footer(footer)) => {
                // The CRC covers the footer up to the CRC itself.
                let covered = end - size_of::<u32>();
                self.consume(covered);
                let crc = self.crc.clone().finalize();
                self.consume(end - covered);
                (Some((footer.summary_crc, crc)), "summary")
            }
            Some(Record::DataEnd(data_end)) => {
                let crc = self.crc.clone().finalize();
                self.consume(end);
                self.crc = Hasher::new();
                self.section = Section::Summary;
                (Some((data_end.data_section_crc, crc)), "data")
            }
            _ => (None, ""),
        };
        if let Some((saved, calculated)) = saved.filter(|(saved, is)| *saved != 0 && saved != is && is_whole) {
            let reason = format!(
                "the CRC of the {name} section is {calculated:08x} and should be {saved:08x}: bytes outside of its \
                 chunks have changed"
            );
            self.add_lost((from, self.offset), &reason);
        }
        if matches!(record, Some(Record::Footer(_))) {
            self.has_footer = self.fill(MAGIC.len())? && self.bytes().starts_with(MAGIC);
            self.section = Section::Ended;
            if self.has_footer {
                self.consume(MAGIC.len());
                let end = self.offset;
                while self.fill(1)? {
                    self.consume(self.bytes().len());
                }
                if self.offset > end {
                    self.add_lost((end, self.offset), &"bytes after the end of the recording");
                }
            }
        }
        Ok(())
    }

    /// Adds the messages of an index to the newest lost part, if they were in it.
    fn add_index(&mut self, index: &MessageIndex) {
        let Some(lost) = self.lost.last_mut().filter(|_| self.indexes_are_lost) else { return };
        *lost.messages.entry(index.channel_id).or_default() += index.records.len() as u64;
        for at in index.records.iter().map(|entry| entry.log_time) {
            lost.log_ns = Some(lost.log_ns.map_or((at, at), |(first, last)| (first.min(at), last.max(at))));
        }
    }

    fn add_lost(&mut self, bytes: (u64, u64), reason: &dyn std::fmt::Display) {
        let reason = reason.to_string();
        self.lost.push(LostPart { bytes, reason, log_ns: None, messages: BTreeMap::new() });
        self.indexes_are_lost = true;
    }

    /// Consumes bytes up to the next record after the current position, or to the end of the file.
    fn search(&mut self, reason: &str) -> Result<(), RecordsError> {
        let from = self.offset;
        let mut at = 1;
        loop {
            if !self.fill(at + RECORD_HEAD_BYTES)? {
                break;
            }
            if self.is_record_at(at)? {
                self.consume(at);
                self.add_lost((from, self.offset), &reason);
                return Ok(());
            }
            at += 1;
            if at == SEARCH_BYTES {
                self.consume(at);
                at = 0;
            }
        }
        // Nothing follows: the file is cut within a record. It is incomplete without being damaged.
        self.consume(self.bytes().len());
        self.section = Section::Ended;
        Ok(())
    }

    /// True if a record is `at` bytes after the current position: its fields agree with each other and with what
    /// follows it.
    fn is_record_at(&mut self, at: usize) -> Result<bool, RecordsError> {
        let (opcode, Some(length)) = head(&self.bytes()[at..]) else { return Ok(false) };
        let (body, end) = (at + RECORD_HEAD_BYTES, at + RECORD_HEAD_BYTES + length);
        let may_be = match opcode {
            op::CHUNK => return Ok(length >= CHUNK_FIELDS_BYTES && self.is_chunk(body, length)?),
            op::FOOTER => {
                let is_whole = length == 20 && self.fill(end + MAGIC.len())?;
                return Ok(is_whole && self.bytes()[end..].starts_with(MAGIC));
            }
            op::DATA_END => length == 4,
            op::MESSAGE_INDEX => {
                length >= 6 && self.fill(body + 6)? && {
                    let bytes = &self.bytes()[body + 2..body + 6];
                    (length - 6).is_multiple_of(16) && u32_at(bytes, 0) as usize == length - 6
                }
            }
            op::SCHEMA | op::CHANNEL | op::METADATA | op::ATTACHMENT => length >= 8,
            // In a file with chunks, all messages are in chunks.
            op::MESSAGE => length >= 22 && !self.has_chunks,
            _ => false,
        };
        if !may_be || !self.head_at(end)? || !self.fill(end)? {
            return Ok(false);
        }
        Ok(parse_strictly(opcode, &self.bytes()[body..end]).is_ok())
    }

    /// True if the fields of a chunk start `at` bytes after the current position.
    fn is_chunk(&mut self, at: usize, length: usize) -> Result<bool, RecordsError> {
        if !self.fill(at + CHUNK_FIELDS_BYTES)? {
            return Ok(false);
        }
        let name_length = u32_at(&self.bytes()[at..], 28) as usize;
        let end = at + CHUNK_FIELDS_BYTES + name_length;
        if name_length > 4 || !self.fill(end)? {
            return Ok(false);
        }
        let fields = &self.bytes()[at..end];
        let (name, data_length) = (&fields[32..32 + name_length], u64_at(fields, 32 + name_length));
        Ok(COMPRESSIONS.contains(&name) && data_length == (length - (end - at).min(length)) as u64)
    }

    /// True if a possible head of a record, or the end of the file, is `at` bytes after the current position.
    fn head_at(&mut self, at: usize) -> Result<bool, RecordsError> {
        if !self.fill(at + RECORD_HEAD_BYTES)? {
            return Ok(self.bytes().len() == at || self.bytes().get(at..).is_some_and(|rest| rest == MAGIC));
        }
        let (opcode, length) = head(&self.bytes()[at..]);
        Ok(is_opcode(opcode) && length.is_some() || self.bytes()[at..].starts_with(MAGIC))
    }

    /// The bytes that are read and not consumed.
    fn bytes(&self) -> &[u8] {
        &self.buffer[self.start..]
    }

    /// Reads until `count` bytes are not consumed; `false` if the file ends before.
    fn fill(&mut self, count: usize) -> io::Result<bool> {
        let missing = count.saturating_sub(self.bytes().len());
        if missing == 0 {
            return Ok(true);
        }
        if self.start >= self.buffer.len() / 2 {
            self.buffer.drain(..self.start);
            self.start = 0;
        }
        // A record that claims to be long gets memory only as its bytes are read.
        let read = (&mut self.source).take(missing as u64).read_to_end(&mut self.buffer)?;
        Ok(read == missing)
    }

    fn consume(&mut self, count: usize) {
        self.crc.update(&self.buffer[self.start..self.start + count]);
        self.start += count;
        self.offset += count as u64;
    }
}

/// The kind and the length of a record, from its head; no length if it is greater than any record's.
fn head(bytes: &[u8]) -> (u8, Option<usize>) {
    let length = usize::try_from(u64_at(bytes, 1)).ok();
    (bytes[0], length.filter(|length| *length <= RECORD_BYTES_MAX))
}

/// True for the kinds of the specification and for private ones.
fn is_opcode(opcode: u8) -> bool {
    (op::HEADER..=op::DATA_END).contains(&opcode) || opcode >= PRIVATE
}

/// Parses a record, and refuses one whose length is not that of its fields, because its kind is damaged.
fn parse_strictly(opcode: u8, body: &[u8]) -> Result<Record<'_>, McapError> {
    let record = parse(opcode, body)?;
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

fn u32_at(bytes: &[u8], at: usize) -> u32 {
    u32::from_le_bytes(bytes[at..at + 4].try_into().expect("four bytes"))
}

fn u64_at(bytes: &[u8], at: usize) -> u64 {
    u64::from_le_bytes(bytes[at..at + 8].try_into().expect("eight bytes"))
}
