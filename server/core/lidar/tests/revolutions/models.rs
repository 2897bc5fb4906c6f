//! All models: identified from packets, decoded in each return mode, configured, and mixed.

use std::f64::consts::TAU;

use clearway_lidar::{Calibration, Model, ReturnMode, Sensor, SensorConfig, SensorStatus};

use crate::stream::{START_NS, Stream};

#[test]
fn every_model_is_identified_and_gives_complete_revolutions() {
    for model in Model::ALL {
        let stream = Stream::of(model);
        let mut sensor = Sensor::new(SensorConfig::default());
        let mut revolutions = stream.push(&mut sensor, 0..stream.packets(3.1));
        revolutions.extend(sensor.finish().cloned());
        // In single-return mode an S3 is identified as an S2 until its status bytes are complete.
        let found = if model == Model::Hdl64eS3 { Model::Hdl64eS2 } else { model };
        assert_eq!(sensor.status().model, Some(found));
        assert_eq!(revolutions.len(), 4, "{model:?}");
        let spec = model.spec();
        for revolution in &revolutions[..3] {
            assert_eq!(revolution.partial, None, "{model:?} {}", revolution.sequence);
            assert!(
                revolution.firings.len().abs_diff(spec.firings_per_revolution(stream.mode, 600.0)) <= 1,
                "{model:?}"
            );
            assert!((revolution.rpm - 600.0).abs() < 1.0, "{model:?} {}", revolution.rpm);
            assert_eq!(revolution.echoes.len(), 1);
            assert_eq!(revolution.returns(), revolution.firings.len() * spec.returns_per_firing());
            assert_eq!(revolution.points().count(), revolution.returns());
        }
        let firings: usize = revolutions.iter().map(|revolution| revolution.firings.len()).sum();
        assert_eq!(firings, stream.packets(3.1) * spec.firings_per_packet(stream.mode), "{model:?}: packets are lost");
        let status = sensor.status();
        assert_eq!(status.packets, stream.packets(3.1) as u64);
        assert_eq!(status.returns as usize, revolutions.iter().map(|revolution| revolution.returns()).sum::<usize>());
    }
}

#[test]
fn coordinates_follow_from_range_elevation_and_azimuth() {
    for model in Model::ALL {
        let stream = Stream::of(model);
        let calibration = Calibration::factory(model);
        let range_m = 5_000.0 * model.spec().distance_m_per_count;
        let mut sensor = Sensor::new(SensorConfig { model: Some(model), ..SensorConfig::default() });
        let revolution = stream.push(&mut sensor, 0..stream.packets(1.05)).remove(0);
        for point in revolution.points() {
            let laser = &calibration.lasers[usize::from(point.laser)];
            let encoder = f64::from(revolution.firings[point.firing as usize].azimuth_rad) - laser.rot_correction;
            let (x, y) = (f64::from(point.x), f64::from(point.y));
            assert!((f64::from(point.range_m) - range_m).abs() < 1e-5);
            assert!((f64::from(point.z) - range_m * laser.vert_correction.sin()).abs() < 1e-4);
            // Within a firing the sensor turns forward, by less than a quarter of a degree.
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
        let revolutions = stream.push(&mut sensor, 0..stream.packets(2.2));
        assert_eq!(sensor.status().model, Some(model));
        assert_eq!(sensor.status().return_mode, Some(ReturnMode::Dual));
        assert_eq!(revolutions.len(), 2, "{model:?}");
        let revolution = &revolutions[1];
        assert_eq!(revolution.partial, None, "{model:?}");
        let spec = model.spec();
        assert!(
            revolution.firings.len().abs_diff(spec.firings_per_revolution(ReturnMode::Dual, 600.0)) <= 1,
            "{model:?}"
        );
        let metres = spec.distance_m_per_count as f32;
        for slot in 0..revolution.firings.len() * revolution.lasers {
            assert!((revolution.echoes[0].range_m[slot] - 5_000.0 * metres).abs() < 1e-4, "{model:?}");
            assert!((revolution.echoes[1].range_m[slot] - 5_500.0 * metres).abs() < 1e-4, "{model:?}");
        }
        let types: Vec<u8> = revolution.points().take(2).map(|point| point.return_type).collect();
        assert_eq!(types, [1, 2]);
    }
}

#[test]
fn a_vlp16_with_the_byte_of_an_hdl32e_is_identified_by_its_rate() {
    let stream = Stream::of(Model::Vlp16);
    let early = |index| {
        let mut packet = stream.packet(index);
        packet[1205] = 0x21;
        packet
    };
    let mut sensor = Sensor::new(SensorConfig::default());
    assert!(sensor.push(&early(0), stream.arrival_ns(0)).unwrap().is_none());
    assert_eq!((sensor.status().model, sensor.status().packets_waiting), (None, 1));
    let mut firings = 0;
    for index in 1..stream.packets(1.5) {
        firings += sensor
            .push(&early(index), stream.arrival_ns(index))
            .unwrap()
            .map_or(0, |revolution| revolution.firings.len());
    }
    assert_eq!(sensor.status().model, Some(Model::Vlp16));
    firings += sensor.finish().map_or(0, |revolution| revolution.firings.len());
    assert_eq!(firings, stream.packets(1.5) * 24);
}

#[test]
fn a_foreign_packet_before_the_model_is_known_is_counted_as_unfit() {
    let stray = Stream::of(Model::Hdl32e).packet(0);
    // An S3 is identified as an S2 until its status table is complete.
    for model in Model::ALL.into_iter().filter(|model| *model != Model::Hdl64eS3) {
        let stream = Stream { start_azimuth: 17_000, device_us: 5_000_000, ..Stream::of(model) };
        let mut sensor = Sensor::new(SensorConfig::default());
        assert!(sensor.push(&stray, stream.arrival_ns(0)).unwrap().is_none());
        for index in 0..40 {
            sensor.push(&stream.packet(index), stream.arrival_ns(index)).unwrap();
        }
        let status = sensor.status();
        let of_stream = status.packets + status.packets_waiting as u64;
        assert_eq!((status.model, status.packets_unfit, of_stream), (Some(model), 1, 40), "{model:?}");
    }
}

#[test]
fn sixteen_packets_from_other_times_do_not_delay_the_stream() {
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
    assert_eq!((status.packets_unfit, status.packets + status.packets_waiting as u64), (16, 40));
}

#[test]
fn the_model_byte_decides_if_no_rate_confirms_it() {
    let stream = Stream::of(Model::Hdl32e);
    // Every third packet arrives: a period of 1,659 µs fits neither model.
    let mut sensor = Sensor::new(SensorConfig::default());
    stream.push(&mut sensor, (0..60).step_by(3));
    assert_eq!(sensor.status().model, Some(Model::Hdl32e));
    assert_eq!(sensor.status().packets + sensor.status().packets_waiting as u64, 20);
    let mut one = Sensor::new(SensorConfig::default());
    stream.push(&mut one, 0..1);
    assert_eq!(one.finish().unwrap().firings.len(), 12);
    assert!(one.finish().is_none());
}

#[test]
fn a_packet_of_another_model_is_refused_and_changes_nothing() {
    let stream = Stream::of(Model::Vlp32c);
    let mut sensor = Sensor::new(SensorConfig { model: Some(Model::Vls128), ..SensorConfig::default() });
    let error = sensor.push(&stream.packet(0), START_NS).unwrap_err();
    assert_eq!(error.reason(), "block_flag");
    assert_eq!(sensor.status(), SensorStatus { model: Some(Model::Vls128), ..SensorStatus::default() });

    let mut sensor = Sensor::new(SensorConfig::default());
    stream.push(&mut sensor, 0..10);
    let before = sensor.status();
    let error = sensor.push(&Stream::of(Model::PuckHiRes).packet(0), START_NS).unwrap_err();
    assert_eq!(error.reason(), "model");
    assert_eq!(error.to_string(), "model byte 0x24 from a VLP-32C; allowed: 0x28");
    assert_eq!(sensor.status(), before);
}

#[test]
fn unknown_bytes_flags_azimuths_and_lengths_are_refused_with_a_reason() {
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
        let error = Sensor::new(SensorConfig::default()).push(&vec![0; length], START_NS).unwrap_err();
        assert_eq!(error.reason(), "length", "{length}");
    }
}

#[test]
fn the_name_of_a_model_is_read_as_written() {
    for model in Model::ALL {
        assert_eq!(model.as_str().parse(), Ok(model));
        assert_eq!(serde_yaml_ng::to_string(&model).unwrap().trim(), model.as_str());
    }
    let error = "ouster".parse::<Model>().unwrap_err().to_string();
    assert!(error.starts_with("unknown sensor model `ouster`; known: hdl64e_s1, hdl64e_s2, "), "{error}");
}

#[test]
fn azimuth_36000_is_0_and_filler_is_not_a_return() {
    let mut packet = Stream { start_azimuth: 0, ..Stream::of(Model::Vlp32c) }.packet(0);
    packet[2..4].copy_from_slice(&36_000_u16.to_le_bytes());
    for (index, raw) in [0_u16, 65_533, 65_534, 65_535].into_iter().enumerate() {
        packet[4 + 3 * index..6 + 3 * index].copy_from_slice(&raw.to_le_bytes());
    }
    let mut sensor = Sensor::new(SensorConfig::default());
    sensor.push(&packet, START_NS).unwrap();
    let revolution = sensor.finish().unwrap();
    assert_eq!(revolution.firings[0].azimuth_rad, 0.0);
    let echo: Vec<bool> = revolution.echoes[0].range_m[..4].iter().map(|range| *range > 0.0).collect();
    assert_eq!(echo, [false, true, false, false]);
}

#[test]
fn a_calibration_of_another_model_refuses_the_first_packet() {
    let calibration = Some(Calibration::factory(Model::Vlp16));
    let mut sensor = Sensor::new(SensorConfig { calibration, ..SensorConfig::default() });
    let error = sensor.push(&Stream::of(Model::Vlp32c).packet(0), START_NS).unwrap_err();
    assert_eq!(error.reason(), "calibration");
    assert_eq!(error.to_string(), "calibration: lasers: 16 of them, but a VLP-32C has 32");
}

#[test]
fn lasers_fire_at_the_times_and_azimuths_of_the_manuals() {
    for (model, laser, offset_ns) in [
        (Model::Hdl64eS1, 63, 0),
        (Model::Hdl64eS2, 9, 13_260),
        (Model::Hdl64eS3, 39, 9_700),
        (Model::Vlp32c, 3, 2_304),
        (Model::Vls128, 63, 18_655),
        (Model::Vls128, 64, 26_650),
    ] {
        assert_eq!(model.spec().laser_offset_ns(laser), offset_ns, "{model:?} {laser}");
    }
    // The lowest lasers of the second and of the first pair of the lower block: 5.25 and -1.75 degrees.
    let lasers = Calibration::factory(Model::Hdl64eS2).lasers;
    let apart = (lasers[42].rot_correction - lasers[38].rot_correction).abs().to_degrees();
    assert!((apart - 7.0).abs() < 1e-3, "{apart}");
}
