//! [`Map`] -> [`EncodedMap`], once: a header chunk and one chunk a layer, each a piece of one `clearway.v1.Map`.
//!
//! Protobuf messages concatenate: header and layer chunks put behind each other are the message, so any selection of
//! layers costs one copy and no encoding, and the bytes of one layer are the same over zenoh, gRPC and in a recording.
//! No clock goes into the bytes: the same events give the same bytes.

use std::sync::Arc;

use bytes::{Bytes, BytesMut};
use clearway_mapping::config::{Extrinsics, SensorConfig};
use clearway_mapping::event::{Body, Cause, EgoPose, Event, Road, RoadFrame, RoadPurpose, Scan};
use clearway_mapping::map::{Cells, Geometry, Layer, Map, SafePoint, SensorState};
use clearway_mapping::pipeline::{model_name, model_of_name};
use clearway_proto::codec::{self, CellsRef};
use clearway_proto::map::{encode_header, encode_layer};
use clearway_proto::packed::{pack, unpack};
use clearway_proto::predicted::encode_beside;
use clearway_proto::v1;
use nalgebra::{Isometry3, Quaternion, Translation3, Unit};
use prost::Message;

use crate::cuts::Cuts;

/// One map, ready for any reader. Cloning it costs reference counts.
#[derive(Clone, Debug, PartialEq)]
pub struct EncodedMap {
    /// The vehicle's name.
    pub vehicle: Arc<str>,
    /// Of the map.
    pub sequence: u64,
    /// Of the map; age is measured from here.
    pub capture_end_ns: i64,
    /// Of the map: arrival of the event that completed it.
    pub completed_ns: i64,
    /// Share of the judged cells that are drivable, where the map has that layer.
    pub drivable_share: Option<f64>,
    /// An encoded `Map` with the header alone.
    pub header: Bytes,
    /// By layer name, in the map's order: an encoded `Map` with this layer alone.
    pub layers: Vec<(&'static str, Bytes)>,
    /// What readers asked of it.
    pub(crate) cuts: Cuts,
}

impl EncodedMap {
    /// Encodes `map` of `vehicle`; `boot_id` names this run of the server, `valid_ms` how long the map may be used.
    pub fn new(map: &Map, vehicle: Arc<str>, boot_id: u64, valid_ms: u32) -> Self {
        let header = encode_header(&header(map, &vehicle, boot_id, valid_ms));
        let encode = |layer: &Layer| (layer.name, encode_layer(&self::layer(layer)));
        let share = |layer: &Layer| layer.figures.iter().find(|(name, _)| *name == "drivable_share").map(|(_, v)| *v);
        Self {
            vehicle,
            sequence: map.sequence,
            capture_end_ns: map.capture_end_ns,
            completed_ns: map.completed_ns,
            drivable_share: map.layers.iter().find_map(share),
            header,
            layers: map.layers.iter().map(encode).collect(),
            cuts: Cuts::default(),
        }
    }

    /// The encoded map with these layers, in the map's order; every layer where none is named. Names nobody knows are
    /// left out.
    pub fn select(&self, layers: &[String]) -> Bytes {
        let wanted = |name: &str| layers.is_empty() || layers.iter().any(|layer| layer == name);
        let chunks = || self.layers.iter().filter(|(name, _)| wanted(name)).map(|(_, bytes)| bytes);
        let mut message = BytesMut::with_capacity(self.header.len() + chunks().map(Bytes::len).sum::<usize>());
        message.extend_from_slice(&self.header);
        chunks().for_each(|chunk| message.extend_from_slice(chunk));
        message.freeze()
    }

    /// The encoded map with one layer: what zenoh carries and the recording holds.
    pub fn layer(&self, chunk: &Bytes) -> Bytes {
        let mut message = BytesMut::with_capacity(self.header.len() + chunk.len());
        message.extend_from_slice(&self.header);
        message.extend_from_slice(chunk);
        message.freeze()
    }
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
        sensors: map.sensors.iter().map(sensor).collect(),
        compensation: map.compensation.as_str().to_owned(),
        made_by: map.sensors.get(usize::from(map.made_by)).map_or(String::new(), |sensor| sensor.name.clone()),
    }
}

fn pose(isometry: &Isometry3<f64>) -> v1::Pose {
    let (t, q) = (isometry.translation.vector, isometry.rotation.coords);
    v1::Pose { x: t.x, y: t.y, z: t.z, qx: q.x, qy: q.y, qz: q.z, qw: q.w }
}

pub(crate) fn sensor(state: &SensorState) -> v1::SensorState {
    v1::SensorState {
        name: state.name.clone(),
        model: state.model.clone(),
        packets: state.packets,
        refused: state.refused,
        returns: state.returns,
        rpm: state.rpm,
        completeness: state.completeness,
        partial: state.partial.to_owned(),
        clock: state.clock.to_owned(),
        clock_offset_ms: state.clock_offset_ms,
        packets_expected: state.packets_expected,
        blocked_sectors: state
            .blocked
            .sectors
            .iter()
            .map(|sector| v1::BlockedSector { from_deg: sector.from_deg.into(), to_deg: sector.to_deg.into() })
            .collect(),
        blocked_lasers: state.blocked.lasers.iter().map(|&laser| laser.into()).collect(),
        state: state.state.as_str().to_owned(),
        age_ms: state.age_ms,
    }
}

fn layer(layer: &Layer) -> v1::Layer {
    let geometry = match &layer.geometry {
        Geometry::Radial { r_bench_m, columns } => {
            v1::layer::Geometry::Radial(v1::RadialGrid { r_bench_m: r_bench_m.clone(), columns: u32::from(*columns) })
        }
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
    let channel = |channel: &clearway_mapping::map::Channel| {
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
        legend: layer.legend.iter().map(|&class| class.to_owned()).collect(),
        channels: layer.channels.iter().map(channel).collect(),
        planes: layer.planes.iter().map(|&[a, b, c]| v1::Plane { a, b, c }).collect(),
        figures: layer.figures.iter().map(|&(name, value)| (name.to_owned(), value)).collect(),
        safe_points: safe_points(layer),
        base_sequence: None,
    }
}

/// Places lie in the middle of a cell or between two.
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

fn road(road: &Road) -> v1::Road {
    let purpose = match road.purpose {
        RoadPurpose::Paint => v1::RoadPurpose::Paint,
        RoadPurpose::Route => v1::RoadPurpose::Route,
    };
    let frame = match road.frame {
        RoadFrame::Ego => v1::RoadFrame::Ego,
        RoadFrame::Map => v1::RoadFrame::Map,
    };
    v1::Road {
        stamp_ns: road.stamp_ns,
        purpose: purpose.into(),
        frame: frame.into(),
        x: road.points.iter().map(|[x, _]| *x).collect(),
        y: road.points.iter().map(|[_, y]| *y).collect(),
        width: road.widths_m.clone(),
        orientations: road.orientations.clone(),
    }
}

/// What the core would refuse stays as it is: the journal holds it too. `Err` names what has no counterpart.
pub(crate) fn road_from_proto(road: v1::Road) -> Result<Road, &'static str> {
    let purpose = match road.purpose() {
        v1::RoadPurpose::Paint => RoadPurpose::Paint,
        v1::RoadPurpose::Route => RoadPurpose::Route,
        v1::RoadPurpose::Unspecified => return Err("known road purpose"),
    };
    let frame = match road.frame() {
        v1::RoadFrame::Ego => RoadFrame::Ego,
        v1::RoadFrame::Map => RoadFrame::Map,
        v1::RoadFrame::Unspecified => return Err("known road frame"),
    };
    if road.x.len() != road.y.len() {
        return Err("y for every x of the road");
    }
    Ok(Road {
        stamp_ns: road.stamp_ns,
        purpose,
        frame,
        points: road.x.into_iter().zip(road.y).map(|(x, y)| [x, y]).collect(),
        widths_m: road.width,
        orientations: road.orientations,
    })
}

/// `None` where the pose is missing.
pub(crate) fn ego_pose_from_proto(ego: &v1::EgoPose) -> Option<EgoPose> {
    let pose = ego.map_from_ego.as_ref()?;
    // Not normalised again: a rounding would make another pose of it than the one that was processed.
    let rotation = Unit::new_unchecked(Quaternion::new(pose.qw, pose.qx, pose.qy, pose.qz));
    let map_from_ego = Isometry3::from_parts(Translation3::new(pose.x, pose.y, pose.z), rotation);
    Some(EgoPose { stamp_ns: ego.stamp_ns, map_from_ego, speed_mps: ego.speed_mps })
}

fn sensor_config(sensor: &SensorConfig) -> v1::Sensor {
    let Extrinsics { x_m, y_m, z_m, roll_deg, pitch_deg, yaw_deg } = sensor.extrinsics;
    v1::Sensor {
        name: sensor.name.clone(),
        model: sensor.model.map(|model| model_name(model).to_owned()),
        rpm: sensor.rpm,
        cut_azimuth_deg: Some(sensor.cut_azimuth_deg),
        range_m_min: Some(sensor.range_m_min),
        elevations_deg: sensor.elevations_deg.clone(),
        x_m,
        y_m,
        z_m,
        roll_deg,
        pitch_deg,
        yaw_deg,
        calibration: sensor.calibration.clone(),
        blind_deg: sensor.blind_deg.as_flattened().to_vec(),
        gps_late_days_max: Some(sensor.gps_late_days_max),
    }
}

/// `Err` names what has no counterpart.
pub(crate) fn sensor_from_proto(sensor: v1::Sensor) -> Result<SensorConfig, &'static str> {
    let v1::Sensor { x_m, y_m, z_m, roll_deg, pitch_deg, yaw_deg, .. } = sensor;
    let plain = SensorConfig::new(sensor.name, Extrinsics { x_m, y_m, z_m, roll_deg, pitch_deg, yaw_deg });
    let (blind_deg, []) = sensor.blind_deg.as_chunks() else { return Err("pairs in blind_deg") };
    let model = sensor.model.map(|name| model_of_name(&name).ok_or("known sensor model")).transpose()?;
    Ok(SensorConfig {
        model,
        rpm: sensor.rpm,
        calibration: sensor.calibration,
        cut_azimuth_deg: sensor.cut_azimuth_deg.unwrap_or(plain.cut_azimuth_deg),
        range_m_min: sensor.range_m_min.unwrap_or(plain.range_m_min),
        blind_deg: blind_deg.to_vec(),
        gps_late_days_max: sensor.gps_late_days_max.unwrap_or(plain.gps_late_days_max),
        elevations_deg: sensor.elevations_deg,
        ..plain
    })
}

fn scan(scan: &Scan) -> v1::Scan {
    v1::Scan {
        stamp_ns: scan.stamp_ns,
        x: pack(&scan.x),
        y: pack(&scan.y),
        z: pack(&scan.z),
        intensity: pack(&scan.intensity),
        ring: pack(&scan.ring),
        offset_ns: pack(&scan.offset_ns),
        no_returns: pack(scan.no_returns.as_flattened()),
    }
}

/// What the core would refuse stays as it is: the journal holds it too. `Err` names what has no counterpart.
pub(crate) fn scan_from_proto(scan: v1::Scan) -> Result<Scan, &'static str> {
    const PART: &str = "whole number at the end of a scan's list";
    let floats = |bytes: &[u8]| unpack(bytes).ok_or(PART);
    let no_returns = floats(&scan.no_returns)?;
    let (directions, []) = no_returns.as_chunks::<3>() else { return Err("z for every x and y of no_returns") };
    Ok(Scan {
        stamp_ns: scan.stamp_ns,
        x: floats(&scan.x)?,
        y: floats(&scan.y)?,
        z: floats(&scan.z)?,
        intensity: floats(&scan.intensity)?,
        ring: unpack(&scan.ring).ok_or(PART)?,
        offset_ns: unpack(&scan.offset_ns).ok_or(PART)?,
        no_returns: directions.to_vec(),
    })
}

/// An event as the journal holds it.
pub fn event_to_proto(event: &Event) -> v1::Event {
    let lost_cause = match event.body {
        Body::Lost { cause, .. } => loss_cause(cause),
        _ => v1::LossCause::Queue,
    };
    let body = match &event.body {
        Body::Datagram(payload) => v1::event::Body::Datagram(payload.clone()),
        Body::Scan(scan) => v1::event::Body::Scan(self::scan(scan)),
        Body::EgoPose(ego) => v1::event::Body::EgoPose(v1::EgoPose {
            stamp_ns: ego.stamp_ns,
            map_from_ego: Some(pose(&ego.map_from_ego)),
            speed_mps: ego.speed_mps,
        }),
        Body::Road(road) => v1::event::Body::Road(self::road(road)),
        Body::Sensor(sensor) => v1::event::Body::Sensor(sensor_config(sensor)),
        Body::Lost { count, .. } => v1::event::Body::Lost(*count),
        Body::End => v1::event::Body::End(v1::End {}),
    };
    v1::Event {
        sequence: event.sequence,
        arrival_ns: event.arrival_ns,
        source: u32::from(event.source),
        body: Some(body),
        lost_cause: lost_cause.into(),
    }
}

fn loss_cause(cause: Cause) -> v1::LossCause {
    match cause {
        Cause::Queue => v1::LossCause::Queue,
        Cause::Kernel => v1::LossCause::Kernel,
        Cause::Sender => v1::LossCause::Sender,
        Cause::Length => v1::LossCause::Length,
        Cause::Observation => v1::LossCause::Observation,
    }
}

/// An event of a journal that is none.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum EventError {
    /// Not protobuf.
    #[error("not a clearway.v1.Event: {0}")]
    Decode(#[from] prost::DecodeError),
    /// A source no vehicle has.
    #[error("event {sequence}: source {source_index}: 0 to 65535 is allowed")]
    Source {
        /// The event's.
        sequence: u64,
        /// What was found.
        source_index: u32,
    },
    /// A body this version does not know, an ego pose without a pose, a loss without a cause, a road without frame or
    /// purpose, a scan with half a direction, a sensor of an unknown model.
    #[error("event {sequence}: no {what}")]
    Missing {
        /// The event's.
        sequence: u64,
        /// `body`, `pose`, or what of a loss, road, scan or sensor.
        what: &'static str,
    },
}

/// An event out of a journal, exactly as it was.
///
/// # Errors
/// [`EventError`] where the bytes are no event.
pub fn event_from_bytes(bytes: Bytes) -> Result<Event, EventError> {
    let event = v1::Event::decode(bytes)?;
    let sequence = event.sequence;
    let source =
        u16::try_from(event.source).map_err(|_| EventError::Source { sequence, source_index: event.source })?;
    let body = match event.body.ok_or(EventError::Missing { sequence, what: "body" })? {
        v1::event::Body::Datagram(payload) => Body::Datagram(payload),
        v1::event::Body::Scan(scan) => {
            Body::Scan(scan_from_proto(scan).map_err(|what| EventError::Missing { sequence, what })?)
        }
        v1::event::Body::EgoPose(ego) => {
            Body::EgoPose(ego_pose_from_proto(&ego).ok_or(EventError::Missing { sequence, what: "pose" })?)
        }
        v1::event::Body::Road(road) => {
            Body::Road(road_from_proto(road).map_err(|what| EventError::Missing { sequence, what })?)
        }
        v1::event::Body::Sensor(sensor) => {
            let sensor = sensor_from_proto(sensor).map_err(|what| EventError::Missing { sequence, what })?;
            Body::Sensor(Box::new(sensor))
        }
        v1::event::Body::Lost(count) => {
            let causes = [Cause::Queue, Cause::Kernel, Cause::Sender, Cause::Length, Cause::Observation];
            let cause = causes.into_iter().find(|cause| i32::from(loss_cause(*cause)) == event.lost_cause);
            let cause = cause.ok_or(EventError::Missing { sequence, what: "known cause of a loss" })?;
            Body::Lost { cause, count }
        }
        v1::event::Body::End(v1::End {}) => Body::End,
    };
    Ok(Event { sequence, arrival_ns: event.arrival_ns, source, body })
}

#[cfg(test)]
mod tests {
    use clearway_mapping::map::Part;

    use super::*;

    #[test]
    fn an_event_comes_out_of_the_journal_as_it_went_in() {
        let pose = Isometry3::new(nalgebra::vector![1.0, 2.0, 3.0], nalgebra::vector![0.1, 0.2, 0.3]);
        let bodies = [
            Body::Datagram(Bytes::from_static(b"anything")),
            Body::Scan(Scan {
                stamp_ns: 7,
                x: vec![1.0],
                y: vec![2.0],
                z: vec![f32::MIN],
                intensity: vec![0.5],
                ring: vec![u16::MAX],
                offset_ns: vec![-20_000_000],
                no_returns: vec![[0.0, 0.6, -0.8]],
            }),
            Body::EgoPose(EgoPose { stamp_ns: -1, map_from_ego: pose, speed_mps: 15.0 }),
            Body::Road(Road {
                stamp_ns: 5,
                purpose: RoadPurpose::Route,
                frame: RoadFrame::Map,
                points: vec![[0.0, -1.5], [1e9, 2.0]],
                widths_m: vec![3.5],
                orientations: vec![1.0, 0.25],
            }),
            Body::Sensor(Box::new(SensorConfig {
                model: Some(clearway_lidar::model::Model::PuckHiRes),
                rpm: Some(600.0),
                elevations_deg: vec![-15.0, 1.5],
                blind_deg: vec![[350.0, 10.0], [80.0, 100.0]],
                gps_late_days_max: 0.5,
                ..SensorConfig::new(
                    "left-2",
                    Extrinsics { x_m: 1.0, y_m: -2.0, z_m: 0.5, roll_deg: 3.0, pitch_deg: 4.0, yaw_deg: -90.0 },
                )
            })),
            Body::Lost { cause: Cause::Queue, count: 12 },
            Body::Lost { cause: Cause::Kernel, count: 3 },
            Body::End,
        ];
        for (sequence, body) in (0..).zip(bodies) {
            let event = Event { sequence, arrival_ns: i64::MIN + 1, source: 3, body };
            assert_eq!(event_from_bytes(event_to_proto(&event).encode_to_vec().into()), Ok(event));
        }
    }

    #[test]
    fn bytes_that_are_no_event_are_named() {
        assert!(matches!(event_from_bytes(Bytes::from_static(b"\xff")), Err(EventError::Decode(_))));
        let missing = Err(EventError::Missing { sequence: 0, what: "body" });
        assert_eq!(event_from_bytes(Bytes::new()), missing);
        for (road, what) in [
            (v1::Road { frame: 1, ..Default::default() }, "known road purpose"),
            (v1::Road { purpose: 9, frame: 1, ..Default::default() }, "known road purpose"),
            (v1::Road { purpose: 1, frame: 3, ..Default::default() }, "known road frame"),
            (v1::Road { purpose: 1, frame: 1, x: vec![0.0], ..Default::default() }, "y for every x of the road"),
        ] {
            let event = v1::Event { body: Some(v1::event::Body::Road(road)), ..Default::default() };
            let missing = Err(EventError::Missing { sequence: 0, what });
            assert_eq!(event_from_bytes(event.encode_to_vec().into()), missing);
        }
        let far = v1::Event { source: 70_000, ..v1::Event::default() };
        let source = Err(EventError::Source { sequence: 0, source_index: 70_000 });
        assert_eq!(event_from_bytes(far.encode_to_vec().into()), source);
    }

    fn map() -> Map {
        let layer = |name| Layer {
            name,
            geometry: Geometry::Radial { r_bench_m: vec![5.0, 60.0], columns: 4 },
            legend: &["unknown", "drivable"],
            channels: vec![clearway_mapping::map::Channel {
                name: "class",
                unit: "",
                scale: 1.0,
                unknown: 0,
                cells: Cells::U8(vec![1, 1, 0, 0, 1, 1, 1, 0]),
            }],
            planes: vec![[0.0, 0.0, 1.0]],
            figures: vec![("drivable_share", 0.5), ("cells", 5.0)],
            points: Vec::new(),
        };
        Map {
            sequence: 9,
            capture_start_ns: 1,
            capture_end_ns: 100,
            completed_ns: 101,
            map_from_ego: None,
            speed_mps: None,
            compensation: clearway_mapping::motion::Compensation::Speed,
            made_by: 1,
            sensors: vec![
                SensorState { name: "top".into(), state: Part::Late, age_ms: Some(250.5), ..SensorState::default() },
                SensorState { name: "left".into(), packets_expected: 75, state: Part::Ok, ..SensorState::default() },
            ],
            layers: vec![layer("drivability"), layer("height_difference")],
        }
    }

    #[test]
    fn chunks_put_behind_each_other_are_the_message() {
        let encoded = EncodedMap::new(&map(), "car".into(), 7, 300);
        let whole = v1::Map::decode(encoded.select(&[])).unwrap();
        assert_eq!(whole.layers.len(), 2);
        let header = whole.header.unwrap();
        assert_eq!((header.sequence, header.boot_id, header.valid_until_ns), (9, 7, 300_000_100));
        assert_eq!((header.compensation.as_str(), header.made_by.as_str()), ("speed", "left"));
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
