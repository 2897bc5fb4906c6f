//! The bytes of a map <-> checked values.
//!
//! Protobuf messages concatenate: the bytes of a header followed by the bytes of any selection of layers are the bytes
//! of the map with these layers. So a server encodes each part once ([`encode_header`], [`encode_layer`]).

use bytes::Bytes;
use prost::Message;

use crate::channel::by_class;
use crate::channel::cells::Cells;
use crate::channel::codec::{check_count, decode_on};
use crate::limits::{Limits, WIRE_VERSION};
use crate::map::base::{Shift, base_of};
use crate::map::error::MapError;
use crate::map::grid::Grid;
use crate::map::id::MapId;
use crate::map::layer::{Channel, Layer, Map};
use crate::map::legend::{self, LegendError};
use crate::map::{parts, safe_points};
use crate::v1;

/// The bytes of a map with this header and without layers.
pub fn encode_header(header: &v1::Header) -> Bytes {
    v1::Map { header: Some(header.clone()), layers: Vec::new() }.encode_to_vec().into()
}

/// The bytes that, appended to a header's bytes, add this layer to the map.
pub fn encode_layer(layer: &v1::Layer) -> Bytes {
    v1::Map { header: None, layers: vec![layer.clone()] }.encode_to_vec().into()
}

/// Decodes an encoded `clearway.v1.Map` of whole layers. It compares the claimed numbers of cells with the grids and
/// the limits before it allocates memory for cells.
///
/// # Errors
/// Names the first fault found. [`MapError::TooLong`], [`MapError::TooManyParts`] and [`MapError::TooManyCells`] if the
/// map is over a limit; [`MapError::Protobuf`] if the bytes are no map; [`MapError::NoBase`] if a layer is a delta; the
/// other variants if a header, layer, legend, channel, cell or safe point is invalid.
pub fn decode_map(bytes: Bytes, limits: &Limits) -> Result<Map, MapError> {
    decode_map_on(bytes, None, limits)
}

/// As [`decode_map`], with the base map of the layers that are deltas. Whole layers do not need it.
///
/// # Errors
/// As [`decode_map`], and for a delta, before memory for cells is allocated: [`MapError::NoBase`] if there is no base
/// map or it does not have the layer, [`MapError::OtherBase`] if `base` is another map than the base map,
/// [`MapError::BaseShape`] if the cells are not comparable.
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
        let base = base_of(&layer, MapId::of(&header), base)?;
        decode_layer(layer, base, limits)
    };
    let layers = map.layers.into_iter().map(on_base).collect::<Result<_, _>>()?;
    Ok(Map { header, layers })
}

fn check_header(header: Option<v1::Header>) -> Result<v1::Header, MapError> {
    let wrong = |what: String| MapError::Header { what };
    let header = header.ok_or_else(|| wrong("absent; every map has one".into()))?;
    if header.wire_version > WIRE_VERSION {
        return Err(MapError::Version { version: header.wire_version, known: WIRE_VERSION });
    }
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

/// Decodes one layer. `base`: its base layer if it is a delta.
pub(crate) fn decode_layer(layer: v1::Layer, base: Option<&Layer>, limits: &Limits) -> Result<Layer, MapError> {
    let grid = Grid::from_wire(&layer)?;
    check_unique("channel", layer.channels.iter().map(|channel| &channel.name))?;
    let shift = match (layer.base_sequence, base) {
        (None, _) => None,
        (Some(base_sequence), None) => return Err(MapError::NoBase { layer: layer.name, base_sequence }),
        (Some(_), Some(base)) => {
            let misfit = |source| MapError::BaseShape { layer: layer.name.clone(), source };
            Some(Shift::new(base, &grid).map_err(misfit)?)
        }
    };
    let legend = match base.filter(|_| shift.is_some()) {
        Some(base) if legend::is_empty(&layer) => base.legend.clone(),
        _ => legend::decode_legend(&layer).map_err(|source| MapError::Legend { layer: layer.name.clone(), source })?,
    };
    let mut channels = Vec::with_capacity(layer.channels.len());
    for channel in &layer.channels {
        channels.push(decode_channel(channel, &channels, &layer.name, &grid, legend.len(), shift.as_ref(), limits)?);
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

/// Decodes one channel of the layer `name`. `before`: the channels that precede it; `classes`: entries of the legend.
fn decode_channel(
    channel: &v1::Channel,
    before: &[Channel],
    name: &str,
    grid: &Grid,
    classes: usize,
    shift: Option<&Shift<'_>>,
    limits: &Limits,
) -> Result<Channel, MapError> {
    let names = || (name.to_owned(), channel.name.clone());
    let refuse_cells = |source| {
        let (layer, channel) = names();
        MapError::Cells { layer, channel, source }
    };
    let (cell_count, expected) = (channel.cell_count, grid.cell_count());
    if u64::from(cell_count) != expected {
        let (layer, channel) = names();
        return Err(MapError::CellCount { layer, channel, cell_count, expected });
    }
    check_count(channel, limits).map_err(refuse_cells)?;
    let base = if !channel.by_class.is_empty() {
        let class = before.iter().find(|channel| channel.name == "class").map(|class| &class.cells);
        Some(by_class::base(channel, class, classes).map_err(|source| {
            let (layer, channel) = names();
            MapError::ByClass { layer, channel, source }
        })?)
    } else if let (Some(shift), v1::Encoding::Changes) = (shift, channel.encoding()) {
        Some(shift.base_of(channel).map_err(|source| MapError::BaseShape { layer: name.to_owned(), source })?)
    } else {
        None
    };
    let cells = decode_on(channel, grid.shape().1 as usize, base).map_err(refuse_cells)?;
    let v1::Channel { name, unit, scale, unknown, .. } = channel;
    Ok(Channel { name: name.clone(), unit: unit.clone(), scale: *scale, unknown: *unknown, cells })
}

/// Checks that the legend has an entry for the class of every cell: a planner must not meet a class without a meaning.
fn check_classes(layer: &Layer) -> Result<(), MapError> {
    let Some(channel) = layer.channel("class") else { return Ok(()) };
    let (name, legend) = (layer.name.clone(), layer.legend.len());
    if layer.legend.first().is_none_or(|first| first.name != "unknown") {
        let first = layer.legend.first().map(|class| class.name.clone()).unwrap_or_default();
        return Err(MapError::Legend { layer: name, source: LegendError::FirstName { name: first } });
    }
    let is_missing = |class: i32| usize::try_from(class).map_or(true, |class| class >= legend);
    let found = match &channel.cells {
        Cells::U8(cells) => cells.iter().position(|&class| is_missing(class.into())),
        Cells::I8(cells) => cells.iter().position(|&class| is_missing(class.into())),
        Cells::U16(cells) => cells.iter().position(|&class| is_missing(class.into())),
    };
    match found {
        Some(cell) => {
            let class = channel.cells.get(cell).unwrap_or_default();
            Err(MapError::Class { layer: name, cell, class, legend })
        }
        None => Ok(()),
    }
}
