//! Scripts that are drawn: whatever the clocks of device, host and receiver do, ten seconds later maps are fresh again,
//! or GPS has vouched for stamps that the host contradicts.

use clearway_lidar::{Clock, Model, Sensor, SensorConfig};
use proptest::collection::vec;
use proptest::prelude::*;

use super::scripts::*;
use super::{push, with_device_us};
use crate::stream::Stream;
use crate::telemetry::datagram;

const DAY: i64 = 24 * HOUR;
/// Time after which stamps must be right.
const HEALED: i64 = 10 * S;
/// Age of a map of right stamps by the host's clock, at most: whole hours of the device are 250 ms off, and a
/// revolution is complete when the next one begins.
const FRESH: std::ops::Range<i64> = -260_000_000..290_000_000;

/// What the device's counter does.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Device {
    /// It shows the minutes and seconds of UTC, ahead by so many ns.
    Utc(i64),
    /// It counts from its start.
    Free,
    /// It shows the same time in each packet.
    Stands,
    /// It shows another minute after every seventh packet.
    Random,
}

/// What the clocks do for some seconds.
#[derive(Clone, Debug)]
struct Span {
    lasts_ns: i64,
    /// The step of the host's clock at the beginning, and its drift.
    host_step_ns: i64,
    host_ppm: i64,
    device: Device,
    /// The time of the receiver less UTC; `None` without telemetry.
    gps_ahead_ns: Option<i64>,
    is_valid: bool,
}

/// A time of any magnitude from 10 ms to a day, forward or back.
fn step() -> impl Strategy<Value = i64> {
    let some = (10_000_000_f64.ln()..(DAY as f64).ln(), any::<bool>());
    let some = some.prop_map(|(ln, is_back)| if is_back { -ln.exp() as i64 } else { ln.exp() as i64 });
    prop_oneof![2 => Just(0), 1 => some, 1 => -600_000_000..600_000_000_i64]
}

fn device() -> impl Strategy<Value = Device> {
    let set = (-600_000_000..600_000_000_i64).prop_map(Device::Utc);
    let standing = prop_oneof![Just(Device::Stands), Just(Device::Random)];
    prop_oneof![3 => Just(Device::Utc(0)), 1 => set, 2 => Just(Device::Free), 1 => standing]
}

fn span(lasts_s: std::ops::Range<i64>) -> impl Strategy<Value = Span> {
    let wrong = (-30..30_i64).prop_map(|hours| Some(hours * HOUR));
    let telemetry = prop_oneof![2 => Just(None), 2 => Just(Some(0)), 2 => wrong];
    let one_of_four = prop_oneof![3 => Just(true), 1 => Just(false)];
    (lasts_s, step(), -2_000..2_000_i64, device(), telemetry, one_of_four).prop_map(
        |(seconds, host_step_ns, host_ppm, device, gps_ahead_ns, is_valid)| Span {
            // The shortest is a single datagram of telemetry.
            lasts_ns: (seconds * S).max(20_000_000),
            host_step_ns,
            host_ppm,
            device,
            gps_ahead_ns,
            is_valid,
        },
    )
}

fn sentence(utc_ns: i64, is_valid: bool) -> String {
    let second = (utc_ns - MIDNIGHT - 300_000_000).div_euclid(S);
    let day = 18 + second.div_euclid(86_400);
    rmc(second.rem_euclid(86_400), if is_valid { 'A' } else { 'V' }, &format!("{day:02}0533"))
}

/// A revolution, the true time when it is complete, ns, and its age by the host's clock then.
fn play(spans: &[Span]) -> Vec<(clearway_lidar::Revolution, i64, i64)> {
    let stream = Stream::of(Model::Vlp16);
    let period = i64::from(Model::Vlp16.spec().packet_period_ns(stream.mode));
    let mut sensor = Sensor::new(SensorConfig { model: Some(Model::Vlp16), ..SensorConfig::default() });
    let mut revolutions = Vec::new();
    let (mut host_ns, mut begin, mut index) = (0, 0, 0);
    for span in spans {
        host_ns += span.host_step_ns;
        let mut telemetry_ns = begin;
        let mut t = begin;
        while t < begin + span.lasts_ns {
            index += 1;
            t = index as i64 * period;
            let host = |t: i64| NOON + t + host_ns + (t - begin) / 1_000_000 * span.host_ppm;
            let device_ns = match span.device {
                Device::Utc(ahead_ns) => NOON + t + ahead_ns,
                Device::Free => FREE(t),
                Device::Stands => FREE(begin),
                Device::Random => NOON + index as i64 / 7 * 2_654_435_761 % 3_600 * S,
            };
            let device_us = (device_ns / 1_000 % 3_600_000_000) as u32;
            if t >= telemetry_ns
                && let Some(ahead_ns) = span.gps_ahead_ns
            {
                telemetry_ns = t + S / 10;
                let mut payload = datagram(device_us, &sentence(NOON + t + ahead_ns, span.is_valid));
                payload[202] = 2;
                assert!(sensor.push(&payload, host(t)).unwrap().is_none());
            }
            let packet = with_device_us(stream.packet(index), device_us);
            if let Some(revolution) = push(&mut sensor, &packet, host(t + period)).cloned() {
                let age_ns = host(t + period) - revolution.end_ns;
                revolutions.push((revolution, t, age_ns));
            }
        }
        host_ns += span.lasts_ns / 1_000_000 * span.host_ppm;
        begin = t;
    }
    revolutions
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 48, ..ProptestConfig::default() })]

    #[test]
    fn maps_are_fresh_ten_seconds_after_any_script_of_the_clocks(
        before in vec(span(0..4), 0..4),
        last in span(14..15),
    ) {
        let last = Span { host_ppm: last.host_ppm / 20, ..last };
        let spans: Vec<_> = before.iter().cloned().chain([last.clone()]).collect();
        let revolutions = play(&spans);
        prop_assume!(last.device != Device::Random);
        let wrong_ns: i64 = before.iter().map(|span| span.lasts_ns).sum();
        let vouches = |span: &Span| span.gps_ahead_ns.is_some() && span.is_valid && span.lasts_ns >= S;
        let has_gps = spans.iter().any(vouches);
        for pair in revolutions.windows(2) {
            let [(before, ..), (next, ..)] = pair else { continue };
            let epochs = before.epoch + u32::from(before.end_ns >= next.start_ns);
            prop_assert_eq!(next.epoch, epochs, "revolution {}: {:#?}", next.sequence, spans);
        }
        let healed: Vec<_> = revolutions.iter().filter(|(_, t, _)| *t > wrong_ns + HEALED).collect();
        prop_assert!(healed.len() > 20, "{} revolutions", healed.len());
        for (revolution, _, age_ns) in healed {
            let is_gps = matches!(revolution.clock, Clock::Gps | Clock::GpsUnlocked);
            // The offset is in the status of the server, which says which clock contradicts the other.
            let is_told = (age_ns / 1_000_000 - revolution.clock_offset_ms).abs() < 150;
            let is_vouched = is_gps && has_gps && is_told && (*age_ns > 0 || vouches(&last));
            prop_assert!(
                FRESH.contains(age_ns) || is_vouched,
                "{age_ns} ns old, by {:?}: {spans:#?}",
                revolution.clock
            );
        }
    }
}
