//! The calibration table in the status bytes of an HDL-64E S2 or S3.

use clearway_lidar::calibration::status_table::{PACKETS_PER_TABLE, StatusTable, status_bytes};
use clearway_lidar::{Calibration, CalibrationSource, Model, Sensor, SensorConfig};

use crate::stream::Stream;

/// A table that differs from the factory table, rounded to hundredths of a degree and millimetres.
fn own_table() -> Calibration {
    let mut calibration = Calibration::factory(Model::Hdl64eS2);
    for (index, laser) in calibration.lasers.iter_mut().enumerate() {
        let near = index as f64 * 0.001;
        laser.vert_correction += 0.003;
        laser.dist_correction = 1.2 + near;
        (laser.dist_correction_x, laser.dist_correction_y) = (Some(1.25 - near), Some(1.26));
        (laser.vert_offset_correction, laser.horiz_offset_correction) = (0.2, -0.026);
        (laser.focal_distance, laser.focal_slope) = (Some(-1.5), Some(1.3));
        (laser.min_intensity, laser.max_intensity) = (Some(40), Some(255));
    }
    let sent = status_bytes(Model::Hdl64eS2, &calibration);
    read(&sent).expect("a complete table").1
}

fn read(sent: &[(u8, u8)]) -> Option<(Model, Calibration)> {
    let mut table = StatusTable::default();
    sent.iter().chain(&sent[..16]).find_map(|status| table.push(*status))
}

#[test]
fn a_table_in_status_bytes_is_read_as_sent_with_its_model() {
    let calibration = own_table();
    assert!((calibration.lasers[63].dist_correction - 1.263).abs() < 1e-9);
    assert!(calibration.lasers.iter().all(|laser| laser.two_pt_correction_available));
    for model in [Model::Hdl64eS2, Model::Hdl64eS3] {
        let sent = status_bytes(model, &calibration);
        assert_eq!(sent.len(), PACKETS_PER_TABLE);
        assert_eq!(read(&sent), Some((model, calibration.clone())));
    }
}

#[test]
fn a_table_with_a_lost_packet_or_a_wrong_byte_is_not_used() {
    let sent = status_bytes(Model::Hdl64eS3, &own_table());
    for lost in [0, 9, 100, 2_000, PACKETS_PER_TABLE - 1] {
        let mut holed = sent.clone();
        holed.remove(lost);
        assert_eq!(read(&holed), None, "packet {lost}");
    }
    for wrong in [9, 60, 1_000, 4_000] {
        let mut damaged = sent.clone();
        let at = (wrong..).find(|at| matches!(at % 16, 10..=15)).unwrap();
        damaged[at].1 ^= 0x10;
        let read = read(&damaged);
        assert!(read.is_none() || at > 4_000, "status {at}: {:?}", read.map(|(model, _)| model));
    }
}

#[test]
fn the_table_in_the_status_bytes_applies_from_the_next_revolution() {
    let calibration = own_table();
    for (model, start) in [(Model::Hdl64eS2, 0), (Model::Hdl64eS3, 1_234)] {
        let stream = Stream::of(model);
        let sent = status_bytes(model, &calibration);
        let with_status = |index: usize| {
            let mut packet = stream.packet(index);
            (packet[1204], packet[1205]) = sent[(index + start) % sent.len()];
            packet
        };
        let mut sensor = Sensor::new(SensorConfig::default());
        let mut revolutions = Vec::new();
        for index in 0..2 * PACKETS_PER_TABLE + stream.packets(2.0) {
            revolutions.extend(sensor.push(&with_status(index), stream.arrival_ns(index)).unwrap().cloned());
        }
        let status = sensor.status();
        assert_eq!((status.model, status.calibration), (Some(model), CalibrationSource::StatusBytes));
        let (first, last) = (revolutions.first().unwrap(), revolutions.last().unwrap());
        assert_eq!(*first.calibration, Calibration::factory(Model::Hdl64eS2));
        assert_eq!(*last.calibration, calibration);
        // All points of a revolution are from one table.
        for revolution in &revolutions {
            let expected = revolution.calibration.lasers[7].dist_correction as f32 + 10.0;
            assert!(
                revolution.echoes[0].range_m.iter().skip(7).step_by(64).all(|range| (range - expected).abs() < 1e-4)
            );
        }

        let configured = Some(Calibration::factory(model));
        let mut sensor = Sensor::new(SensorConfig { calibration: configured, ..SensorConfig::default() });
        (0..5_000).for_each(|index| drop(sensor.push(&with_status(index), stream.arrival_ns(index)).unwrap().cloned()));
        assert_eq!(sensor.status().calibration, CalibrationSource::Configured);
    }
}
