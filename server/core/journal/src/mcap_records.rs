//! The bytes of an MCAP file -> its records, with the records of its chunks, in file order; and the parts of the file
//! that cannot be read.
//!
//! A damaged record costs that record: its length or, if that is damaged too, a search finds the next one. A record
//! found by the search is accepted only if its fields agree with each other and with what follows.

use std::io::{self, Read};

use mcap::records::{MessageIndex, Record, op};
use mcap::{MAGIC, McapError};

use super::chunk::{
    CHUNK_FIELDS_BYTES, RECORD_BYTES_MAX, RECORD_HEAD_BYTES, attachment_name, decompress, has_added_bytes,
    parse_strictly, split_record, u32_at, u64_at,
};
use super::chunk_indexes::ChunkIndexes;
use super::damage::LostPart;
use super::section_crc::{Finding, SectionCrc, wrong_crc};

/// Bytes that a search reads at once.
const SEARCH_BYTES: usize = 1 << 20;
/// Why a file that is repaired does not start as MCAP files do.
const NO_MAGIC: &str = "the file does not start with the magic bytes";
/// Least kind of the records that programs define for themselves.
const PRIVATE: u8 = 0x80;
/// Names of the compressions, as chunks have them.
const COMPRESSIONS: [&[u8]; 3] = [b"", b"zstd", b"lz4"];

/// The records of an MCAP file cannot be read further.
#[derive(Debug)]
pub(super) enum RecordsError {
    Read(io::Error),
    /// The file does not start as an MCAP file does.
    NotMcap,
    /// The file was searched, and has no record.
    NoRecord,
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
    /// The message indexes of the chunk that were read.
    indexes: ChunkIndexes,
    /// Number of lost parts before the end of the chunk.
    lost_before_indexes: usize,
    /// CRC of the consumed bytes of the section.
    crc: SectionCrc,
    /// Number of lost parts before the section.
    lost_before: usize,
    /// True if a file that does not start as MCAP files do is searched for records.
    any_start: bool,
    has_chunks: bool,
    /// Position in the content of the newest lost chunk from which its messages are lost, while message indexes belong
    /// to it.
    lost_from: Option<u64>,
    /// The bytes of the newest record, if it is of a private kind. Message indexes behind it say that it was a chunk.
    private: Option<(u64, u64)>,
    has_data_end: bool,
    has_footer: bool,
    has_more: bool,
    has_sound_summary: bool,
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
            indexes: ChunkIndexes::default(),
            lost_before_indexes: 0,
            crc: SectionCrc::default(),
            lost_before: 0,
            any_start,
            has_chunks: false,
            lost_from: None,
            private: None,
            has_data_end: false,
            has_footer: false,
            has_more: false,
            has_sound_summary: false,
            lost: Vec::new(),
        }
    }

    /// Number of bytes read and consumed so far.
    pub(super) fn offset(&self) -> u64 {
        self.offset
    }

    /// True if the file was read to the record that ends its data; only repetitions follow it.
    pub(super) fn has_data_end(&self) -> bool {
        self.has_data_end
    }

    /// True if the file has its closing records.
    pub(super) fn has_footer(&self) -> bool {
        self.has_footer
    }

    /// True if bytes follow the end of the file.
    pub(super) fn has_more(&self) -> bool {
        self.has_more
    }

    /// True if the file has a summary without damage, whose counts can be trusted.
    pub(super) fn has_sound_summary(&self) -> bool {
        self.has_sound_summary
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
        let from = *position as u64;
        let record = split_record(&mut rest).map(Record::into_owned);
        *position = content.len() - rest.len();
        match record {
            Ok(record) => Some(record),
            Err(error) => {
                content.clear();
                self.add_lost(self.chunk_bytes, &error);
                self.lost_from = Some(from);
                None
            }
        }
    }

    fn read_start(&mut self) -> Result<(), RecordsError> {
        self.section = Section::Data;
        if self.fill(MAGIC.len())? && self.bytes().starts_with(MAGIC) {
            self.consume(MAGIC.len());
        } else if self.any_start && self.fill(MAGIC.len() + RECORD_HEAD_BYTES)? && self.is_header_at(MAGIC.len())? {
            self.consume(MAGIC.len());
            self.lost.push(LostPart::new((0, self.offset), NO_MAGIC.into(), false));
        } else if self.any_start {
            self.search(NO_MAGIC)?;
            if self.section == Section::Ended {
                return Err(RecordsError::NoRecord);
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
            return self.search("a record has an unknown kind or an impossible length").map(|()| None);
        };
        let end = RECORD_HEAD_BYTES + length;
        if !self.fill(end)? {
            // Either a crash has cut the file here, or the length is damaged and other records follow.
            return self.search("a record reaches beyond the end of the file").map(|()| None);
        }
        let is_longer = has_added_bytes(opcode, &self.bytes()[RECORD_HEAD_BYTES..end]);
        let is_too_long = is_longer && !self.goes_on_at(opcode, end)?;
        let body = &self.bytes()[RECORD_HEAD_BYTES..end];
        let is_index = matches!(opcode, op::MESSAGE | PRIVATE..) && ChunkIndexes::is_index(body, &self.chunk.0);
        let record = parse_strictly(opcode, body);
        let from = self.offset;
        let read = match record {
            _ if is_too_long => Err(("a record is longer than its fields, and no record follows it".to_owned(), None)),
            _ if is_index => Err(("it has the kind of other records".to_owned(), None)),
            Ok(Record::Chunk { header, data }) => match decompress(&header, &data) {
                Ok(content) => {
                    let content = content.into_owned();
                    self.end_indexes();
                    self.chunk = (content, 0);
                    self.chunk_bytes = (from, from + end as u64);
                    (self.has_chunks, self.lost_from) = (true, None);
                    (self.indexes, self.lost_before_indexes) = (ChunkIndexes::default(), self.lost.len());
                    Ok(None)
                }
                Err(error) => Err((error.to_string(), Some((header.message_start_time, header.message_end_time)))),
            },
            Ok(record) => Ok(Some(record.into_owned())),
            Err(error) => Err((reason(opcode, &self.bytes()[RECORD_HEAD_BYTES..end], &error), None)),
        };
        match read {
            Ok(record) => {
                let private = self.private.take();
                match &record {
                    Some(Record::DataEnd(data_end)) => self.end_data(data_end.data_section_crc, end),
                    Some(Record::Footer(footer)) => self.end_summary(footer.summary_crc, end)?,
                    Some(Record::MessageIndex(index)) => self.read_index(index, end, private),
                    _ => self.consume(end),
                }
                self.private = Some((from, self.offset)).filter(|_| opcode >= PRIVATE);
                Ok(record)
            }
            Err((reason, _)) if !self.goes_on_at(opcode, end)? => self.search(&reason).map(|()| None),
            Err((reason, chunk_ns)) => {
                self.consume(end);
                self.add_lost((from, self.offset), &reason);
                if let Some(lost) = self.lost.last_mut() {
                    lost.chunk_ns = chunk_ns.filter(|(first, last)| first <= last && *last > 0);
                }
                Ok(None)
            }
        }
    }

    /// Consumes the record that ends the data section, and checks the section's CRC unless a part of it is lost.
    fn end_data(&mut self, saved: u32, end: usize) {
        self.end_indexes();
        let (from, crc) = (self.offset, std::mem::take(&mut self.crc));
        self.has_data_end = true;
        self.consume(end);
        self.crc = SectionCrc::default();
        match crc.compare(saved) {
            Finding::Changed(crc) if self.lost.is_empty() => {
                self.add_lost((from, self.offset), &wrong_crc("data", crc, saved));
            }
            Finding::Indexes(wrong) => {
                for bytes in wrong {
                    let reason = "a message index does not agree with its chunk".into();
                    self.lost.push(LostPart::new(bytes, reason, false));
                }
            }
            _ => {}
        }
        self.section = Section::Summary;
        self.lost_before = self.lost.len();
    }

    /// Consumes the footer, checks the CRC of the summary, and what follows.
    fn end_summary(&mut self, saved: u32, end: usize) -> Result<(), RecordsError> {
        let from = self.offset;
        if !self.has_data_end {
            self.add_lost((from, from), &"the record that ends the data is missing, and with it the data's CRC");
        }
        // The CRC covers the footer up to the CRC itself.
        let covered = end - size_of::<u32>();
        self.consume(covered);
        let crc = self.crc.compare(saved);
        self.consume(end - covered);
        let is_read = self.section == Section::Summary && self.lost.len() == self.lost_before;
        self.has_sound_summary = is_read && crc == Finding::Whole;
        if let Finding::Changed(crc) = crc
            && is_read
        {
            self.add_lost((from, self.offset), &wrong_crc("summary", crc, saved));
        }
        self.section = Section::Ended;
        self.fill(MAGIC.len())?;
        self.has_footer = self.bytes().starts_with(MAGIC);
        let end = if self.has_footer { MAGIC.len() } else { 0 };
        // A beginning of the magic bytes alone is a cut.
        if self.has_footer || !MAGIC.starts_with(self.bytes()) {
            self.consume(end);
            let end = self.offset;
            while self.fill(1)? {
                self.consume(self.bytes().len());
            }
            self.has_more = self.offset > end;
            if self.has_more {
                let reason = "bytes after the end of the recording".into();
                self.lost.push(LostPart::new((end, self.offset), reason, true));
            }
        }
        Ok(())
    }

    /// Consumes an index: of the newest chunk, or of a lost one, which a record of a private kind before it was.
    fn read_index(&mut self, index: &MessageIndex, end: usize, private: Option<(u64, u64)>) {
        let body = &self.buffer[self.start + RECORD_HEAD_BYTES..self.start + end];
        let Some(right) = self.indexes.add(index, body, &self.chunk.0) else { return self.consume(end) };
        if let Some(chunk) = private {
            self.add_lost(chunk, &"a chunk has the kind of other records");
        }
        if let Some(from) = self.lost_from {
            self.consume(end);
            self.lost.last_mut().into_iter().for_each(|lost| lost.add_index(index, from));
        } else {
            self.crc.update_wrong_index(self.offset, &self.buffer[self.start..self.start + end], &right);
            self.start += end;
            self.offset += end as u64;
        }
    }

    /// Decides whether the only lost part behind the newest chunk was the indexes of the chunk, of which nothing else
    /// was lost.
    fn end_indexes(&mut self) {
        let Some([part]) = self.lost.get_mut(self.lost_before_indexes..) else { return };
        if part.is_loss && part.bytes.1 - part.bytes.0 == self.indexes.missing_bytes(&self.chunk.0) {
            *part = LostPart::new(part.bytes, format!("a message index: {}", part.reason), false);
        }
    }

    /// Adds a part that cannot be read. What the summary holds is a repetition.
    fn add_lost(&mut self, bytes: (u64, u64), reason: &dyn std::fmt::Display) {
        let is_loss = matches!(self.section, Section::Start | Section::Data);
        self.lost.push(LostPart::new(bytes, reason.to_string(), is_loss));
        self.lost_from = Some(0);
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

    /// True if the header of a file is `at` bytes after the current position.
    fn is_header_at(&mut self, at: usize) -> Result<bool, RecordsError> {
        let (opcode, length) = head(&self.bytes()[at..]);
        let (body, end) = (at + RECORD_HEAD_BYTES, at + RECORD_HEAD_BYTES + length.unwrap_or(RECORD_BYTES_MAX));
        let is_whole = opcode == op::HEADER && length.is_some() && self.fill(end)?;
        Ok(is_whole && parse_strictly(opcode, &self.bytes()[body..end]).is_ok())
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

    /// True if the file goes on `at` bytes after the current position, behind a damaged record of this kind. If it is
    /// no chunk, only its length says where it ends, and the length may be what is damaged.
    fn goes_on_at(&mut self, opcode: u8, at: usize) -> Result<bool, RecordsError> {
        let is_alone = self.section == Section::Data && opcode != op::CHUNK && self.fill(at + RECORD_HEAD_BYTES)?;
        Ok(self.head_at(at)? && (!is_alone || self.is_record_at(at)?))
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

/// Why a record of this kind cannot be read, with its name if it has one.
fn reason(opcode: u8, body: &[u8], error: &McapError) -> String {
    match (opcode, attachment_name(body)) {
        (op::ATTACHMENT, Some(name)) => format!("the attachment {name:?}: {error}"),
        (op::ATTACHMENT, None) => format!("an attachment: {error}"),
        (op::METADATA, _) => format!("metadata: {error}"),
        _ => error.to_string(),
    }
}
