//! A damaged MCAP file -> a whole one with every record that can be read, and a report of what is lost.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::BufWriter;
use std::path::{Path, PathBuf};

use mcap::records::{AttachmentHeader, Metadata, Record};
use mcap::{Attachment, Compression, McapError, McapResult, WriteOptions, Writer};
use serde_json::{Value, json};

use super::damage::Damage;
use super::header::Header;
use super::mcap_file::CHUNK_NS;
use super::mcap_reader::{McapReadError, McapReader, REPAIR_LOST_KEY, REPAIR_METADATA};
use crate::file_advice::advised;

/// What was recovered and what is lost.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Report {
    /// Number of messages of the new file.
    pub messages: u64,
    /// Number of messages that the damaged file should have and the new one lacks; `None` if the damaged file does not
    /// say how many it should have, or says it in damaged records.
    pub lost_messages: Option<u64>,
    /// The damaged parts of the file.
    pub damages: Vec<Damage>,
    /// How the file is incomplete; `None` if it is whole.
    pub incomplete: Option<String>,
    /// True if the new file lacks a record, or may have a changed one.
    pub is_loss: bool,
    /// True if the damaged file proves by its own counts that no message, attachment or metadata is lost.
    pub has_all_records: bool,
    /// True if the file is a recording of clearway whose configuration is lost: the new one cannot be verified.
    pub lacks_config: bool,
}

impl Report {
    /// The report as one JSON object.
    pub fn to_json(&self) -> Value {
        json!({
            "messages": self.messages, "lost_messages": self.lost_messages, "incomplete": self.incomplete,
            "is_loss": self.is_loss, "has_all_records": self.has_all_records, "lacks_config": self.lacks_config,
            "damage": self.damages.iter().map(Damage::to_json).collect::<Vec<_>>(),
        })
    }
}

/// A file cannot be repaired.
#[derive(Debug, thiserror::Error)]
pub enum RepairError {
    /// The damaged file cannot be read.
    #[error(transparent)]
    Read(#[from] McapReadError),
    /// No message of the damaged file can be read.
    #[error("{}: no message can be read{}", file.display(), incomplete.as_ref().map_or(String::new(), |of| format!(": {of}")))]
    Nothing {
        /// Path of the damaged file.
        file: PathBuf,
        /// How the damaged file is incomplete; `None` if it is whole.
        incomplete: Option<String>,
    },
    /// The new file cannot be created or moved to its name.
    #[error("{}: {source}", file.display())]
    Create {
        /// Path of the new file.
        file: PathBuf,
        /// Error of the operating system.
        source: std::io::Error,
    },
    /// The new file cannot be written.
    #[error("{}: {source}", file.display())]
    Write {
        /// Path of the new file.
        file: PathBuf,
        /// Error of the MCAP writer.
        source: McapError,
    },
    /// The new file does not hold what was written to it.
    #[error("{}: read again, it has {found} messages and not {written}", file.display())]
    Differs {
        /// Path of the new file.
        file: PathBuf,
        /// Number of messages that were written.
        written: u64,
        /// Number of messages that the new file has.
        found: u64,
    },
}

/// Writes every record of `input` that can be read to the new file `output`, which has its name only once it is whole.
///
/// # Errors
/// [`RepairError`]; then there is no file `output`.
pub fn repair(input: &Path, output: &Path) -> Result<Report, RepairError> {
    let create = |source| RepairError::Create { file: output.to_owned(), source: advised(output, source) };
    if output.exists() {
        return Err(create(std::io::ErrorKind::AlreadyExists.into()));
    }
    let mut reader = McapReader::open_records(input)?;
    let folder = output.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let name = output.file_name().unwrap_or_default().to_string_lossy();
    let partial = folder.join(format!(".{name}.{}.partial", std::process::id()));
    let file = File::create_new(&partial).map_err(create)?;
    let written = copy(&mut reader, file, output).and_then(|report| {
        read_again(&partial, output, report.messages)?;
        // A hard link, unlike a rename, never replaces a file that has appeared meanwhile.
        std::fs::hard_link(&partial, output).map_err(create)?;
        Ok(report)
    });
    // The new file has its own name now; after an error the rest is of no use.
    let _ = std::fs::remove_file(&partial);
    written
}

/// Copies all records; returns the report, or an error if there was no message.
fn copy(reader: &mut McapReader, file: File, output: &Path) -> Result<Report, RepairError> {
    let failed = |source| RepairError::Write { file: output.to_owned(), source };
    let mut copy = RecordCopy::new(file).map_err(failed)?;
    let mut damages = 0;
    while let Some(record) = reader.next_record()? {
        // Only the message behind a damaged part decides what was lost with it.
        if matches!(record, Record::Message { .. }) && reader.damage_count() > damages {
            copy.note_losses(losses(&reader.damages()[damages..])).map_err(failed)?;
            damages = reader.damage_count();
        }
        copy.write(record, reader.header()).map_err(failed)?;
    }
    let mut report = Report { messages: copy.messages, ..Report::default() };
    (report.lost_messages, report.has_all_records) = (reader.lost_messages(), reader.has_all_records());
    (report.damages, report.incomplete) = (reader.damages(), reader.incomplete());
    if report.messages == 0 {
        return Err(RepairError::Nothing { file: reader.file().to_owned(), incomplete: report.incomplete });
    }
    report.is_loss = report.damages.iter().any(|damage| damage.is_loss) || reader.is_loss_at_end();
    let header = reader.header();
    report.lacks_config = header.config.is_none() && !header.metadata.is_empty();
    let mut at_end = losses(&report.damages[damages..]);
    if reader.is_loss_at_end() {
        at_end.extend(reader.faults_of_end());
    }
    copy.note_losses(at_end).and_then(|()| copy.finish()).map_err(failed)?;
    Ok(report)
}

/// The new file, while records are copied to it.
struct RecordCopy {
    writer: Writer<BufWriter<File>>,
    /// Ids of the damaged file -> ids of the new one.
    schemas: BTreeMap<u16, u16>,
    channels: BTreeMap<u16, u16>,
    messages: u64,
    /// Time of the message with which the newest chunk began.
    chunk_ns: u64,
}

impl RecordCopy {
    fn new(file: File) -> McapResult<Self> {
        let writer = WriteOptions::new()
            .profile("")
            .library(concat!("clearway/", env!("CARGO_PKG_VERSION")))
            .compression(Some(Compression::Zstd))
            .compression_threads(0)
            .create(BufWriter::new(file))?;
        Ok(Self { writer, schemas: BTreeMap::from([(0, 0)]), channels: BTreeMap::new(), messages: 0, chunk_ns: 0 })
    }

    fn write(&mut self, record: Record<'_>, header: &Header) -> McapResult<()> {
        match record {
            Record::Schema { header, data } => {
                let id = self.writer.add_schema(&header.name, &header.encoding, &data)?;
                self.schemas.insert(header.id, id);
            }
            Record::Channel(channel) => {
                let schema = self.schemas.get(&channel.schema_id).copied().unwrap_or_default();
                let (topic, encoding) = (&channel.topic, &channel.message_encoding);
                let id = self.writer.add_channel(schema, topic, encoding, &channel.metadata)?;
                self.channels.insert(channel.id, id);
            }
            Record::Message { mut header, data } => {
                let Some(id) = self.channels.get(&header.channel_id) else { return Ok(()) };
                header.channel_id = *id;
                self.messages += 1;
                if header.log_time.abs_diff(self.chunk_ns) >= CHUNK_NS {
                    self.writer.flush()?;
                    self.chunk_ns = header.log_time;
                }
                self.writer.write_to_known_channel(&header, &data)?;
            }
            Record::Metadata(metadata) => self.writer.write_metadata(&header.with_known_format(metadata))?,
            Record::Attachment { header, data, .. } => {
                let AttachmentHeader { log_time, create_time, name, media_type } = header;
                self.writer.attach(&Attachment { log_time, create_time, name, media_type, data })?;
            }
            _ => {}
        }
        Ok(())
    }

    /// Writes what is lost at this place.
    fn note_losses(&mut self, lost: Vec<String>) -> McapResult<()> {
        lost.into_iter().try_for_each(|lost| {
            let metadata = BTreeMap::from([(REPAIR_LOST_KEY.to_owned(), lost)]);
            self.writer.write_metadata(&Metadata { name: REPAIR_METADATA.into(), metadata })
        })
    }

    /// Ends the file, and returns when the disk has it.
    fn finish(mut self) -> McapResult<()> {
        self.writer.finish()?;
        let file = self.writer.into_inner().into_inner().map_err(|error| error.into_error())?;
        Ok(file.sync_all()?)
    }
}

/// The texts of the damages that are losses.
fn losses(damages: &[Damage]) -> Vec<String> {
    damages.iter().filter(|damage| damage.is_loss).map(ToString::to_string).collect()
}

/// Reads the new file from its start to its end.
fn read_again(partial: &Path, output: &Path, written: u64) -> Result<(), RepairError> {
    let mut reader = McapReader::open(partial)?;
    let mut found = 0;
    for message in reader.by_ref() {
        message?;
        found += 1;
    }
    let is_whole = reader.incomplete().is_none() && found == written;
    if is_whole { Ok(()) } else { Err(RepairError::Differs { file: output.to_owned(), written, found }) }
}
