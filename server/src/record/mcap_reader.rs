//! Any MCAP file, or a ROS 2 bag in sqlite -> its header and its messages, in file order. All commands read such files
//! with this reader.
//!
//! Damage costs the damaged chunk and is not an error, and neither is a file that a crash has cut: the reader returns
//! every message that is whole, and [`McapReader::incomplete`] then says what is missing. A chunk whose CRC is wrong is
//! damaged as a whole.

use std::collections::{BTreeMap, BTreeSet, HashMap, VecDeque};
use std::io::Read;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use bytes::Bytes;
use clearway_proto::v1;
use clearway_ros::Kind;
use mcap::records::{Metadata, Record};
use prost::Message as _;

use crate::base::counted::counted;
use crate::base::file_advice::advised;

use super::channel::{Channel, Content};
use super::damage::Damage;
use super::file_records::FileRecords;
use super::mcap_records::{McapRecords, RecordsError};
use super::mcap_summary;
use super::record_counts::RecordCounts;

/// Version of the contents of our recordings, in their metadata. A recording without one has version 1.
pub const FORMAT: u32 = 1;
/// The name of the metadata that a repaired file has at each place at which a part of the damaged file is lost.
pub(super) const REPAIR_METADATA: &str = "clearway-repair";
/// The key of what is lost there.
pub(super) const REPAIR_LOST_KEY: &str = "lost";
/// The packages of the messages that this version reads.
const PACKAGES: [&str; 1] = ["clearway.v1."];

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

    /// The vehicle, if this is a map, the digest of one, or an event.
    pub fn vehicle(&self) -> Option<&str> {
        match &self.channel.content {
            Content::Map { vehicle, .. } | Content::Digest { vehicle, .. } | Content::Journal { vehicle } => {
                Some(vehicle)
            }
            _ => None,
        }
    }

    /// The header of the map, if this is a map or the digest of one.
    pub fn map_header(&self) -> Option<v1::Header> {
        match &self.channel.content {
            Content::Map { .. } => v1::Map::decode(self.data.clone()).ok()?.header,
            Content::Digest { .. } => v1::MapDigest::decode(self.data.clone()).ok()?.header,
            _ => None,
        }
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
    #[error("{}: not an MCAP file: it does not start with the magic bytes; if it was one, `clearway repair` reads the rest",
        file.display())]
    NotMcap {
        /// The file.
        file: PathBuf,
    },
    /// The file was searched for records of an MCAP file, and has none.
    #[error("{}: not an MCAP file, and no record of one is in it", file.display())]
    NoRecord {
        /// The file.
        file: PathBuf,
    },
    /// A later version of clearway wrote the file.
    #[error("{}: a recording with {found}; this clearway reads {known}: use the version that wrote it, {by}, or a later one",
        file.display())]
    Version {
        /// The file.
        file: PathBuf,
        /// What the file has.
        found: String,
        /// What this version reads.
        known: String,
        /// The version that wrote the file.
        by: String,
    },
}

/// An open MCAP file; an iterator over its messages.
pub struct McapReader {
    file: PathBuf,
    records: FileRecords,
    /// True if `file` can be opened to read its summary.
    has_path: bool,
    schemas: HashMap<u16, String>,
    channels: HashMap<u16, Arc<Channel>>,
    header: Header,
    /// Records of the summary that are read before their turn, and the message that needs them.
    waiting: VecDeque<Record<'static>>,
    /// The first message, which opening the file has read.
    first: Option<Message>,
    /// Number of messages of channels that no record describes.
    unknown: u64,
    counts: RecordCounts,
    /// What a repair could not read, in file order.
    repaired: Vec<String>,
    /// True if the format in the metadata is damaged.
    has_wrong_format: bool,
    has_ended: bool,
}

impl McapReader {
    /// Opens a file and reads up to its first message.
    ///
    /// # Errors
    /// [`McapReadError::Read`] if the file cannot be read, [`McapReadError::NotMcap`] if it is not an MCAP file,
    /// [`McapReadError::Version`] if a later version of clearway wrote it.
    pub fn open(file: &Path) -> Result<Self, McapReadError> {
        Self::new(file, open(file, false)?, true)
    }

    /// Reads an MCAP file from `source`, up to its first message; errors name it `file`.
    ///
    /// # Errors
    /// As [`McapReader::open`].
    pub fn from_source(file: &Path, source: impl Read + Send + 'static) -> Result<Self, McapReadError> {
        Self::new(file, FileRecords::Mcap(Box::new(McapRecords::new(source, false))), false)
    }

    /// Opens a file to read its records; its first bytes may be damaged too.
    pub(super) fn open_any(file: &Path) -> Result<Self, McapReadError> {
        Ok(Self::unread(file, open(file, true)?, true))
    }

    fn new(file: &Path, records: FileRecords, has_path: bool) -> Result<Self, McapReadError> {
        let mut reader = Self::unread(file, records, has_path);
        reader.first = reader.read()?;
        Ok(reader)
    }

    fn unread(file: &Path, records: FileRecords, has_path: bool) -> Self {
        Self {
            file: file.to_owned(),
            records,
            has_path,
            schemas: HashMap::new(),
            channels: HashMap::new(),
            header: Header::default(),
            waiting: VecDeque::new(),
            first: None,
            unknown: 0,
            counts: RecordCounts::default(),
            repaired: Vec::new(),
            has_wrong_format: false,
            has_ended: false,
        }
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
        self.records.offset()
    }

    /// True if the file ended before its closing records, because a crash cut it. Known after the last message.
    pub fn is_cut(&self) -> bool {
        self.has_ended && !self.records.has_end()
    }

    /// The damaged parts so far.
    pub fn damages(&self) -> Vec<Damage> {
        self.records.lost().iter().map(|part| Damage::new(part, |id| self.topic(id))).collect()
    }

    /// Number of damaged parts so far.
    pub fn damage_count(&self) -> usize {
        self.records.lost().len()
    }

    /// The contents of a metadata record, with the format of the file if it is damaged there.
    pub(super) fn with_known_format(&self, mut metadata: Metadata) -> Metadata {
        if self.has_wrong_format && metadata.name == "clearway" {
            metadata.metadata.insert("format".into(), FORMAT.to_string());
        }
        metadata
    }

    /// Number of damaged parts so far whose contents no other record repeats.
    pub fn loss_count(&self) -> usize {
        self.records.lost().iter().filter(|part| part.is_loss).count()
    }

    /// What `clearway repair` could not read of the damaged file, if it wrote this one: the losses so far, in file
    /// order. The file itself is whole.
    pub fn repaired(&self) -> &[String] {
        &self.repaired
    }

    /// How the file is incomplete: damaged, cut, or with fewer messages than it says. `None` for a complete file, and
    /// before the last message.
    pub fn incomplete(&self) -> Option<String> {
        if !self.has_ended {
            return None;
        }
        let damages = self.damages();
        let mut faults = Vec::new();
        if let Some(first) = damages.first() {
            let places = counted(damages.len() as u64, "place");
            let first = if damages.len() == 1 { first.to_string() } else { format!("the first: {first}") };
            faults.push(format!("damaged in {places}, {first}"));
        }
        faults.extend(self.faults_of_end());
        (!faults.is_empty()).then(|| faults.join("; "))
    }

    /// What is wrong with the file beside its damaged parts; empty before the last message.
    pub(super) fn faults_of_end(&self) -> Vec<String> {
        let mut faults = Vec::new();
        if self.is_cut() {
            faults.push(format!("cut after {} bytes: the closing records are missing", self.bytes_read()));
        }
        if self.has_ended && self.has_wrong_format {
            let of = |key: &str| self.header.metadata.get(key).map_or("", |value| value);
            let (format, version) = (of("format"), of("version"));
            faults.push(format!("its metadata has format {format:?}, which clearway {version} has never written"));
        }
        if self.has_ended && self.unknown > 0 {
            faults.push(format!("{} of channels that the file does not describe", counted(self.unknown, "message")));
        }
        faults.extend(self.faults_of_header());
        let lost = self.records.lost().iter();
        let named = (self.damage_count() > 0).then(|| lost.flat_map(|part| part.messages.values()).sum());
        faults.extend(self.counts.fault(named, |id| self.topic(id)));
        faults
    }

    /// What a recording of clearway lacks to be verified, if this is one. A repaired file says it where it was lost.
    fn faults_of_header(&self) -> Vec<String> {
        let has = |is: fn(&Content) -> bool| {
            self.channels.iter().any(|(id, of)| is(&of.content) && self.counts.has_message_of(*id))
        };
        if !self.has_ended || !self.repaired.is_empty() || !has(|of| matches!(of, Content::Journal { .. })) {
            return Vec::new();
        }
        let mut faults = Vec::new();
        let of = |key: &str| self.header.metadata.get(key).map(String::as_str);
        if self.header.boot_id == 0 {
            faults.push(format!("its metadata has the boot id {:?}, which is none", of("boot_id").unwrap_or_default()));
        }
        let has_maps = has(|of| matches!(of, Content::Map { .. } | Content::Digest { .. }));
        if has_maps && of("maps") == Some("none") {
            faults.push("its metadata says that no map is recorded, and maps are".into());
        }
        match self.header.config.as_ref().map(|text| text.parse::<toml::Table>()) {
            None => faults.push("it has no config.toml, so its maps cannot be made again".into()),
            Some(Err(error)) => faults.push(format!("its config.toml cannot be read: {}", error.message())),
            Some(Ok(_)) => {}
        }
        faults
    }

    /// True if the faults of [`McapReader::faults_of_end`] may have cost a record. A file that is cut after its data
    /// lacks only repetitions.
    pub(super) fn is_loss_at_end(&self) -> bool {
        let harmless = usize::from(self.is_cut() && self.records.has_data_end());
        self.faults_of_end().len() > harmless
    }

    /// How many records the file has, and how many it should have.
    pub(super) fn counts(&self) -> &RecordCounts {
        &self.counts
    }

    /// Number of messages that the file lacks by its own count, if that can be trusted; 0 before the last message.
    pub fn missing_messages(&self) -> u64 {
        self.counts.missing_messages()
    }

    fn topic(&self, id: u16) -> String {
        self.channels.get(&id).map_or_else(|| format!("channel {id}"), |of| of.topic.clone())
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
        while let Some(record) = self.next_record()? {
            let Record::Message { header, data } = record else { continue };
            if let Some(channel) = self.channels.get(&header.channel_id).cloned() {
                return Ok(Some(Message { channel, log_ns: header.log_time, data: Bytes::from(data.into_owned()) }));
            }
        }
        Ok(None)
    }

    /// Reads the next record, also of a chunk; `None` at the end, cut or not.
    pub(super) fn next_record(&mut self) -> Result<Option<Record<'static>>, McapReadError> {
        let record = match self.waiting.pop_front() {
            Some(record) => Some(record),
            None => self.records.next().map_err(|error| match error {
                RecordsError::Read(source) => {
                    McapReadError::Read { file: self.file.clone(), source: advised(&self.file, source) }
                }
                RecordsError::NotMcap => McapReadError::NotMcap { file: self.file.clone() },
                RecordsError::NoRecord => McapReadError::NoRecord { file: self.file.clone() },
            })?,
        };
        let Some(mut record) = record else {
            self.has_ended = true;
            self.counts.end(self.records.has_sound_counts());
            return Ok(None);
        };
        let is_unknown = |id: &u16| !self.channels.contains_key(id);
        if let Record::Message { header, .. } = &record
            && is_unknown(&header.channel_id)
            && std::mem::take(&mut self.has_path)
        {
            // The chunk that describes the channels is damaged; the summary repeats them.
            self.waiting.extend(mcap_summary::schemas_and_channels(&self.file).unwrap_or_default());
            self.waiting.push_back(record);
            record = self.waiting.pop_front().expect("the record itself");
        }
        self.remember(&record)?;
        Ok(Some(record))
    }

    /// Remembers what a record says about the messages and the file.
    fn remember(&mut self, record: &Record<'_>) -> Result<(), McapReadError> {
        self.counts.add(record);
        match record {
            Record::Schema { header, .. } => {
                self.check_version(&header.name)?;
                self.schemas.insert(header.id, header.name.clone());
            }
            Record::Channel(of) => {
                let schema = self.schemas.get(&of.schema_id).cloned().unwrap_or_default();
                let content = Content::of(&of.topic, &schema, &of.message_encoding);
                self.channels.insert(of.id, Arc::new(Channel { topic: of.topic.clone(), schema, content }));
            }
            Record::Message { header, .. } => {
                self.unknown += u64::from(!self.channels.contains_key(&header.channel_id));
            }
            Record::Metadata(metadata) if metadata.name == "clearway" => {
                let boot_id = metadata.metadata.get("boot_id").and_then(|id| id.parse().ok());
                self.header.boot_id = boot_id.unwrap_or_default();
                self.header.metadata.clone_from(&metadata.metadata);
                self.has_wrong_format = !self.has_known_format()?;
            }
            Record::Metadata(metadata) if metadata.name == REPAIR_METADATA => {
                self.repaired.extend(metadata.metadata.get(REPAIR_LOST_KEY).cloned());
            }
            Record::Attachment { header, data, .. } => {
                let text = String::from_utf8_lossy(data).into_owned();
                if header.name == "config.toml" {
                    self.header.config = Some(text);
                } else if header.name.starts_with("calibration/") {
                    self.header.calibrations.insert(header.name.clone(), text);
                }
            }
            _ => {}
        }
        Ok(())
    }

    /// False if the format is one that the version that wrote the file cannot have written: then the metadata, which
    /// no checksum of its own covers, is damaged. An error if a later version wrote the file.
    fn has_known_format(&self) -> Result<bool, McapReadError> {
        let Some(found) = self.header.metadata.get("format") else { return Ok(true) };
        if matches!(found.parse::<u32>(), Ok(1..=FORMAT)) {
            return Ok(true);
        }
        let by = self.header.metadata.get("version").and_then(|by| version_numbers(by));
        match by.is_some_and(|by| Some(by) <= version_numbers(env!("CARGO_PKG_VERSION"))) {
            true => Ok(false),
            false => Err(self.version_error(format!("format {found}"), format!("formats up to {FORMAT}"))),
        }
    }

    fn check_version(&self, schema: &str) -> Result<(), McapReadError> {
        let is_known = !schema.starts_with("clearway.") || PACKAGES.iter().any(|package| schema.starts_with(package));
        match is_known {
            true => Ok(()),
            false => {
                Err(self.version_error(format!("messages of schema {schema}"), format!("{}*", PACKAGES.join("*, "))))
            }
        }
    }

    fn version_error(&self, found: String, known: String) -> McapReadError {
        let by = self.header.metadata.get("version").cloned().unwrap_or_else(|| "which it does not name".into());
        McapReadError::Version { file: self.file.clone(), found, known, by }
    }
}

impl Iterator for McapReader {
    type Item = Result<Message, McapReadError>;

    fn next(&mut self) -> Option<Self::Item> {
        if let Some(first) = self.first.take() {
            return Some(Ok(first));
        }
        let next = self.read().transpose();
        self.has_ended |= matches!(next, Some(Err(_)));
        next
    }
}

/// The numbers of a version such as `0.1.0`, which compare as versions do.
fn version_numbers(version: &str) -> Option<Vec<u32>> {
    version.split('.').map(|number| number.parse().ok()).collect()
}

fn open(file: &Path, any_start: bool) -> Result<FileRecords, McapReadError> {
    let wrong = |source| McapReadError::Read { file: file.to_owned(), source: advised(file, source) };
    FileRecords::open(file, any_start).map_err(wrong)
}
