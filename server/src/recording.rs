//! An MCAP file -> its preface, events and maps, in file order. Reads what [`crate::record`] writes, and the ROS 2
//! messages of anyone's that [`clearway_ros`] knows.
//!
//! A file cut by a crash yields all its whole chunks and says that it was cut. Damage is an error, whatever came before
//! it: chunks are checked against their CRC before anything of them is given.

use std::collections::{BTreeMap, HashMap, VecDeque};
use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};

use bytes::Bytes;
use clearway_lidar::calibration::Calibration;
use clearway_mapping::event::Event;
use clearway_ros::Kind;
use mcap::records::Record;
use mcap::sans_io::LinearReaderOptions;
use mcap::sans_io::linear_reader::{LinearReadEvent, LinearReader};
use mcap::{McapError, parse_record};

use crate::config::{Calibrations, Config, ConfigError};
use crate::wire::{EventError, event_from_bytes};

/// No chunk of ours exceeds a few MiB; a length beyond this is damage, refused before it is allocated.
const RECORD_BYTES_MAX: usize = 256 << 20;

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
    #[error("{}: no attachment config.toml: not a recording of clearway-server, or cut at its very start", file.display())]
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
    source: File,
    reader: LinearReader,
    topics: HashMap<u16, Topic>,
    schemas: HashMap<u16, String>,
    preface: Preface,
    waiting: VecDeque<Entry>,
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
        let options = LinearReaderOptions::default()
            .with_skip_end_magic(true)
            .with_prevalidate_chunk_crcs(true)
            .with_validate_data_section_crc(true)
            .with_record_length_limit(RECORD_BYTES_MAX);
        let mut recording = Self {
            file: file.to_owned(),
            source,
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
            recording.waiting.push_back(first);
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
        while let Some(event) = self.reader.next_event() {
            let record = match event {
                Ok(LinearReadEvent::ReadRequest(need)) => {
                    let read = self
                        .source
                        .read(self.reader.insert(need))
                        .map_err(|source| RecordingError::Read { file: self.file.clone(), source })?;
                    self.reader.notify_read(read);
                    self.bytes_read += read as u64;
                    continue;
                }
                Ok(LinearReadEvent::Record { opcode, data }) => parse_record(opcode, data),
                Err(McapError::UnexpectedEof) if self.bytes_read > 0 => break,
                Err(error) => Err(error),
            };
            let damaged = |source| RecordingError::Damaged { file: self.file.clone(), messages: self.messages, source };
            match record.map_err(damaged)? {
                Record::Schema { header, .. } => {
                    self.schemas.insert(header.id, header.name);
                }
                Record::Channel(channel) => {
                    let schema = self.schemas.get(&channel.schema_id).map_or("", String::as_str);
                    self.topics.insert(channel.id, topic(channel.topic, schema, &channel.message_encoding));
                }
                Record::Message { header, data } => {
                    self.messages += 1;
                    let Some(topic) = self.topics.get(&header.channel_id).cloned() else { continue };
                    let bytes = Bytes::from(data.into_owned());
                    match topic {
                        Topic::Other => {}
                        Topic::Map { vehicle, layer } => return Ok(Some(Entry::Map { vehicle, layer, bytes })),
                        Topic::Ros { topic, kind } => {
                            let log_ns = i64::try_from(header.log_time).unwrap_or(i64::MAX);
                            return Ok(Some(Entry::Ros { topic, kind, log_ns, bytes }));
                        }
                        Topic::Journal { vehicle, topic } => match event_from_bytes(bytes) {
                            Ok(event) => return Ok(Some(Entry::Event { vehicle, event })),
                            Err(source) => {
                                return Err(RecordingError::Event { file: self.file.clone(), topic, source });
                            }
                        },
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
        }
        self.ended = true;
        Ok(None)
    }
}

impl Iterator for Recording {
    type Item = Result<Entry, RecordingError>;

    fn next(&mut self) -> Option<Self::Item> {
        if let Some(entry) = self.waiting.pop_front() {
            return Some(Ok(entry));
        }
        if self.ended {
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
