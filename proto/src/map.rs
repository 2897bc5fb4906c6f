//! A whole map's bytes to checked values, and the parts of a map to bytes.
//!
//! In: an encoded `clearway.v1.Map`, from gRPC, zenoh, WebSocket or a recording. Out: [`Map`], whose every channel has
//! as many cells as its grid and whose every class has a name.
//!
//! Protobuf messages concatenate: the bytes of a header followed by those of any selection of layers are the bytes of
//! the map with these layers. So a server encodes each part once ([`encode_header`], [`encode_layer`]).

use std::collections::BTreeMap;

use bytes::Bytes;
use prost::Message;

use crate::codec::{Cells, DecodeError, Limits};
use crate::decode::{check_count, decode_on};
use crate::delta::{self, Shift};
use crate::grid::Grid;
use crate::legend::{self, Class, LegendError};
use crate::v1::{self, ClassMeaning};
use crate::{by_class, parts, safe_points};

/// The bytes of a map with this header and no layer yet.
pub fn encode_header(header: &v1::Header) -> Bytes {
    v1::Map { header: Some(header.clone()), layers: Vec::new() }.encode_to_vec().into()
}

/// The bytes to append to a header's for a map with this layer.
pub fn encode_layer(layer: &v1::Layer) -> Bytes {
    v1::Map { header: None, layers: vec![layer.clone()] }.encode_to_vec().into()
}

/// A map, decoded and checked.
#[derive(Clone, Debug, PartialEq)]
pub struct Map {
    /// As on the wire.
    pub header: v1::Header,
    /// In the order on the wire.
    pub layers: Vec<Layer>,
}

/// One named grid of a map.
#[derive(Clone, Debug, PartialEq)]
pub struct Layer {
    /// `drivability`, …
    pub name: String,
    /// Where the cells lie.
    pub grid: Grid,
    /// The classes, by value of channel `class`; class 0 is `unknown`.
    pub legend: Vec<Class>,
    /// In the order on the wire; each has [`Grid::cell_count`] cells.
    pub channels: Vec<Channel>,
    /// Planes z = ax + by + c in the ego frame, by segment id.
    pub planes: Vec<[f64; 3]>,
    /// Figures of the whole layer, such as `drivable_share`.
    pub metrics: BTreeMap<String, f64>,
    /// Safe points, the vehicle's own place first; empty in layers without.
    pub points: Vec<SafePoint>,
}

/// A place in the ego frame that is as far as can be from the obstacles on both sides.
#[derive(Clone, Debug, PartialEq)]
pub struct SafePoint {
    /// Metres forward.
    pub x_m: f32,
    /// Metres to the left.
    pub y_m: f32,
    /// Distance to the nearest cell that is not free.
    pub radius_m: f32,
    /// Indices of points before this one that the vehicle gets to straight from here, ascending.
    pub links: Vec<u32>,
}

/// One value a cell.
#[derive(Clone, Debug, PartialEq)]
pub struct Channel {
    /// `class`, `unit_height`, …
    pub name: String,
    /// Unit of raw * scale; empty for classes and ids.
    pub unit: String,
    /// A cell's value in `unit` is `raw * scale`.
    pub scale: f32,
    /// The raw value that means: nothing is known of this cell.
    pub unknown: i32,
    /// Raw values.
    pub cells: Cells,
}

impl Map {
    /// The layer of that name.
    pub fn layer(&self, name: &str) -> Option<&Layer> {
        self.layers.iter().find(|layer| layer.name == name)
    }
}

impl Layer {
    /// The channel of that name.
    pub fn channel(&self, name: &str) -> Option<&Channel> {
        self.channels.iter().find(|channel| channel.name == name)
    }

    /// Value and name of the class at a point (ego frame, metres): (0, "unknown") outside the grid and in a layer without
    /// classes.
    pub fn class_at(&self, x_m: f64, y_m: f64) -> (u16, &str) {
        match self.grid.cell_at(x_m, y_m).and_then(|cell| self.class_of(cell)) {
            Some((value, class)) => (value, &class.name),
            None => (0, "unknown"),
        }
    }

    /// Meaning of the class at a point (ego frame, metres): unknown outside the grid and in a layer without classes.
    pub fn meaning_at(&self, x_m: f64, y_m: f64) -> ClassMeaning {
        self.grid.cell_at(x_m, y_m).map_or(ClassMeaning::Unknown, |cell| self.meaning_of(cell))
    }

    /// Meaning of the class of a cell, by the cell's index: unknown past the last cell and in a layer without classes.
    pub fn meaning_of(&self, cell: usize) -> ClassMeaning {
        self.class_of(cell).map_or(ClassMeaning::Unknown, |(_, class)| class.meaning)
    }

    fn class_of(&self, cell: usize) -> Option<(u16, &Class)> {
        let value = u16::try_from(self.channel("class")?.cells.get(cell)?).ok()?;
        Some((value, self.legend.get(usize::from(value))?))
    }

    /// A channel's value at a point, ego frame, metres, in the channel's unit. `None` where nothing is known: outside
    /// the grid, in a cell marked unknown, and where the layer has no such channel.
    pub fn value_at(&self, channel: &str, x_m: f64, y_m: f64) -> Option<f64> {
        self.channel(channel)?.value(self.grid.cell_at(x_m, y_m)?)
    }
}

impl Channel {
    /// A cell's value in [`Channel::unit`]; `None` where nothing is known, and past the last cell.
    pub fn value(&self, index: usize) -> Option<f64> {
        let raw = self.cells.get(index)?;
        (raw != self.unknown).then(|| f64::from(raw) * f64::from(self.scale))
    }
}

/// Names one map among all there are.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct MapId {
    /// `Header.vehicle`.
    pub vehicle: String,
    /// `Header.boot_id`.
    pub boot_id: u64,
    /// `Header.sequence`.
    pub sequence: u64,
}

impl MapId {
    /// Of the map with this header.
    pub fn of(header: &v1::Header) -> Self {
        Self { vehicle: header.vehicle.clone(), boot_id: header.boot_id, sequence: header.sequence }
    }
}

impl std::fmt::Display for MapId {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "map {} of {:?}, boot id {:016x}", self.sequence, self.vehicle, self.boot_id)
    }
}

/// Why a map was refused.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum MapError {
    /// More bytes than the reader allows.
    #[error("map of {length} bytes; at most {allowed} are allowed")]
    TooLong {
        /// Of the encoded map.
        length: usize,
        /// [`Limits::map_bytes`].
        allowed: usize,
    },
    /// More layers, channels, planes, sensors and names than the reader allows.
    #[error("map of {parts} parts; at most {allowed} are allowed")]
    TooManyParts {
        /// Claimed.
        parts: usize,
        /// [`Limits::map_parts`].
        allowed: usize,
    },
    /// Not a protobuf `clearway.v1.Map`.
    #[error("not an encoded clearway.v1.Map: {0}")]
    Protobuf(#[from] prost::DecodeError),
    /// The header is absent, or one of its values is impossible.
    #[error("header: {what}")]
    Header {
        /// What is wrong, the value and what is needed.
        what: String,
    },
    /// Two layers, or two channels of a layer, with one name.
    #[error("{what} {name:?} occurs twice; names are unique")]
    Twice {
        /// `layer` or `channel`.
        what: &'static str,
        /// The name.
        name: String,
    },
    /// A grid that cannot be.
    #[error("layer {layer:?}, geometry: {what}")]
    Geometry {
        /// The layer's name.
        layer: String,
        /// What is wrong, the value and what is needed.
        what: String,
    },
    /// All channels together claim more cells than the reader allows.
    #[error("the channels claim {cells} cells together; at most {allowed} are allowed")]
    TooManyCells {
        /// Claimed.
        cells: u64,
        /// [`Limits::map_cells`].
        allowed: u64,
    },
    /// A channel whose cells are not those of its grid.
    #[error("layer {layer:?}, channel {channel:?}: {cell_count} cells; the grid has {expected}")]
    CellCount {
        /// The layer's name.
        layer: String,
        /// The channel's name.
        channel: String,
        /// Claimed.
        cell_count: u32,
        /// Of the grid.
        expected: u64,
    },
    /// A channel whose payload was refused.
    #[error("layer {layer:?}, channel {channel:?}: {source}")]
    Cells {
        /// The layer's name.
        layer: String,
        /// The channel's name.
        channel: String,
        /// What is wrong with the payload.
        source: DecodeError,
    },
    /// A delta without the map it stands on, or one that has not this layer.
    #[error("layer {layer:?} is a delta to that of map {base_sequence}, which is needed and not there")]
    NoBase {
        /// The layer's name.
        layer: String,
        /// Of the map it stands on.
        base_sequence: u64,
    },
    /// A delta to another map than the one given.
    #[error("layer {layer:?} is a delta to {needed}; given was {given}")]
    OtherBase {
        /// The layer's name.
        layer: String,
        /// What it stands on.
        needed: Box<MapId>,
        /// What was given.
        given: Box<MapId>,
    },
    /// A delta to a layer whose cells are not comparable.
    #[error("layer {layer:?} is a delta that does not fit its base: {what}")]
    BaseShape {
        /// The layer's name.
        layer: String,
        /// What is different.
        what: String,
    },
    /// A channel told by class that does not fit the classes.
    #[error("layer {layer:?}, channel {channel:?} is told by class: {what}")]
    ByClass {
        /// The layer's name.
        layer: String,
        /// The channel's name.
        channel: String,
        /// What does not fit.
        what: String,
    },
    /// A safe point that cannot be.
    #[error("layer {layer:?}, safe point {point}: {what}")]
    SafePoint {
        /// The layer's name.
        layer: String,
        /// Its index.
        point: usize,
        /// What is wrong, the value and what is needed.
        what: String,
    },
    /// The legend was refused.
    #[error("layer {layer:?}, legend: {source}")]
    Legend {
        /// The layer's name.
        layer: String,
        /// What is wrong with the legend.
        source: LegendError,
    },
    /// A class without a name.
    #[error("layer {layer:?}: class {class} in cell {cell}; the legend has {legend} entries")]
    Class {
        /// The layer's name.
        layer: String,
        /// The cell's index.
        cell: usize,
        /// Its value.
        class: i32,
        /// Entries.
        legend: usize,
    },
}

impl MapError {
    /// The variant's name in the golden vectors, the same in every client language; a refused payload has its own
    /// [`DecodeError::name`].
    pub fn name(&self) -> &'static str {
        match self {
            Self::TooLong { .. } => "too_long",
            Self::TooManyParts { .. } => "too_many_parts",
            Self::Protobuf(_) => "protobuf",
            Self::Header { .. } => "header",
            Self::Twice { .. } => "twice",
            Self::Geometry { .. } => "geometry",
            Self::TooManyCells { .. } => "too_many_cells",
            Self::CellCount { .. } => "cell_count",
            Self::Cells { source, .. } => source.name(),
            Self::NoBase { .. } => "no_base",
            Self::OtherBase { .. } => "other_base",
            Self::BaseShape { .. } => "base_shape",
            Self::ByClass { .. } => "by_class",
            Self::SafePoint { .. } => "safe_point",
            Self::Legend { .. } => "legend",
            Self::Class { .. } => "class",
        }
    }
}

/// Decodes an encoded `clearway.v1.Map`. Claimed cell counts are compared with the grid and with the limits before any
/// cell is made.
///
/// # Errors
/// [`MapError`], naming the first thing found wrong; a delta is refused.
pub fn decode_map(bytes: Bytes, limits: &Limits) -> Result<Map, MapError> {
    decode_map_on(bytes, None, limits)
}

/// As [`decode_map`], with the map that deltas stand on: whole layers do without it.
///
/// # Errors
/// [`MapError`], naming the first thing found wrong: [`MapError::NoBase`], [`MapError::OtherBase`] and
/// [`MapError::BaseShape`] where a delta stands on something else, before any cell is made.
pub fn decode_map_on(bytes: Bytes, base: Option<&Map>, limits: &Limits) -> Result<Map, MapError> {
    if bytes.len() > limits.map_bytes {
        return Err(MapError::TooLong { length: bytes.len(), allowed: limits.map_bytes });
    }
    let parts = parts::count(&bytes);
    if parts > limits.map_parts {
        return Err(MapError::TooManyParts { parts, allowed: limits.map_parts });
    }
    let map = v1::Map::decode(bytes)?;
    let header = check_header(map.header)?;
    check_unique("layer", map.layers.iter().map(|layer| &layer.name))?;
    let channels = map.layers.iter().flat_map(|layer| &layer.channels);
    let cells = channels.map(|channel| u64::from(channel.cell_count)).sum();
    if cells > limits.map_cells {
        return Err(MapError::TooManyCells { cells, allowed: limits.map_cells });
    }
    let on_base = |layer: v1::Layer| {
        let base = delta::base_of(&layer, MapId::of(&header), base)?;
        decode_layer(layer, base, limits)
    };
    let layers = map.layers.into_iter().map(on_base).collect::<Result<_, _>>()?;
    Ok(Map { header, layers })
}

fn check_header(header: Option<v1::Header>) -> Result<v1::Header, MapError> {
    let wrong = |what: String| MapError::Header { what };
    let header = header.ok_or_else(|| wrong("absent; every map has one".into()))?;
    if header.capture_start_ns > header.capture_end_ns {
        return Err(wrong(format!(
            "capture starts at {} ns; that is after its end at {} ns",
            header.capture_start_ns, header.capture_end_ns
        )));
    }
    if let Some(p) = &header.map_from_ego {
        let norm = (p.qx * p.qx + p.qy * p.qy + p.qz * p.qz + p.qw * p.qw).sqrt();
        let finite = [p.x, p.y, p.z, norm].iter().all(|v| v.is_finite());
        if !finite || (norm - 1.0).abs() > 1e-3 {
            return Err(wrong(format!(
                "map_from_ego at ({}, {}, {}) m with a quaternion of norm {norm}; finite metres and norm 1 are needed",
                p.x, p.y, p.z
            )));
        }
    }
    Ok(header)
}

fn check_unique<'a>(what: &'static str, names: impl Iterator<Item = &'a String>) -> Result<(), MapError> {
    let mut names: Vec<_> = names.collect();
    names.sort_unstable();
    match names.array_windows().find(|[a, b]| a == b) {
        Some([name, _]) => Err(MapError::Twice { what, name: (*name).clone() }),
        None => Ok(()),
    }
}

/// `base`: the layer that a delta stands on.
pub(crate) fn decode_layer(layer: v1::Layer, base: Option<&Layer>, limits: &Limits) -> Result<Layer, MapError> {
    let grid = Grid::from_wire(&layer)?;
    check_unique("channel", layer.channels.iter().map(|channel| &channel.name))?;
    let shift = match (layer.base_sequence, base) {
        (None, _) => None,
        (Some(base_sequence), None) => return Err(MapError::NoBase { layer: layer.name, base_sequence }),
        (Some(_), Some(base)) => {
            let misfit = |what| MapError::BaseShape { layer: layer.name.clone(), what };
            Some(Shift::new(base, &grid).map_err(misfit)?)
        }
    };
    let legend = match base {
        // A delta without a legend has that of its base.
        Some(base) if legend::is_empty(&layer) => base.legend.clone(),
        _ => legend::decode_legend(&layer).map_err(|source| MapError::Legend { layer: layer.name.clone(), source })?,
    };
    let (expected, columns) = (grid.cell_count(), grid.shape().1 as usize);
    let mut channels: Vec<Channel> = Vec::with_capacity(layer.channels.len());
    for channel in &layer.channels {
        let names = || (layer.name.clone(), channel.name.clone());
        let wrong = |source| MapError::Cells { layer: layer.name.clone(), channel: channel.name.clone(), source };
        if u64::from(channel.cell_count) != expected {
            let (layer, name) = names();
            return Err(MapError::CellCount { layer, channel: name, cell_count: channel.cell_count, expected });
        }
        check_count(channel, limits).map_err(wrong)?;
        let base = if !channel.by_class.is_empty() {
            let class = channels.iter().find(|channel| channel.name == "class").map(|class| &class.cells);
            Some(by_class::base(channel, class, legend.len()).map_err(|what| {
                let (layer, channel) = names();
                MapError::ByClass { layer, channel, what }
            })?)
        } else if let (Some(shift), v1::Encoding::Changes) = (&shift, channel.encoding()) {
            let misfit = |what| MapError::BaseShape { layer: layer.name.clone(), what };
            Some(shift.base_of(channel).map_err(misfit)?)
        } else {
            None
        };
        let (name, cells) = (channel.name.clone(), decode_on(channel, columns, base).map_err(wrong)?);
        let v1::Channel { unit, scale, unknown, .. } = channel;
        channels.push(Channel { name, unit: unit.clone(), scale: *scale, unknown: *unknown, cells });
    }
    let planes = layer.planes.iter().map(|plane| [plane.a, plane.b, plane.c]).collect();
    let metrics = layer.metrics.into_iter().collect();
    let points = match &layer.safe_points {
        Some(packed) => safe_points::unpack(&layer.name, packed, limits.map_parts)?,
        None => Vec::new(),
    };
    let layer = Layer { name: layer.name, grid, legend, channels, planes, metrics, points };
    check_classes(&layer)?;
    Ok(layer)
}

/// A planner that meets a class without a name could not know whether it may drive there.
fn check_classes(layer: &Layer) -> Result<(), MapError> {
    let Some(channel) = layer.channel("class") else { return Ok(()) };
    let (name, legend) = (layer.name.clone(), layer.legend.len());
    if layer.legend.first().is_none_or(|first| first.name != "unknown") {
        let first = layer.legend.first().map(|class| class.name.clone()).unwrap_or_default();
        return Err(MapError::Legend { layer: name, source: LegendError::FirstName { name: first } });
    }
    let nameless = |class: i32| usize::try_from(class).map_or(true, |class| class >= legend);
    let found = match &channel.cells {
        Cells::U8(cells) => cells.iter().position(|&class| nameless(class.into())),
        Cells::I8(cells) => cells.iter().position(|&class| nameless(class.into())),
        Cells::U16(cells) => cells.iter().position(|&class| nameless(class.into())),
    };
    match found {
        Some(cell) => {
            let class = channel.cells.get(cell).unwrap_or_default();
            Err(MapError::Class { layer: name, cell, class, legend })
        }
        None => Ok(()),
    }
}
