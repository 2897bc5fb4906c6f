//! Two maps of one layer, recorded and computed -> their first difference.

use std::fmt;

use bytes::Bytes;
use clearway_proto::codec::{DecodeError, Limits};
use clearway_proto::grid::Grid;
use clearway_proto::map::{Channel, Layer, MapError, decode_map};
use clearway_proto::v1;
use prost::Message;
use serde_json::{Value, json};

/// A difference between a recording and the maps of its events.
#[derive(Clone, Debug, PartialEq)]
pub struct Difference {
    /// Name of the vehicle.
    pub vehicle: String,
    /// Sequence of the map.
    pub sequence: u64,
    /// Name of the layer that differs.
    pub layer: String,
    /// The first difference of the map.
    pub kind: DifferenceKind,
}

/// The kind of a difference.
#[derive(Clone, Debug, PartialEq)]
pub enum DifferenceKind {
    /// A cell has another value in the recording than in the computed map.
    Cell {
        /// Row of the grid.
        row: u32,
        /// Column of the grid.
        column: u32,
        /// Name of the channel that differs.
        channel: String,
        /// Raw value in the recording.
        recorded: i32,
        /// Raw value computed from the events.
        computed: i32,
    },
    /// Another part of the map differs.
    Field {
        /// Name of the part.
        field: String,
        /// Value in the recording.
        recorded: String,
        /// Value computed from the events.
        computed: String,
    },
    /// The recording lacks this map of the events.
    Missing,
    /// The recording has this map, which does not follow from the events.
    Extra,
}

impl Difference {
    /// The difference as one JSON object.
    pub(super) fn to_json(&self) -> Value {
        let kind = match &self.kind {
            DifferenceKind::Cell { row, column, channel, recorded, computed } => json!({
                "cell": { "row": row, "column": column, "channel": channel, "recorded": recorded, "computed": computed }
            }),
            DifferenceKind::Field { field, recorded, computed } => {
                json!({ "field": { "name": field, "recorded": recorded, "computed": computed } })
            }
            DifferenceKind::Missing => json!("missing"),
            DifferenceKind::Extra => json!("extra"),
        };
        json!({ "vehicle": self.vehicle, "sequence": self.sequence, "layer": self.layer, "what": kind })
    }
}

impl fmt::Display for Difference {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { vehicle, sequence, layer, kind } = self;
        write!(f, "vehicle {vehicle}, sequence {sequence}, layer {layer}: ")?;
        match kind {
            DifferenceKind::Cell { row, column, channel, recorded, computed } => {
                write!(f, "cell row {row} column {column}, channel {channel}: recorded {recorded}, computed {computed}")
            }
            DifferenceKind::Field { field, recorded, computed } => {
                write!(f, "{field}: recorded {recorded}, computed {computed}")
            }
            DifferenceKind::Missing => write!(f, "the recording lacks this map of the events"),
            DifferenceKind::Extra => {
                write!(f, "the recording has this map, which does not follow from the events")
            }
        }
    }
}

/// The first difference of two encoded maps of one layer, in the order header, geometry, channels, all else.
pub(super) fn first_difference(recorded: &Bytes, computed: &Bytes) -> DifferenceKind {
    let field = |field: &str, recorded: &dyn fmt::Debug, computed: &dyn fmt::Debug| DifferenceKind::Field {
        field: field.to_owned(),
        recorded: format!("{recorded:?}"),
        computed: format!("{computed:?}"),
    };
    let (was, is) = match (v1::Map::decode(recorded.clone()), v1::Map::decode(computed.clone())) {
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
        // Debug distinguishes all values: it prints floats exactly, and -0 differs from 0.
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
    let (recorded, computed) = match (decode_first_layer(recorded), decode_first_layer(computed)) {
        (Ok(recorded), Ok(computed)) => (recorded, computed),
        (was, is) => return field("cells", &was.err(), &is.err()),
    };
    for (a, b) in was.channels.iter().zip(&is.channels) {
        if a == b {
            continue;
        }
        if let (Some(recorded), Some(computed)) = (recorded.channel(&a.name), computed.channel(&b.name)) {
            let cells = 0..recorded.cells.len().min(computed.cells.len());
            let value = |of: &Channel, cell: usize| of.cells.get(cell).unwrap_or_default();
            if let Some(cell) = cells.into_iter().find(|&cell| value(recorded, cell) != value(computed, cell)) {
                let (row, column) = (cell as u32 / columns, cell as u32 % columns);
                let (recorded, computed) = (value(recorded, cell), value(computed, cell));
                return DifferenceKind::Cell { row, column, channel: b.name.clone(), recorded, computed };
            }
        }
        return field(&format!("channel {}", b.name), a, b);
    }
    field("layer", &was, &is)
}

/// Decodes the first layer of a map, also if a checksum of its cells is wrong, and without the channels that cannot be
/// decoded.
fn decode_first_layer(bytes: &Bytes) -> Result<Layer, MapError> {
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
