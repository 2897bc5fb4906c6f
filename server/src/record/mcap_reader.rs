//! Any MCAP file -> its header and its messages, in file order. All commands read MCAP files with this reader.
//!
//! The reader returns all whole chunks of a file that a crash has cut, and then reports it as cut. Damage is an error,
//! even after valid messages: the reader checks the CRC of a chunk before it returns a message of it.
//! [`McapReader::salvage`] instead returns the messages before the damage and then reports it.

use std::collections::{BTreeMap, BTreeSet, HashMap, VecDeque};
use std::fs::File;
use std::io::{Error, ErrorKind, Read};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use bytes::Bytes;
use clearway_ros::Kind;
use mcap::McapError;
use mcap::records::{ChunkHeader, Record};
use mcap::sans_io::LinearReaderOptions;
use mcap::sans_io::linear_reader::{LinearReadEvent, LinearReader};

use crate::counted::counted;
use crate::file_advice::advised;

use super::chunk::{RECORD_BYTES_MAX, decompress, parse, split_record};

/// Greatest number of bytes of one read. A record that claims to be long gets memory only as its bytes are read.
const READ_BYTES_MAX: usize = 1 << 20;

/// The contents of a recording before its first message; empty in an MCAP file of another program.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Header {
    /// Identifies the run of the server that made the maps; 0 in a file of another program.
    pub boot_id: u64,
    /// The metadata `clearway`.
    pub metadata: BTreeMap<String, String>,
    /// The effective configuration, TOML.
    pub config: Option<String>,
    /// The configured calibration tables: attachment name, ROS YAML.
    pub calibrations: BTreeMap<String, String>,
}

/// One channel of an MCAP file.
#[derive(Clone, Debug, PartialEq)]
pub struct Channel {
    /// The topic, such as `/<vehicle>/map/<layer>`.
    pub topic: String,
    /// The name of the schema, such as `clearway.v1.Map`.
    pub schema: String,
    /// The kind of the messages.
    pub content: Content,
}

/// The kind of the messages of a channel.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Content {
    /// Events of a vehicle's journal.
    Journal {
        /// The vehicle's name.
        vehicle: String,
    },
    /// Maps of a vehicle, with one layer each.
    Map {
        /// The vehicle's name.
        vehicle: String,
        /// The layer's name.
        layer: String,
    },
    /// Keyframes of a vehicle.
    Keyframe {
        /// The vehicle's name.
        vehicle: String,
    },
    /// Counts of the recorder.
    Counts,
    /// ROS 2 messages in CDR.
    Ros(Kind),
    /// Anything else.
    Other,
}

/// One message of an MCAP file.
#[derive(Clone, Debug, PartialEq)]
pub struct Message {
    /// The message's channel.
    pub channel: Arc<Channel>,
    /// Log time, ns since the Unix epoch.
    pub log_ns: u64,
    /// The encoded message.
    pub data: Bytes,
}

impl Message {
    /// The vehicle and the layer, if this is a map.
    pub fn map_of(&self) -> Option<(&str, &str)> {
        match &self.channel.content {
            Content::Map { vehicle, layer } => Some((vehicle, layer)),
            _ => None,
        }
    }

    /// The vehicle, if this is an event of its journal.
    pub fn journal_of(&self) -> Option<&str> {
        match &self.channel.content {
            Content::Journal { vehicle } => Some(vehicle),
            _ => None,
        }
    }

    /// The vehicle, if this is a map or an event.
    pub fn vehicle(&self) -> Option<&str> {
        self.map_of().map(|(vehicle, _)| vehicle).or_else(|| self.journal_of())
    }

    /// True if this is a `VelodyneScan`, in any encoding.
    pub fn is_velodyne_scan(&self) -> bool {
        Kind::from_name(&self.channel.schema) == Some(Kind::VelodyneScan)
    }
}

/// An MCAP file cannot be read further.
#[derive(Debug, thiserror::Error)]
pub enum McapReadError {
    /// The file cannot be read.
    #[error("{}: {source}", file.display())]
    Read {
        /// The file.
        file: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
    /// The file does not start as an MCAP file does.
    #[error("{}: not an MCAP file: it does not start with the magic bytes", file.display())]
    NotMcap {
        /// The file.
        file: PathBuf,
    },
    /// The file is damaged.
    #[error("{}: damaged after {}: {source}", file.display(), counted(*messages, "message"))]
    Damaged {
        /// The file.
        file: PathBuf,
        /// Number of valid messages before the damage.
        messages: u64,
        /// The kind of damage.
        source: McapError,
    },
}

/// An open MCAP file; an iterator over its messages.
pub struct McapReader {
    file: PathBuf,
    source: Box<dyn Read + Send>,
    records: LinearReader,
    schemas: HashMap<u16, String>,
    channels: HashMap<u16, Arc<Channel>>,
    header: Header,
    /// Messages of the newest chunk, and the damage after them.
    waiting: VecDeque<Result<Message, McapReadError>>,
    messages: u64,
    bytes_read: u64,
    salvages: bool,
    has_footer: bool,
    has_ended: bool,
    damage: Option<String>,
}

impl McapReader {
    /// Opens a file and reads up to its first message. Damage is an error.
    ///
    /// # Errors
    /// [`McapReadError::Read`] if the file cannot be read, [`McapReadError::NotMcap`] if it is not an MCAP file,
    /// [`McapReadError::Damaged`] if it is damaged before its first message.
    pub fn open(file: &Path) -> Result<Self, McapReadError> {
        Self::from_source(file, open(file)?)
    }

    /// Opens a file like [`McapReader::open`], but damage only ends the messages: [`McapReader::incomplete`] then
    /// describes it.
    ///
    /// # Errors
    /// [`McapReadError::Read`] if the file cannot be read, [`McapReadError::NotMcap`] if it is not an MCAP file.
    pub fn salvage(file: &Path) -> Result<Self, McapReadError> {
        Self::new(file, open(file)?, true)
    }

    /// Reads an MCAP file from `source`, up to its first message; errors name it `file`.
    ///
    /// # Errors
    /// As [`McapReader::open`].
    pub fn from_source(file: &Path, source: impl Read + Send + 'static) -> Result<Self, McapReadError> {
        Self::new(file, source, false)
    }

    fn new(file: &Path, source: impl Read + Send + 'static, salvages: bool) -> Result<Self, McapReadError> {
        let options = LinearReaderOptions::default()
            .with_skip_end_magic(true)
            .with_emit_chunks(true)
            .with_validate_data_section_crc(true)
            .with_record_length_limit(RECORD_BYTES_MAX);
        let mut reader = Self {
            file: file.to_owned(),
            source: Box::new(source),
            records: LinearReader::new_with_options(options),
            schemas: HashMap::new(),
            channels: HashMap::new(),
            header: Header::default(),
            waiting: VecDeque::new(),
            messages: 0,
            bytes_read: 0,
            salvages,
            has_footer: false,
            has_ended: false,
            damage: None,
        };
        if let Some(first) = reader.next().transpose()? {
            reader.waiting.push_front(Ok(first));
        }
        Ok(reader)
    }

    /// The file's path.
    pub fn file(&self) -> &Path {
        &self.file
    }

    /// The contents before the first message.
    pub fn header(&self) -> &Header {
        &self.header
    }

    /// Number of bytes read so far.
    pub fn bytes_read(&self) -> u64 {
        self.bytes_read
    }

    /// True if the file ended before its closing records, because a crash cut it. Known after the last message.
    pub fn is_cut(&self) -> bool {
        self.has_ended && !self.has_footer
    }

    /// How the file is incomplete: cut or damaged. `None` for a complete file, and before the last message.
    pub fn incomplete(&self) -> Option<String> {
        let cut = || format!("cut after {} bytes: the closing records are missing", self.bytes_read);
        self.damage.clone().or_else(|| (self.waiting.is_empty() && self.is_cut()).then(cut))
    }

    /// The names of the layers of all maps so far, in alphabetical order.
    pub fn layers(&self) -> Vec<String> {
        self.names_of_maps(|_, layer| layer)
    }

    /// The names of the vehicles with maps so far, in alphabetical order.
    pub fn vehicles(&self) -> Vec<String> {
        self.names_of_maps(|vehicle, _| vehicle)
    }

    fn names_of_maps(&self, name: impl for<'a> Fn(&'a str, &'a str) -> &'a str) -> Vec<String> {
        let names = self.channels.values().filter_map(|channel| match &channel.content {
            Content::Map { vehicle, layer } => Some(name(vehicle, layer).to_owned()),
            _ => None,
        });
        names.collect::<BTreeSet<_>>().into_iter().collect()
    }

    /// Reads the next message; `None` at the end, cut or not.
    fn read(&mut self) -> Result<Option<Message>, McapReadError> {
        loop {
            if let Some(message) = self.waiting.pop_front() {
                return message.map(Some);
            }
            if self.has_ended {
                return Ok(None);
            }
            let record = match self.records.next_event() {
                None => break,
                Some(Ok(LinearReadEvent::ReadRequest(need))) => {
                    let read = self.source.read(self.records.insert(need.min(READ_BYTES_MAX))).map_err(|source| {
                        McapReadError::Read { file: self.file.clone(), source: advised(&self.file, source) }
                    })?;
                    self.records.notify_read(read);
                    self.bytes_read += read as u64;
                    continue;
                }
                Some(Ok(LinearReadEvent::Record { opcode, data })) => parse(opcode, data),
                Some(Err(McapError::UnexpectedEof)) if self.bytes_read > 0 => break,
                Some(Err(McapError::BadMagic)) => return Err(McapReadError::NotMcap { file: self.file.clone() }),
                Some(Err(error)) => Err(error),
            };
            match record.map(Record::into_owned).map_err(|source| self.damaged(source))? {
                Record::Chunk { header, data } => self.read_chunk(&header, &data)?,
                record => {
                    let message = self.read_record(record);
                    self.waiting.extend(message.map(Ok));
                }
            }
        }
        self.has_ended = true;
        Ok(None)
    }

    /// Reads all records of a chunk, up to the first damaged one.
    fn read_chunk(&mut self, header: &ChunkHeader, data: &[u8]) -> Result<(), McapReadError> {
        let content = decompress(header, data).map_err(|source| self.damaged(source))?;
        let mut rest = &*content;
        while !rest.is_empty() {
            match split_record(&mut rest) {
                Ok(record) => {
                    let message = self.read_record(record);
                    self.waiting.extend(message.map(Ok));
                }
                Err(source) => {
                    let damaged = self.damaged(source);
                    self.waiting.push_back(Err(damaged));
                    break;
                }
            }
        }
        Ok(())
    }

    fn damaged(&self, source: McapError) -> McapReadError {
        McapReadError::Damaged { file: self.file.clone(), messages: self.messages, source }
    }

    /// Reads one record: returns a message, or remembers a schema, a channel or a part of the header.
    fn read_record(&mut self, record: Record<'_>) -> Option<Message> {
        match record {
            Record::Schema { header, .. } => {
                self.schemas.insert(header.id, header.name);
            }
            Record::Channel(channel) => {
                let schema = self.schemas.get(&channel.schema_id).cloned().unwrap_or_default();
                let content = content(&channel.topic, &schema, &channel.message_encoding);
                self.channels.insert(channel.id, Arc::new(Channel { topic: channel.topic, schema, content }));
            }
            Record::Message { header, data } => {
                self.messages += 1;
                let channel = self.channels.get(&header.channel_id)?.clone();
                return Some(Message { channel, log_ns: header.log_time, data: Bytes::from(data.into_owned()) });
            }
            Record::Metadata(metadata) if metadata.name == "clearway" => {
                let boot_id = metadata.metadata.get("boot_id").and_then(|id| id.parse().ok());
                self.header.boot_id = boot_id.unwrap_or_default();
                self.header.metadata = metadata.metadata;
            }
            Record::Attachment { header, data, .. } => {
                let text = String::from_utf8_lossy(&data).into_owned();
                if header.name == "config.toml" {
                    self.header.config = Some(text);
                } else if header.name.starts_with("calibration/") {
                    self.header.calibrations.insert(header.name, text);
                }
            }
            Record::Footer(_) => self.has_footer = true,
            _ => {}
        }
        None
    }
}

impl Iterator for McapReader {
    type Item = Result<Message, McapReadError>;

    fn next(&mut self) -> Option<Self::Item> {
        let next = self.read().transpose();
        if let Some(Err(error)) = &next {
            self.has_ended = true;
            self.waiting.clear();
            if let (McapReadError::Damaged { source, .. }, true) = (error, self.salvages) {
                self.damage = Some(format!("damaged near byte {}: {source}", self.bytes_read));
                return None;
            }
        }
        next
    }
}

fn open(file: &Path) -> Result<File, McapReadError> {
    let wrong = |source| McapReadError::Read { file: file.to_owned(), source: advised(file, source) };
    let opened = File::open(file).map_err(wrong)?;
    match opened.metadata().map_err(wrong)? {
        of_file if of_file.is_file() && of_file.len() == 0 => {
            Err(wrong(Error::new(ErrorKind::UnexpectedEof, "the file is empty")))
        }
        _ => Ok(opened),
    }
}

/// The kind of the messages of a channel, by its topic, the name of its schema, and its encoding.
fn content(topic: &str, schema: &str, encoding: &str) -> Content {
    // A bag that was converted from ROS 1 has the same types in another encoding.
    if let Some(kind) = Kind::from_name(schema).filter(|_| encoding == "cdr") {
        return Content::Ros(kind);
    }
    let parts: Vec<&str> = topic.split('/').collect();
    match (schema, &parts[..]) {
        ("clearway.v1.Event", ["", vehicle, "journal"]) => Content::Journal { vehicle: (*vehicle).into() },
        ("clearway.v1.Map", ["", vehicle, "map", layer]) => {
            Content::Map { vehicle: (*vehicle).into(), layer: (*layer).into() }
        }
        ("clearway.v1.Keyframe", ["", vehicle, "keyframe"]) => Content::Keyframe { vehicle: (*vehicle).into() },
        ("clearway.v1.RecordingCounts", ["", "recorder", "counts"]) => Content::Counts,
        _ => Content::Other,
    }
}
