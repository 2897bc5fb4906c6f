//! An MCAP file -> its preface, events and maps, in file order. Reads what [`crate::record::writer`] writes, and the ROS 2
//! messages of anyone's that [`clearway_ros`] knows.
//!
//! A file cut by a crash yields all its whole chunks and says that it was cut. Damage is an error, whatever came before
//! it: chunks are checked against their CRC before anything of them is given. They are opened here, because mcap's own
//! reader believes the length of a record that reaches beyond its chunk.

use std::borrow::Cow;
use std::collections::{BTreeMap, HashMap, VecDeque};
use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};

use bytes::Bytes;
use clearway_lidar::calibration::Calibration;
use clearway_mapping::event::Event;
use clearway_ros::Kind;
use mcap::records::{ChunkHeader, Record, op};
use mcap::sans_io::LinearReaderOptions;
use mcap::sans_io::linear_reader::{LinearReadEvent, LinearReader};
use mcap::{McapError, parse_record};

use crate::config::{Calibrations, Config, ConfigError};
use crate::encode::{EventError, event_from_bytes};

/// No chunk of ours exceeds a few MiB; a length beyond this is damage, refused before it is allocated.
const RECORD_BYTES_MAX: usize = 256 << 20;
/// Read at once: a record's claimed length is not allocated before its bytes have come.
const READ_BYTES_MAX: usize = 1 << 20;
/// A record opens with its kind (one byte) and its length (eight).
const RECORD_HEAD_BYTES: usize = 9;

/// One message of a recording.
#[derive(Clone, Debug, PartialEq)]
pub enum Entry {
    /// Of `/<vehicle>/journal`.
    Event {
        /// The vehicle's name.
        vehicle: String,
        /// As it was processed.
        event: Event,
    },
    /// Of `/<vehicle>/map/<layer>`.
    Map {
        /// The vehicle's name.
        vehicle: String,
        /// The layer's name.
        layer: String,
        /// An encoded `clearway.v1.Map` with this one layer.
        bytes: Bytes,
    },
    /// A ROS 2 message, CDR.
    Ros {
        /// The topic.
        topic: String,
        /// What it is.
        kind: Kind,
        /// When it was logged, ns since the Unix epoch.
        log_ns: i64,
        /// The message.
        bytes: Bytes,
    },
}

/// What stands before the first message of one of our recordings.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Preface {
    /// Names the run of the server that made the maps; 0 where the file is not ours.
    pub boot_id: u64,
    /// The metadata `clearway`.
    pub notes: BTreeMap<String, String>,
    /// The effective configuration, TOML.
    pub config: Option<String>,
    /// The configured calibration tables: attachment name, ROS YAML.
    pub calibrations: BTreeMap<String, String>,
}

/// Why a recording cannot be read on.
#[derive(Debug, thiserror::Error)]
pub enum RecordingError {
    /// The file cannot be read.
    #[error("{}: {source}", file.display())]
    Read {
        /// The recording.
        file: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// The file is damaged, or no MCAP.
    #[error("{}: damaged after {messages} messages: {source}", file.display())]
    Damaged {
        /// The recording.
        file: PathBuf,
        /// Whole messages before the damage.
        messages: u64,
        /// What is wrong.
        source: McapError,
    },
    /// A message of a journal is no event.
    #[error("{}: {topic}: {source}", file.display())]
    Event {
        /// The recording.
        file: PathBuf,
        /// The journal.
        topic: String,
        /// What is wrong.
        source: EventError,
    },
    /// The file has no configuration: it is not one of our recordings, or was cut before anything was in it.
    #[error("{}: no attachment config.toml: not a recording of clearway, or cut at its very start", file.display())]
    NoConfig {
        /// The recording.
        file: PathBuf,
    },
    /// The recorded configuration is none.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// A recorded calibration is none.
    #[error("{}: attachment {name}: {reason}", file.display())]
    Calibration {
        /// The recording.
        file: PathBuf,
        /// The attachment.
        name: String,
        /// What is wrong.
        reason: String,
    },
}

/// An open recording; an iterator over its entries.
pub struct Recording {
    file: PathBuf,
    source: Box<dyn Read + Send>,
    reader: LinearReader,
    topics: HashMap<u16, Topic>,
    schemas: HashMap<u16, String>,
    preface: Preface,
    /// Of the chunk read last.
    waiting: VecDeque<Result<Entry, RecordingError>>,
    messages: u64,
    bytes_read: u64,
    whole: bool,
    ended: bool,
}

#[derive(Clone)]
enum Topic {
    Journal { vehicle: String, topic: String },
    Map { vehicle: String, layer: String },
    Ros { topic: String, kind: Kind },
    Other,
}

impl Recording {
    /// Opens a recording and reads up to its first message.
    ///
    /// # Errors
    /// [`RecordingError`] where the file cannot be read or is no MCAP.
    pub fn open(file: &Path) -> Result<Self, RecordingError> {
        let source = File::open(file).map_err(|source| RecordingError::Read { file: file.to_owned(), source })?;
        Self::of(file, source)
    }

    /// [`Recording::open`] for bytes from anywhere; `file` names them in errors.
    ///
    /// # Errors
    /// [`RecordingError`] where they cannot be read or are no MCAP.
    pub fn of(file: &Path, source: impl Read + Send + 'static) -> Result<Self, RecordingError> {
        let options = LinearReaderOptions::default()
            .with_skip_end_magic(true)
            .with_emit_chunks(true)
            .with_validate_data_section_crc(true)
            .with_record_length_limit(RECORD_BYTES_MAX);
        let mut recording = Self {
            file: file.to_owned(),
            source: Box::new(source),
            reader: LinearReader::new_with_options(options),
            topics: HashMap::new(),
            schemas: HashMap::new(),
            preface: Preface::default(),
            waiting: VecDeque::new(),
            messages: 0,
            bytes_read: 0,
            whole: false,
            ended: false,
        };
        if let Some(first) = recording.read()? {
            recording.waiting.push_front(Ok(first));
        }
        Ok(recording)
    }

    /// What stands before the first message.
    pub fn preface(&self) -> &Preface {
        &self.preface
    }

    /// Bytes of the file read so far.
    pub fn bytes_read(&self) -> u64 {
        self.bytes_read
    }

    /// Whether the file ended before its closing records: a crash cut it. Known once all entries have been read.
    pub fn is_cut(&self) -> bool {
        self.ended && !self.whole
    }

    /// The configuration the recording was made with, and its calibration tables as [`Config::calibrations`] gives
    /// them.
    ///
    /// # Errors
    /// [`RecordingError`] where either is missing or unreadable.
    pub fn config(&self) -> Result<(Config, Calibrations), RecordingError> {
        let text = self.preface.config.as_ref().ok_or_else(|| RecordingError::NoConfig { file: self.file.clone() })?;
        let config = Config::parse(text, &self.file.join("config.toml"), &[])?;
        let table = |vehicle: &str, sensor: &clearway_mapping::config::SensorConfig| {
            if sensor.calibration.is_none() {
                return Ok(None);
            }
            let name = format!("calibration/{vehicle}/{}.yaml", sensor.name);
            let wrong =
                |reason: String| RecordingError::Calibration { file: self.file.clone(), name: name.clone(), reason };
            let text = self.preface.calibrations.get(&name).ok_or_else(|| wrong("missing".into()))?;
            Calibration::load_str(text).map(Some).map_err(|error| wrong(error.to_string()))
        };
        let tables = config
            .vehicles
            .iter()
            .map(|v| v.sensors.iter().map(|s| table(&v.name, s)).collect())
            .collect::<Result<_, _>>()?;
        Ok((config, tables))
    }

    /// The next message that concerns us; `None` at the end, cut or not.
    fn read(&mut self) -> Result<Option<Entry>, RecordingError> {
        loop {
            if let Some(entry) = self.waiting.pop_front() {
                return entry.map(Some);
            }
            let record = match self.reader.next_event() {
                None => break,
                Some(Ok(LinearReadEvent::ReadRequest(need))) => {
                    let read = self
                        .source
                        .read(self.reader.insert(need.min(READ_BYTES_MAX)))
                        .map_err(|source| RecordingError::Read { file: self.file.clone(), source })?;
                    self.reader.notify_read(read);
                    self.bytes_read += read as u64;
                    continue;
                }
                Some(Ok(LinearReadEvent::Record { opcode, data })) => parse(opcode, data),
                Some(Err(McapError::UnexpectedEof)) if self.bytes_read > 0 => break,
                Some(Err(error)) => Err(error),
            };
            match record.map(Record::into_owned).map_err(|source| self.damaged(source))? {
                Record::Chunk { header, data } => self.open_chunk(&header, &data)?,
                record => {
                    let entry = self.take(record);
                    self.waiting.extend(entry);
                }
            }
        }
        self.ended = true;
        Ok(None)
    }

    /// Takes a chunk's records: all of them, or those before the first that is none.
    fn open_chunk(&mut self, header: &ChunkHeader, data: &[u8]) -> Result<(), RecordingError> {
        let content = content(header, data).map_err(|source| self.damaged(source))?;
        let mut rest = &*content;
        while !rest.is_empty() {
            let entry = match next_record(&mut rest) {
                Ok(record) => self.take(record),
                Err(source) => Some(Err(self.damaged(source))),
            };
            let is_damage = matches!(entry, Some(Err(_)));
            self.waiting.extend(entry);
            if is_damage {
                break;
            }
        }
        Ok(())
    }

    fn damaged(&self, source: McapError) -> RecordingError {
        RecordingError::Damaged { file: self.file.clone(), messages: self.messages, source }
    }

    /// Notes what a record says of the file; gives a message that concerns us.
    fn take(&mut self, record: Record<'_>) -> Option<Result<Entry, RecordingError>> {
        match record {
            Record::Schema { header, .. } => {
                self.schemas.insert(header.id, header.name);
            }
            Record::Channel(channel) => {
                let schema = self.schemas.get(&channel.schema_id).map_or("", String::as_str);
                self.topics.insert(channel.id, topic(channel.topic, schema, &channel.message_encoding));
            }
            Record::Message { header, data } => {
                self.messages += 1;
                let bytes = Bytes::from(data.into_owned());
                match self.topics.get(&header.channel_id).cloned()? {
                    Topic::Other => {}
                    Topic::Map { vehicle, layer } => return Some(Ok(Entry::Map { vehicle, layer, bytes })),
                    Topic::Ros { topic, kind } => {
                        let log_ns = i64::try_from(header.log_time).unwrap_or(i64::MAX);
                        return Some(Ok(Entry::Ros { topic, kind, log_ns, bytes }));
                    }
                    Topic::Journal { vehicle, topic } => {
                        let event = event_from_bytes(bytes).map(|event| Entry::Event { vehicle, event });
                        let file = &self.file;
                        return Some(event.map_err(|s| RecordingError::Event { file: file.clone(), topic, source: s }));
                    }
                }
            }
            Record::Metadata(metadata) if metadata.name == "clearway" => {
                let boot_id = metadata.metadata.get("boot_id").and_then(|id| id.parse().ok());
                self.preface.boot_id = boot_id.unwrap_or_default();
                self.preface.notes = metadata.metadata;
            }
            Record::Attachment { header, data, .. } => {
                let text = String::from_utf8_lossy(&data).into_owned();
                if header.name == "config.toml" {
                    self.preface.config = Some(text);
                } else if header.name.starts_with("calibration/") {
                    self.preface.calibrations.insert(header.name, text);
                }
            }
            Record::Footer(_) => self.whole = true,
            _ => {}
        }
        None
    }
}

/// The records of a chunk, as long as it says and with the CRC it says, if it says one.
fn content<'a>(header: &ChunkHeader, data: &'a [u8]) -> Result<Cow<'a, [u8]>, McapError> {
    let size = usize::try_from(header.uncompressed_size).ok().filter(|size| *size <= RECORD_BYTES_MAX);
    let size = size.ok_or(McapError::ChunkTooLarge(header.uncompressed_size))?;
    let content = match &*header.compression {
        "" => Cow::Borrowed(data),
        "zstd" => zstd::bulk::decompress(data, size)
            .map(Cow::Owned)
            .map_err(|error| McapError::DecompressionError(error.to_string()))?,
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

/// Splits the first record off a chunk's.
fn next_record<'a>(rest: &mut &'a [u8]) -> Result<Record<'a>, McapError> {
    let (head, behind) = rest.split_at_checked(RECORD_HEAD_BYTES).ok_or(McapError::UnexpectedEoc)?;
    let length = u64::from_le_bytes(head[1..].try_into().expect("eight bytes"));
    let length = usize::try_from(length).map_err(|_| McapError::UnexpectedEoc)?;
    let (body, behind) = behind.split_at_checked(length).ok_or(McapError::UnexpectedEoc)?;
    *rest = behind;
    parse(head[0], body)
}

/// A record; mcap would panic at an attachment that ends before its CRC.
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

impl Iterator for Recording {
    type Item = Result<Entry, RecordingError>;

    fn next(&mut self) -> Option<Self::Item> {
        if self.ended && self.waiting.is_empty() {
            return None;
        }
        let next = self.read().transpose();
        self.ended |= matches!(next, Some(Err(_)));
        next
    }
}

fn topic(topic: String, schema: &str, encoding: &str) -> Topic {
    // Bags converted from ROS 1 have the same types in an encoding of their own.
    if let Some(kind) = Kind::of(schema).filter(|_| encoding == "cdr") {
        return Topic::Ros { topic, kind };
    }
    let parts: Vec<&str> = topic.split('/').collect();
    match (schema, &parts[..]) {
        ("clearway.v1.Event", ["", vehicle, "journal"]) => Topic::Journal { vehicle: (*vehicle).into(), topic },
        ("clearway.v1.Map", ["", vehicle, "map", layer]) => {
            Topic::Map { vehicle: (*vehicle).into(), layer: (*layer).into() }
        }
        _ => Topic::Other,
    }
}
