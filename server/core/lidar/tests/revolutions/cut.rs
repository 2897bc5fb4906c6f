//! Cuts, gaps, reversals, fields of view, sensors that stand still, and the end of the hour.

use clearway_lidar::model::AZIMUTHS_PER_REVOLUTION;
use clearway_lidar::{Model, Partial, ReturnMode, Sensor, SensorConfig};

use crate::stream::{START_NS, Stream};
use crate::telemetry;

#[test]
fn revolutions_are_cut_between_firings_at_the_configured_azimuth() {
    for cut_azimuth_deg in [0.0, 0.01, 90.0, 179.99, 180.0, 359.99] {
        for model in Model::ALL {
            let stream = Stream { start_azimuth: 4_321, ..Stream::of(model) };
            let mut sensor = Sensor::new(SensorConfig { cut_azimuth_deg, ..SensorConfig::default() });
            let revolutions = stream.push(&mut sensor, 0..stream.packets(3.0));
            assert!(revolutions.len() >= 2, "{model:?} {cut_azimuth_deg}");
            assert_eq!(revolutions[0].partial, Some(Partial::Start));
            for revolution in &revolutions[1..] {
                assert_eq!(revolution.partial, None);
                let past_cut = |firing: usize| {
                    (revolution.firings[firing].azimuth_rad.to_degrees() - cut_azimuth_deg + 360.0005) % 360.0
                };
                assert!(past_cut(0) < 0.25, "{model:?} {cut_azimuth_deg} {}", past_cut(0));
                assert!(past_cut(revolution.firings.len() - 1) > 359.75, "{model:?} {cut_azimuth_deg}");
                assert_eq!(revolution.echoes[0].range_m.len(), revolution.firings.len() * revolution.lasers);
                assert_eq!(revolution.echoes[0].intensity.len(), revolution.firings.len() * revolution.lasers);
            }
            assert!(revolutions.windows(2).all(|pair| pair[0].sequence + 1 == pair[1].sequence));
        }
    }
}

#[test]
fn the_last_revolution_is_partial_unless_the_stream_ends_at_the_cut() {
    let stream = Stream::of(Model::Vlp16);
    let mut sensor = Sensor::new(SensorConfig::default());
    stream.push(&mut sensor, 0..stream.packets(0.5));
    assert_eq!(sensor.finish().unwrap().partial, Some(Partial::End));
    assert!(sensor.finish().is_none());

    let stream = Stream::of(Model::Hdl32e);
    let mut sensor = Sensor::new(SensorConfig::default());
    // 181 packets are 2,172 firings: a revolution has 2,171, and the last one belongs to the next.
    let revolution = stream.push(&mut sensor, 0..181).remove(0);
    assert_eq!((revolution.firings.len(), revolution.partial), (2_171, None));
}

#[test]
fn one_lost_packet_makes_a_revolution_of_any_model_partial() {
    for mode in [ReturnMode::Strongest, ReturnMode::Dual] {
        for model in Model::ALL.into_iter().filter(|model| mode == ReturnMode::Strongest || model.spec().dual_return) {
            let stream = Stream { mode, ..Stream::of(model) };
            for lost in [20, 50, stream.packets(0.7)] {
                let mut sensor = Sensor::new(SensorConfig::default());
                let revolutions = stream.push(&mut sensor, (0..stream.packets(2.1)).filter(|index| *index != lost));
                assert_eq!(revolutions[0].partial, Some(Partial::Gap), "{model:?} {mode:?} packet {lost}");
                assert_eq!(revolutions[1].partial, None, "{model:?} {mode:?} packet {lost}");
            }
        }
    }
}

#[test]
fn a_field_of_view_of_180_degrees_gives_complete_revolutions() {
    let stream = Stream { start_azimuth: 9_000, ..Stream::of(Model::Vlp16) };
    let ahead = |index: &usize| {
        let packet = stream.packet(*index);
        !(9_000..27_000).contains(&u16::from_le_bytes([packet[2], packet[3]]))
    };
    let mut sensor = Sensor::new(SensorConfig::default());
    let revolutions = stream.push(&mut sensor, (0..stream.packets(6.2)).filter(ahead));
    assert!(revolutions.len() >= 5, "{}", revolutions.len());
    // The first field-of-view gap, which is between these two, may be loss.
    assert_eq!((revolutions[0].fov_gap_rad, revolutions[1].partial), (None, Some(Partial::Gap)));
    for revolution in &revolutions[2..] {
        assert_eq!((revolution.partial, revolution.packets), (None, revolution.packets_expected));
        assert_eq!(revolution.firings.len(), revolution.firings_expected as usize);
        let [from, to] = revolution.fov_gap_rad.unwrap().map(f32::to_degrees);
        // A packet is 4.8 degrees long.
        assert!((from - 90.0).abs() < 5.0 && (to - 270.0).abs() < 5.0, "{from} {to}");
        assert!((revolution.rpm - 600.0).abs() < 3.0, "{}", revolution.rpm);
    }
}

/// A packet whose blocks all have the same azimuth.
fn still(stream: &Stream) -> Vec<u8> {
    let mut packet = stream.packet(0);
    (0..12).for_each(|block| packet[block * 100 + 2..block * 100 + 4].copy_from_slice(&[0, 1]));
    packet
}

#[test]
fn a_sensor_that_stands_still_does_not_fill_the_memory() {
    let stream = Stream::of(Model::Hdl64eS2);
    let still = still(&stream);
    let mut sensor = Sensor::new(SensorConfig::default());
    let mut lengths = Vec::new();
    for index in 0..10_000 {
        if let Some(revolution) = sensor.push(&stream.at_time_of(index, &still), stream.arrival_ns(index)).unwrap() {
            assert!(matches!(revolution.partial, Some(Partial::Start | Partial::Overlong)));
            lengths.push(revolution.firings.len());
        }
    }
    // The limit is 12,500, and a packet has at most 24 firings.
    assert!(!lengths.is_empty() && lengths.iter().all(|length| (12_476..=12_500).contains(length)), "{lengths:?}");
}

#[test]
fn a_pause_of_more_than_a_second_ends_the_revolution_of_a_sensor_that_stands_still() {
    let stream = Stream::of(Model::Vlp16);
    let still = still(&stream);
    let packet_ns = stream.model.spec().packet_period_ns(stream.mode) as usize;
    for (pause_ms, is_long) in [(500, false), (990, false), (1_010, true), (1_500, true), (3_000, true)] {
        let resumed = 50 + pause_ms * 1_000_000 / packet_ns;
        let mut sensor = Sensor::new(SensorConfig::default());
        let (mut ended, mut refused) = (Vec::new(), 0);
        for index in (0..50).chain(resumed..resumed + 50) {
            match sensor.push(&stream.at_time_of(index, &still), stream.arrival_ns(index)) {
                Ok(done) => ended.extend(done.map(|revolution| (revolution.firings.len(), revolution.partial))),
                Err(_) => refused += 1,
            }
        }
        // The first packet after a long pause is refused until the second one confirms its device time.
        let expected = if is_long { vec![(50 * 24, Some(Partial::Start))] } else { Vec::new() };
        assert_eq!((ended, refused), (expected, usize::from(is_long)), "{pause_ms} ms");
    }
}

#[test]
fn azimuths_in_disorder_cut_at_most_one_revolution_per_packet() {
    let stream = Stream::of(Model::Vlp16);
    let mut packet = stream.packet(0);
    for block in 0..12 {
        let azimuth = (block as u32 * 14_000 % AZIMUTHS_PER_REVOLUTION) as u16;
        packet[block * 100 + 2..block * 100 + 4].copy_from_slice(&azimuth.to_le_bytes());
    }
    let mut sensor = Sensor::new(SensorConfig::default());
    let mut firings = 0;
    for index in 0..50 {
        let revolution = sensor.push(&stream.at_time_of(index, &packet), stream.arrival_ns(index)).unwrap();
        firings += revolution.map_or(0, |revolution| revolution.firings.len());
    }
    firings += sensor.finish().map_or(0, |revolution| revolution.firings.len());
    assert_eq!(firings, 50 * 24);
}

#[test]
fn stamps_continue_over_the_end_of_the_hour() {
    let mut stream = Stream::of(Model::Hdl32e);
    stream.device_us = 3_599_900_000;
    let mut sensor = Sensor::new(SensorConfig::default());
    let revolutions = stream.push(&mut sensor, 0..stream.packets(4.1));
    assert_eq!(revolutions.len(), 4);
    for (index, pair) in revolutions.windows(2).enumerate() {
        let between_ns = pair[1].start_ns - pair[0].start_ns;
        assert!((between_ns - 100_000_000).abs() < 60_000, "{index}: {between_ns}");
        assert!(pair[0].end_ns < pair[1].start_ns);
    }
}

#[test]
fn stamps_follow_the_device_if_it_agrees_with_utc_else_arrival() {
    let stream = Stream::of(Model::Hdl32e);
    let mut sensor = Sensor::new(SensorConfig::default());
    let revolutions = stream.push(&mut sensor, 0..stream.packets(1.1));
    assert_eq!(revolutions[0].start_ns, START_NS);

    let boot = Stream { device_us: 1_000_000, ..stream };
    let mut sensor = Sensor::new(SensorConfig::default());
    let revolutions = boot.push(&mut sensor, 0..stream.packets(1.1));
    assert!((revolutions[0].start_ns - START_NS).abs() < 1_000, "{}", revolutions[0].start_ns - START_NS);
}

#[test]
fn telemetry_changes_no_stamp_of_a_sensor_without_device_time() {
    let stream = Stream::of(Model::Hdl64eS1);
    let mut sensor = Sensor::new(SensorConfig { model: Some(Model::Hdl64eS1), ..SensorConfig::default() });
    let sentence = telemetry::with_sum("GPRMC,120000,A,4807.0380,N,01131.0000,E,022.4,084.4,010126,003.1,W");
    assert!(sensor.push(&telemetry::datagram(5, &sentence), START_NS).unwrap().is_none());
    let revolutions = stream.push(&mut sensor, 0..stream.packets(1.1));
    assert!((revolutions[0].start_ns - START_NS).abs() < 1_000_000_000, "{}", revolutions[0].start_ns);
}

#[test]
fn a_change_of_return_mode_ends_the_revolution() {
    let single = Stream::of(Model::Vlp16);
    let dual = Stream { mode: ReturnMode::Dual, start_azimuth: 0, ..single };
    let mut sensor = Sensor::new(SensorConfig::default());
    assert!(single.push(&mut sensor, 0..40).is_empty());
    let revolutions = dual.push(&mut sensor, 80..81);
    assert_eq!((revolutions[0].echoes.len(), revolutions[0].partial), (1, Some(Partial::End)));
    let revolutions = dual.push(&mut sensor, 81..500);
    assert!(revolutions.iter().all(|revolution| revolution.echoes.len() == 2));
}
