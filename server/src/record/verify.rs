//! A recording -> are these the maps of these events? Rebuilds every vehicle's pipeline from the recorded configuration
//! and calibration, steps all journal events and holds each map's bytes against the recorded ones.

use std::collections::BTreeMap;
use std::fmt;
use std::path::Path;
use std::sync::Arc;

use bytes::Bytes;
use clearway_mapping::config::ConfigValueError;
use clearway_mapping::pipeline::Pipeline;
use clearway_proto::codec::{DecodeError, Limits};
use clearway_proto::grid::Grid;
use clearway_proto::map::{Channel, Layer, MapError, decode_map};
use clearway_proto::v1;
use prost::Message;
use serde_json::{Value, json};

use crate::record::reader::{RecordedMessage, RecordingError, RecordingReader};
use crate::encode::EncodedMap;

/// Differences kept in a report; all are counted.
const DIFFERENCES_MAX: usize = 20;

/// What a recording was found to be.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Report {
    /// Events stepped.
    pub events: u64,
    /// Maps of one layer that equal the recomputed ones, byte for byte.
    pub equal: u64,
    /// Maps made by the events.
    pub maps: u64,
    /// The file was cut by a crash: what it holds was checked.
    pub cut: bool,
    /// Maps made by the last events before the cut, and no longer recorded.
    pub beyond_cut: u64,
    /// The first differences found.
    pub differences: Vec<Difference>,
    /// All differences.
    pub different: u64,
}

/// Where a recording is not what its events make.
#[derive(Clone, Debug, PartialEq)]
pub struct Difference {
    /// The vehicle's name.
    pub vehicle: String,
    /// Of the map; of the event where the journal has a hole.
    pub sequence: u64,
    /// The layer's name; empty where the journal has a hole.
    pub layer: String,
    /// What differs first.
    pub what: What,
}

/// What differs.
#[derive(Clone, Debug, PartialEq)]
pub enum What {
    /// A cell.
    Cell {
        /// Row of the grid.
        row: u32,
        /// Column of the grid.
        column: u32,
        /// The channel's name.
        channel: String,
        /// Raw value in the recording.
        recorded: i32,
        /// Raw value made of the events.
        made: i32,
    },
    /// Anything else of the map.
    Field {
        /// Its name.
        field: String,
        /// In the recording.
        recorded: String,
        /// Made of the events.
        made: String,
    },
    /// The events make this map, the recording does not hold it.
    Missing,
    /// The recording holds this map, the events do not make it.
    Extra,
    /// The journal lacks the events from here up to the one named.
    Hole {
        /// Sequence of the event that came instead.
        found: u64,
    },
}

/// Why a recording cannot be checked.
#[derive(Debug, thiserror::Error)]
pub enum VerifyError {
    /// The file cannot be read.
    #[error(transparent)]
    Recording(#[from] RecordingError),
    /// The recorded configuration cannot be used.
    #[error(transparent)]
    Config(#[from] ConfigValueError),
}

impl Report {
    /// Whether every recorded map is the map of its events.
    pub fn is_good(&self) -> bool {
        self.different == 0
    }

    /// One object with all of it.
    pub fn to_json(&self) -> Value {
        json!({
            "ok": self.is_good(),
            "events": self.events, "maps": self.maps, "equal": self.equal, "different": self.different,
            "cut": self.cut, "beyond_cut": self.beyond_cut,
            "differences": self.differences.iter().map(Difference::to_json).collect::<Vec<_>>(),
        })
    }

    fn add(&mut self, vehicle: &str, sequence: u64, layer: &str, what: What) {
        self.different += 1;
        if self.differences.len() < DIFFERENCES_MAX {
            self.differences.push(Difference { vehicle: vehicle.into(), sequence, layer: layer.into(), what });
        }
    }
}

impl Difference {
    fn to_json(&self) -> Value {
        let what = match &self.what {
            What::Cell { row, column, channel, recorded, made } => json!({
                "cell": { "row": row, "column": column, "channel": channel, "recorded": recorded, "made": made }
            }),
            What::Field { field, recorded, made } => {
                json!({ "field": { "name": field, "recorded": recorded, "made": made } })
            }
            What::Missing => json!("missing"),
            What::Extra => json!("extra"),
            What::Hole { found } => json!({ "hole": { "found": found } }),
        };
        json!({ "vehicle": self.vehicle, "sequence": self.sequence, "layer": self.layer, "what": what })
    }
}

impl fmt::Display for Difference {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { vehicle, sequence, layer, what } = self;
        if let What::Hole { found } = what {
            return write!(f, "vehicle {vehicle}: the journal lacks events {sequence} to {}", found.saturating_sub(1));
        }
        write!(f, "vehicle {vehicle}, sequence {sequence}, layer {layer}: ")?;
        match what {
            What::Cell { row, column, channel, recorded, made } => {
                write!(f, "cell row {row} column {column}, channel {channel}: recorded {recorded}, made {made}")
            }
            What::Field { field, recorded, made } => write!(f, "{field}: recorded {recorded}, made {made}"),
            What::Missing => write!(f, "the events make this map, the recording does not hold it"),
            What::Extra | What::Hole { .. } => write!(f, "the recording holds this map, the events do not make it"),
        }
    }
}

/// One vehicle, stepped again.
struct Remaker {
    name: Arc<str>,
    pipeline: Pipeline,
    valid_ms: u32,
    next_event: u64,
    /// Made and not yet met in the recording, by sequence and layer.
    made: BTreeMap<(u64, String), Bytes>,
}

/// Checks a recording.
///
/// # Errors
/// [`VerifyError`] where the file cannot be read as a recording; a map that differs is no error but in the [`Report`].
pub fn verify(file: &Path) -> Result<Report, VerifyError> {
    let mut recording = RecordingReader::open(file)?;
    let boot_id = recording.header().boot_id;
    let (config, tables) = recording.config()?;
    let mut remakers = Vec::new();
    for (vehicle, tables) in config.vehicles.iter().zip(tables) {
        remakers.push(Remaker {
            name: vehicle.name.as_str().into(),
            pipeline: Pipeline::new(&vehicle.core(), tables)?,
            valid_ms: vehicle.maps.valid_ms,
            next_event: 0,
            made: BTreeMap::new(),
        });
    }
    let mut report = Report::default();
    for entry in recording.by_ref() {
        match entry? {
            RecordedMessage::Event { vehicle, event } => {
                let Some(remaker) = remakers.iter_mut().find(|r| *r.name == *vehicle) else { continue };
                report.events += 1;
                if event.sequence != remaker.next_event {
                    report.add(&vehicle, remaker.next_event, "", What::Hole { found: event.sequence });
                }
                remaker.next_event = event.sequence.saturating_add(1);
                if let Ok(Some(map)) = remaker.pipeline.step(&event) {
                    let map = EncodedMap::new(map, remaker.name.clone(), boot_id, remaker.valid_ms);
                    report.maps += 1;
                    for (layer, chunk) in &map.layers {
                        remaker.made.insert((map.sequence, (*layer).to_owned()), map.layer(chunk));
                    }
                }
            }
            RecordedMessage::Map { vehicle, layer, bytes } => {
                let sequence = sequence_of(&bytes);
                let remaker = remakers.iter_mut().find(|r| *r.name == *vehicle);
                match remaker.and_then(|remaker| remaker.made.remove(&(sequence, layer.clone()))) {
                    None => report.add(&vehicle, sequence, &layer, What::Extra),
                    Some(made) if made == bytes => report.equal += 1,
                    Some(made) => report.add(&vehicle, sequence, &layer, first_difference(&bytes, &made)),
                }
            }
            RecordedMessage::Ros { .. } => {}
        }
    }
    report.cut = recording.is_cut();
    for remaker in &remakers {
        // The recorder writes an event and then its map, so a cut may leave the last events without theirs, no others.
        let tail = remaker.made.last_key_value().map(|((sequence, _), _)| *sequence);
        for (sequence, layer) in remaker.made.keys() {
            if report.cut && Some(*sequence) == tail {
                report.beyond_cut += 1;
            } else {
                report.add(&remaker.name, *sequence, layer, What::Missing);
            }
        }
    }
    Ok(report)
}

/// The sequence a recorded map claims; one that cannot be read is found as extra under the largest number there is.
fn sequence_of(bytes: &Bytes) -> u64 {
    let map = v1::Map::decode(bytes.clone()).ok();
    map.and_then(|map| map.header).map_or(u64::MAX, |header| header.sequence)
}

/// Where two encoded maps of one layer differ first: header, geometry, channels cell by cell, the rest.
fn first_difference(recorded: &Bytes, made: &Bytes) -> What {
    let field = |field: &str, recorded: &dyn fmt::Debug, made: &dyn fmt::Debug| What::Field {
        field: field.to_owned(),
        recorded: format!("{recorded:?}"),
        made: format!("{made:?}"),
    };
    let (was, is) = match (v1::Map::decode(recorded.clone()), v1::Map::decode(made.clone())) {
        (Ok(was), Ok(is)) => (was, is),
        (was, is) => return field("message", &was.err(), &is.err()),
    };
    let (head, new) = (was.header.unwrap_or_default(), is.header.unwrap_or_default());
    let fields: [(&str, &dyn fmt::Debug, &dyn fmt::Debug); 12] = [
        ("header vehicle", &head.vehicle, &new.vehicle),
        ("header boot_id", &head.boot_id, &new.boot_id),
        ("header sequence", &head.sequence, &new.sequence),
        ("header capture_start_ns", &head.capture_start_ns, &new.capture_start_ns),
        ("header capture_end_ns", &head.capture_end_ns, &new.capture_end_ns),
        ("header completed_ns", &head.completed_ns, &new.completed_ns),
        ("header valid_until_ns", &head.valid_until_ns, &new.valid_until_ns),
        ("header map_from_ego", &head.map_from_ego, &new.map_from_ego),
        ("header speed_mps", &head.speed_mps, &new.speed_mps),
        ("header sensors", &head.sensors, &new.sensors),
        ("header compensation", &head.compensation, &new.compensation),
        ("header source_sensor", &head.source_sensor, &new.source_sensor),
    ];
    for (name, a, b) in fields {
        // Debug prints every bit that matters: floats in full, and -0 apart from 0.
        if format!("{a:?}") != format!("{b:?}") {
            return field(name, a, b);
        }
    }
    let (Some(was), Some(is)) = (was.layers.first(), is.layers.first()) else {
        return field("layers", &was.layers.len(), &is.layers.len());
    };
    if was.geometry != is.geometry {
        return field("geometry", &was.geometry, &is.geometry);
    }
    let columns = Grid::from_wire(is).map_or(1, |grid| grid.shape().1.max(1));
    let (recorded, made) = match (decoded(recorded), decoded(made)) {
        (Ok(recorded), Ok(made)) => (recorded, made),
        (was, is) => return field("cells", &was.err(), &is.err()),
    };
    for (a, b) in was.channels.iter().zip(&is.channels) {
        if a == b {
            continue;
        }
        if let (Some(recorded), Some(made)) = (recorded.channel(&a.name), made.channel(&b.name)) {
            let cells = 0..recorded.cells.len().min(made.cells.len());
            let value = |of: &Channel, cell: usize| of.cells.get(cell).unwrap_or_default();
            if let Some(cell) = cells.into_iter().find(|&cell| value(recorded, cell) != value(made, cell)) {
                let (row, column) = (cell as u32 / columns, cell as u32 % columns);
                let (recorded, made) = (value(recorded, cell), value(made, cell));
                return What::Cell { row, column, channel: b.name.clone(), recorded, made };
            }
        }
        return field(&format!("channel {}", b.name), a, b);
    }
    field("layer", &was, &is)
}

/// The first layer, even where a checksum says that its cells are not those that were encoded, and without the channels
/// that cannot be decoded.
fn decoded(bytes: &Bytes) -> Result<Layer, MapError> {
    let mut bytes = bytes.clone();
    loop {
        let (of, name, source) = match decode_map(bytes.clone(), &Limits::default()) {
            Err(MapError::Cells { layer, channel, source }) => (layer, channel, source),
            map => return map.map(|mut map| map.layers.swap_remove(0)),
        };
        let mut map = v1::Map::decode(bytes)?;
        for layer in map.layers.iter_mut().filter(|layer| layer.name == of) {
            match source {
                DecodeError::Crc { computed, .. } => {
                    let channels = layer.channels.iter_mut().filter(|channel| channel.name == name);
                    channels.for_each(|channel| channel.crc32 = computed);
                }
                _ => layer.channels.retain(|channel| channel.name != name),
            }
        }
        bytes = map.encode_to_vec().into();
    }
}
