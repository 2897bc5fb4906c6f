//! Telemetry datagrams, valid and damaged.

use clearway_lidar::nmea::NmeaError;
use clearway_lidar::telemetry::{Pps, Telemetry};
use clearway_lidar::{DatagramError, Model, Sensor, SensorConfig};

use crate::stream::{START_NS, Stream};

const SENTENCE: &str = "$GPRMC,214106,A,3707.8178,N,12139.2690,W,010.3,188.2,230715,013.8,E,D*05\r\n";

pub fn datagram(device_us: u32, sentence: &str) -> Vec<u8> {
    let mut bytes = vec![0; 512];
    bytes[198..202].copy_from_slice(&device_us.to_le_bytes());
    bytes[202] = 2;
    bytes[206..206 + sentence.len()].copy_from_slice(sentence.as_bytes());
    bytes
}

pub fn with_sum(text: &str) -> String {
    format!("${text}*{:02X}\r\n", text.bytes().fold(0, |sum, byte| sum ^ byte))
}

#[test]
fn a_fix_is_read_to_the_last_field() {
    let telemetry = Telemetry::new(&datagram(2_467_110_195, SENTENCE)).unwrap();
    assert_eq!((telemetry.device_us, telemetry.pps), (2_467_110_195, Pps::Locked));
    let fix = telemetry.gprmc.unwrap();
    assert!(fix.valid);
    assert_eq!(fix.utc_ns, Some(1_437_687_666_000_000_000));
    assert!((fix.latitude_deg.unwrap() - 37.130_296_667).abs() < 1e-9);
    assert!((fix.longitude_deg.unwrap() + 121.654_483_333).abs() < 1e-9);
    assert_eq!((fix.speed_knots, fix.course_deg), (Some(10.3), Some(188.2)));
    assert!((fix.speed_mps().unwrap() - 5.298_78).abs() < 1e-4);
    let with_fraction = with_sum(&SENTENCE[1..SENTENCE.len() - 5].replace("214106", "214106.25"));
    let fix = Telemetry::new(&datagram(0, &with_fraction)).unwrap().gprmc.unwrap();
    assert_eq!(fix.utc_ns, Some(1_437_687_666_250_000_000));
}

#[test]
fn telemetry_without_receiver_or_fix_is_accepted() {
    assert_eq!(Telemetry::new(&datagram(0, "")).unwrap().gprmc, None);
    let fix = Telemetry::new(&datagram(0, &with_sum("GPRMC,,V,,,,,,,,,,N"))).unwrap().gprmc.unwrap();
    assert!(!fix.valid && fix.utc_ns.is_none() && fix.latitude_deg.is_none());
}

#[test]
fn random_bytes_of_the_length_of_telemetry_are_refused() {
    let mut state = 12_u64;
    let mut random = || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 56) as u8
    };
    let mut sensor = Sensor::new(SensorConfig::default());
    for _ in 0..20_000 {
        let mut payload: Vec<u8> = (0..512).map(|_| random()).collect();
        // Every second one states no sentence.
        payload[206] &= 0x0d * u8::from(payload[0].is_multiple_of(2));
        assert!(sensor.push(&payload, START_NS).is_err());
    }
    assert_eq!(sensor.status().telemetry, 0);
    let mut empty = datagram(3_601_000_000, "");
    assert!(matches!(Telemetry::new(&empty), Err(DatagramError::Telemetry { device_us: 3_601_000_000 })));
    empty[201] = 0;
    assert!(Telemetry::new(&empty).is_ok());
}

#[test]
fn a_damaged_sentence_is_refused_as_nmea_with_the_wrong_value() {
    let error_of = |sentence: &str| match Telemetry::new(&datagram(0, sentence)).unwrap_err() {
        error @ DatagramError::Nmea(_) => (error.reason(), error.to_string()),
        other => panic!("{other}"),
    };
    let flipped = SENTENCE.replace("3707", "3708");
    assert_eq!(error_of(&flipped), ("nmea", "telemetry: checksum `05`; 0A is right".into()));
    for (text, named) in [
        ("GPGGA,1", "RMC"),
        ("GPRMC,254106,A,,,,,,,230715", "time: `254106`"),
        ("GPRMC,214106,A,,,,,,,231315", "date: `231315`"),
        ("GPRMC,214106,X", "status: `X`"),
        ("GPRMC,214106,A,9107.8178,N", "latitude: `9107.8178`"),
        ("GPRMC,214106,A,3707.8178,Q", "latitude: `3707.8178,Q`"),
        ("GPRMC,214106,A,3760.0000,N", "latitude: `3760.0000`; it must be degrees and minutes below 60"),
        ("GPRMC,214106,A,3707.8178,N,01199.9999,E", "longitude: `01199.9999`"),
        ("GPRMC,216006,A,,,,,,,230715", "time: `216006`"),
        ("GPRMC,2141067,A,,,,,,,230715", "time: `2141067`"),
        ("GPRMC,214161,A,,,,,,,230715", "time: `214161`"),
        ("GPRMC,214106,A,,,,,,,310615", "date: `310615`"),
        ("GPRMC,214106,A,,,,,,,290215", "date: `290215`"),
        ("GPRMC,214106,A,,,,,fast", "speed: `fast`"),
        ("GPRMC,2141,A,,,,,,,230715", "time: `2141`"),
        ("GPRMC,214106.5e300,A,,,,,,,230715", "time: `214106.5e300`"),
    ] {
        let (_, shown) = error_of(&with_sum(text));
        assert!(shown.contains(named), "{text}: {shown}");
    }
    assert!(error_of("GPRMC").1.contains("RMC"));
    assert!(matches!(
        Telemetry::new(&datagram(0, "$GPRMC\u{7f}")).unwrap_err(),
        DatagramError::Nmea(NmeaError::Byte { byte: 0x7F, at: 6 })
    ));
}

#[test]
fn gprmc_gives_the_hour_and_a_refused_datagram_changes_nothing() {
    // The device's time agrees with GPRMC, while the host's clock is in another hour.
    let past_hour_us = 41 * 60_000_000 + 7_100_000;
    let stream = Stream { device_us: past_hour_us, ..Stream::of(Model::Vlp16) };
    let utc_ns = 1_437_687_660_000_000_000 + 7_100_000_000;
    let arrival_ns = |index| utc_ns + stream.arrival_ns(index) - START_NS + 3 * 3_600_000_000_000;
    let mut sensor = Sensor::new(SensorConfig::default());
    let before = sensor.status();
    assert!(sensor.push(&datagram(past_hour_us, &SENTENCE.replace("*05", "*06")), arrival_ns(0)).is_err());
    assert_eq!(sensor.status(), before);
    assert!(sensor.push(&datagram(past_hour_us, SENTENCE), arrival_ns(0)).unwrap().is_none());
    assert_eq!((sensor.status().telemetry, sensor.status().pps), (1, Some(Pps::Locked)));
    let push =
        |index| sensor.push(&stream.packet(index), arrival_ns(index)).unwrap().map(|revolution| revolution.start_ns);
    assert_eq!((0..stream.packets(1.1)).find_map(push), Some(utc_ns));
}

#[test]
fn without_epochs_stamps_ahead_of_gps_run_at_half_speed_until_gps_catches_up() {
    // The stream starts without GPS, and the host is 9 s ahead of the device's hour; then GPRMC sets stamps 9 s back.
    let utc_past_hour_us = 41 * 60_000_000 + 7_100_000;
    let stream = Stream { device_us: utc_past_hour_us, ..Stream::of(Model::Vlp16) };
    let arrival_ns = |index| 1_437_687_667_250_000_000 + stream.arrival_ns(index) - START_NS + 9_000_000_000;
    let mut sensor = Sensor::new(SensorConfig { ahead_ns_max: 0, ..SensorConfig::default() });
    let mut revolutions = Vec::new();
    for index in 0..stream.packets(1.6) {
        revolutions.extend(sensor.push(&stream.packet(index), arrival_ns(index)).unwrap().cloned());
    }
    sensor.push(&datagram(utc_past_hour_us, SENTENCE), 0).unwrap();
    for index in stream.packets(1.6)..stream.packets(200.0) {
        revolutions.extend(sensor.push(&stream.packet(index), arrival_ns(index)).unwrap().cloned());
    }
    assert!(revolutions.windows(2).all(|pair| pair[0].end_ns <= pair[1].start_ns));
    let last = revolutions.last().unwrap();
    let utc_ns = 1_437_687_667_100_000_000 + last.sequence as i64 * 100_000_000;
    assert!((last.start_ns - utc_ns).abs() < 1_000_000, "{}", last.start_ns - utc_ns);
}
