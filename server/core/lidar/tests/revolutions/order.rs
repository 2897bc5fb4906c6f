//! Packets that are late, duplicated or lost, and sensors that pause, restart, have a field of view or change their
//! rate.

use clearway_lidar::{Model, Partial, ReturnMode, Revolution, Sensor, SensorConfig, SensorStatus};

use crate::stream::Stream;

fn sensor(model: Model) -> Sensor {
    Sensor::new(SensorConfig { model: Some(model), ..SensorConfig::default() })
}

/// Decodes packets, asserts that none is refused, and returns the revolutions and the status at the end.
fn decode(model: Model, packets: &[(Vec<u8>, i64)]) -> (Vec<Revolution>, SensorStatus) {
    let mut sensor = sensor(model);
    let push = |(packet, arrival_ns): &(Vec<u8>, i64)| sensor.push(packet, *arrival_ns).unwrap().cloned();
    let mut revolutions: Vec<Revolution> = packets.iter().filter_map(push).collect();
    revolutions.extend(sensor.finish().cloned());
    (revolutions, sensor.status())
}

#[test]
fn a_packet_waits_only_behind_a_gap_and_until_it_is_filled() {
    let stream = Stream::of(Model::Vlp16);
    let mut sensor = sensor(Model::Vlp16);
    let waiting = |sensor: &Sensor| sensor.status().packets_waiting;
    stream.push(&mut sensor, 0..32);
    assert_eq!(waiting(&sensor), 32, "it is unknown whether packet 0 is the first");
    for index in 32..60 {
        stream.push(&mut sensor, [index]);
        assert_eq!(waiting(&sensor), 0, "{index}");
    }
    stream.push(&mut sensor, 61..70);
    assert_eq!(waiting(&sensor), 9);
    stream.push(&mut sensor, [60]);
    assert_eq!((waiting(&sensor), sensor.status().packets), (0, 70));
    // Packet 70 never arrives: after 32 more packets the others pass.
    stream.push(&mut sensor, 71..103);
    assert_eq!(waiting(&sensor), 32);
    stream.push(&mut sensor, 103..104);
    assert!(waiting(&sensor) < 32, "a packet ends one revolution; packets behind its cut pass with the next packet");
    stream.push(&mut sensor, 104..105);
    assert_eq!((waiting(&sensor), sensor.status().packets_lost), (0, 1));
    let late = sensor.push(&stream.packet(70), stream.arrival_ns(104)).unwrap_err();
    assert_eq!(late.reason(), "late");
    assert_eq!(
        late.to_string(),
        "the packet of device time 2000092897 us, azimuth 15443 is 34 packets late; 32 are allowed"
    );
    let copy = sensor.push(&stream.packet(103), stream.arrival_ns(105)).unwrap_err();
    assert_eq!(copy.to_string(), "a copy of the packet of device time 2000136691 us, azimuth 31209");
}

#[test]
fn an_hdl64e_s1_without_time_is_put_in_order_by_azimuth() {
    let stream = Stream::of(Model::Hdl64eS1);
    // The last bytes of an S1 are text, not time.
    let packet = |index: usize| {
        let mut packet = stream.packet(index);
        packet[1200..].copy_from_slice(if index.is_multiple_of(2) { b"\x58\x02v25c" } else { b"\x00\x19DegC" });
        (packet, stream.arrival_ns(index))
    };
    let clean: Vec<_> = (0..stream.packets(2.3)).map(packet).collect();
    let (expected, _) = decode(Model::Hdl64eS1, &clean);
    let mut shuffled = clean.clone();
    shuffled.chunks_mut(20).for_each(|packets| packets.reverse());
    let (revolutions, status) = decode(Model::Hdl64eS1, &shuffled);
    assert_eq!((revolutions.len(), status.packets_lost), (expected.len(), 0));
    for (revolution, expected) in revolutions.iter().zip(&expected) {
        assert!(
            revolution
                .points()
                .map(|p| (p.x, p.y, p.z, p.firing))
                .eq(expected.points().map(|p| (p.x, p.y, p.z, p.firing)))
        );
        assert_eq!((revolution.partial, revolution.packets), (expected.partial, expected.packets));
    }
    let mut lossy = clean.clone();
    lossy.drain(300..340);
    lossy.drain(100..101);
    let (_, status) = decode(Model::Hdl64eS1, &lossy);
    assert_eq!(status.packets_lost, 41);

    let mut sensor = sensor(Model::Hdl64eS1);
    clean[..50].iter().for_each(|(packet, arrival_ns)| drop(sensor.push(packet, *arrival_ns).unwrap().cloned()));
    assert_eq!(sensor.push(&clean[48].0, clean[50].1).unwrap_err().reason(), "duplicate");
}

#[test]
fn a_field_of_view_gap_inside_or_between_packets_is_not_loss() {
    for model in [Model::Hdl64eS2, Model::Hdl32e, Model::Vlp16, Model::Vls128] {
        for (from, to) in [(9_000, 27_000), (4_000, 6_500), (30_000, 12_000)] {
            let stream = Stream::of(model);
            let visible =
                |azimuth: u32| if from < to { !(from..to).contains(&azimuth) } else { (to..from).contains(&azimuth) };
            let inside = stream.rotating(stream.packets(4.0), |_| 600.0, visible);
            let (revolutions, status) = decode(model, &inside);
            assert_eq!(status.packets_lost, 0, "{model:?} {from} {to}");
            assert!(
                revolutions[2..].iter().all(|revolution| revolution.packets_expected == revolution.packets),
                "{model:?} {from} {to}"
            );

            let all = stream.rotating(stream.packets(7.0), |_| 600.0, |_| true);
            let azimuth = |packet: &[u8]| u32::from(u16::from_le_bytes([packet[2], packet[3]]));
            let mut between: Vec<_> = all.into_iter().filter(|(packet, _)| visible(azimuth(packet))).collect();
            let (revolutions, status) = decode(model, &between);
            assert_eq!(status.packets_lost, 0, "{model:?} {from} {to}");
            assert!(
                revolutions[2..].iter().all(|revolution| revolution.packets_expected == revolution.packets),
                "{model:?} {from} {to}"
            );

            // Loss beside the gap is still loss.
            let seen = between.len() / 2;
            between.drain(seen..seen + 3);
            let (_, status) = decode(model, &between);
            assert!((2..=4).contains(&status.packets_lost), "{model:?} {from} {to}: {}", status.packets_lost);
        }
    }
}

#[test]
fn a_gap_that_the_next_revolution_does_not_repeat_is_loss() {
    let stream = Stream::of(Model::Vlp16);
    let mut sensor = sensor(Model::Vlp16);
    let mut revolutions = stream.push(&mut sensor, (0..150).filter(|index| !(90..120).contains(index)));
    assert_eq!(sensor.status().packets_lost, 0, "it may be a field-of-view gap");
    revolutions.extend(stream.push(&mut sensor, 150..250));
    assert_eq!(sensor.status().packets_lost, 30);
    let missing =
        revolutions.iter().map(|revolution| revolution.packets_expected - revolution.packets).collect::<Vec<_>>();
    assert_eq!(missing, [0, 30, 0]);
}

#[test]
fn a_change_of_the_rate_of_rotation_loses_no_packet() {
    for model in Model::ALL {
        let stream = Stream::of(model);
        for mode in [ReturnMode::Strongest, ReturnMode::Dual] {
            if mode == ReturnMode::Dual && !model.spec().dual_return {
                continue;
            }
            let stream = Stream { mode, ..stream };
            // The rate changes from 300 to 1,200 rpm and back within two seconds, or at once. An S1 has no time, so
            // that a sudden change looks like a lost packet.
            let smooth = |seconds: f64| 750.0 - 450.0 * (seconds * std::f64::consts::PI).cos();
            let sudden = |seconds: f64| if seconds % 1.0 < 0.5 { 300.0 } else { 1200.0 };
            let mut streams = vec![(stream.rotating(stream.packets(20.0), smooth, |_| true), 0)];
            if model != Model::Hdl64eS1 {
                streams.push((stream.rotating(stream.packets(20.0), sudden, |_| true), 6));
            }
            for (packets, broken_max) in streams {
                let (revolutions, status) = decode(model, &packets);
                assert_eq!(status.packets_lost, 0, "{model:?} {mode:?}");
                assert_eq!(
                    revolutions[1..revolutions.len() - 1]
                        .iter()
                        .filter(|revolution| revolution.packets_expected > revolution.packets)
                        .count(),
                    0
                );
                // The mean rate is 750 rpm.
                assert!((24..=27).contains(&revolutions.len()), "{model:?} {mode:?}: {}", revolutions.len());
                let broken = revolutions[1..revolutions.len() - 1]
                    .iter()
                    .filter(|revolution| revolution.partial.is_some())
                    .count();
                assert!(
                    broken <= broken_max,
                    "{model:?} {mode:?}: {broken} revolutions are partial, {broken_max} are allowed"
                );
            }
        }
    }
}

#[test]
fn a_restart_loses_one_packet_and_cuts_the_revolution() {
    for model in Model::ALL.into_iter().filter(|model| *model != Model::Hdl64eS1) {
        let before = Stream { device_us: 3_000_000_000, ..Stream::of(model) };
        let after = Stream { device_us: 0, start_azimuth: 1_234, ..before };
        let mut sensor = sensor(model);
        let half = before.packets(1.5);
        let mut revolutions = before.push(&mut sensor, 0..half);
        let error = sensor.push(&after.packet(0), before.arrival_ns(half)).unwrap_err();
        assert_eq!(error.reason(), "device_time", "{model:?}");
        let arrival_ns = |index| before.arrival_ns(half + index);
        for index in 1..after.packets(2.5) {
            revolutions.extend(sensor.push(&after.packet(index), arrival_ns(index)).unwrap().cloned());
        }
        assert_eq!(sensor.status().packets_lost, 0, "{model:?}");
        let partials: Vec<_> = revolutions.iter().map(|revolution| revolution.partial).collect();
        assert_eq!(partials[..4], [None, Some(Partial::Gap), Some(Partial::Gap), None], "{model:?}");
        assert!(revolutions.windows(2).all(|pair| pair[0].end_ns <= pair[1].start_ns), "{model:?}");
    }
}

#[test]
fn a_pause_of_the_network_is_loss_and_a_set_clock_is_not() {
    let stream = Stream::of(Model::Hdl32e);
    let mut sensor = sensor(Model::Hdl32e);
    stream.push(&mut sensor, 0..300);
    // The pause is 10,000 packets, 5.5 s.
    assert_eq!(sensor.push(&stream.packet(10_300), stream.arrival_ns(10_300)).unwrap_err().reason(), "device_time");
    stream.push(&mut sensor, 10_301..10_900);
    assert_eq!(sensor.status().packets_lost, 10_001);

    let set = Stream { device_us: stream.device_us + 100_000_000, ..stream };
    let mut sensor = self::sensor(Model::Hdl32e);
    stream.push(&mut sensor, 0..300);
    assert_eq!(sensor.push(&set.packet(300), stream.arrival_ns(300)).unwrap_err().reason(), "device_time");
    set.push(&mut sensor, 301..900);
    assert_eq!(sensor.status().packets_lost, 0);
}

#[test]
fn a_single_packet_from_another_time_is_refused() {
    for device_us in [0, 1, 900_000_000, 1_990_000_000, 2_001_200_000, 3_599_999_999] {
        let stream = Stream::of(Model::Hdl64eS2);
        let mut sensor = sensor(Model::Hdl64eS2);
        let mut revolutions = stream.push(&mut sensor, 0..500);
        let stray = Stream { device_us, ..stream }.packet(0);
        assert_eq!(sensor.push(&stray, stream.arrival_ns(500)).unwrap_err().reason(), "device_time", "{device_us}");
        revolutions.extend(stream.push(&mut sensor, 500..1100));
        assert!(revolutions.iter().all(|revolution| revolution.partial.is_none()), "{device_us}");
        assert_eq!(sensor.status().packets_lost, 0);
    }
}

#[test]
fn the_end_of_the_hour_is_not_a_jump() {
    let stream = Stream { device_us: 3_599_990_000, ..Stream::of(Model::Vlp16) };
    let mut sensor = sensor(Model::Vlp16);
    let mut order: Vec<usize> = (0..300).collect();
    order.chunks_mut(16).for_each(|packets| packets.reverse());
    let revolutions = stream.push(&mut sensor, order);
    assert!(revolutions.iter().all(|revolution| revolution.partial.is_none()));
    assert_eq!((sensor.status().packets, sensor.status().packets_lost), (300, 0));
}

#[test]
fn a_lost_revolution_does_not_join_its_neighbours() {
    let stream = Stream::of(Model::Vlp16);
    let mut sensor = sensor(Model::Vlp16);
    // 79 packets are one revolution and 19 degrees: by azimuth alone, three packets were lost.
    let revolutions = stream.push(&mut sensor, (0..400).filter(|index| !(100..179).contains(index)));
    assert_eq!(revolutions[1].partial, Some(Partial::Gap));
    assert_eq!(revolutions[1].packets_expected - revolutions[1].packets, 79);
    assert!(revolutions.iter().all(|revolution| revolution.end_ns - revolution.start_ns < 100_000_000));
    assert!(revolutions.iter().all(|revolution| (revolution.rpm - 600.0).abs() < 3.0));
}
