//! Any MCAP file, or a ROS 2 bag in sqlite -> its header and its messages, in file order. All commands read such files
//! with this reader.
//!
//! Damage costs the damaged chunk and is not an error, and neither is a file that a crash has cut: the reader returns
//! every message that is whole, and [`McapReader::incomplete`] then says what is missing. A chunk whose CRC is wrong is
//! damaged as a whole.

use std::collections::{BTreeSet, HashMap, VecDeque};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use bytes::Bytes;
use clearway_proto::v1;
use clearway_ros::Kind;
use mcap::records::Record;
use prost::Message as _;

use crate::counted::counted;
use crate::file_advice::advised;

use super::channel::{Channel, Content};
use super::damage::Damage;
use super::file_records::FileRecords;
use super::header::{FORMAT, Format};
use super::mcap_records::RecordsError;
use super::message_order::MessageOrder;
use super::record_counts::RecordCounts;

pub use super::header::Header;
pub use super::mcap_records::McapSource;

/// The name of the metadata that a repaired file has at each place at which a part of the damaged file is lost.
pub(super) const REPAIR_METADATA: &str = "clearway-repair";
/// The key of what is lost there.
pub(super) const REPAIR_LOST_KEY: &str = "lost";
/// The packages of the messages that this version reads.
const PACKAGES: [&str; 1] = ["clearway.v1."];

/// One message of an MCAP file.
#[derive(Clone, Debug, PartialEq)]
pub struct Message {
    /// Channel of the message: topic, schema and encoding.
    pub channel: Arc<Channel>,
    /// Log time, ns since the Unix epoch.
    pub log_ns: u64,
    /// Payload in the encoding that the channel names.
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
        /// Path of the file that cannot be read.
        file: PathBuf,
        /// Error of the operating system.
        source: std::io::Error,
    },
    /// The file does not start as an MCAP file does.
    #[error("{}: not an MCAP file: it does not start with the magic bytes", file.display())]
    NotMcap {
        /// Path of the file that is not MCAP.
        file: PathBuf,
    },
    /// A later version of clearway wrote the file.
    #[error("{}: a recording with {found}; this clearway reads {known}: use the version that wrote it, {by}, or a later one",
        file.display())]
    Version {
        /// Path of the file that is too new.
        file: PathBuf,
        /// The format or message schema of the file, in words.
        found: String,
        /// The formats or schemas that this clearway reads, in words.
        known: String,
        /// The version that wrote the file.
        by: String,
    },
}

/// An open MCAP file; an iterator over its messages.
pub struct McapReader {
    file: PathBuf,
    records: FileRecords,
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
    order: MessageOrder,
    /// Number of lost parts before the newest message.
    losses_before: usize,
    /// What a repair could not read, in file order.
    repaired: Vec<String>,
    has_ended: bool,
}

impl McapReader {
    /// Opens a file and reads up to its first message.
    ///
    /// # Errors
    /// [`McapReadError::Read`] if the file cannot be read, [`McapReadError::NotMcap`] if it is not an MCAP file,
    /// [`McapReadError::Version`] if a later version of clearway wrote it.
    pub fn open(file: &Path) -> Result<Self, McapReadError> {
        Self::unread(file, FileRecords::open(file))?.with_first()
    }

    /// Reads an MCAP file from `source`, up to its first message; errors name it `file`.
    ///
    /// # Errors
    /// As [`McapReader::open`].
    pub fn from_source(file: &Path, source: impl McapSource + 'static) -> Result<Self, McapReadError> {
        Self::unread(file, FileRecords::of_mcap(source))?.with_first()
    }

    /// Opens a file to read its records.
    pub(super) fn open_records(file: &Path) -> Result<Self, McapReadError> {
        Self::unread(file, FileRecords::open(file))
    }

    fn with_first(mut self) -> Result<Self, McapReadError> {
        self.first = self.read()?;
        Ok(self)
    }

    fn unread(file: &Path, records: Result<FileRecords, RecordsError>) -> Result<Self, McapReadError> {
        Ok(Self {
            file: file.to_owned(),
            records: records.map_err(|error| read_error(file, error))?,
            schemas: HashMap::new(),
            channels: HashMap::new(),
            header: Header::default(),
            waiting: VecDeque::new(),
            first: None,
            unknown: 0,
            counts: RecordCounts::default(),
            order: MessageOrder::default(),
            losses_before: 0,
            repaired: Vec::new(),
            has_ended: false,
        })
    }

    /// Path of the file, as given to open it.
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
        self.has_ended && !self.records.end().is_closed
    }

    /// The damaged parts so far.
    pub fn damages(&self) -> Vec<Damage> {
        self.records.lost().iter().map(|part| Damage::new(part, |id| self.topic(id))).collect()
    }

    /// Number of damaged parts so far.
    pub fn damage_count(&self) -> usize {
        self.records.lost().len()
    }

    /// Number of damaged parts so far whose contents no other record repeats.
    pub fn loss_count(&self) -> usize {
        self.records.lost().iter().filter(|part| part.is_loss).count()
    }

    /// What `clearway repair` could not read of the damaged file, if it wrote this file: the losses so far, in file
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
        if self.has_ended && self.unknown > 0 {
            faults.push(format!("{} of channels that the file does not describe", counted(self.unknown, "message")));
        }
        if !self.has_ended {
            return faults;
        }
        faults.extend(self.counts.faults(self.named_losses(), |id| self.topic(id)));
        // A repaired file says what it lacks where it was lost.
        if self.repaired.is_empty() {
            faults.extend(self.order.fault(self.counts.has_dropped()));
            if self.has(|content| matches!(content, Content::Journal { .. })) {
                let has_maps = self.has(|content| matches!(content, Content::Map { .. } | Content::Digest { .. }));
                faults.extend(self.header.faults(has_maps));
            }
        }
        faults
    }

    /// True if a message of a channel with such content was read.
    fn has(&self, is: fn(&Content) -> bool) -> bool {
        self.channels.iter().any(|(id, of)| is(&of.content) && self.counts.has_message_of(*id))
    }

    /// Number of lost messages that the damaged parts name.
    fn named_losses(&self) -> u64 {
        self.records.lost().iter().flat_map(|part| part.messages.values()).sum()
    }

    /// True if the faults of [`McapReader::faults_of_end`] may have cost a record. A file that is cut after its data
    /// lacks only repetitions.
    pub(super) fn is_loss_at_end(&self) -> bool {
        let harmless = usize::from(self.is_cut() && self.records.end().has_all_data);
        self.faults_of_end().len() > harmless
    }

    /// Number of messages that are lost, by the file's own counts or as its damaged parts name them; `None` before the
    /// last message, or without counts that can be trusted.
    pub(super) fn lost_messages(&self) -> Option<u64> {
        // What is in the file twice hides in the counts what is lost.
        self.counts.missing_messages(|id| self.topic(id)).map(|missing| missing.max(self.named_losses()))
    }

    /// True if the file proves by its own counts that it has all messages, attachments and metadata.
    pub(super) fn has_all_records(&self) -> bool {
        self.named_losses() == 0 && !self.records.end().has_more && self.counts.are_all_there(|id| self.topic(id))
    }

    /// True if the messages are not all there or not as they were written, by what the file says of them. Known after
    /// the last message.
    pub fn lacks_messages(&self) -> bool {
        self.lost_messages().is_some_and(|lost| lost > 0) || self.order.fault(false).is_some()
    }

    /// The channels so far, by topic, each with the number of its messages.
    pub fn channels(&self) -> Vec<(&Channel, u64)> {
        let counted = self.channels.iter().map(|(id, channel)| (&**channel, self.counts.messages_of(*id)));
        let mut channels: Vec<_> = counted.collect();
        channels.sort_by(|a, b| a.0.topic.cmp(&b.0.topic));
        channels
    }

    /// The channels that have messages by the file's own counts, read so far or not; `None` if the file has no counts,
    /// because it is cut or has no summary.
    ///
    /// # Errors
    /// [`McapReadError::Version`] if a later version of clearway wrote it.
    pub fn announced(&mut self) -> Result<Option<Vec<Arc<Channel>>>, McapReadError> {
        let Some(ids) = self.records.with_messages() else { return Ok(None) };
        for record in self.records.take_described() {
            self.remember(&record)?;
        }
        Ok(ids.iter().map(|id| self.channels.get(id).cloned()).collect())
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
            None => self.records.next().map_err(|error| read_error(&self.file, error))?,
        };
        let Some(mut record) = record else {
            self.has_ended = true;
            self.counts.end(self.records.end().has_sound_counts, !self.repaired.is_empty());
            return Ok(None);
        };
        let is_unknown = |id: &u16| !self.channels.contains_key(id);
        if let Record::Message { header, .. } = &record
            && is_unknown(&header.channel_id)
        {
            // The chunk that describes the channels is damaged; the summary repeats them.
            self.waiting.extend(self.records.take_described());
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
                let (topic, encoding) = (of.topic.clone(), of.message_encoding.clone());
                self.channels.insert(of.id, Arc::new(Channel { topic, schema, encoding, content }));
            }
            Record::Message { header, data } => {
                let losses = self.loss_count();
                let has_loss = std::mem::replace(&mut self.losses_before, losses) < losses;
                match self.channels.get(&header.channel_id) {
                    None => self.unknown += 1,
                    Some(of) if of.content == Content::Counts => {
                        self.counts.add_recorder(v1::RecordingCounts::decode(&data[..]).unwrap_or_default());
                    }
                    Some(of) => self.order.add(of, data, has_loss),
                }
            }
            Record::Metadata(metadata) if metadata.name == REPAIR_METADATA => {
                self.repaired.extend(metadata.metadata.get(REPAIR_LOST_KEY).cloned());
            }
            Record::Metadata(metadata) => {
                self.header.add_metadata(metadata);
                if self.header.format() == Format::Later {
                    let found = format!("format {}", self.header.value("format"));
                    return Err(self.version_error(found, format!("formats up to {FORMAT}")));
                }
            }
            Record::Attachment { header, data, .. } => self.header.add_attachment(header, data),
            _ => {}
        }
        Ok(())
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

fn read_error(file: &Path, error: RecordsError) -> McapReadError {
    let file = file.to_owned();
    match error {
        RecordsError::Read(source) => McapReadError::Read { source: advised(&file, source), file },
        RecordsError::NotMcap => McapReadError::NotMcap { file },
    }
}
