//! [`Map`] -> [`EncodedMap`], once: a header chunk and one chunk for each layer, each a piece of one `clearway.v1.Map`.
//!
//! Protobuf messages concatenate: the header chunk and layer chunks one after the other are the message, so a selection
//! of layers costs one copy and no encoding, and the bytes of one layer are the same over zenoh and gRPC and in a
//! recording. No clock goes into the bytes: the same events give the same bytes.

use std::sync::Arc;

use bytes::{Bytes, BytesMut};
use clearway_mapping::layer::{Cells, Geometry, Layer, Meaning, SafePoint};
use clearway_mapping::map::{ElevationSource, Map, SensorState};
use clearway_proto::by_class::encode_beside;
use clearway_proto::codec::{self, CellsRef};
use clearway_proto::map::{encode_header, encode_layer};
use clearway_proto::region::RegionError;
use clearway_proto::v1;
use nalgebra::Isometry3;
use prost::Message;

use super::payload_cache::{PayloadCache, cropped, delta};
use super::replayed::{Replayed, alter_header};

/// One encoded map. A clone shares the bytes.
#[derive(Clone, Debug, PartialEq)]
pub struct EncodedMap {
    /// Name of the vehicle.
    pub vehicle: Arc<str>,
    /// Identifier of the run that serves the map.
    pub boot_id: u64,
    /// Sequence of the map.
    pub sequence: u64,
    /// End of the map's capture, in ns since the Unix epoch; the age of the map counts from here.
    pub capture_end_ns: i64,
    /// Arrival of the event that completed the map, in ns since the Unix epoch.
    pub completed_ns: i64,
    /// Share of the judged cells of the layer `drivability` that are drivable; `None` if the map does not have it.
    pub drivable_share: Option<f64>,
    /// Encoded `Map` with the header alone.
    pub header: Bytes,
    /// Encoded `Map`s with one layer each, without the header, by layer name, in the map's order.
    pub layers: Vec<(&'static str, Bytes)>,
    /// Regions and deltas of this map that were already encoded.
    pub(super) cache: PayloadCache,
}

impl EncodedMap {
    /// Encodes `map` of `vehicle`; `boot_id` names this run of the server, `valid_ms` how long the map may be used.
    pub fn new(map: &Map, vehicle: Arc<str>, boot_id: u64, valid_ms: u32) -> Self {
        Self::replayed(map, vehicle, boot_id, valid_ms, None)
    }

    /// Encodes `map` as [`EncodedMap::new`] does, with the header of a replayed map if `replayed` is given. The layers
    /// are the same bytes.
    pub fn replayed(map: &Map, vehicle: Arc<str>, boot_id: u64, valid_ms: u32, replayed: Option<Replayed>) -> Self {
        let mut header = header(map, &vehicle, boot_id, valid_ms);
        if let Some(replayed) = replayed {
            alter_header(&mut header, replayed);
        }
        let (boot_id, capture_end_ns, completed_ns) = (header.boot_id, header.capture_end_ns, header.completed_ns);
        let header = encode_header(&header);
        let encode = |layer: &Layer| (layer.name, encode_layer(&self::layer(layer)));
        let share = |layer: &Layer| {
            let share = layer.metrics.iter().find(|(name, _)| *name == "drivable_share");
            share.filter(|_| layer.name == "drivability").map(|(_, value)| *value)
        };
        Self {
            vehicle,
            boot_id,
            sequence: map.sequence,
            capture_end_ns,
            completed_ns,
            drivable_share: map.layers.iter().find_map(share),
            header,
            layers: map.layers.iter().map(encode).collect(),
            cache: PayloadCache::default(),
        }
    }

    /// The encoded map with these layers, in the map's order; every layer if `layers` is empty. Unknown names are
    /// ignored.
    pub fn select(&self, layers: &[String]) -> Bytes {
        let is_selected = |name: &str| layers.is_empty() || layers.iter().any(|layer| layer == name);
        let chunks = || self.layers.iter().filter(|(name, _)| is_selected(name)).map(|(_, bytes)| bytes);
        let mut message = BytesMut::with_capacity(self.header.len() + chunks().map(Bytes::len).sum::<usize>());
        message.extend_from_slice(&self.header);
        chunks().for_each(|chunk| message.extend_from_slice(chunk));
        message.freeze()
    }

    /// Length of the encoded map with every layer, in bytes.
    pub fn bytes(&self) -> usize {
        self.header.len() + self.layers.iter().map(|(_, chunk)| chunk.len()).sum::<usize>()
    }

    /// The encoded map with the layer of `chunk`: the payload of zenoh and of the recording.
    pub fn layer(&self, chunk: &Bytes) -> Bytes {
        let mut message = BytesMut::with_capacity(self.header.len() + chunk.len());
        message.extend_from_slice(&self.header);
        message.extend_from_slice(chunk);
        message.freeze()
    }

    /// The encoded map with these layers (every layer if `layers` is empty), cropped to `region`. A layer is a delta
    /// against the same layer of `base` if the delta is shorter.
    ///
    /// # Errors
    /// [`RegionError`] if the region lies outside a layer's grid.
    pub fn encode_for(
        &self,
        layers: &[String],
        region: Option<&v1::Region>,
        base: Option<&EncodedMap>,
    ) -> Result<Bytes, RegionError> {
        if region.is_none() && base.is_none() {
            return Ok(self.select(layers));
        }
        let mut message = BytesMut::from(&self.header[..]);
        for index in 0..self.layers.len() {
            if layers.is_empty() || layers.iter().any(|layer| layer == self.layers[index].0) {
                message.extend_from_slice(&self.encode_layer_for(index, region, base)?);
            }
        }
        Ok(message.freeze())
    }

    fn encode_layer_for(
        &self,
        index: usize,
        region: Option<&v1::Region>,
        base: Option<&EncodedMap>,
    ) -> Result<Bytes, RegionError> {
        let (name, whole) = &self.layers[index];
        let base = base.and_then(|base| Some((base, base.layers.iter().position(|(of, _)| of == name)?)));
        let bits =
            |region: &v1::Region| [region.x_from_m, region.x_to_m, region.y_from_m, region.y_to_m].map(f64::to_bits);
        let slot = |base| self.cache.slot((index, region.map(bits), base));
        match (region, base) {
            (None, None) => Ok(whole.clone()),
            (Some(region), None) => slot(None).get_or_init(|| cropped(whole, region)).clone(),
            (_, Some((base, at))) => slot(Some(base.sequence))
                .get_or_init(|| {
                    let (from, to) =
                        (base.encode_layer_for(at, region, None)?, self.encode_layer_for(index, region, None)?);
                    Ok(delta(&from, base.sequence, &to).unwrap_or(to))
                })
                .clone(),
        }
    }
}

/// The encoded map `computed` with the replay's header, if the header of the encoded map `served` has one; equal to
/// `served` if the map was replayed right. Bytes that are no map stay as they are.
pub fn as_served(computed: Bytes, served: &Bytes) -> Bytes {
    as_served_with(computed, v1::Map::decode(served.clone()).ok().and_then(|map| map.header))
}

/// As [`as_served`], from the header of the served map.
pub fn as_served_with(computed: Bytes, served: Option<v1::Header>) -> Bytes {
    let Some((boot_id, replay)) = served.and_then(|header| Some((header.boot_id, header.replay?))) else {
        return computed;
    };
    let Ok(mut map) = v1::Map::decode(computed.clone()) else { return computed };
    if let Some(header) = &mut map.header {
        alter_header(header, Replayed { shift_ns: replay.shift_ns, boot_id, first_at_ns: None });
    }
    map.encode_to_vec().into()
}

fn header(map: &Map, vehicle: &str, boot_id: u64, valid_ms: u32) -> v1::Header {
    v1::Header {
        vehicle: vehicle.to_owned(),
        boot_id,
        sequence: map.sequence,
        capture_start_ns: map.capture_start_ns,
        capture_end_ns: map.capture_end_ns,
        completed_ns: map.completed_ns,
        valid_until_ns: map.capture_end_ns.saturating_add(i64::from(valid_ms) * 1_000_000),
        map_from_ego: map.map_from_ego.as_ref().map(pose),
        speed_mps: map.speed_mps,
        sensors: map.present_sensors().map(sensor).collect(),
        compensation: map.compensation.as_str().to_owned(),
        source_sensor: map.sensors.get(usize::from(map.source)).map_or(String::new(), |sensor| sensor.name.to_string()),
        reference_sensor: (map.sensors.get(usize::from(map.reference_sensor)))
            .map_or(String::new(), |sensor| sensor.name.to_string()),
        epoch: map.epoch,
        ..v1::Header::default()
    }
}

/// A pose on the wire.
pub(super) fn pose(isometry: &Isometry3<f64>) -> v1::Pose {
    let (t, q) = (isometry.translation.vector, isometry.rotation.coords);
    v1::Pose { x: t.x, y: t.y, z: t.z, qx: q.x, qy: q.y, qz: q.z, qw: q.w }
}

/// A sensor's state on the wire.
pub fn sensor(state: &SensorState) -> v1::SensorState {
    v1::SensorState {
        name: state.name.to_string(),
        model: state.model.to_owned(),
        packets: state.packets,
        refused: state.refused,
        returns: state.returns,
        rpm: state.rpm,
        completeness: state.completeness,
        partial: state.partial.to_owned(),
        clock: state.clock.to_owned(),
        clock_offset_ms: state.clock_offset_ms,
        epoch: state.epoch,
        packets_expected: state.packets_expected,
        blocked_sectors: state
            .blocked
            .sectors
            .iter()
            .map(|sector| v1::BlockedSector { from_deg: sector.from_deg.into(), to_deg: sector.to_deg.into() })
            .collect(),
        blocked_lasers: state.blocked.lasers.iter().map(|&laser| laser.into()).collect(),
        state: state.contribution.as_str().to_owned(),
        age_ms: state.age_ms,
        elevations: state.elevations.map_or("", ElevationSource::as_str).to_owned(),
    }
}

fn layer(layer: &Layer) -> v1::Layer {
    let geometry = match &layer.geometry {
        Geometry::Radial { centre_m, row_radius_m, columns } => v1::layer::Geometry::Radial(v1::RadialGrid {
            row_radius_m: row_radius_m.clone(),
            columns: u32::from(*columns),
            centre_x_m: centre_m[0],
            centre_y_m: centre_m[1],
        }),
        &Geometry::Cartesian { origin_x_m, origin_y_m, width, height, cell_m, yaw_rad, first_cell } => {
            let [first_ix, first_iy] = first_cell;
            v1::layer::Geometry::Cartesian(v1::CartesianGrid {
                origin_x_m,
                origin_y_m,
                width,
                height,
                cell_m,
                yaw_rad,
                first_ix,
                first_iy,
            })
        }
    };
    let columns = match &layer.geometry {
        Geometry::Radial { columns, .. } => usize::from(*columns),
        Geometry::Cartesian { width, .. } => *width as usize,
    };
    let class = layer.channels.iter().find(|channel| channel.name == "class");
    let channel = |channel: &clearway_mapping::layer::Channel| {
        let cells = match &channel.cells {
            Cells::U8(cells) => CellsRef::U8(cells),
            Cells::I8(cells) => CellsRef::I8(cells),
            Cells::U16(cells) => CellsRef::U16(cells),
        };
        let encoded = match class.map(|class| &class.cells) {
            Some(Cells::U8(class)) if channel.name != "class" => {
                encode_beside(cells, class, layer.legend.len(), columns)
            }
            _ => codec::encode_grid(cells, columns),
        };
        encoded.into_channel(channel.name, channel.unit, channel.scale, channel.unknown)
    };
    v1::Layer {
        name: layer.name.to_owned(),
        geometry: Some(geometry),
        legend: layer.legend.iter().map(|class| class.name.to_owned()).collect(),
        legend_meanings: layer.legend.iter().map(|class| meaning(class.meaning).into()).collect(),
        legend_rgb: layer.legend.iter().map(|class| class.rgb).collect(),
        channels: layer.channels.iter().map(channel).collect(),
        planes: layer.planes.iter().map(|&[a, b, c]| v1::Plane { a, b, c }).collect(),
        metrics: layer.metrics.iter().map(|&(name, value)| (name.to_owned(), value)).collect(),
        safe_points: safe_points(layer),
        base_sequence: None,
    }
}

/// Translates the core's meaning of a class to the wire's.
pub fn meaning(meaning: Meaning) -> v1::ClassMeaning {
    match meaning {
        Meaning::Unknown => v1::ClassMeaning::Unknown,
        Meaning::Free => v1::ClassMeaning::Free,
        Meaning::Inferred => v1::ClassMeaning::Inferred,
        Meaning::Occupied => v1::ClassMeaning::Occupied,
        Meaning::Hidden => v1::ClassMeaning::Hidden,
        Meaning::NotReached => v1::ClassMeaning::NotReached,
        Meaning::Low => v1::ClassMeaning::Low,
    }
}

/// Safe points on the wire, in steps of half a cell: they lie in the middle of a cell or between two.
fn safe_points(layer: &Layer) -> Option<v1::SafePoints> {
    let Geometry::Cartesian { cell_m, .. } = layer.geometry else { return None };
    let single = |SafePoint { x_m, y_m, radius_m, links }: &SafePoint| clearway_proto::map::SafePoint {
        x_m: *x_m as f32,
        y_m: *y_m as f32,
        radius_m: *radius_m as f32,
        links: links.clone(),
    };
    let points: Vec<_> = layer.points.iter().map(single).collect();
    (!points.is_empty()).then(|| clearway_proto::safe_points::pack(&points, cell_m / 2.0))
}

#[cfg(test)]
mod tests {
    use clearway_mapping::layer::{ClassInfo, Meaning};
    use clearway_mapping::map::Contribution;
    use prost::Message;

    use super::*;

    fn map() -> Map {
        let layer = |name| Layer {
            name,
            geometry: Geometry::Radial { centre_m: [0.0; 2], row_radius_m: vec![5.0, 60.0], columns: 4 },
            legend: &[ClassInfo::UNKNOWN, ClassInfo { name: "drivable", meaning: Meaning::Free, rgb: 0 }],
            channels: vec![clearway_mapping::layer::Channel {
                name: "class",
                unit: "",
                scale: 1.0,
                unknown: 0,
                cells: Cells::U8(vec![1, 1, 0, 0, 1, 1, 1, 0]),
            }],
            planes: vec![[0.0, 0.0, 1.0]],
            metrics: vec![("drivable_share", 0.5), ("cells", 5.0)],
            points: Vec::new(),
        };
        Map {
            sequence: 9,
            capture_start_ns: 1,
            capture_end_ns: 100,
            epoch: 0,
            completed_ns: 101,
            map_from_ego: None,
            speed_mps: None,
            compensation: clearway_mapping::sensor::motion::Compensation::Speed,
            source: 1,
            reference_sensor: 0,
            sensors: vec![
                SensorState {
                    name: "top".into(),
                    contribution: Contribution::Late,
                    age_ms: Some(250.5),
                    ..SensorState::default()
                },
                SensorState {
                    name: "left".into(),
                    packets_expected: 75,
                    contribution: Contribution::Ok,
                    ..SensorState::default()
                },
            ],
            layers: vec![layer("drivability"), layer("height_difference")],
        }
    }

    #[test]
    fn concatenated_chunks_are_the_message() {
        let encoded = EncodedMap::new(&map(), "car".into(), 7, 300);
        let whole = v1::Map::decode(encoded.select(&[])).unwrap();
        assert_eq!(whole.layers.len(), 2);
        let header = whole.header.unwrap();
        assert_eq!((header.sequence, header.boot_id, header.valid_until_ns), (9, 7, 300_000_100));
        assert_eq!((header.compensation.as_str(), header.source_sensor.as_str()), ("speed", "left"));
        let sensors: Vec<_> = header.sensors.iter().map(|s| (s.state.as_str(), s.age_ms, s.packets_expected)).collect();
        assert_eq!(sensors, [("late", Some(250.5), 0), ("ok", None, 75)]);
        let one = encoded.select(&["height_difference".into()]);
        assert_eq!(one, encoded.layer(&encoded.layers[1].1));
        let one = v1::Map::decode(one).unwrap();
        assert_eq!(one.layers.iter().map(|l| l.name.as_str()).collect::<Vec<_>>(), ["height_difference"]);
        assert_eq!(encoded.drivable_share, Some(0.5));
    }

    #[test]
    fn the_same_map_gives_the_same_bytes() {
        let encode = || EncodedMap::new(&map(), "car".into(), 7, 300);
        assert_eq!(encode(), encode());
    }
}
