//! [`Event`] <-> `clearway.v1.Event`: events of the journal, and bodies of observations.
//!
//! An event read from a journal equals the event that was written, also if the core refuses the event.

use bytes::Bytes;
use clearway_lidar::model::Model;
use clearway_mapping::config::{Extrinsics, SensorConfig};
use clearway_mapping::event::{Body, Cause, EgoPose, Event, Road, RoadFrame, RoadPurpose, Scan};
use clearway_proto::packed::{pack, unpack};
use clearway_proto::v1;
use nalgebra::{Isometry3, Quaternion, Translation3, Unit};
use prost::Message;

use super::map::pose;

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
        speed_limit: road.speed_limits_mps.clone(),
    }
}

/// A road from the wire. Values that the core would refuse stay as they are, because the journal holds them too.
///
/// # Errors
/// [`NoCounterpartError`] for an unknown purpose or frame, and if x and y differ in length.
pub fn road_from_proto(road: v1::Road) -> Result<Road, NoCounterpartError> {
    let purpose = match road.purpose() {
        v1::RoadPurpose::Paint => RoadPurpose::Paint,
        v1::RoadPurpose::Route => RoadPurpose::Route,
        v1::RoadPurpose::Unspecified => return Err(NoCounterpartError("known road purpose")),
    };
    let frame = match road.frame() {
        v1::RoadFrame::Ego => RoadFrame::Ego,
        v1::RoadFrame::Map => RoadFrame::Map,
        v1::RoadFrame::Unspecified => return Err(NoCounterpartError("known road frame")),
    };
    if road.x.len() != road.y.len() {
        return Err(NoCounterpartError("y for every x of the road"));
    }
    Ok(Road {
        stamp_ns: road.stamp_ns,
        purpose,
        frame,
        points: road.x.into_iter().zip(road.y).map(|(x, y)| [x, y]).collect(),
        widths_m: road.width,
        orientations: road.orientations,
        speed_limits_mps: road.speed_limit,
    })
}

/// An ego pose from the wire; `None` if the pose is missing.
pub fn ego_pose_from_proto(ego: &v1::EgoPose) -> Option<EgoPose> {
    let pose = ego.map_from_ego.as_ref()?;
    // Not normalised again: rounding would change the pose that was processed.
    let rotation = Unit::new_unchecked(Quaternion::new(pose.qw, pose.qx, pose.qy, pose.qz));
    let map_from_ego = Isometry3::from_parts(Translation3::new(pose.x, pose.y, pose.z), rotation);
    Some(EgoPose { stamp_ns: ego.stamp_ns, map_from_ego, speed_mps: ego.speed_mps })
}

fn sensor_config(sensor: &SensorConfig) -> v1::Sensor {
    let Extrinsics { x_m, y_m, z_m, roll_deg, pitch_deg, yaw_deg } = sensor.extrinsics;
    v1::Sensor {
        name: sensor.name.clone(),
        model: sensor.model.map(|model| model.as_str().to_owned()),
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
        range_noise_m: sensor.range_noise_m,
    }
}

/// A sensor's configuration from the wire.
///
/// # Errors
/// [`NoCounterpartError`] for an unknown model, and if blind_deg holds no pairs.
pub fn sensor_from_proto(sensor: v1::Sensor) -> Result<SensorConfig, NoCounterpartError> {
    let v1::Sensor { x_m, y_m, z_m, roll_deg, pitch_deg, yaw_deg, .. } = sensor;
    let plain = SensorConfig::new(sensor.name, Extrinsics { x_m, y_m, z_m, roll_deg, pitch_deg, yaw_deg });
    let (blind_deg, []) = sensor.blind_deg.as_chunks() else { return Err(NoCounterpartError("pairs in blind_deg")) };
    let model = sensor
        .model
        .map(|name| name.parse::<Model>().map_err(|_| NoCounterpartError("known sensor model")))
        .transpose()?;
    Ok(SensorConfig {
        model,
        rpm: sensor.rpm,
        calibration: sensor.calibration,
        cut_azimuth_deg: sensor.cut_azimuth_deg.unwrap_or(plain.cut_azimuth_deg),
        range_m_min: sensor.range_m_min.unwrap_or(plain.range_m_min),
        blind_deg: blind_deg.to_vec(),
        gps_late_days_max: sensor.gps_late_days_max.unwrap_or(plain.gps_late_days_max),
        elevations_deg: sensor.elevations_deg,
        range_noise_m: sensor.range_noise_m,
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

/// A scan from the wire. Values that the core would refuse stay as they are, because the journal holds them too.
///
/// # Errors
/// [`NoCounterpartError`] if a list ends inside a number, or a direction lacks a coordinate.
pub fn scan_from_proto(scan: v1::Scan) -> Result<Scan, NoCounterpartError> {
    const PART: NoCounterpartError = NoCounterpartError("whole number at the end of a scan's list");
    let floats = |bytes: &[u8]| unpack(bytes).ok_or(PART);
    let no_returns = floats(&scan.no_returns)?;
    let (directions, []) = no_returns.as_chunks::<3>() else {
        return Err(NoCounterpartError("z for every x and y of no_returns"));
    };
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
        Body::Withdrawn => v1::event::Body::Withdrawn(v1::Withdrawn {}),
        Body::Plan(plan) => v1::event::Body::Plan(Box::new(v1::Plan::decode(plan.clone()).unwrap_or_default())),
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

/// A message that lacks a part which its counterpart in the core needs; it names the part.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("no {0}")]
pub struct NoCounterpartError(pub &'static str);

/// Why bytes of a journal are no event.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum EventDecodeError {
    /// The bytes are not protobuf.
    #[error("not a clearway.v1.Event: {0}")]
    Decode(#[from] prost::DecodeError),
    /// The source is too large.
    #[error("event {sequence}: source {source_index}: 0 to 65535 is allowed")]
    Source {
        /// Sequence of the event.
        sequence: u64,
        /// The source that was found.
        source_index: u32,
    },
    /// A part is missing or unknown: the body, the pose of an ego pose, the cause of a loss, the frame or purpose of a
    /// road, a coordinate of a direction, the model of a sensor.
    #[error("event {sequence}: no {what}")]
    Missing {
        /// Sequence of the event.
        sequence: u64,
        /// The missing part: `body`, `pose`, or a part of a loss, road, scan or sensor.
        what: &'static str,
    },
}

/// An event from a journal, equal to the event that was written.
///
/// # Errors
/// [`EventDecodeError::Decode`] if the bytes are not protobuf, [`EventDecodeError::Source`] if the source is too large,
/// [`EventDecodeError::Missing`] if a part is missing or unknown.
pub fn event_from_bytes(bytes: Bytes) -> Result<Event, EventDecodeError> {
    let event = v1::Event::decode(bytes)?;
    let sequence = event.sequence;
    let source =
        u16::try_from(event.source).map_err(|_| EventDecodeError::Source { sequence, source_index: event.source })?;
    let body = match event.body.ok_or(EventDecodeError::Missing { sequence, what: "body" })? {
        v1::event::Body::Datagram(payload) => Body::Datagram(payload),
        v1::event::Body::Scan(scan) => Body::Scan(
            scan_from_proto(scan).map_err(|NoCounterpartError(what)| EventDecodeError::Missing { sequence, what })?,
        ),
        v1::event::Body::EgoPose(ego) => {
            Body::EgoPose(ego_pose_from_proto(&ego).ok_or(EventDecodeError::Missing { sequence, what: "pose" })?)
        }
        v1::event::Body::Road(road) => Body::Road(
            road_from_proto(road).map_err(|NoCounterpartError(what)| EventDecodeError::Missing { sequence, what })?,
        ),
        v1::event::Body::Sensor(sensor) => {
            let sensor = sensor_from_proto(sensor)
                .map_err(|NoCounterpartError(what)| EventDecodeError::Missing { sequence, what })?;
            Body::Sensor(Box::new(sensor))
        }
        v1::event::Body::Lost(count) => {
            let causes = [Cause::Queue, Cause::Kernel, Cause::Sender, Cause::Length, Cause::Observation];
            let cause = causes.into_iter().find(|cause| i32::from(loss_cause(*cause)) == event.lost_cause);
            let cause = cause.ok_or(EventDecodeError::Missing { sequence, what: "known cause of a loss" })?;
            Body::Lost { cause, count }
        }
        v1::event::Body::End(v1::End {}) => Body::End,
        v1::event::Body::Withdrawn(v1::Withdrawn {}) => Body::Withdrawn,
        v1::event::Body::Plan(plan) => Body::Plan(plan.encode_to_vec().into()),
    };
    Ok(Event { sequence, arrival_ns: event.arrival_ns, source, body })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_event_read_from_the_journal_equals_the_written_one() {
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
                speed_limits_mps: vec![0.0, 13.5],
            }),
            Body::Sensor(Box::new(SensorConfig {
                model: Some(Model::PuckHiRes),
                rpm: Some(600.0),
                elevations_deg: vec![-15.0, 1.5],
                blind_deg: vec![[350.0, 10.0], [80.0, 100.0]],
                gps_late_days_max: 0.5,
                range_noise_m: Some(0.03),
                ..SensorConfig::new(
                    "left-2",
                    Extrinsics { x_m: 1.0, y_m: -2.0, z_m: 0.5, roll_deg: 3.0, pitch_deg: 4.0, yaw_deg: -90.0 },
                )
            })),
            Body::Lost { cause: Cause::Queue, count: 12 },
            Body::Lost { cause: Cause::Kernel, count: 3 },
            Body::End,
            Body::Withdrawn,
            Body::Plan(v1::Plan { x: vec![1.0], y: vec![f64::MIN], ..Default::default() }.encode_to_vec().into()),
        ];
        for (sequence, body) in (0..).zip(bodies) {
            let event = Event { sequence, arrival_ns: i64::MIN + 1, source: 3, body };
            assert_eq!(event_from_bytes(event_to_proto(&event).encode_to_vec().into()), Ok(event));
        }
    }

    #[test]
    fn the_reason_why_bytes_are_no_event_is_named() {
        assert!(matches!(event_from_bytes(Bytes::from_static(b"\xff")), Err(EventDecodeError::Decode(_))));
        let missing = Err(EventDecodeError::Missing { sequence: 0, what: "body" });
        assert_eq!(event_from_bytes(Bytes::new()), missing);
        for (road, what) in [
            (v1::Road { frame: 1, ..Default::default() }, "known road purpose"),
            (v1::Road { purpose: 9, frame: 1, ..Default::default() }, "known road purpose"),
            (v1::Road { purpose: 1, frame: 3, ..Default::default() }, "known road frame"),
            (v1::Road { purpose: 1, frame: 1, x: vec![0.0], ..Default::default() }, "y for every x of the road"),
        ] {
            let event = v1::Event { body: Some(v1::event::Body::Road(road)), ..Default::default() };
            let missing = Err(EventDecodeError::Missing { sequence: 0, what });
            assert_eq!(event_from_bytes(event.encode_to_vec().into()), missing);
        }
        let far = v1::Event { source: 70_000, ..v1::Event::default() };
        let source = Err(EventDecodeError::Source { sequence: 0, source_index: 70_000 });
        assert_eq!(event_from_bytes(far.encode_to_vec().into()), source);
    }
}
