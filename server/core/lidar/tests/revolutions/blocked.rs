//! Blocked windows, and views that are only empty.

use clearway_lidar::{Blocked, BlockedSector, Calibration, Model, ReturnMode, Revolution, Sensor, SensorConfig};

use crate::stream::Stream;

/// Number of revolutions before the window is blocked.
const CLEAN: usize = 7;
/// Number of revolutions with the blocked window.
const BLOCKED: usize = 4;

/// Decodes eleven revolutions. In the last four, returns have the distance `cover(laser, degree)` if it is not `None`.
fn revolutions(stream: &Stream, cover: impl Fn(usize, u32) -> Option<u16>) -> Vec<Revolution> {
    let (spec, calibration) = (stream.model.spec(), Calibration::factory(stream.model));
    let mut sensor = Sensor::new(SensorConfig { model: Some(stream.model), ..SensorConfig::default() });
    let change = stream.packets(CLEAN as f64);
    let mut revolutions = Vec::new();
    for index in 0..stream.packets((CLEAN + BLOCKED) as f64) {
        let mut packet = stream.packet(index);
        for block in (0..spec.blocks_used(stream.mode)).filter(|_| index >= change) {
            let bytes = &mut packet[100 * block..100 * (block + 1)];
            let azimuth_deg = f64::from(u16::from_le_bytes([bytes[2], bytes[3]])) / 100.0;
            let bank = spec.block_position(block, stream.mode).bank;
            for (place, distance) in bytes[4..].chunks_exact_mut(3).enumerate() {
                let laser = (32 * bank + place) % spec.lasers;
                let direction_deg = azimuth_deg - calibration.lasers[laser].rot_correction.to_degrees();
                if let Some(counts) = cover(laser, direction_deg.rem_euclid(360.0) as u32) {
                    distance[..2].copy_from_slice(&counts.to_le_bytes());
                }
            }
        }
        revolutions.extend(sensor.push(&packet, stream.arrival_ns(index)).unwrap().cloned());
    }
    assert_eq!(sensor.status().blocked, revolutions.last().unwrap().blocked);
    assert!(revolutions[..CLEAN - 1].iter().all(|revolution| revolution.blocked.is_empty()));
    revolutions
}

#[test]
fn a_sector_without_returns_or_with_near_ones_is_blocked() {
    let kinds = [
        (Model::Hdl64eS2, ReturnMode::Strongest),
        (Model::Vlp16, ReturnMode::Dual),
        (Model::Vls128, ReturnMode::Strongest),
    ];
    for (model, mode) in kinds {
        let stream = Stream { mode, ..Stream::of(model) };
        for (from_deg, to_deg, counts) in [(40, 70, 0), (350, 380, 100), (0, 360, 65_534)] {
            let inside =
                |degree: u32| (from_deg..to_deg).contains(&degree) || (from_deg..to_deg).contains(&(degree + 360));
            let revolutions = revolutions(&stream, |_, degree| inside(degree).then_some(counts));
            let blocked = &revolutions[CLEAN + 1].blocked;
            let [found] = blocked.sectors[..] else { panic!("{model:?} {mode:?} {from_deg}: {blocked:?}") };
            // A block of a VLP-16 has a second firing, which may be in the next degree.
            let width = u32::from(found.to_deg - found.from_deg);
            assert!(u32::from(found.from_deg).abs_diff(from_deg) <= 1, "{model:?} {mode:?}: {found:?}");
            assert!((to_deg - from_deg).abs_diff(width) <= 2, "{model:?} {mode:?}: {found:?}");
            assert_eq!(blocked.lasers.len(), if to_deg == 360 { model.spec().lasers } else { 0 }, "{model:?}");
        }
    }
    let over_zero = Blocked { sectors: vec![BlockedSector { from_deg: 350, to_deg: 380 }], lasers: vec![7] };
    let hidden = |degrees: f32| over_zero.hides(0, degrees.to_radians());
    assert!(hidden(350.0) && hidden(-5.0) && hidden(0.0) && hidden(379.0) && hidden(20.9) && hidden(349.1));
    assert!(!hidden(348.5) && !hidden(21.5) && !hidden(180.0) && over_zero.hides(7, 3.0));
    // A sector of four degrees is the space between two objects.
    let revolutions = revolutions(&Stream::of(Model::Hdl32e), |_, degree| (40..44).contains(&degree).then_some(0));
    assert!(revolutions.iter().all(|revolution| revolution.blocked.is_empty()));
}

#[test]
fn a_laser_without_returns_is_blocked_until_its_first_return() {
    let stream = Stream::of(Model::Vlp16);
    let dark = |laser: usize| matches!(laser, 3 | 14);
    let found = revolutions(&stream, |laser, _| dark(laser).then_some(0));
    assert_eq!(found[CLEAN + 1].blocked, Blocked { sectors: vec![], lasers: vec![3, 14] });
    let wiped = |laser: usize, degree: u32| (dark(laser) && degree != 200).then_some(0);
    assert!(revolutions(&stream, wiped).iter().all(|revolution| revolution.blocked.is_empty()));
}

#[test]
fn lost_packets_and_open_sky_are_not_blocked() {
    let stream = Stream::of(Model::Vlp16);
    let mut sensor = Sensor::new(SensorConfig { model: Some(Model::Vlp16), ..SensorConfig::default() });
    let all = stream.packets(12.0);
    // From the eighth revolution on only every fourth packet arrives.
    let revolutions = stream.push(&mut sensor, (0..all).filter(|index| *index < 600 || index % 4 == 0));
    assert!(revolutions.iter().all(|revolution| revolution.blocked.is_empty()));

    let mut sensor = Sensor::new(SensorConfig { model: Some(Model::Vlp16), ..SensorConfig::default() });
    let sky = Stream { distance: 0, ..stream };
    assert!(sky.push(&mut sensor, 0..all).iter().all(|revolution| revolution.blocked.is_empty()));
}
