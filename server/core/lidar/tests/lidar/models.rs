//! Every model: told from its packets, decoded in each return mode, overridden, mixed up.

use std::f64::consts::TAU;

use clearway_lidar::{Calibration, Model, ReturnMode, Sensor, SensorConfig, SensorStatus};

use crate::stream::{START_NS, Stream};

#[test]
fn every_model_is_found_and_gives_whole_turns() {
    for model in Model::ALL {
        let stream = Stream::of(model);
        let mut sensor = Sensor::new(SensorConfig::default());
        let mut turns = stream.push(&mut sensor, 0..stream.packets(3.1));
        turns.extend(sensor.finish().cloned());
        // An S3 in single return looks like an S2 until its status bytes have told.
        let found = if model == Model::Hdl64eS3 { Model::Hdl64eS2 } else { model };
        assert_eq!(sensor.status().model, Some(found));
        assert_eq!(turns.len(), 4, "{model:?}");
        let spec = model.spec();
        for turn in &turns[..3] {
            assert_eq!(turn.partial, None, "{model:?} {}", turn.sequence);
            assert!(turn.firings.len().abs_diff(spec.firings_per_turn(stream.mode, 600.0)) <= 1, "{model:?}");
            assert!((turn.rpm - 600.0).abs() < 1.0, "{model:?} {}", turn.rpm);
            assert_eq!(turn.echoes.len(), 1);
            assert_eq!(turn.returns(), turn.firings.len() * spec.returns_per_firing());
            assert_eq!(turn.points().count(), turn.returns());
        }
        let firings: usize = turns.iter().map(|turn| turn.firings.len()).sum();
        assert_eq!(firings, stream.packets(3.1) * spec.firings_per_packet(stream.mode), "{model:?}: none lost");
        let status = sensor.status();
        assert_eq!(status.packets, stream.packets(3.1) as u64);
        assert_eq!(status.returns as usize, turns.iter().map(|turn| turn.returns()).sum::<usize>());
    }
}

#[test]
fn points_lie_where_range_elevation_and_azimuth_say() {
    for model in Model::ALL {
        let stream = Stream::of(model);
        let calibration = Calibration::factory(model);
        let range_m = 5_000.0 * model.spec().distance_m_per_count;
        let mut sensor = Sensor::new(SensorConfig { model: Some(model), ..SensorConfig::default() });
        let turn = stream.push(&mut sensor, 0..stream.packets(1.05)).remove(0);
        for point in turn.points() {
            let laser = &calibration.lasers[usize::from(point.laser)];
            let encoder = f64::from(turn.firings[point.firing as usize].azimuth_rad) - laser.rot_correction;
            let (x, y) = (f64::from(point.x), f64::from(point.y));
            assert!((f64::from(point.range_m) - range_m).abs() < 1e-5);
            assert!((f64::from(point.z) - range_m * laser.vert_correction.sin()).abs() < 1e-4);
            // Within a firing the sensor turns by less than a quarter of a degree: never backwards.
            let turned = (-y.atan2(x) - encoder).rem_euclid(TAU);
            assert!(!(0.005..TAU - 0.000_2).contains(&turned), "{model:?} laser {} turned {turned}", point.laser);
        }
    }
}

#[test]
fn dual_return_gives_two_images_strongest_first() {
    for model in Model::ALL.into_iter().filter(|model| model.spec().dual_return) {
        let stream = Stream { mode: ReturnMode::Dual, ..Stream::of(model) };
        let mut sensor = Sensor::new(SensorConfig::default());
        let turns = stream.push(&mut sensor, 0..stream.packets(2.2));
        assert_eq!(sensor.status().model, Some(model));
        assert_eq!(sensor.status().return_mode, Some(ReturnMode::Dual));
        assert_eq!(turns.len(), 2, "{model:?}");
        let turn = &turns[1];
        assert_eq!(turn.partial, None, "{model:?}");
        let spec = model.spec();
        assert!(turn.firings.len().abs_diff(spec.firings_per_turn(ReturnMode::Dual, 600.0)) <= 1, "{model:?}");
        let metres = spec.distance_m_per_count as f32;
        for slot in 0..turn.firings.len() * turn.lasers {
            assert!((turn.echoes[0].range_m[slot] - 5_000.0 * metres).abs() < 1e-4, "{model:?}");
            assert!((turn.echoes[1].range_m[slot] - 5_500.0 * metres).abs() < 1e-4, "{model:?}");
        }
        let types: Vec<u8> = turn.points().take(2).map(|point| point.return_type).collect();
        assert_eq!(types, [1, 2]);
    }
}

#[test]
fn a_vlp16_with_the_byte_of_an_hdl32e_is_known_by_its_rate_and_no_packet_is_lost() {
    let stream = Stream::of(Model::Vlp16);
    let early = |index| {
        let mut packet = stream.packet(index);
        packet[1205] = 0x21;
        packet
    };
    let mut sensor = Sensor::new(SensorConfig::default());
    assert!(sensor.push(&early(0), stream.arrival_ns(0)).unwrap().is_none());
    assert_eq!((sensor.status().model, sensor.status().packets_held), (None, 1));
    let mut firings = 0;
    for index in 1..stream.packets(1.5) {
        firings += sensor.push(&early(index), stream.arrival_ns(index)).unwrap().map_or(0, |turn| turn.firings.len());
    }
    assert_eq!(sensor.status().model, Some(Model::Vlp16));
    firings += sensor.finish().map_or(0, |turn| turn.firings.len());
    assert_eq!(firings, stream.packets(1.5) * 24);
}

#[test]
fn a_stray_held_before_the_model_was_known_is_counted_and_holds_up_nobody() {
    let stray = Stream::of(Model::Hdl32e).packet(0);
    // An S3 is an S2 until its status table has come.
    for model in Model::ALL.into_iter().filter(|model| *model != Model::Hdl64eS3) {
        let stream = Stream { start_azimuth: 17_000, device_us: 5_000_000, ..Stream::of(model) };
        let mut sensor = Sensor::new(SensorConfig::default());
        assert!(sensor.push(&stray, stream.arrival_ns(0)).unwrap().is_none());
        for index in 0..40 {
            sensor.push(&stream.packet(index), stream.arrival_ns(index)).unwrap();
        }
        let status = sensor.status();
        let of_stream = status.packets + status.packets_held as u64;
        assert_eq!((status.model, status.packets_unfit, of_stream), (Some(model), 1, 40), "{model:?}");
    }
}

#[test]
fn sixteen_strays_from_other_times_hold_up_nobody() {
    let stream = Stream::of(Model::Hdl32e);
    let mut sensor = Sensor::new(SensorConfig::default());
    for stray in 1..17 {
        let other = Stream { device_us: 100_000_000 * stray, ..stream };
        sensor.push(&other.packet(0), stream.arrival_ns(0)).unwrap();
    }
    for index in 0..40 {
        sensor.push(&stream.packet(index), stream.arrival_ns(index)).unwrap();
    }
    let status = sensor.status();
    assert_eq!((status.packets_unfit, status.packets + status.packets_held as u64), (16, 40));
}

#[test]
fn a_byte_that_no_rate_confirms_is_believed_in_the_end() {
    let stream = Stream::of(Model::Hdl32e);
    // Every third packet arrives: 1,659 µs fits neither model.
    let mut sensor = Sensor::new(SensorConfig::default());
    stream.push(&mut sensor, (0..60).step_by(3));
    assert_eq!(sensor.status().model, Some(Model::Hdl32e));
    assert_eq!(sensor.status().packets + sensor.status().packets_held as u64, 20);
    let mut one = Sensor::new(SensorConfig::default());
    stream.push(&mut one, 0..1);
    assert_eq!(one.finish().unwrap().firings.len(), 12);
    assert!(one.finish().is_none());
}

#[test]
fn a_configured_model_refuses_another_models_packets_and_keeps_its_state() {
    let stream = Stream::of(Model::Vlp32c);
    let mut sensor = Sensor::new(SensorConfig { model: Some(Model::Vls128), ..SensorConfig::default() });
    let refusal = sensor.push(&stream.packet(0), START_NS).unwrap_err();
    assert_eq!(refusal.reason(), "block_flag");
    assert_eq!(sensor.status(), SensorStatus { model: Some(Model::Vls128), ..SensorStatus::default() });

    let mut sensor = Sensor::new(SensorConfig::default());
    stream.push(&mut sensor, 0..10);
    let before = sensor.status();
    let refusal = sensor.push(&Stream::of(Model::PuckHiRes).packet(0), START_NS).unwrap_err();
    assert_eq!(refusal.reason(), "model");
    assert_eq!(refusal.to_string(), "model byte 0x24 from a VLP-32C; allowed: 0x28");
    assert_eq!(sensor.status(), before);
}

#[test]
fn unknown_bytes_flags_azimuths_and_lengths_are_refused_by_name() {
    let good = Stream::of(Model::Vlp16).packet(0);
    let damaged = |at: usize, with: &[u8]| {
        let mut packet = good.clone();
        packet[at..at + with.len()].copy_from_slice(with);
        Sensor::new(SensorConfig::default()).push(&packet, START_NS).unwrap_err()
    };
    assert_eq!(damaged(1205, &[0x99]).reason(), "model");
    assert_eq!(damaged(300, &[0x12, 0x34]).reason(), "block_flag");
    assert_eq!(damaged(502, &36_001_u16.to_le_bytes()).reason(), "azimuth");
    assert_eq!(
        damaged(502, &40_000_u16.to_le_bytes()).to_string(),
        "block 5 has azimuth 40000; 0 to 36000 hundredths of a degree are allowed"
    );
    for length in [0, 1, 511, 513, 1205, 1207, 1248, 65_507] {
        let refusal = Sensor::new(SensorConfig::default()).push(&vec![0; length], START_NS).unwrap_err();
        assert_eq!(refusal.reason(), "length", "{length}");
    }
}

#[test]
fn azimuth_36000_is_0_and_filler_returns_are_none() {
    let mut packet = Stream { start_azimuth: 0, ..Stream::of(Model::Vlp32c) }.packet(0);
    packet[2..4].copy_from_slice(&36_000_u16.to_le_bytes());
    for (index, raw) in [0_u16, 65_533, 65_534, 65_535].into_iter().enumerate() {
        packet[4 + 3 * index..6 + 3 * index].copy_from_slice(&raw.to_le_bytes());
    }
    let mut sensor = Sensor::new(SensorConfig::default());
    sensor.push(&packet, START_NS).unwrap();
    let turn = sensor.finish().unwrap();
    assert_eq!(turn.firings[0].azimuth_rad, 0.0);
    let echo: Vec<bool> = turn.echoes[0].range_m[..4].iter().map(|range| *range > 0.0).collect();
    assert_eq!(echo, [false, true, false, false]);
}

#[test]
fn a_table_of_another_sensor_is_refused_with_the_first_packet() {
    let calibration = Some(Calibration::factory(Model::Vlp16));
    let mut sensor = Sensor::new(SensorConfig { calibration, ..SensorConfig::default() });
    let refusal = sensor.push(&Stream::of(Model::Vlp32c).packet(0), START_NS).unwrap_err();
    assert_eq!(refusal.reason(), "calibration");
    assert_eq!(refusal.to_string(), "calibration: lasers: 16 of them, but a VLP-32C has 32");
}
