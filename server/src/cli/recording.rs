//! An MCAP file -> what it says of itself, and its messages in file order.
//!
//! A file cut by a crash yields all its whole chunks, and then says that it was cut; so does one with damage inside.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::fs::File;
use std::io::Read;
use std::path::Path;

use anyhow::{Context, Result};
use bytes::Bytes;
use mcap::records::Record;
use mcap::sans_io::LinearReaderOptions;
use mcap::sans_io::linear_reader::{LinearReadEvent, LinearReader};
use mcap::{McapError, parse_record};

/// A length beyond this is damage, refused before it is allocated.
const RECORD_BYTES_MAX: usize = 256 << 20;

/// One message.
pub struct Message {
    /// `/<vehicle>/map/<layer>`, …
    pub topic: String,
    /// `clearway.v1.Map`, …
    pub schema: String,
    /// ns since the Unix epoch.
    pub log_time_ns: u64,
    /// As it was recorded.
    pub data: Bytes,
}

impl Message {
    /// Vehicle and layer, where this is a map.
    pub fn map_of(&self) -> Option<(&str, &str)> {
        map_topic(&self.topic, &self.schema)
    }

    /// The vehicle, where this is its journal.
    pub fn journal_of(&self) -> Option<&str> {
        let vehicle = self.topic.strip_prefix('/')?.strip_suffix("/journal")?;
        (self.schema == "clearway.v1.Event").then_some(vehicle)
    }

    /// The vehicle, where this is a map or a journal.
    pub fn vehicle(&self) -> Option<&str> {
        self.map_of().map(|(vehicle, _)| vehicle).or_else(|| self.journal_of())
    }

    /// Whether this is one of anyone's Velodyne scans.
    pub fn is_velodyne_scan(&self) -> bool {
        matches!(self.schema.as_str(), "velodyne_msgs/msg/VelodyneScan" | "velodyne_msgs/VelodyneScan")
    }
}

fn map_topic<'a>(topic: &'a str, schema: &str) -> Option<(&'a str, &'a str)> {
    let (vehicle, layer) = topic.strip_prefix('/')?.split_once("/map/")?;
    (schema == "clearway.v1.Map").then_some((vehicle, layer))
}

/// An open recording; an iterator over its messages.
pub struct Recording {
    source: File,
    reader: LinearReader,
    schemas: HashMap<u16, String>,
    /// Topic and schema, by channel id.
    channels: HashMap<u16, (String, String)>,
    /// The metadata `clearway`: boot id, version, vehicles …
    pub notes: BTreeMap<String, String>,
    /// Attachments by name: `config.toml`, `calibration/<vehicle>/<sensor>.yaml`.
    pub attachments: BTreeMap<String, Vec<u8>>,
    /// Bytes of the file read so far.
    pub bytes_read: u64,
    /// Why the file is not whole; known at the end.
    pub cut: Option<String>,
    whole: bool,
    ended: bool,
}

impl Recording {
    /// Opens a file.
    ///
    /// # Errors
    /// Where it cannot be read.
    pub fn open(file: &Path) -> Result<Self> {
        let source = File::open(file).with_context(|| format!("open {}", file.display()))?;
        let options = LinearReaderOptions::default()
            .with_skip_end_magic(true)
            .with_prevalidate_chunk_crcs(true)
            .with_record_length_limit(RECORD_BYTES_MAX);
        Ok(Self {
            source,
            reader: LinearReader::new_with_options(options),
            schemas: HashMap::new(),
            channels: HashMap::new(),
            notes: BTreeMap::new(),
            attachments: BTreeMap::new(),
            bytes_read: 0,
            cut: None,
            whole: false,
            ended: false,
        })
    }

    /// Names of the layers seen so far.
    pub fn layers(&self) -> Vec<String> {
        self.map_topics(|(_, layer)| layer)
    }

    /// Names of the vehicles with maps seen so far.
    pub fn vehicles(&self) -> Vec<String> {
        self.map_topics(|(vehicle, _)| vehicle)
    }

    fn map_topics(&self, part: impl for<'a> Fn((&'a str, &'a str)) -> &'a str) -> Vec<String> {
        let topics = self.channels.values();
        let parts = topics.filter_map(|(topic, schema)| map_topic(topic, schema)).map(|of| part(of).to_owned());
        parts.collect::<BTreeSet<_>>().into_iter().collect()
    }

    fn read(&mut self) -> Result<Option<Message>> {
        while let Some(event) = self.reader.next_event() {
            let record = match event {
                Ok(LinearReadEvent::ReadRequest(need)) => {
                    let read = self.source.read(self.reader.insert(need)).context("read the recording")?;
                    self.reader.notify_read(read);
                    self.bytes_read += read as u64;
                    continue;
                }
                Ok(LinearReadEvent::Record { opcode, data }) => parse_record(opcode, data),
                Err(error) => Err(error),
            };
            match record {
                Err(McapError::BadMagic) if self.channels.is_empty() && self.schemas.is_empty() => {
                    anyhow::bail!("not an MCAP file: it does not start with the magic bytes");
                }
                Err(McapError::UnexpectedEof) => break,
                Err(error) => {
                    self.cut = Some(format!("damaged near byte {}: {error}", self.bytes_read));
                    return Ok(None);
                }
                Ok(Record::Schema { header, .. }) => {
                    self.schemas.insert(header.id, header.name);
                }
                Ok(Record::Channel(channel)) => {
                    let schema = self.schemas.get(&channel.schema_id).cloned().unwrap_or_default();
                    self.channels.insert(channel.id, (channel.topic, schema));
                }
                Ok(Record::Message { header, data }) => {
                    let Some((topic, schema)) = self.channels.get(&header.channel_id).cloned() else { continue };
                    let data = Bytes::from(data.into_owned());
                    return Ok(Some(Message { topic, schema, log_time_ns: header.log_time, data }));
                }
                Ok(Record::Metadata(metadata)) if metadata.name == "clearway" => self.notes = metadata.metadata,
                Ok(Record::Attachment { header, data, .. }) => {
                    self.attachments.insert(header.name, data.into_owned());
                }
                Ok(Record::Footer(_)) => self.whole = true,
                Ok(_) => {}
            }
        }
        if !self.whole {
            self.cut = Some(format!("cut after {} bytes: the closing records are missing", self.bytes_read));
        }
        Ok(None)
    }
}

impl Iterator for Recording {
    type Item = Result<Message>;

    fn next(&mut self) -> Option<Self::Item> {
        if self.ended {
            return None;
        }
        let next = self.read().transpose();
        self.ended = !matches!(next, Some(Ok(_)));
        next
    }
}
