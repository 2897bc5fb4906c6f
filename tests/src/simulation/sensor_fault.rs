//! Faults of the sensors themselves: silence, restarts, covered windows, and senders of invalid messages.

use std::ops::Range;

use bytes::Bytes;
use clearway_proto::packed::{pack, unpack};
use clearway_proto::v1;
use clearway_sim::vehicle::{Datagram, Kind};
use nalgebra::{Isometry3, Vector3};

use super::fault_plan::{Rng, SensorFault};

const HOUR_US: u32 = 3_600_000_000;
/// Bytes of one block of a data packet: flag, azimuth, 32 returns of 3 bytes.
const BLOCK_BYTES: usize = 100;
const BLOCKS: usize = 12;

/// Applies a fault to a datagram of a rotating sensor; `None` if the sensor sends nothing.
pub fn apply(mut datagram: Datagram, now_ns: i64, fault: &SensorFault) -> Option<Datagram> {
    if fault.silent.as_ref().is_some_and(|silent| silent.contains(&now_ns)) {
        return None;
    }
    if let Some((from_ns, ahead_us)) = fault.restart
        && now_ns >= from_ns
    {
        if datagram.kind == Kind::Telemetry {
            return None;
        }
        let stamp: &mut [u8] = &mut datagram.payload[BLOCKS * BLOCK_BYTES..BLOCKS * BLOCK_BYTES + 4];
        let device_us = u32::from_le_bytes([stamp[0], stamp[1], stamp[2], stamp[3]]);
        stamp.copy_from_slice(&((u64::from(device_us) + u64::from(ahead_us)) % u64::from(HOUR_US)).to_le_bytes()[..4]);
    }
    Some(datagram)
}

/// True if a direction (ego frame, degrees counter-clockwise) lies in a sector.
pub fn inside(sector_deg: &Range<i64>, direction_deg: f64) -> bool {
    (direction_deg - sector_deg.start as f64).rem_euclid(360.0) < (sector_deg.end - sector_deg.start) as f64
}

/// Removes the returns in a sector of directions from a data packet. The encoder's angle is the lasers' direction.
pub fn cover_datagram(datagram: &mut Datagram, sector_deg: &Range<i64>, ego_from_sensor: &Isometry3<f64>) {
    if datagram.kind != Kind::Data {
        return;
    }
    let yaw_deg = ego_from_sensor.rotation.euler_angles().2.to_degrees();
    for block in datagram.payload[..BLOCKS * BLOCK_BYTES].chunks_exact_mut(BLOCK_BYTES) {
        let azimuth_deg = f64::from(u16::from_le_bytes([block[2], block[3]])) / 100.0;
        if inside(sector_deg, yaw_deg - azimuth_deg) {
            block[4..].fill(0);
        }
    }
}

/// Removes the points in a sector of directions from a scan.
pub fn cover_scan(observation: &mut v1::Observation, sector_deg: &Range<i64>, ego_from_sensor: &Isometry3<f64>) {
    let Some(v1::observation::Body::Scan(scan)) = &mut observation.body else { return };
    let list = |bytes: &Bytes| unpack::<f32>(bytes).expect("the car packs whole numbers");
    let (x, y) = (list(&scan.x), list(&scan.y));
    let seen: Vec<bool> = x
        .iter()
        .zip(&y)
        .map(|(x, y)| {
            let direction = ego_from_sensor.rotation * Vector3::new(f64::from(*x), f64::from(*y), 0.0);
            !inside(sector_deg, direction.y.atan2(direction.x).to_degrees())
        })
        .collect();
    let keep = |bytes: &Bytes, width: usize| -> Bytes {
        let kept = bytes.chunks_exact(width).zip(&seen).filter(|(_, seen)| **seen);
        kept.flat_map(|(bytes, _)| bytes.iter().copied()).collect::<Vec<u8>>().into()
    };
    for list in [&mut scan.x, &mut scan.y, &mut scan.z, &mut scan.intensity, &mut scan.offset_ns] {
        *list = keep(list, 4);
    }
    scan.ring = keep(&scan.ring, 2);
    scan.no_returns = Bytes::new();
}

/// A random datagram that no sensor sends.
pub fn invalid_datagram(rng: &mut Rng) -> Vec<u8> {
    let lengths = [0, 1, 42, 511, 512, 513, 1205, 1206, 1206, 1206, 1207, 1535];
    let length = lengths[rng.within(0..lengths.len() as i64) as usize];
    (0..length).map(|_| rng.draw() as u8).collect()
}

/// An invalid observation, of a known or an unknown sensor.
pub fn invalid_observation(stamp_ns: i64, rng: &mut Rng) -> v1::Observation {
    use v1::observation::Body;
    let scan = |x: &[f32], y: &[f32]| v1::Scan { stamp_ns, x: pack(x), y: pack(y), z: pack(y), ..Default::default() };
    let level = Some(v1::Pose { qw: 1.0, ..Default::default() });
    let (sensor, body) = match rng.within(0..9) {
        0 => ("ahead", None),
        1 => ("unknown", Some(Body::Scan(scan(&[1.0], &[2.0])))),
        2 => ("ahead", Some(Body::Scan(scan(&[1.0, 2.0], &[2.0])))),
        3 => ("ahead", Some(Body::Scan(v1::Scan { x: Bytes::from_static(&[1, 2, 3]), ..scan(&[], &[]) }))),
        4 => ("ahead", Some(Body::Scan(v1::Scan { ring: pack(&[1_u16, 2]), ..scan(&[3.0], &[4.0]) }))),
        5 => ("ahead", Some(Body::Scan(v1::Scan { stamp_ns: i64::MIN, ..scan(&[1.0], &[2.0]) }))),
        6 => ("", Some(Body::EgoPose(v1::EgoPose { stamp_ns: i64::MAX, map_from_ego: level, speed_mps: 0.0 }))),
        7 => ("", Some(Body::EgoPose(v1::EgoPose { stamp_ns, map_from_ego: None, speed_mps: f64::NAN }))),
        _ => ("", Some(Body::Road(v1::Road { stamp_ns, x: vec![f64::NAN], ..Default::default() }))),
    };
    v1::Observation { sensor: sensor.into(), body, ..Default::default() }
}
