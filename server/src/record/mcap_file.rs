//! The MCAP file of a recording while it is written.
//!
//! Layout: metadata `clearway` (boot id, version, vehicles, source of each calibration), attachments `config.toml` (the
//! effective configuration) and `calibration/<vehicle>/<sensor>.yaml` (the configured tables), then the channels
//! `/<vehicle>/journal` (`clearway.v1.Event`) and `/<vehicle>/map/<layer>` (`clearway.v1.Map`, the same bytes that
//! zenoh carries). Log time is the arrival of the event, or of the event that completed the map.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::sync::Arc;

use bytes::Bytes;
use clearway_mapping::event::Event;
use clearway_proto::DESCRIPTORS;
use mcap::records::{MessageHeader, Metadata};
use mcap::write::NoSeek;
use mcap::{Attachment, Compression, McapError, WriteOptions};
use prost::Message;

use super::mcap_reader::FORMAT;
use crate::encode::{self, EncodedMap};

/// The contents of a recording before its first event.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Header {
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

/// The disk that receives the bytes of a recording: a file, or a simulated disk in tests.
pub trait Disk: Write + Send {
    /// Makes everything written so far survive a crash of the machine.
    ///
    /// # Errors
    /// [`io::Error`] if the disk fails.
    fn sync(&mut self) -> io::Result<()>;
}

impl Disk for File {
    fn sync(&mut self) -> io::Result<()> {
        self.sync_all()
    }
}

/// A disk that is never written again after its first failure. The MCAP library finishes a file when its writer is
/// dropped; a disk that has recovered by then would hold a file that looks complete but lacks its end.
struct StopAtFailure<D: Disk> {
    disk: D,
    failed: Option<io::ErrorKind>,
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

impl<D: Disk> Write for StopAtFailure<D> {
    fn write(&mut self, data: &[u8]) -> io::Result<usize> {
        self.unless_failed(|disk| disk.write(data))
    }

    fn flush(&mut self) -> io::Result<()> {
        self.unless_failed(Write::flush)
    }
}

/// An open MCAP file with the channels of all vehicles.
pub(super) struct McapFile<D: Disk> {
    writer: mcap::Writer<NoSeek<BufWriter<StopAtFailure<D>>>>,
    vehicles: Vec<VehicleChannels>,
}

struct VehicleChannels {
    journal: u16,
    maps: BTreeMap<&'static str, u16>,
}

impl<D: Disk> McapFile<D> {
    /// Writes the header to `disk`.
    pub(super) fn create(disk: D, header: &Header) -> Result<Self, McapError> {
        let mut writer = WriteOptions::new()
            .profile("")
            .library(concat!("clearway/", env!("CARGO_PKG_VERSION")))
            .compression(Some(Compression::Zstd))
            // Compresses in the recorder's thread; by default the library starts one thread a core.
            .compression_threads(0)
            // Writes each chunk at once, with its length first. Otherwise a crash leaves a chunk with length 0, which a
            // reader cannot distinguish from damage.
            .disable_seeking(true)
            .create(NoSeek::new(BufWriter::new(StopAtFailure { disk, failed: None })))?;
        let names: Vec<&str> = header.vehicles.iter().map(|(name, _)| &**name).collect();
        let mut metadata = header.metadata.clone();
        metadata.insert("format".into(), FORMAT.to_string());
        metadata.insert("boot_id".into(), header.boot_id.to_string());
        metadata.insert("version".into(), env!("CARGO_PKG_VERSION").into());
        metadata.insert("vehicles".into(), names.join(","));
        writer.write_metadata(&Metadata { name: "clearway".into(), metadata })?;
        let mut attach = |name: String, media_type: &str, text: &str| {
            let data = text.as_bytes().into();
            writer.attach(&Attachment { log_time: 0, create_time: 0, name, media_type: media_type.into(), data })
        };
        attach("config.toml".into(), "application/toml", &header.config)?;
        for (vehicle, sensor, yaml) in &header.calibrations {
            attach(format!("calibration/{vehicle}/{sensor}.yaml"), "application/yaml", yaml)?;
        }
        let event = writer.add_schema("clearway.v1.Event", "protobuf", DESCRIPTORS)?;
        let map = writer.add_schema("clearway.v1.Map", "protobuf", DESCRIPTORS)?;
        let mut vehicles = Vec::new();
        for (vehicle, layers) in &header.vehicles {
            let mut channel = |schema, topic: String| writer.add_channel(schema, &topic, "protobuf", &BTreeMap::new());
            let journal = channel(event, format!("/{vehicle}/journal"))?;
            let maps = layers
                .iter()
                .map(|&layer| Ok((layer, channel(map, format!("/{vehicle}/map/{layer}"))?)))
                .collect::<Result<_, McapError>>()?;
            vehicles.push(VehicleChannels { journal, maps });
        }
        writer.flush()?;
        Ok(Self { writer, vehicles })
    }

    /// Writes an event into the journal of the vehicle with this index.
    pub(super) fn write_event(&mut self, vehicle: usize, event: &Event) -> Result<(), McapError> {
        let bytes = encode::event_to_proto(event).encode_to_vec();
        self.write_message(self.vehicles[vehicle].journal, event.sequence, event.arrival_ns, &bytes)
    }

    /// Writes each layer of a map into its channel of the vehicle with this index.
    pub(super) fn write_map(&mut self, vehicle: usize, map: &EncodedMap) -> Result<(), McapError> {
        for (layer, chunk) in &map.layers {
            let Some(&channel) = self.vehicles[vehicle].maps.get(layer) else { continue };
            let bytes: Bytes = map.layer(chunk);
            self.write_message(channel, map.sequence, map.completed_ns, &bytes)?;
        }
        Ok(())
    }

    fn write_message(&mut self, channel_id: u16, sequence: u64, arrival_ns: i64, data: &[u8]) -> Result<(), McapError> {
        // MCAP has 32-bit sequences and no time before 1970; the message itself has the full values.
        let sequence = sequence as u32;
        let log_time = u64::try_from(arrival_ns).unwrap_or(0);
        let header = MessageHeader { channel_id, sequence, log_time, publish_time: log_time };
        self.writer.write_to_known_channel(&header, data)
    }

    /// Ends the current chunk, so that a crash does not lose it.
    pub(super) fn flush(&mut self) -> Result<(), McapError> {
        self.writer.flush()
    }

    /// Writes the closing records.
    pub(super) fn finish(mut self) -> Result<(), McapError> {
        self.writer.finish()?;
        // `finish` leaves the last bytes in the buffer.
        let buffer = self.writer.into_inner().into_inner();
        let mut complete = buffer.into_inner().map_err(|error| McapError::Io(error.into_error()))?;
        complete.disk.sync().map_err(McapError::Io)
    }
}
