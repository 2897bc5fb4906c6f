//! The MCAP file of one part of a recording while it is written. Standard MCAP; any MCAP program reads it.
//!
//! Layout: metadata `clearway` (boot id, version, vehicles, source of each calibration, number of the part),
//! attachments `config.toml` (the effective configuration) and `calibration/<vehicle>/<sensor>.yaml` (the configured
//! tables), then the channels. Log time is the arrival of the event, or of the event that completed the map.
//!
//! | channel | schema | contents |
//! |---|---|---|
//! | `/<vehicle>/journal` | `clearway.v1.Event` | every event; at a keyframe also the events that are in force |
//! | `/<vehicle>/map/<layer>` | `clearway.v1.Map` | the same bytes that zenoh carries |
//! | `/<vehicle>/digest/<layer>` | `clearway.v1.MapDigest` | in place of the maps with `recorder.maps = "digest"` |
//! | `/<vehicle>/keyframe` | `clearway.v1.Keyframe` | from where on the maps follow from this file's events alone |
//! | `/recorder/counts` | `clearway.v1.RecordingCounts` | after each loss, and as the last message of a closed file |
//!
//! Metadata `maps` is `recorder.maps`: with `none` there is neither map nor digest; files without it have maps.
//! Metadata `part` is the number of the part, `1` for the first. Part 1 begins with a new pipeline, so it needs no
//! keyframe. Other parts hold no map before the first keyframe with `BEGIN`. Files of earlier versions have neither
//! `part` nor the last two channels: they are read as part 1.
//!
//! Chunks are compressed and have a CRC, as have the data section, the summary and each attachment. A chunk ends when
//! it is full, after half a second of log time and at each [`McapFile::sync`], so a cut file ends with a whole chunk
//! that was on the disk, and a replay's recording is cut like a drive's.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use bytes::Bytes;
use clearway_mapping::event::Event;
use clearway_proto::{RECORDING_DESCRIPTORS, v1};
use mcap::records::{MessageHeader, Metadata};
use mcap::write::NoSeek;
use mcap::{Attachment, McapError, WriteOptions};
use prost::Message;

use super::header::FORMAT;
use crate::RecordedMaps;
use crate::encode::{self, EncodedMap};

/// The contents of a recording before its first event.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RecordingHeader {
    /// Identifies the run of the server.
    pub boot_id: u64,
    /// The effective configuration, TOML.
    pub config: String,
    /// The vehicles with the layers of their maps, in the order of the configuration.
    pub vehicles: Vec<(Arc<str>, Vec<&'static str>)>,
    /// The configured calibration tables: vehicle, sensor, ROS YAML.
    pub calibrations: Vec<(String, String, String)>,
    /// Further metadata, by name.
    pub metadata: BTreeMap<String, String>,
}

/// Length of a chunk before its compression, in bytes. Ours: what a damaged byte costs at most.
const CHUNK_BYTES: u64 = 1 << 20;

/// Log time after which a chunk ends, in ns. Ours: what a cut costs at most.
pub const CHUNK_NS: u64 = 500_000_000;

/// The disk that receives the bytes of one file: a file, or a simulated disk in tests.
pub trait Disk: Write + Send {
    /// Waits until everything written so far survives a power cut.
    ///
    /// # Errors
    /// [`io::Error`] if the disk fails.
    fn sync(&mut self) -> io::Result<()>;
}

impl Disk for File {
    fn sync(&mut self) -> io::Result<()> {
        self.sync_data()
    }
}

/// A disk that is never written again after its first failure. The MCAP library finishes a file when its writer is
/// dropped; a disk that has recovered by then would hold a file that looks complete but lacks its end.
struct StopAtFailure<D: Disk> {
    disk: D,
    failed: Option<io::ErrorKind>,
    /// Number of bytes written.
    bytes: u64,
}

impl<D: Disk> StopAtFailure<D> {
    fn unless_failed<T>(&mut self, act: impl FnOnce(&mut D) -> io::Result<T>) -> io::Result<T> {
        match self.failed {
            Some(kind) => Err(kind.into()),
            // The caller repeats an interrupted call, so it is not a failure.
            None => act(&mut self.disk).inspect_err(|error| {
                self.failed = Some(error.kind()).filter(|kind| *kind != io::ErrorKind::Interrupted);
            }),
        }
    }
}

/// The disk, for the MCAP library to write and for [`McapFile`] to sync.
struct SharedDisk<D: Disk>(Arc<Mutex<StopAtFailure<D>>>);

impl<D: Disk> SharedDisk<D> {
    fn locked(&self) -> MutexGuard<'_, StopAtFailure<D>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl<D: Disk> Clone for SharedDisk<D> {
    fn clone(&self) -> Self {
        Self(self.0.clone())
    }
}

impl<D: Disk> Write for SharedDisk<D> {
    fn write(&mut self, data: &[u8]) -> io::Result<usize> {
        let mut disk = self.locked();
        let written = disk.unless_failed(|disk| disk.write(data))?;
        disk.bytes += written as u64;
        Ok(written)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.locked().unless_failed(Write::flush)
    }
}

/// The topic of a layer's maps, or of their digests.
pub fn topic_of_layer(vehicle: &str, layer: &str, maps: RecordedMaps) -> String {
    let kind = if maps == RecordedMaps::Digest { "digest" } else { "map" };
    format!("/{vehicle}/{kind}/{layer}")
}

/// The encoded digest of an encoded map of one layer; `header` is the encoded map with the header alone.
fn digest(header: &Bytes, map: &Bytes) -> Vec<u8> {
    let header = v1::Map::decode(header.clone()).ok().and_then(|map| map.header);
    v1::MapDigest { header, sha256: sha256(map) }.encode_to_vec()
}

/// The SHA-256 of an encoded map.
pub fn sha256(map: &Bytes) -> Bytes {
    Bytes::copy_from_slice(ring::digest::digest(&ring::digest::SHA256, map).as_ref())
}

/// An open MCAP file with the channels of all vehicles.
pub struct McapFile<D: Disk> {
    writer: mcap::Writer<NoSeek<BufWriter<SharedDisk<D>>>>,
    disk: SharedDisk<D>,
    vehicles: Vec<VehicleChannels>,
    counts: u16,
    newest_ns: i64,
    /// Log time of the first message of the chunk.
    chunk_ns: u64,
    records: RecordedMaps,
}

struct VehicleChannels {
    journal: u16,
    keyframes: u16,
    maps: BTreeMap<&'static str, u16>,
}

impl<D: Disk> McapFile<D> {
    /// Writes the header of part number `part` to `disk`. Messages before its first event have the log time
    /// `begins_ns`.
    pub fn create(
        disk: D,
        recorded: RecordedMaps,
        header: &RecordingHeader,
        part: u64,
        begins_ns: i64,
    ) -> Result<Self, McapError> {
        let disk = SharedDisk(Arc::new(Mutex::new(StopAtFailure { disk, failed: None, bytes: 0 })));
        let mut writer = WriteOptions::new()
            .profile("")
            .library(concat!("clearway/", env!("CARGO_PKG_VERSION")))
            .compression(Some(mcap::Compression::Zstd))
            .chunk_size(Some(CHUNK_BYTES))
            .calculate_chunk_crcs(true)
            .calculate_data_section_crc(true)
            .calculate_summary_section_crc(true)
            .calculate_attachment_crcs(true)
            // Compresses in the recorder's thread; by default the library starts one thread a core.
            .compression_threads(0)
            // Writes each chunk at once, with its length first. Otherwise a crash leaves a chunk with length 0, which a
            // reader cannot distinguish from damage.
            .disable_seeking(true)
            .create(NoSeek::new(BufWriter::new(disk.clone())))?;
        writer.write_metadata(&metadata(header, recorded, part))?;
        let mut attach = |name: String, media_type: &str, text: &str| {
            let data = text.as_bytes().into();
            writer.attach(&Attachment { log_time: 0, create_time: 0, name, media_type: media_type.into(), data })
        };
        attach("config.toml".into(), "application/toml", &header.config)?;
        for (vehicle, sensor, yaml) in &header.calibrations {
            attach(format!("calibration/{vehicle}/{sensor}.yaml"), "application/yaml", yaml)?;
        }
        let event = writer.add_schema("clearway.v1.Event", "protobuf", RECORDING_DESCRIPTORS)?;
        let of_maps = if recorded == RecordedMaps::Digest { "clearway.v1.MapDigest" } else { "clearway.v1.Map" };
        let map = writer.add_schema(of_maps, "protobuf", RECORDING_DESCRIPTORS)?;
        let keyframe = writer.add_schema("clearway.v1.Keyframe", "protobuf", RECORDING_DESCRIPTORS)?;
        let counts = writer.add_schema("clearway.v1.RecordingCounts", "protobuf", RECORDING_DESCRIPTORS)?;
        let mut channel = |schema, topic: &str| writer.add_channel(schema, topic, "protobuf", &BTreeMap::new());
        let mut vehicles = Vec::new();
        for (vehicle, layers) in &header.vehicles {
            let journal = channel(event, &format!("/{vehicle}/journal"))?;
            let keyframes = channel(keyframe, &format!("/{vehicle}/keyframe"))?;
            let maps = layers
                .iter()
                .map(|&layer| Ok((layer, channel(map, &topic_of_layer(vehicle, layer, recorded))?)))
                .collect::<Result<_, McapError>>()?;
            vehicles.push(VehicleChannels { journal, keyframes, maps });
        }
        let counts = channel(counts, "/recorder/counts")?;
        let (newest_ns, chunk_ns) = (begins_ns, 0);
        let mut file = Self { writer, disk, vehicles, counts, newest_ns, chunk_ns, records: recorded };
        file.sync()?;
        Ok(file)
    }

    /// Number of bytes in the file so far.
    pub fn bytes(&self) -> u64 {
        self.disk.locked().bytes
    }

    /// Writes an event into the journal of the vehicle with this index.
    pub fn write_event(&mut self, vehicle: usize, event: &Event) -> Result<(), McapError> {
        let bytes = encode::event_to_proto(event).encode_to_vec();
        self.newest_ns = event.arrival_ns;
        self.write_message(self.vehicles[vehicle].journal, event.sequence, event.arrival_ns, &bytes)
    }

    /// Writes each layer of a map, or its digest, into its channel of the vehicle with this index.
    pub fn write_map(&mut self, vehicle: usize, map: &EncodedMap) -> Result<(), McapError> {
        for (layer, chunk) in &map.layers {
            let Some(&channel) = self.vehicles[vehicle].maps.get(layer) else { continue };
            let bytes: Bytes = map.layer(chunk);
            let bytes = match self.records {
                RecordedMaps::Digest => digest(&map.header, &bytes).into(),
                RecordedMaps::Full | RecordedMaps::None => bytes,
            };
            self.write_message(channel, map.sequence, map.completed_ns, &bytes)?;
        }
        Ok(())
    }

    /// Writes a keyframe of the vehicle with this index, with the log time of the newest event, but no earlier than
    /// `least_ns`: a new file has no event yet.
    pub fn write_keyframe(&mut self, vehicle: usize, least_ns: i64, keyframe: &v1::Keyframe) -> Result<(), McapError> {
        let channel = self.vehicles[vehicle].keyframes;
        self.newest_ns = self.newest_ns.max(least_ns);
        self.write_message(channel, keyframe.first_event, self.newest_ns, &keyframe.encode_to_vec())
    }

    /// Writes what the file holds and lacks, with the log time of the newest event.
    pub fn write_counts(&mut self, counts: &v1::RecordingCounts) -> Result<(), McapError> {
        self.write_message(self.counts, 0, self.newest_ns, &counts.encode_to_vec())
    }

    fn write_message(&mut self, channel_id: u16, sequence: u64, arrival_ns: i64, data: &[u8]) -> Result<(), McapError> {
        // MCAP has 32-bit sequences and no time before 1970; the message itself has the full values.
        let sequence = sequence as u32;
        let log_time = u64::try_from(arrival_ns).unwrap_or(0);
        if log_time.abs_diff(self.chunk_ns) >= CHUNK_NS {
            self.writer.flush()?;
            self.chunk_ns = log_time;
        }
        let header = MessageHeader { channel_id, sequence, log_time, publish_time: log_time };
        self.writer.write_to_known_channel(&header, data)
    }

    /// Ends the current chunk and waits until the disk has it, so that a power cut does not lose it.
    pub fn sync(&mut self) -> Result<(), McapError> {
        self.writer.flush()?;
        self.disk.locked().unless_failed(Disk::sync).map_err(McapError::Io)
    }

    /// Writes the closing records and waits until the disk has them.
    pub fn finish(mut self) -> Result<(), McapError> {
        self.writer.finish()?;
        // `finish` leaves the last bytes in the buffer.
        let buffer = self.writer.into_inner().into_inner();
        buffer.into_inner().map_err(|error| McapError::Io(error.into_error()))?;
        self.disk.locked().unless_failed(Disk::sync).map_err(McapError::Io)
    }

    /// Leaves the file as it is, without closing records: it stays recognizable as cut.
    pub fn abandon(self) {
        self.disk.locked().failed.get_or_insert(io::ErrorKind::Other);
    }
}

/// The metadata of part number `part` of a recording.
fn metadata(header: &RecordingHeader, recorded: RecordedMaps, part: u64) -> Metadata {
    let names: Vec<&str> = header.vehicles.iter().map(|(name, _)| &**name).collect();
    let mut metadata = header.metadata.clone();
    metadata.insert("format".into(), FORMAT.to_string());
    metadata.insert("boot_id".into(), header.boot_id.to_string());
    metadata.insert("version".into(), env!("CARGO_PKG_VERSION").into());
    metadata.insert("vehicles".into(), names.join(","));
    metadata.insert("part".into(), part.to_string());
    metadata.insert("maps".into(), recorded.as_str().into());
    Metadata { name: "clearway".into(), metadata }
}
