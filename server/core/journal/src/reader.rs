//! A recording -> its events, its maps and the ROS 2 messages that [`clearway_ros`] decodes, in file order; and the
//! configuration of the recorded run.

use std::collections::BTreeSet;
use std::error::Error;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use bytes::Bytes;
use clearway_lidar::calibration::Calibration;
use clearway_mapping::config::SensorConfig;
use clearway_mapping::event::Event;
use clearway_proto::v1;
use clearway_ros::Kind;
use prost::Message as _;

use super::channel::{Channel, Content};
use super::damage::Damage;
use super::mcap_reader::{Header, McapReadError, McapReader, McapSource, Message};
use crate::RecordedMaps;
use crate::encode::{EventDecodeError, event_from_bytes};

/// One message of a recording.
#[derive(Clone, Debug, PartialEq)]
pub enum RecordedMessage {
    /// An event of `/<vehicle>/journal`.
    Event {
        /// Name of the vehicle.
        vehicle: String,
        /// The event as the pipeline processed it.
        event: Event,
    },
    /// A map of `/<vehicle>/map/<layer>`.
    Map {
        /// Name of the vehicle.
        vehicle: String,
        /// Name of the map's layer.
        layer: String,
        /// An encoded `clearway.v1.Map` with this one layer.
        bytes: Bytes,
    },
    /// A digest of `/<vehicle>/digest/<layer>`.
    Digest {
        /// Name of the vehicle.
        vehicle: String,
        /// Name of the map's layer.
        layer: String,
        /// The header of the map, and the SHA-256 of its bytes.
        digest: v1::MapDigest,
    },
    /// A mark of `/<vehicle>/keyframe`.
    Keyframe {
        /// Name of the vehicle.
        vehicle: String,
        /// The keyframe: a new pipeline warms up, or replaces the old one.
        keyframe: v1::Keyframe,
    },
    /// What the recorder has written and dropped so far, of `/recorder/counts`.
    Counts(v1::RecordingCounts),
    /// A ROS 2 message.
    Ros {
        /// Topic of the message.
        topic: String,
        /// Type of the message.
        kind: Kind,
        /// Log time, ns since the Unix epoch.
        log_ns: i64,
        /// The message in CDR, with its header.
        bytes: Bytes,
    },
}

/// A recording cannot be read further, or its configuration cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum RecordingError {
    /// The file cannot be read, is not an MCAP file, or is of a later version.
    #[error(transparent)]
    Mcap(#[from] McapReadError),
    /// A message of a journal is not an event.
    #[error("{}: {topic}: {source}", file.display())]
    Event {
        /// Path of the recording.
        file: PathBuf,
        /// The topic of the journal.
        topic: String,
        /// The fault of the message.
        source: EventDecodeError,
    },
    /// The file has no configuration: another program wrote it, it was cut before its first message, or it is damaged.
    #[error("{}: no attachment config.toml: {reason}", file.display())]
    NoConfig {
        /// Path of the recording.
        file: PathBuf,
        /// Why it has none, as far as known.
        reason: String,
    },
    /// The recorded configuration is invalid.
    #[error(transparent)]
    Config(Box<dyn Error + Send + Sync>),
    /// A recorded calibration is missing or invalid.
    #[error("{}: attachment {name}: {reason}", file.display())]
    Calibration {
        /// Path of the recording.
        file: PathBuf,
        /// The name of the attachment.
        name: String,
        /// Why the calibration cannot be used.
        reason: String,
    },
}

/// What the first messages of a recording say about its run. They are in a chunk with a checksum, which the metadata
/// does not have.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Beginning {
    /// The boot id of the first map; `None` if the file has no map.
    pub boot_id: Option<u64>,
    /// Sequence of the first event; `None` if the file has no event before its first map.
    pub first_event: Option<u64>,
}

impl Beginning {
    /// Reads a recording up to its first map.
    ///
    /// # Errors
    /// As [`RecordingReader::open`], and the errors of the recording's messages.
    pub fn of(file: &Path) -> Result<Self, RecordingError> {
        let mut beginning = Self::default();
        for message in RecordingReader::open(file)? {
            let header = match message? {
                RecordedMessage::Event { event, .. } => {
                    beginning.first_event.get_or_insert(event.sequence);
                    continue;
                }
                RecordedMessage::Map { bytes, .. } => v1::Map::decode(bytes).ok().and_then(|map| map.header),
                RecordedMessage::Digest { digest, .. } => digest.header,
                _ => continue,
            };
            let recorded_boot_id = |header: v1::Header| header.replay.map_or(header.boot_id, |of| of.recorded_boot_id);
            beginning.boot_id = header.map(recorded_boot_id);
            break;
        }
        Ok(beginning)
    }
}

/// An open recording; an iterator over its messages. It skips messages of other kinds.
pub struct RecordingReader {
    reader: McapReader,
    has_ended: bool,
}

impl RecordingReader {
    /// Opens a recording and reads up to its first message.
    ///
    /// # Errors
    /// [`RecordingError::Mcap`] if the file cannot be read, is not an MCAP file, or is of a later version.
    pub fn open(file: &Path) -> Result<Self, RecordingError> {
        Ok(Self { reader: McapReader::open(file)?, has_ended: false })
    }

    /// Reads a recording from `source`; errors name it `file`.
    ///
    /// # Errors
    /// As [`RecordingReader::open`].
    pub fn from_source(file: &Path, source: impl McapSource + 'static) -> Result<Self, RecordingError> {
        Ok(Self { reader: McapReader::from_source(file, source)?, has_ended: false })
    }

    /// Path of the file, as given to open it.
    pub fn file(&self) -> &Path {
        self.reader.file()
    }

    /// The contents before the first message.
    pub fn header(&self) -> &Header {
        self.reader.header()
    }

    /// The channels so far, by topic, each with the number of its messages.
    pub fn channels(&self) -> Vec<(&Channel, u64)> {
        self.reader.channels()
    }

    /// The ROS topics that have messages by the file's own counts; `None` if it has no counts. See
    /// [`McapReader::announced`].
    ///
    /// # Errors
    /// As [`RecordingReader::open`].
    pub fn announced_topics(&mut self) -> Result<Option<BTreeSet<String>>, RecordingError> {
        let of_ros = |channels: Vec<Arc<Channel>>| {
            let channels = channels.iter().filter(|channel| matches!(channel.content, Content::Ros(_)));
            channels.map(|channel| channel.topic.clone()).collect()
        };
        Ok(self.reader.announced()?.map(of_ros))
    }

    /// Number of bytes read so far.
    pub fn bytes_read(&self) -> u64 {
        self.reader.bytes_read()
    }

    /// True if the file ended before its closing records, because a crash cut it. Known after the last message.
    pub fn is_cut(&self) -> bool {
        self.reader.is_cut()
    }

    /// The damaged parts so far.
    pub fn damages(&self) -> Vec<Damage> {
        self.reader.damages()
    }

    /// What a repair could not read of the damaged file, if this file is repaired: the losses so far.
    pub fn repaired(&self) -> &[String] {
        self.reader.repaired()
    }

    /// Number of lost parts so far, of this file and of the file from which it was repaired.
    pub fn loss_count(&self) -> usize {
        self.reader.loss_count() + self.repaired().len()
    }

    /// True if the messages are not all there or not as they were written, by what the file says of them. Known after
    /// the last message.
    pub fn lacks_messages(&self) -> bool {
        self.reader.lacks_messages()
    }

    /// How the file is incomplete: damaged, cut, or with fewer messages than it says. `None` for a complete file, and
    /// before the last message.
    pub fn incomplete(&self) -> Option<String> {
        self.reader.incomplete()
    }

    /// The number of the part; `None` if the metadata lacks it.
    pub fn part(&self) -> Option<u64> {
        self.header().metadata.get("part").and_then(|part| part.parse().ok())
    }

    /// What the recording holds of the maps.
    pub fn maps(&self) -> RecordedMaps {
        let recorded = self.header().metadata.get("maps");
        let kinds = [RecordedMaps::Digest, RecordedMaps::None];
        kinds.into_iter().find(|maps| recorded.is_some_and(|name| name == maps.as_str())).unwrap_or_default()
    }

    /// The configuration of the recorded run, TOML.
    ///
    /// # Errors
    /// [`RecordingError::NoConfig`] if the recording has none.
    pub fn config_text(&self) -> Result<&str, RecordingError> {
        let no_config = || RecordingError::NoConfig { file: self.file().to_owned(), reason: self.why_no_config() };
        self.header().config.as_deref().ok_or_else(no_config)
    }

    /// The calibration table of a sensor of the recorded run; `None` if its configuration names none.
    ///
    /// # Errors
    /// [`RecordingError::Calibration`] if the configuration names a table that is missing or invalid.
    pub fn table(&self, vehicle: &str, sensor: &SensorConfig) -> Result<Option<Calibration>, RecordingError> {
        if sensor.calibration.is_none() {
            return Ok(None);
        }
        let name = format!("calibration/{vehicle}/{}.yaml", sensor.name);
        let text = self.header().calibrations.get(&name);
        let table = text.map(|text| Calibration::load_str(text).map_err(|error| error.to_string()));
        let table = table.unwrap_or_else(|| Err("missing".into()));
        table.map(Some).map_err(|reason| RecordingError::Calibration { file: self.file().to_owned(), name, reason })
    }

    fn why_no_config(&self) -> String {
        let damages = self.damages();
        let mut lost = damages.iter().map(ToString::to_string).chain(self.repaired().iter().cloned());
        match lost.find(|lost| lost.contains("config.toml")) {
            Some(lost) => format!("it is lost ({lost}), and without it its maps cannot be made again"),
            None if self.header().metadata.is_empty() => "not a recording of clearway, or cut at its very start".into(),
            None => "it is lost, and without it its maps cannot be made again".into(),
        }
    }

    fn decode(&self, message: Message) -> Option<Result<RecordedMessage, RecordingError>> {
        let Message { channel, log_ns, data: bytes } = message;
        let topic = &channel.topic;
        match &channel.content {
            Content::Other => None,
            Content::Map { vehicle, layer } => {
                Some(Ok(RecordedMessage::Map { vehicle: vehicle.clone(), layer: layer.clone(), bytes }))
            }
            Content::Digest { vehicle, layer } => {
                let (vehicle, layer) = (vehicle.clone(), layer.clone());
                // A digest that cannot be decoded differs from every map.
                let digest = v1::MapDigest::decode(bytes).unwrap_or_default();
                Some(Ok(RecordedMessage::Digest { vehicle, layer, digest }))
            }
            Content::Keyframe { vehicle } => {
                // A keyframe that cannot be decoded leaves the maps after it unjudged.
                let keyframe = v1::Keyframe::decode(bytes).ok()?;
                Some(Ok(RecordedMessage::Keyframe { vehicle: vehicle.clone(), keyframe }))
            }
            Content::Counts => Some(Ok(RecordedMessage::Counts(v1::RecordingCounts::decode(bytes).ok()?))),
            Content::Ros(kind) => {
                let log_ns = i64::try_from(log_ns).unwrap_or(i64::MAX);
                Some(Ok(RecordedMessage::Ros { topic: topic.clone(), kind: *kind, log_ns, bytes }))
            }
            Content::Journal { vehicle } => {
                let event = event_from_bytes(bytes);
                let event = event.map(|event| RecordedMessage::Event { vehicle: vehicle.clone(), event });
                let file = self.reader.file();
                Some(event.map_err(|source| RecordingError::Event { file: file.into(), topic: topic.clone(), source }))
            }
        }
    }
}

impl Iterator for RecordingReader {
    type Item = Result<RecordedMessage, RecordingError>;

    fn next(&mut self) -> Option<Self::Item> {
        if self.has_ended {
            return None;
        }
        let next = loop {
            match self.reader.next() {
                None => break None,
                Some(Err(error)) => break Some(Err(error.into())),
                Some(Ok(message)) => {
                    if let Some(message) = self.decode(message) {
                        break Some(message);
                    }
                }
            }
        };
        self.has_ended = !matches!(next, Some(Ok(_)));
        next
    }
}
