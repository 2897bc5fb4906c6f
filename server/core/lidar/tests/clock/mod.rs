//! Stamps: they rise within an epoch, and after an event of any clock they are right again one revolution later, or
//! half a second later if they must go back.

mod drawn;
mod scripts;

use clearway_lidar::{Clock, DatagramError, Model, Revolution, Sensor, SensorConfig};
use proptest::collection::vec;
use proptest::prelude::*;

use self::scripts::*;
use crate::stream::Stream;
use crate::telemetry::datagram;

fn with_device_us(mut packet: Vec<u8>, device_us: u32) -> Vec<u8> {
    packet[1200..1204].copy_from_slice(&device_us.to_le_bytes());
    packet
}

/// Pushes a packet and returns the revolution that it completes. Copies, late packets, and the first packet of another
/// time are refused.
fn push<'a>(sensor: &'a mut Sensor, packet: &[u8], arrival_ns: i64) -> Option<&'a Revolution> {
    match sensor.push(packet, arrival_ns) {
        Ok(revolution) => revolution,
        Err(DatagramError::DeviceTime { .. } | DatagramError::Late { .. } | DatagramError::Duplicate { .. }) => None,
        Err(error) => panic!("{error}"),
    }
}

/// All revolutions of a script.
fn play(script: &Script, sensor: &mut Sensor) -> Vec<Revolution> {
    play_timed(script, sensor).into_iter().map(|(revolution, _)| revolution).collect()
}

/// All revolutions of a script, each with the time of the packet that completed it. Telemetry is sent 50 times per
/// second.
fn play_timed(script: &Script, sensor: &mut Sensor) -> Vec<(Revolution, i64)> {
    let stream = Stream::of(Model::Vlp16);
    let period = i64::from(Model::Vlp16.spec().packet_period_ns(stream.mode));
    let mut revolutions = Vec::new();
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
        revolutions.extend(push(sensor, &packet, arrival(t + period)).map(|revolution| (revolution.clone(), t)));
    }
    revolutions
}

fn past_hour_us(script: &Script, t: i64) -> u32 {
    let us = (script.device_ns)(t) / 1_000;
    // During a leap second the counter goes on past the hour.
    if (3_600_000_000..3_601_000_000).contains(&us) { us as u32 } else { (us % 3_600_000_000) as u32 }
}

fn assert_rising(name: &str, revolutions: &[Revolution]) {
    for pair in revolutions.windows(2) {
        let (goes_back, epochs) = (pair[0].end_ns >= pair[1].start_ns, pair[1].epoch - pair[0].epoch);
        assert_eq!(epochs, u32::from(goes_back), "{name}: revolution {}", pair[1].sequence);
    }
    for revolution in revolutions {
        assert!(revolution.start_ns < revolution.end_ns, "{name}: revolution {}", revolution.sequence);
        assert!(
            revolution.firings.windows(2).all(|pair| pair[0].offset_ns < pair[1].offset_ns),
            "{name}: {}",
            revolution.sequence
        );
    }
}

#[test]
fn stamps_rise_and_are_right_one_revolution_after_an_event() {
    for script in scripts() {
        let (revolutions, done): (Vec<_>, Vec<_>) =
            play_timed(&script, &mut Sensor::new(SensorConfig::default())).into_iter().unzip();
        let name = script.name;
        assert_rising(name, &revolutions);
        assert!(
            revolutions.len() as i64 >= (script.lasts_ns - script.silence_ns) / REVOLUTION - 1,
            "{name}: {} revolutions",
            revolutions.len()
        );
        for (index, (revolution, done)) in revolutions.iter().zip(done).enumerate() {
            // A jump of device time tears a revolution in two. The end of a complete revolution shows its place.
            let t = (done + REVOLUTION / 2) / REVOLUTION * REVOLUTION - REVOLUTION;
            let torn = revolution.partial.is_some() && (0..=REVOLUTION).contains(&(done - script.event_ns));
            let healing = (script.event_ns - REVOLUTION..script.event_ns + script.healed_ns).contains(&t);
            if torn || healing {
                continue;
            }
            let error_ns = revolution.start_ns - (script.utc_ns + t + (script.right_ns)(t));
            assert!(error_ns.abs() <= script.tolerance_ns, "{name}: revolution {index} is {error_ns} ns off");
        }
        let last = revolutions.last().unwrap();
        assert_eq!((last.clock, last.epoch), (script.last, script.epochs), "{name}");
    }
}

#[test]
fn without_epochs_stamps_never_go_back() {
    let config = SensorConfig { ahead_ns_max: 0, ..SensorConfig::default() };
    let free = Script { device_ns: FREE, telemetry: SILENT, lasts_ns: 4 * S, ..BASE };
    for host_ns in [|t| after(t, -HOUR, 0), |t| after(t, -2 * S, 0)] {
        let revolutions = play(&Script { host_ns, ..free }, &mut Sensor::new(config.clone()));
        assert_rising("without epochs", &revolutions);
        let last = revolutions.last().unwrap();
        assert_eq!((last.clock, last.epoch), (Clock::Holdover, 0));
    }
}

#[test]
fn old_gps_time_is_used_if_the_configuration_allows_it() {
    let config = SensorConfig { gps_late_ns_max: 100 * 365 * 24 * HOUR, ..SensorConfig::default() };
    let script = Script { name: "an old capture", host_ns: |_| 20_000 * HOUR, ..BASE };
    let revolutions = play(&script, &mut Sensor::new(config.clone()));
    assert!(
        revolutions.iter().all(|revolution| revolution.clock == Clock::Gps)
            && (revolutions[0].start_ns - NOON).abs() < 1_000_000
    );
    // If GPS time is behind stamps already given, the stamps follow arrival.
    let script = Script { telemetry: |t| after(t, gps(NOON + t), None), ..script };
    let revolutions = play(&script, &mut Sensor::new(config));
    assert_rising(script.name, &revolutions);
    let last = revolutions.last().unwrap();
    assert_eq!((last.clock, last.clock_offset_ms), (Clock::Device, 0));
}

#[test]
fn a_revolution_has_the_clock_offset_of_the_host() {
    let offset = |host_ns| {
        let revolutions = play(&Script { host_ns, ..BASE }, &mut Sensor::new(SensorConfig::default()));
        revolutions.last().unwrap().clock_offset_ms
    };
    assert_eq!(offset(|_| 0), 0);
    assert_eq!(offset(|t| after(t, HOUR, 0)), 3_600_000);
    assert_eq!(offset(|_| -250_000_000), -250);
}

#[test]
fn two_sensors_in_different_hours_have_the_same_time() {
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

/// All revolutions of an HDL-64E over the end of a day. Its receiver is in state `gps`; the host is 3 h and 100 s
/// ahead.
fn hdl64e(gps: u8) -> Vec<Revolution> {
    let utc_ns = MIDNIGHT + 24 * HOUR - S / 2;
    let stream = Stream { device_us: (utc_ns / 1_000 % 3_600_000_000) as u32, ..Stream::of(Model::Hdl64eS2) };
    let period = i64::from(Model::Hdl64eS2.spec().packet_period_ns(stream.mode));
    let mut sensor = Sensor::new(SensorConfig { model: Some(Model::Hdl64eS2), ..SensorConfig::default() });
    let mut revolutions = Vec::new();
    for index in 0..stream.packets(15.2) {
        let t = index as i64 * period;
        // The sensor reads each byte from its clock when it sends it, so that a cycle may contain two seconds.
        let second = (utc_ns + t - MIDNIGHT - 300_000_000) / S;
        let of_day = second % 86_400;
        let day = if second < 86_400 { 18 } else { 19 };
        let cycle = [of_day / 3_600, of_day / 60 % 60, of_day % 60, day, 5, 33, i64::from(gps), 25, 0x47];
        let mut packet = stream.packet(index);
        let status = b"HMSDNYGTV1234567"[index % 16];
        (packet[1204], packet[1205]) = (status, cycle.get(index % 16).map_or(0, |value| *value as u8));
        revolutions.extend(push(&mut sensor, &packet, utc_ns + t + period + 3 * HOUR + 100 * S).cloned());
    }
    let first = revolutions.iter().map(|revolution| revolution.start_ns - utc_ns).next().unwrap();
    assert!([0, 3 * HOUR + 100 * S].iter().any(|right_ns| (first - right_ns).abs() < 1_000_000), "{gps}: {first}");
    assert_rising("HDL-64E", &revolutions);
    let lasted_ns = revolutions.last().unwrap().end_ns - revolutions[0].start_ns;
    assert!((lasted_ns - revolutions.len() as i64 * REVOLUTION).abs() < 1_000_000, "{gps}: {lasted_ns}");
    revolutions
}

#[test]
fn the_status_bytes_of_an_hdl64e_give_gps_time() {
    for (gps, clock) in [(b'A', Clock::Gps), (b'V', Clock::GpsUnlocked), (b'P', Clock::Arrival), (0, Clock::Arrival)] {
        let revolutions = hdl64e(gps);
        assert!(
            revolutions.len() >= 14 && revolutions.iter().all(|revolution| revolution.clock == clock),
            "{gps}: {:?}",
            revolutions[0].clock
        );
        let is_gps = clock != Clock::Arrival;
        assert_eq!(revolutions[0].start_ns < MIDNIGHT + 24 * HOUR, is_gps, "{gps}");
    }
}

// To save time, only every 20th packet of three minutes is pushed.
#[test]
fn a_device_that_drifts_by_100_ppm_stays_within_12_ms_of_arrival() {
    let stream = Stream::of(Model::Vlp16);
    let period = i64::from(Model::Vlp16.spec().packet_period_ns(stream.mode));
    for ppm in [-100, 100] {
        let mut sensor = Sensor::new(SensorConfig { model: Some(Model::Vlp16), ..SensorConfig::default() });
        let (mut revolutions, mut worst_ns) = (Vec::new(), 0);
        for index in (0..stream.packets(1_800.0)).step_by(20) {
            let t = index as i64 * period;
            let packet = with_device_us(stream.packet(index), (FREE(t + t / 1_000_000 * ppm) / 1_000) as u32);
            if let Some(revolution) = sensor.push(&packet, NOON + t + period).unwrap().cloned() {
                // At 600 rpm the azimuth gives the true time within the revolution.
                let turned_deg = revolution.firings.last().unwrap().azimuth_rad.to_degrees() - 180.0;
                let true_ns = NOON + (f64::from(turned_deg) / 360.0 * REVOLUTION as f64) as i64;
                let error_ns = (revolution.end_ns - true_ns + REVOLUTION / 2).rem_euclid(REVOLUTION) - REVOLUTION / 2;
                worst_ns = worst_ns.max(error_ns.abs());
                revolutions.push(revolution);
            }
        }
        assert_rising("drift", &revolutions);
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
            let mut revolutions = Vec::new();
            for index in 0..packets {
                let mut packet = stream.packet(index);
                if wild(index) && model != Model::Hdl64eS1 {
                    packet = with_device_us(packet, (index as u32).wrapping_mul(2_654_435_761));
                }
                revolutions.extend(push(&mut sensor, &packet, stream.arrival_ns(index) + late_ns(index)).cloned());
            }
            revolutions
                .iter()
                .map(|revolution| (revolution.start_ns, revolution.end_ns, revolution.clock))
                .collect::<Vec<_>>()
        };
        let clean = stamps(|_| 0, |_| false);
        assert!(clean.len() >= 20);
        // Jitter of up to 7 ms, but none for some packets; a burst of 100 packets that arrive together.
        let jitter = |index: usize| if index % 50 == 7 { 0 } else { (index as i64 * 7_919 % 7_001) * 1_000 };
        let burst = |index: usize| if (400..500).contains(&index) { (500 - index as i64) * 300_000 } else { 0 };
        assert_eq!(stamps(jitter, |_| false), clean, "{model:?}");
        assert_eq!(stamps(burst, |_| false), clean, "{model:?}");
        // A packet with a damaged device time is refused. If it is the first or last of a revolution, the stamps differ
        // by a packet.
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
    fn stamps_rise_for_any_times(
        timed in any::<bool>(),
        events in vec((0..5_u8, any::<u32>(), any::<i64>(), 0..86_400_i64, 0..2_000_i64), 1..150),
    ) {
        let model = if timed { Model::Vlp16 } else { Model::Hdl64eS1 };
        let stream = Stream::of(model);
        let mut sensor = Sensor::new(SensorConfig { model: Some(model), ..SensorConfig::default() });
        let (mut newest_ns, mut epoch, mut index, mut device_us, mut arrival_ns) = (i64::MIN, 0, 0, 0_u32, NOON);
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
                if let Some(revolution) = push(&mut sensor, &packet, arrival_ns) {
                    let goes_back = newest_ns >= revolution.start_ns;
                    let (start_ns, expected) = (revolution.start_ns, epoch + u32::from(goes_back));
                    prop_assert!(revolution.epoch == expected, "{newest_ns} {start_ns}");
                    prop_assert!(revolution.start_ns <= revolution.end_ns);
                    (newest_ns, epoch) = (revolution.end_ns, revolution.epoch);
                }
            }
        }
    }
}
