//! Scripts of what happens to clocks: stamps always rise, and are right again one turn later.

use clearway_lidar::{Clock, Model, Refusal, Revolution, Sensor, SensorConfig};
use proptest::collection::vec;
use proptest::prelude::*;

use crate::clock_scripts::*;
use crate::stream::Stream;
use crate::telemetry::datagram;

fn with_device_us(mut packet: Vec<u8>, device_us: u32) -> Vec<u8> {
    packet[1200..1204].copy_from_slice(&device_us.to_le_bytes());
    packet
}

/// The turn a packet completes. The first packet of another time is refused until the next one confirms it, and copies
/// are.
fn take<'a>(sensor: &'a mut Sensor, packet: &[u8], arrival_ns: i64) -> Option<&'a Revolution> {
    match sensor.push(packet, arrival_ns) {
        Ok(turn) => turn,
        Err(Refusal::DeviceTime { .. } | Refusal::Late { .. } | Refusal::Duplicate { .. }) => None,
        Err(refusal) => panic!("{refusal}"),
    }
}

/// Every turn of a script.
fn play(script: &Script, sensor: &mut Sensor) -> Vec<Revolution> {
    play_timed(script, sensor).into_iter().map(|(turn, _)| turn).collect()
}

/// Every turn of a script, and when the packet came that completed it; telemetry 50 times a second.
fn play_timed(script: &Script, sensor: &mut Sensor) -> Vec<(Revolution, i64)> {
    let stream = Stream::of(Model::Vlp16);
    let period = i64::from(Model::Vlp16.spec().packet_period_ns(stream.mode));
    let mut turns = Vec::new();
    let mut telemetry_ns = 0;
    for (index, t) in (0..script.lasts_ns).step_by(period as usize).enumerate() {
        let arrival = |t: i64| script.utc_ns + t + (script.host_ns)(t);
        if (script.event_ns..script.event_ns + script.silence_ns).contains(&t) {
            telemetry_ns = t;
            continue;
        }
        if t >= telemetry_ns {
            if let Some((pps, sentence)) = (script.telemetry)(telemetry_ns) {
                let mut payload = datagram(past_hour_us(script, telemetry_ns), &sentence);
                payload[202] = pps;
                assert!(sensor.push(&payload, arrival(telemetry_ns)).unwrap().is_none());
            }
            telemetry_ns += S / 50;
        }
        let packet = with_device_us(stream.packet(index), past_hour_us(script, t));
        turns.extend(take(sensor, &packet, arrival(t + period)).map(|turn| (turn.clone(), t)));
    }
    turns
}

fn past_hour_us(script: &Script, t: i64) -> u32 {
    let us = (script.device_ns)(t) / 1_000;
    // A leap second is told as it is counted; all else past the hour.
    if (3_600_000_000..3_601_000_000).contains(&us) { us as u32 } else { (us % 3_600_000_000) as u32 }
}

fn assert_rising(name: &str, turns: &[Revolution]) {
    for pair in turns.windows(2) {
        assert!(pair[0].end_ns < pair[1].start_ns, "{name}: turn {}", pair[1].sequence);
    }
    for turn in turns {
        assert!(turn.start_ns < turn.end_ns, "{name}: turn {}", turn.sequence);
        assert!(turn.firings.windows(2).all(|pair| pair[0].offset_ns < pair[1].offset_ns), "{name}: {}", turn.sequence);
    }
}

#[test]
fn stamps_rise_and_are_right_again_one_turn_after_whatever_happens_to_a_clock() {
    for script in scripts() {
        let (turns, done): (Vec<_>, Vec<_>) =
            play_timed(&script, &mut Sensor::new(SensorConfig::default())).into_iter().unzip();
        let name = script.name;
        assert_rising(name, &turns);
        assert!(
            turns.len() as i64 >= (script.lasts_ns - script.silence_ns) / TURN - 1,
            "{name}: {} turns",
            turns.len()
        );
        for (index, (turn, done)) in turns.iter().zip(done).enumerate() {
            // Where the device's time jumps, a turn is torn in two: the whole ones are told by when they ended.
            let t = (done + TURN / 2) / TURN * TURN - TURN;
            let torn = turn.partial.is_some() && (0..=TURN).contains(&(done - script.event_ns));
            let healing = (script.event_ns - TURN..script.event_ns + script.healed_ns).contains(&t);
            if torn || healing {
                continue;
            }
            let error_ns = turn.start_ns - (script.utc_ns + t + (script.right_ns)(t));
            assert!(error_ns.abs() <= script.tolerance_ns, "{name}: turn {index} is {error_ns} ns off");
        }
        assert_eq!(turns.last().unwrap().clock, script.last, "{name}");
    }
}

#[test]
fn gps_time_of_years_ago_is_believed_where_the_configuration_says_so() {
    let config = SensorConfig { gps_late_ns_max: 100 * 365 * 24 * HOUR, ..SensorConfig::default() };
    let script = Script { name: "an old capture", host_ns: |_| 20_000 * HOUR, ..BASE };
    let turns = play(&script, &mut Sensor::new(config.clone()));
    assert!(turns.iter().all(|turn| turn.clock == Clock::Gps) && (turns[0].start_ns - NOON).abs() < 1_000_000);
    // Behind stamps already given it is no use: they follow arrival.
    let script = Script { telemetry: |t| after(t, gps(NOON + t), None), ..script };
    let turns = play(&script, &mut Sensor::new(config));
    assert_rising(script.name, &turns);
    let last = turns.last().unwrap();
    assert_eq!((last.clock, last.clock_offset_ms), (Clock::Device, 0));
}

#[test]
fn the_turn_says_how_far_the_host_is_from_its_clock() {
    let offset = |host_ns| {
        let turns = play(&Script { host_ns, ..BASE }, &mut Sensor::new(SensorConfig::default()));
        turns.last().unwrap().clock_offset_ms
    };
    assert_eq!(offset(|_| 0), 0);
    assert_eq!(offset(|t| after(t, HOUR, 0)), 3_600_000);
    assert_eq!(offset(|_| -250_000_000), -250);
}

#[test]
fn two_sensors_on_different_hours_give_one_time() {
    let gps = play(
        &Script { utc_ns: LATE, device_ns: |t| LATE + t, telemetry: |t| gps(LATE + t), ..BASE },
        &mut Sensor::new(SensorConfig::default()),
    );
    let free = play(
        &Script { utc_ns: LATE, device_ns: FREE, telemetry: SILENT, ..BASE },
        &mut Sensor::new(SensorConfig::default()),
    );
    assert_eq!((gps[5].clock, free[5].clock), (Clock::Gps, Clock::Arrival));
    for (gps, free) in gps.iter().zip(&free) {
        assert!((gps.start_ns - free.start_ns).abs() < 2_000, "{}", gps.start_ns - free.start_ns);
    }
}

/// The turns of an HDL-64E that ends an hour and a day, its receiver in state `gps`; the host is 3 h and 100 s ahead.
fn hdl64e(gps: u8) -> Vec<Revolution> {
    let utc_ns = MIDNIGHT + 24 * HOUR - S / 2;
    let stream = Stream { device_us: (utc_ns / 1_000 % 3_600_000_000) as u32, ..Stream::of(Model::Hdl64eS2) };
    let period = i64::from(Model::Hdl64eS2.spec().packet_period_ns(stream.mode));
    let mut sensor = Sensor::new(SensorConfig { model: Some(Model::Hdl64eS2), ..SensorConfig::default() });
    let mut turns = Vec::new();
    for index in 0..stream.packets(15.2) {
        let t = index as i64 * period;
        // Each byte is read from the clock when it is sent, so that a cycle may hold two seconds' parts.
        let second = (utc_ns + t - MIDNIGHT - 300_000_000) / S;
        let of_day = second % 86_400;
        let day = if second < 86_400 { 18 } else { 19 };
        let cycle = [of_day / 3_600, of_day / 60 % 60, of_day % 60, day, 5, 33, i64::from(gps), 25, 0x47];
        let mut packet = stream.packet(index);
        let status = b"HMSDNYGTV1234567"[index % 16];
        (packet[1204], packet[1205]) = (status, cycle.get(index % 16).map_or(0, |value| *value as u8));
        turns.extend(take(&mut sensor, &packet, utc_ns + t + period + 3 * HOUR + 100 * S).cloned());
    }
    let first = turns.iter().map(|turn| turn.start_ns - utc_ns).next().unwrap();
    assert!([0, 3 * HOUR + 100 * S].iter().any(|right_ns| (first - right_ns).abs() < 1_000_000), "{gps}: {first}");
    assert_rising("HDL-64E", &turns);
    let lasted_ns = turns.last().unwrap().end_ns - turns[0].start_ns;
    assert!((lasted_ns - turns.len() as i64 * TURN).abs() < 1_000_000, "{gps}: {lasted_ns}");
    turns
}

#[test]
fn an_hdl64e_tells_gps_time_by_its_status_bytes() {
    for (gps, clock) in [(b'A', Clock::Gps), (b'V', Clock::GpsUnlocked), (b'P', Clock::Arrival), (0, Clock::Arrival)] {
        let turns = hdl64e(gps);
        assert!(turns.len() >= 14 && turns.iter().all(|turn| turn.clock == clock), "{gps}: {:?}", turns[0].clock);
        let is_gps = clock != Clock::Arrival;
        assert_eq!(turns[0].start_ns < MIDNIGHT + 24 * HOUR, is_gps, "{gps}");
    }
}

/// Every 20th packet of three minutes.
#[test]
fn a_device_that_drifts_by_100_ppm_stays_within_12_ms_of_arrival() {
    let stream = Stream::of(Model::Vlp16);
    let period = i64::from(Model::Vlp16.spec().packet_period_ns(stream.mode));
    for ppm in [-100, 100] {
        let mut sensor = Sensor::new(SensorConfig { model: Some(Model::Vlp16), ..SensorConfig::default() });
        let (mut turns, mut worst_ns) = (Vec::new(), 0);
        for index in (0..stream.packets(1_800.0)).step_by(20) {
            let t = index as i64 * period;
            let packet = with_device_us(stream.packet(index), (FREE(t + t / 1_000_000 * ppm) / 1_000) as u32);
            if let Some(turn) = sensor.push(&packet, NOON + t + period).unwrap().cloned() {
                // At 600 rpm the azimuth tells the true time within the turn.
                let turned_deg = turn.firings.last().unwrap().azimuth_rad.to_degrees() - 180.0;
                let true_ns = NOON + (f64::from(turned_deg) / 360.0 * TURN as f64) as i64;
                let error_ns = (turn.end_ns - true_ns + TURN / 2).rem_euclid(TURN) - TURN / 2;
                worst_ns = worst_ns.max(error_ns.abs());
                turns.push(turn);
            }
        }
        assert_rising("drift", &turns);
        assert!((5_000_000..12_000_000).contains(&worst_ns), "{ppm} ppm: {worst_ns}");
    }
}

#[test]
fn jitter_bursts_and_wild_device_times_change_no_stamp() {
    for model in [Model::Vlp16, Model::Hdl32e, Model::Hdl64eS1] {
        let stream = Stream { device_us: 500_000_000, ..Stream::of(model) };
        let packets = stream.packets(20.5);
        let stamps = |late_ns: fn(usize) -> i64, wild: fn(usize) -> bool| {
            let mut sensor = Sensor::new(SensorConfig { model: Some(model), ..SensorConfig::default() });
            let mut turns = Vec::new();
            for index in 0..packets {
                let mut packet = stream.packet(index);
                if wild(index) && model != Model::Hdl64eS1 {
                    packet = with_device_us(packet, (index as u32).wrapping_mul(2_654_435_761));
                }
                turns.extend(take(&mut sensor, &packet, stream.arrival_ns(index) + late_ns(index)).cloned());
            }
            turns.iter().map(|turn| (turn.start_ns, turn.end_ns, turn.clock)).collect::<Vec<_>>()
        };
        let clean = stamps(|_| 0, |_| false);
        assert!(clean.len() >= 20);
        // Late by up to 7 ms, now and then not at all; 100 packets in a row that come at once.
        let jitter = |index: usize| if index % 50 == 7 { 0 } else { (index as i64 * 7_919 % 7_001) * 1_000 };
        let burst = |index: usize| if (400..500).contains(&index) { (500 - index as i64) * 300_000 } else { 0 };
        assert_eq!(stamps(jitter, |_| false), clean, "{model:?}");
        assert_eq!(stamps(burst, |_| false), clean, "{model:?}");
        // A packet whose device time is damaged is refused: where it would have begun or ended a turn, the next one
        // does.
        let packet_ns = model.spec().packet_period_ns(stream.mode) as u64;
        for (wild, clean) in stamps(|_| 0, |index| index % 90 == 60).iter().zip(&clean) {
            assert!(
                wild.0.abs_diff(clean.0) <= packet_ns && wild.1.abs_diff(clean.1) <= packet_ns,
                "{model:?} {wild:?} {clean:?}"
            );
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 64, ..ProptestConfig::default() })]

    #[test]
    fn whatever_the_times_stamps_rise(
        timed in any::<bool>(),
        events in vec((0..5_u8, any::<u32>(), any::<i64>(), 0..86_400_i64, 0..2_000_i64), 1..150),
    ) {
        let model = if timed { Model::Vlp16 } else { Model::Hdl64eS1 };
        let stream = Stream::of(model);
        let mut sensor = Sensor::new(SensorConfig { model: Some(model), ..SensorConfig::default() });
        let (mut newest_ns, mut index, mut device_us, mut arrival_ns) = (i64::MIN, 0, 0_u32, NOON);
        for (kind, us, ns, second, near) in events {
            match kind {
                0 => device_us = us,
                1 => arrival_ns = ns,
                2 => arrival_ns = arrival_ns.saturating_add((near - 1_000) * 5_000_000),
                3 => {
                    let date = format!("{:02}{:02}{:02}", 1 + us % 28, 1 + us % 12, us % 100);
                    let text = rmc(second, if near % 9 == 0 { 'V' } else { 'A' }, &date);
                    device_us = ((second * 1_000_000 + near * 1_000) % 3_600_000_000) as u32;
                    let mut payload = datagram(device_us, &text);
                    payload[202] = (near % 5) as u8;
                    prop_assert!(sensor.push(&payload, arrival_ns).unwrap().is_none());
                }
                _ => {}
            }
            for _ in 0..40 {
                index += 1;
                device_us = device_us.wrapping_add(1_327);
                arrival_ns = arrival_ns.saturating_add(1_327_000);
                let packet = with_device_us(stream.packet(index), device_us);
                if let Some(turn) = take(&mut sensor, &packet, arrival_ns) {
                    prop_assert!(newest_ns < turn.start_ns, "{newest_ns} {}", turn.start_ns);
                    prop_assert!(turn.start_ns <= turn.end_ns);
                    newest_ns = turn.end_ns;
                }
            }
        }
    }
}
