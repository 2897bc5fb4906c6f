//! Packets late, twice, lost, from a sensor that pauses, restarts, sees half its turn or changes its rate.

use clearway_lidar::{Model, Partial, ReturnMode, Revolution, Sensor, SensorConfig, SensorStatus};

use crate::stream::Stream;

fn sensor(model: Model) -> Sensor {
    Sensor::new(SensorConfig { model: Some(model), ..SensorConfig::default() })
}

/// Revolutions of packets of which none is refused, and the status at the end.
fn decode(model: Model, packets: &[(Vec<u8>, i64)]) -> (Vec<Revolution>, SensorStatus) {
    let mut sensor = sensor(model);
    let push = |(packet, arrival_ns): &(Vec<u8>, i64)| sensor.push(packet, *arrival_ns).unwrap().cloned();
    let mut turns: Vec<Revolution> = packets.iter().filter_map(push).collect();
    turns.extend(sensor.finish().cloned());
    (turns, sensor.status())
}

#[test]
fn a_packet_in_order_waits_for_nothing_and_one_behind_a_gap_until_it_is_filled() {
    let stream = Stream::of(Model::Vlp16);
    let mut sensor = sensor(Model::Vlp16);
    let held = |sensor: &Sensor| sensor.status().packets_held;
    stream.push(&mut sensor, 0..32);
    assert_eq!(held(&sensor), 32, "nobody knows yet whether packet 0 was the first");
    for index in 32..60 {
        stream.push(&mut sensor, [index]);
        assert_eq!(held(&sensor), 0, "{index}");
    }
    stream.push(&mut sensor, 61..70);
    assert_eq!(held(&sensor), 9);
    stream.push(&mut sensor, [60]);
    assert_eq!((held(&sensor), sensor.status().packets), (0, 70));
    // Packet 70 never comes: after 32 more the others go on.
    stream.push(&mut sensor, 71..103);
    assert_eq!(held(&sensor), 32);
    stream.push(&mut sensor, 103..104);
    assert!(held(&sensor) < 32, "one revolution a packet: what lies behind its cut goes on with the next");
    stream.push(&mut sensor, 104..105);
    assert_eq!((held(&sensor), sensor.status().packets_lost), (0, 1));
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
    // The S1's last bytes are text, not time.
    let packet = |index: usize| {
        let mut packet = stream.packet(index);
        packet[1200..].copy_from_slice(if index.is_multiple_of(2) { b"\x58\x02v25c" } else { b"\x00\x19DegC" });
        (packet, stream.arrival_ns(index))
    };
    let clean: Vec<_> = (0..stream.packets(2.3)).map(packet).collect();
    let (expected, _) = decode(Model::Hdl64eS1, &clean);
    let mut shuffled = clean.clone();
    shuffled.chunks_mut(20).for_each(|packets| packets.reverse());
    let (turns, status) = decode(Model::Hdl64eS1, &shuffled);
    assert_eq!((turns.len(), status.packets_lost), (expected.len(), 0));
    for (turn, expected) in turns.iter().zip(&expected) {
        assert!(
            turn.points().map(|p| (p.x, p.y, p.z, p.firing)).eq(expected.points().map(|p| (p.x, p.y, p.z, p.firing)))
        );
        assert_eq!((turn.partial, turn.packets), (expected.partial, expected.packets));
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
fn a_field_of_view_is_no_loss_whether_it_ends_inside_a_packet_or_between_two() {
    for model in [Model::Hdl64eS2, Model::Hdl32e, Model::Vlp16, Model::Vls128] {
        for (from, to) in [(9_000, 27_000), (4_000, 6_500), (30_000, 12_000)] {
            let stream = Stream::of(model);
            let lit =
                |azimuth: u32| if from < to { !(from..to).contains(&azimuth) } else { (to..from).contains(&azimuth) };
            let inside = stream.turning(stream.packets(4.0), |_| 600.0, lit);
            let (turns, status) = decode(model, &inside);
            assert_eq!(status.packets_lost, 0, "{model:?} {from} {to}");
            assert!(turns[2..].iter().all(|turn| turn.packets_expected == turn.packets), "{model:?} {from} {to}");

            let all = stream.turning(stream.packets(7.0), |_| 600.0, |_| true);
            let azimuth = |packet: &[u8]| u32::from(u16::from_le_bytes([packet[2], packet[3]]));
            let mut between: Vec<_> = all.into_iter().filter(|(packet, _)| lit(azimuth(packet))).collect();
            let (turns, status) = decode(model, &between);
            assert_eq!(status.packets_lost, 0, "{model:?} {from} {to}");
            assert!(turns[2..].iter().all(|turn| turn.packets_expected == turn.packets), "{model:?} {from} {to}");

            // Loss beside it is still loss.
            let seen = between.len() / 2;
            between.drain(seen..seen + 3);
            let (_, status) = decode(model, &between);
            assert!((2..=4).contains(&status.packets_lost), "{model:?} {from} {to}: {}", status.packets_lost);
        }
    }
}

#[test]
fn a_gap_that_does_not_come_back_was_loss() {
    let stream = Stream::of(Model::Vlp16);
    let mut sensor = sensor(Model::Vlp16);
    let mut turns = stream.push(&mut sensor, (0..150).filter(|index| !(90..120).contains(index)));
    assert_eq!(sensor.status().packets_lost, 0, "it may be a field of view");
    turns.extend(stream.push(&mut sensor, 150..250));
    assert_eq!(sensor.status().packets_lost, 30);
    let missing = turns.iter().map(|turn| turn.packets_expected - turn.packets).collect::<Vec<_>>();
    assert_eq!(missing, [0, 30, 0]);
}

#[test]
fn a_sensor_that_changes_its_rate_loses_nothing_and_turns_go_on() {
    for model in Model::ALL {
        let stream = Stream::of(model);
        for mode in [ReturnMode::Strongest, ReturnMode::Dual] {
            if mode == ReturnMode::Dual && !model.spec().dual_return {
                continue;
            }
            let stream = Stream { mode, ..stream };
            // 300 to 1200 and back within two seconds, and at once: what an S1 cannot do without seeming to lose a
            // packet.
            let smooth = |seconds: f64| 750.0 - 450.0 * (seconds * std::f64::consts::PI).cos();
            let sudden = |seconds: f64| if seconds % 1.0 < 0.5 { 300.0 } else { 1200.0 };
            let mut streams = vec![(stream.turning(stream.packets(20.0), smooth, |_| true), 0)];
            if model != Model::Hdl64eS1 {
                streams.push((stream.turning(stream.packets(20.0), sudden, |_| true), 6));
            }
            for (packets, broken_max) in streams {
                let (turns, status) = decode(model, &packets);
                assert_eq!(status.packets_lost, 0, "{model:?} {mode:?}");
                assert_eq!(
                    turns[1..turns.len() - 1].iter().filter(|turn| turn.packets_expected > turn.packets).count(),
                    0
                );
                // 750 a minute in the mean.
                assert!((24..=27).contains(&turns.len()), "{model:?} {mode:?}: {}", turns.len());
                let broken = turns[1..turns.len() - 1].iter().filter(|turn| turn.partial.is_some()).count();
                assert!(broken <= broken_max, "{model:?} {mode:?}: {broken} turns broken, {broken_max} allowed");
            }
        }
    }
}

#[test]
fn a_restart_costs_one_packet_and_cuts_the_turn() {
    for model in Model::ALL.into_iter().filter(|model| *model != Model::Hdl64eS1) {
        let before = Stream { device_us: 3_000_000_000, ..Stream::of(model) };
        let after = Stream { device_us: 0, start_azimuth: 1_234, ..before };
        let mut sensor = sensor(model);
        let half = before.packets(1.5);
        let mut turns = before.push(&mut sensor, 0..half);
        let refusal = sensor.push(&after.packet(0), before.arrival_ns(half)).unwrap_err();
        assert_eq!(refusal.reason(), "device_time", "{model:?}");
        let arrival_ns = |index| before.arrival_ns(half + index);
        for index in 1..after.packets(2.5) {
            turns.extend(sensor.push(&after.packet(index), arrival_ns(index)).unwrap().cloned());
        }
        assert_eq!(sensor.status().packets_lost, 0, "{model:?}");
        let partials: Vec<_> = turns.iter().map(|turn| turn.partial).collect();
        assert_eq!(partials[..4], [None, Some(Partial::Gap), Some(Partial::Gap), None], "{model:?}");
        assert!(turns.windows(2).all(|pair| pair[0].end_ns <= pair[1].start_ns), "{model:?}");
    }
}

#[test]
fn a_pause_of_the_network_is_loss_and_a_clock_that_was_set_is_not() {
    let stream = Stream::of(Model::Hdl32e);
    let mut sensor = sensor(Model::Hdl32e);
    stream.push(&mut sensor, 0..300);
    // 10,000 packets, 5.5 s.
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
fn one_packet_from_another_time_is_refused_and_the_stream_goes_on() {
    for device_us in [0, 1, 900_000_000, 1_990_000_000, 2_001_200_000, 3_599_999_999] {
        let stream = Stream::of(Model::Hdl64eS2);
        let mut sensor = sensor(Model::Hdl64eS2);
        let mut turns = stream.push(&mut sensor, 0..500);
        let stray = Stream { device_us, ..stream }.packet(0);
        assert_eq!(sensor.push(&stray, stream.arrival_ns(500)).unwrap_err().reason(), "device_time", "{device_us}");
        turns.extend(stream.push(&mut sensor, 500..1100));
        assert!(turns.iter().all(|turn| turn.partial.is_none()), "{device_us}");
        assert_eq!(sensor.status().packets_lost, 0);
    }
}

#[test]
fn the_hours_end_is_no_jump_even_out_of_order() {
    let stream = Stream { device_us: 3_599_990_000, ..Stream::of(Model::Vlp16) };
    let mut sensor = sensor(Model::Vlp16);
    let mut order: Vec<usize> = (0..300).collect();
    order.chunks_mut(16).for_each(|packets| packets.reverse());
    let turns = stream.push(&mut sensor, order);
    assert!(turns.iter().all(|turn| turn.partial.is_none()));
    assert_eq!((sensor.status().packets, sensor.status().packets_lost), (300, 0));
}

#[test]
fn whole_turns_lost_leave_no_turn_made_of_two() {
    let stream = Stream::of(Model::Vlp16);
    let mut sensor = sensor(Model::Vlp16);
    // 79 packets are one turn and 19 degrees: the azimuth alone would say that three were lost.
    let turns = stream.push(&mut sensor, (0..400).filter(|index| !(100..179).contains(index)));
    assert_eq!(turns[1].partial, Some(Partial::Gap));
    assert_eq!(turns[1].packets_expected - turns[1].packets, 79);
    assert!(turns.iter().all(|turn| turn.end_ns - turn.start_ns < 100_000_000));
    assert!(turns.iter().all(|turn| (turn.rpm - 600.0).abs() < 3.0));
}
