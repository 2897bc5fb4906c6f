//! An HDL-32E on a moving car compared with velodyne-decoder, and one packet of another HDL-32E.

use clearway_lidar::{Clock, Model, Revolution, Sensor, SensorConfig};

use crate::world::{against, archive, data, decode_capture, distance_m, points, spread};

const CAPTURE: &str = "pcap/rust-lidar-utils/hdl32_example.pcap";

#[test]
#[cfg_attr(not(clearway_data), ignore = "needs the recorded drives: set CLEARWAY_DATA")]
fn an_hdl32e_decodes_as_in_velodyne_decoder_echo_by_echo() {
    let (revolutions, sensor) = decode_capture(SensorConfig::default(), CAPTURE);
    let status = sensor.status();
    assert_eq!((status.model, status.packets, status.telemetry), (Some(Model::Hdl32e), 876, 100));
    assert!((status.rpm.unwrap() - 703.0).abs() < 3.0, "{:?}", status.rpm);
    let (errors, first) =
        against(&points(&revolutions), &archive::reference("ref/rust-lidar-utils__hdl32_example.npz"));
    assert_eq!(first, 0);
    let (median, greatest) = spread("HDL-32E against velodyne-decoder", errors);
    assert!(median < 0.01 && greatest < 0.03, "{median} m, {greatest} m");
}

#[test]
#[cfg_attr(not(clearway_data), ignore = "needs the recorded drives: set CLEARWAY_DATA")]
fn stamps_of_an_hdl32e_follow_gprmc() {
    let (revolutions, sensor) = decode_capture(SensorConfig::default(), CAPTURE);
    let fix = sensor.status().gprmc.unwrap();
    assert!((fix.speed_mps().unwrap() - 14.8).abs() < 0.5);
    assert!(revolutions.windows(2).all(|pair| pair[0].end_ns < pair[1].start_ns));
    // The device time of the first packet is 164,473,090 µs past 22 h on 11 December 2012.
    assert_eq!(revolutions[0].start_ns, 1_355_263_200_000_000_000 + 164_473_090_000);
    assert!(revolutions.iter().all(|revolution| revolution.clock == Clock::Gps));
    // The clock of the recording host was 0.9 s ahead.
    assert!(revolutions.iter().all(|revolution| (904..=905).contains(&revolution.clock_offset_ms)));
}

#[test]
#[cfg_attr(not(clearway_data), ignore = "needs the recorded drives: set CLEARWAY_DATA")]
fn a_packet_has_the_382_points_that_foxglove_finds() {
    let mut sensor = Sensor::new(SensorConfig::default());
    let packet = std::fs::read(data("pcap/single/foxglove_HDL32E_PACKET1.bin")).unwrap();
    assert!(sensor.push(&packet, 0).unwrap().is_none());
    let points: Vec<_> = sensor.finish().map(Revolution::points).unwrap().collect();
    assert_eq!(points.len(), 382);
    let first = [points[0].x, points[0].y, points[0].z];
    assert!(distance_m(first, [-1.550_485_7, 1.439_792, -1.254_827_9]) < 1e-6, "{first:?}");
}
