//! The bytes of an MCAP file -> its records, with the records of its chunks, in file order; and the parts of the file
//! that cannot be read.
//!
//! Records are read one after the other by their lengths. Behind a damaged record the reader goes on at the end of the
//! record if the head of another record is there, else at the next record that the summary of the file names. Without a
//! summary, a damaged length costs the rest of the file.

use std::io::{self, BufReader, Read, Seek, SeekFrom};

use crc32fast::Hasher;
use mcap::records::{MessageIndex, Record, op};
use mcap::{MAGIC, McapError};

use super::chunk::{
    RECORD_BYTES_MAX, RECORD_HEAD_BYTES, attachment_name, decompress, is_message, parse_strictly, split_record,
};
use super::damage::LostPart;
use super::mcap_summary::McapSummary;

/// Least kind of the records that programs define for themselves.
const PRIVATE: u8 = 0x80;

/// The records of an MCAP file cannot be read further.
#[derive(Debug)]
pub(super) enum RecordsError {
    Read(io::Error),
    /// The file does not start as an MCAP file does.
    NotMcap,
}

impl From<io::Error> for RecordsError {
    fn from(error: io::Error) -> Self {
        Self::Read(error)
    }
}

/// The bytes of a file, to read from any position.
pub trait McapSource: Read + Seek + Send {}

impl<T: Read + Seek + Send> McapSource for T {}

#[derive(Clone, Copy, Debug, PartialEq)]
enum Section {
    Data,
    Summary,
    Ended,
}

/// How a file ends, as far as it is read.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct FileEnd {
    /// True if the file has the end that its writer makes.
    pub(super) is_closed: bool,
    /// True if the file was read to the end of its data; only repetitions follow it.
    pub(super) has_all_data: bool,
    /// True if bytes follow the end of the file.
    pub(super) has_more: bool,
    /// True if the file has a summary without damage, whose counts can be trusted.
    pub(super) has_sound_counts: bool,
}

/// The content of the newest chunk.
#[derive(Default)]
struct OpenChunk {
    content: Vec<u8>,
    /// Position of the next record in the content.
    at: usize,
    /// The bytes of the chunk in the file.
    bytes: (u64, u64),
    /// Position in the content from which the messages are lost; `None` if the whole chunk can be read.
    lost_from: Option<u64>,
}

/// An MCAP file while it is read.
pub(super) struct McapRecords {
    source: BufReader<Box<dyn McapSource>>,
    /// Position of the source.
    at: u64,
    /// Length of the file.
    length: u64,
    /// Position of the next record.
    offset: u64,
    section: Section,
    pub(super) summary: McapSummary,
    chunk: OpenChunk,
    /// Bytes of the chunks so far, decompressed.
    decompressed: u64,
    /// CRC of the section so far.
    crc: Hasher,
    /// Number of lost parts of the data section.
    lost_data: usize,
    /// The bytes of message indexes that do not agree with their chunk: they are damaged if the CRC of the data is
    /// wrong.
    wrong_indexes: Vec<(u64, u64)>,
    end: FileEnd,
    lost: Vec<LostPart>,
}

impl McapRecords {
    /// Reads from `source`.
    ///
    /// # Errors
    /// [`RecordsError`] if it cannot be read, or is no MCAP file.
    pub(super) fn open(mut source: Box<dyn McapSource>) -> Result<Self, RecordsError> {
        let summary = McapSummary::read(&mut source)?;
        let length = source.seek(SeekFrom::End(0))?;
        let mut records = Self {
            at: length,
            source: BufReader::new(source),
            length,
            offset: MAGIC.len() as u64,
            section: Section::Data,
            summary,
            chunk: OpenChunk::default(),
            decompressed: 0,
            crc: Hasher::new(),
            lost_data: 0,
            wrong_indexes: Vec::new(),
            end: FileEnd::default(),
            lost: Vec::new(),
        };
        let start = records.read_at(0, MAGIC.len() as u64)?;
        if start != MAGIC {
            return Err(RecordsError::NotMcap);
        }
        records.crc.update(&start);
        Ok(records)
    }

    /// Number of bytes read so far.
    pub(super) fn offset(&self) -> u64 {
        self.offset
    }

    /// How the file ends, as far as it is read.
    pub(super) fn end(&self) -> FileEnd {
        self.end
    }

    /// The parts so far that cannot be read.
    pub(super) fn lost(&self) -> &[LostPart] {
        &self.lost
    }

    /// The schemas and channels that the summary repeats; a second call returns none.
    pub(super) fn take_described(&mut self) -> Vec<Record<'static>> {
        std::mem::take(&mut self.summary.described)
    }

    /// The next record; `None` at the end. Chunks are not returned, but their records are.
    pub(super) fn next(&mut self) -> Result<Option<Record<'static>>, RecordsError> {
        loop {
            if let Some(record) = self.next_of_chunk() {
                return Ok(Some(record));
            }
            if self.section == Section::Ended {
                return Ok(None);
            }
            if let Some(record) = self.read_record()? {
                return Ok(Some(record));
            }
        }
    }

    /// The next record of the open chunk. A record that reaches beyond its chunk ends the chunk.
    fn next_of_chunk(&mut self) -> Option<Record<'static>> {
        let chunk = &mut self.chunk;
        let mut rest = chunk.content.get(chunk.at..).filter(|rest| !rest.is_empty())?;
        let from = chunk.at;
        let record = split_record(&mut rest).map(Record::into_owned);
        chunk.at = chunk.content.len() - rest.len();
        match record {
            Ok(record) => Some(record),
            Err(error) => {
                self.lost.push(LostPart::new(chunk.bytes, error.to_string(), true));
                (chunk.lost_from, chunk.at) = (Some(from as u64), chunk.content.len());
                None
            }
        }
    }

    /// Reads the record at the current position. `None` if it was a chunk, damage or the end.
    fn read_record(&mut self) -> io::Result<Option<Record<'static>>> {
        let from = self.offset;
        let Some((opcode, length)) = self.head_at(from)? else {
            self.section = Section::Ended;
            return Ok(None);
        };
        let end = from.saturating_add(RECORD_HEAD_BYTES as u64).saturating_add(length);
        if length > RECORD_BYTES_MAX as u64 || end > self.length || self.next_known(from, end)?.is_some() {
            let reason = match end > self.length {
                true => "a record reaches beyond the end of the file",
                false => "a record reaches over the next one, or has an impossible length",
            };
            self.skip(from, opcode, None, reason)?;
            return Ok(None);
        }
        let is_other_kind = self.summary.starts.get(&from).is_some_and(|kind| *kind != opcode);
        if is_other_kind || !is_opcode(opcode) {
            self.skip(from, opcode, Some(end), "a record has an unknown kind, or the kind of other records")?;
            return Ok(None);
        }
        let body = self.read_at(from + RECORD_HEAD_BYTES as u64, length)?;
        let record = match parse_strictly(opcode, &body) {
            Ok(record) => record,
            Err(error) => {
                self.skip(from, opcode, Some(end), &reason(opcode, &body, &error))?;
                return Ok(None);
            }
        };
        match record {
            Record::Chunk { header, data } => match decompress(&header, &data, self.decompressed, end) {
                Ok(content) => {
                    self.decompressed += content.len() as u64;
                    let content = content.into_owned();
                    self.chunk = OpenChunk { content, at: 0, bytes: (from, end), lost_from: None };
                    self.pass(opcode, &body, end);
                }
                Err(error) => {
                    self.skip(from, opcode, Some(end), &error.to_string())?;
                    let times = (header.message_start_time, header.message_end_time);
                    if let Some(lost) = self.lost.last_mut().filter(|_| self.chunk.lost_from.is_some()) {
                        lost.chunk_ns = Some(times).filter(|(first, last)| first <= last && *last > 0);
                    }
                }
            },
            Record::Footer(footer) => {
                self.end_summary(&body, footer.summary_crc, (from, end))?;
                return Ok(Some(Record::Footer(footer)));
            }
            record => {
                match &record {
                    Record::MessageIndex(index) => self.check_index(index, (from, end)),
                    Record::DataEnd(data_end) => self.end_data(data_end.data_section_crc, (from, end)),
                    _ => {}
                }
                let record = record.into_owned();
                self.pass(opcode, &body, end);
                return Ok(Some(record));
            }
        }
        Ok(None)
    }

    /// Goes on at the end of a record that was read.
    fn pass(&mut self, opcode: u8, body: &[u8], end: u64) {
        // The record that ends the data belongs to neither section.
        if opcode != op::DATA_END {
            self.add_to_crc(opcode, body.len(), body);
        }
        self.offset = end;
    }

    fn add_to_crc(&mut self, opcode: u8, length: usize, bytes: &[u8]) {
        self.crc.update(&[opcode]);
        self.crc.update(&(length as u64).to_le_bytes());
        self.crc.update(bytes);
    }

    /// Goes on behind a damaged record at `from`: at its `end` if another record can begin there, else at the next
    /// record that the summary names. Without one the file ends here, as if it was cut.
    fn skip(&mut self, from: u64, opcode: u8, end: Option<u64>, reason: &str) -> io::Result<()> {
        let next = match end {
            Some(end) if self.goes_on_at(end)? => Some(end),
            _ => self.next_known(from, self.length)?,
        };
        let Some(next) = next else {
            self.section = Section::Ended;
            return Ok(());
        };
        let mut kinds: Vec<u8> = self.summary.starts.range(from..next).map(|(_, kind)| *kind).collect();
        if kinds.is_empty() {
            kinds.push(opcode);
        }
        let is_index = kinds.iter().all(|kind| *kind == op::MESSAGE_INDEX);
        // Message indexes and the summary repeat what other records hold.
        let is_loss = self.section == Section::Data && !is_index;
        let kind = if is_index { "a message index: " } else { "" };
        self.lost.push(LostPart::new((from, next), format!("{kind}{reason}"), is_loss));
        if kinds.contains(&op::CHUNK) {
            self.chunk = OpenChunk { lost_from: Some(0), ..OpenChunk::default() };
        }
        self.offset = next;
        Ok(())
    }

    /// True if the file ends at `at`, or if a record can begin there.
    fn goes_on_at(&mut self, at: u64) -> io::Result<bool> {
        let Some((opcode, length)) = self.head_at(at)? else { return Ok(at == self.length) };
        Ok(is_opcode(opcode) && length <= self.length - at)
    }

    /// The first record after `from`, and before `end`, that the summary names and whose head is there.
    fn next_known(&mut self, from: u64, end: u64) -> io::Result<Option<u64>> {
        let known = self.summary.starts.range(from.saturating_add(1)..end.max(from.saturating_add(1)));
        for (at, kind) in known.map(|(at, kind)| (*at, *kind)).collect::<Vec<_>>() {
            let head = self.head_at(at)?;
            if head.is_some_and(|(opcode, length)| opcode == kind && length <= self.length - at) {
                return Ok(Some(at));
            }
        }
        Ok(None)
    }

    /// The kind and the length of the record at this position; `None` if the file ends before.
    fn head_at(&mut self, at: u64) -> io::Result<Option<(u8, u64)>> {
        let head = self.read_at(at, RECORD_HEAD_BYTES as u64)?;
        let (Some(opcode), Some(length)) = (head.first(), head.get(1..).and_then(|bytes| bytes.try_into().ok())) else {
            return Ok(None);
        };
        Ok(Some((*opcode, u64::from_le_bytes(length))))
    }

    /// The bytes from this position, at most so many: memory grows with what is read, not with what is asked for.
    fn read_at(&mut self, at: u64, length: u64) -> io::Result<Vec<u8>> {
        self.source.seek_relative(at as i64 - self.at as i64)?;
        let mut bytes = Vec::new();
        let read = (&mut self.source).take(length).read_to_end(&mut bytes);
        self.at = at + bytes.len() as u64;
        read.map(|_| bytes)
    }

    /// Compares an index with the newest chunk, or adds it to the lost messages of the chunk.
    fn check_index(&mut self, index: &MessageIndex, bytes: (u64, u64)) {
        if let Some(from) = self.chunk.lost_from {
            self.lost.last_mut().into_iter().for_each(|lost| lost.add_index(index, from));
        } else if !index.records.iter().all(|entry| is_message(&self.chunk.content, index.channel_id, entry)) {
            self.wrong_indexes.push(bytes);
        }
    }

    /// Ends the data section: checks its CRC unless a part of it is lost.
    fn end_data(&mut self, saved: u32, bytes: (u64, u64)) {
        let crc = std::mem::take(&mut self.crc).finalize();
        (self.section, self.end.has_all_data) = (Section::Summary, true);
        if saved != 0 && saved != crc && self.lost.is_empty() {
            for bytes in &self.wrong_indexes {
                let reason = "a message index does not agree with its chunk".into();
                self.lost.push(LostPart::new(*bytes, reason, false));
            }
            if self.wrong_indexes.is_empty() {
                self.lost.push(LostPart::new(bytes, wrong_crc("data", crc, saved), true));
            }
        }
        self.lost_data = self.lost.len();
    }

    /// Ends the file: checks the CRC of the summary, and what follows.
    fn end_summary(&mut self, footer: &[u8], saved: u32, (from, end): (u64, u64)) -> io::Result<()> {
        if !self.end.has_all_data {
            let reason = "the record that ends the data is missing, and with it the data's CRC";
            self.lost.push(LostPart::new((from, from), reason.into(), true));
        }
        // The CRC covers the footer up to the CRC itself.
        self.add_to_crc(op::FOOTER, footer.len(), &footer[..footer.len() - size_of::<u32>()]);
        let crc = std::mem::take(&mut self.crc).finalize();
        let is_read = self.section == Section::Summary && self.lost.len() == self.lost_data;
        self.end.has_sound_counts = is_read && (saved == 0 || saved == crc);
        if is_read && !self.end.has_sound_counts {
            self.lost.push(LostPart::new((from, end), wrong_crc("summary", crc, saved), false));
        }
        (self.section, self.offset) = (Section::Ended, end);
        let magic = self.read_at(end, MAGIC.len() as u64)?;
        self.end.is_closed = magic == MAGIC;
        // A beginning of the magic bytes alone is a cut.
        if MAGIC.starts_with(&magic) {
            self.offset += magic.len() as u64;
        }
        if self.offset < self.length {
            self.end.has_more = true;
            let reason = "bytes after the end of the recording".into();
            self.lost.push(LostPart::new((self.offset, self.length), reason, true));
            self.offset = self.length;
        }
        Ok(())
    }
}

/// True for the kinds of the specification and for private kinds.
fn is_opcode(opcode: u8) -> bool {
    (op::HEADER..=op::DATA_END).contains(&opcode) || opcode >= PRIVATE
}

/// What is wrong with a section whose bytes have changed.
fn wrong_crc(section: &str, calculated: u32, saved: u32) -> String {
    format!(
        "the CRC of the {section} section is {calculated:08x} and should be {saved:08x}: records outside of its chunks \
         have changed"
    )
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
