//! Scripts of events of clocks: the times of device, host and receiver, and the time at which stamps are right again.

use clearway_lidar::Clock;

use crate::telemetry::with_sum;

pub(crate) const S: i64 = 1_000_000_000;
pub(crate) const HOUR: i64 = 3_600 * S;
pub(crate) const REVOLUTION: i64 = S / 10;
/// 18 May 2033, 0 h UTC.
pub(crate) const MIDNIGHT: i64 = 1_999_987_200 * S;
/// Time of the event in most scripts, in ns: inside a revolution.
pub(crate) const EVENT: i64 = 1_033_000_000;

/// One script. The argument of all functions is the time since its beginning, in ns.
#[derive(Clone, Copy)]
pub(crate) struct Script {
    pub(crate) name: &'static str,
    /// UTC at the beginning.
    pub(crate) utc_ns: i64,
    pub(crate) lasts_ns: i64,
    /// Device time, in ns; the sensor sends it past the hour.
    pub(crate) device_ns: fn(i64) -> i64,
    /// Time by which the host's clock is ahead of UTC.
    pub(crate) host_ns: fn(i64) -> i64,
    /// State of the pulse, and GPRMC sentence.
    pub(crate) telemetry: fn(i64) -> Option<(u8, String)>,
    /// Time by which right stamps are ahead of UTC.
    pub(crate) right_ns: fn(i64) -> i64,
    pub(crate) event_ns: i64,
    /// Time after the event during which the sensor sends nothing.
    pub(crate) silence_ns: i64,
    /// Time from the event until stamps must be right.
    pub(crate) healed_ns: i64,
    pub(crate) tolerance_ns: i64,
    pub(crate) last: Clock,
    /// How often stamps go back.
    pub(crate) epochs: u32,
}

pub(crate) const BASE: Script = Script {
    name: "",
    utc_ns: NOON,
    lasts_ns: 2 * S,
    device_ns: |t| NOON + t,
    host_ns: |_| 0,
    telemetry: |t| gps(NOON + t),
    right_ns: |_| 0,
    event_ns: EVENT,
    silence_ns: 0,
    healed_ns: REVOLUTION,
    tolerance_ns: 200_000,
    last: Clock::Gps,
    epochs: 0,
};
pub(crate) const NOON: i64 = MIDNIGHT + 12 * HOUR + 1_234 * S;
/// One second before the end of a day.
pub(crate) const LATE: i64 = MIDNIGHT + 24 * HOUR - S;
/// Time of a device without GPS, 500 s after power-on.
pub(crate) const FREE: fn(i64) -> i64 = |t| 500 * S + t;
pub(crate) const SILENT: fn(i64) -> Option<(u8, String)> = |_| None;

pub(crate) fn rmc(second: i64, status: char, date: &str) -> String {
    let of_day = second % 86_400;
    let (hour, minute) = (of_day / 3_600, of_day / 60 % 60);
    with_sum(&format!(
        "GPRMC,{hour:02}{minute:02}{:02},{status},3707.8178,N,12139.2690,W,010.3,188.2,{date}",
        of_day % 60
    ))
}

/// Telemetry with a locked pulse and the GPRMC of 0.3 s before.
pub(crate) fn gps(utc_ns: i64) -> Option<(u8, String)> {
    let second = (utc_ns - MIDNIGHT - 300_000_000) / S;
    Some((2, rmc(second, 'A', if second < 86_400 { "180533" } else { "190533" })))
}

pub(crate) fn dated(t: i64, date: &str) -> Option<(u8, String)> {
    Some((2, rmc((NOON + t - MIDNIGHT) / S, 'A', date)))
}

pub(crate) fn restarted(t: i64) -> bool {
    (EVENT - REVOLUTION..EVENT).contains(&t)
}

/// Time by which a packet is read late if the receiver stands still for `for_ns` after the event.
fn stood_still(t: i64, for_ns: i64) -> i64 {
    if t < EVENT { 0 } else { (EVENT + for_ns - t).max(0) }
}

pub(crate) fn after<T>(t: i64, then: T, before: T) -> T {
    if t >= EVENT { then } else { before }
}

pub(crate) fn scripts() -> Vec<Script> {
    let late = Script { utc_ns: LATE, device_ns: |t| LATE + t, telemetry: |t| gps(LATE + t), ..BASE };
    let free = Script { device_ns: FREE, telemetry: SILENT, last: Clock::Arrival, ..BASE };
    // Stamps are right half a second after the host's clock was set back: revolutions must agree on it.
    let back = Script {
        host_ns: |t| after(t, -2 * S, 0),
        right_ns: |t| after(t, -2 * S, 0),
        lasts_ns: 4 * S,
        healed_ns: 5 * REVOLUTION,
        epochs: 1,
        ..free
    };
    // So are they if packets take longer from now on: that is a clock that was set forward, for all that can be seen.
    let grown =
        |host_ns, name| Script { name, host_ns, right_ns: host_ns, lasts_ns: 4 * S, healed_ns: 5 * REVOLUTION, ..free };
    let silent = Script { silence_ns: 3 * REVOLUTION, healed_ns: 4 * REVOLUTION, ..BASE };
    vec![
        Script { name: "hour and day end, and telemetry arrives in that microsecond", event_ns: S, ..late },
        Script { name: "the hour ends without telemetry", telemetry: SILENT, last: Clock::Device, event_ns: S, ..late },
        Script {
            name: "GPS is found: the device jumps to UTC; the host is 20 s behind",
            device_ns: |t| after(t, NOON, 500 * S) + t,
            telemetry: |t| after(t, gps(NOON + t), Some((1, rmc(0, 'V', "010100")))),
            host_ns: |_| -20 * S,
            right_ns: |t| after(t, 0, -20 * S),
            ..BASE
        },
        Script {
            name: "GPS is found 40 ms behind the host: stamps run at half speed until they are right",
            device_ns: |t| after(t, NOON, 500 * S) + t,
            telemetry: |t| after(t, gps(NOON + t), None),
            host_ns: |_| 40_000_000,
            right_ns: |t| after(t, 0, 40_000_000),
            healed_ns: 2 * REVOLUTION,
            ..BASE
        },
        Script {
            name: "GPS is lost, while the host is 7 s off: nothing changes",
            telemetry: |t| after(t, Some((0, rmc(0, 'V', ""))), gps(NOON + t)),
            host_ns: |_| 7 * S,
            last: Clock::GpsUnlocked,
            ..BASE
        },
        Script {
            name: "telemetry ends",
            telemetry: |t| after(t, None, gps(NOON + t)),
            lasts_ns: 5 * S,
            last: Clock::GpsUnlocked,
            ..BASE
        },
        Script {
            name: "the pulse is lost",
            telemetry: |t| gps(NOON + t).map(|(pps, text)| (after(t, 3, pps), text)),
            last: Clock::GpsUnlocked,
            ..BASE
        },
        Script { name: "the host steps an hour forward, with GPS", host_ns: |t| after(t, HOUR, 0), ..BASE },
        Script { name: "the host steps an hour back, with GPS", host_ns: |t| after(t, -HOUR, 0), ..BASE },
        Script {
            name: "a restart while the host is an hour back; between two packets GPS is found and the host is set",
            device_ns: |t| if restarted(t) { 1_034 * S + t } else { NOON + t },
            telemetry: |t| if restarted(t) { None } else { gps(NOON + t) },
            host_ns: |t| if restarted(t) { -HOUR } else { 0 },
            event_ns: EVENT - REVOLUTION,
            healed_ns: 2 * REVOLUTION,
            ..BASE
        },
        Script {
            name: "the host steps 2 s forward during a silence, with GPS",
            host_ns: |t| after(t, 2 * S, 0),
            ..silent
        },
        Script {
            name: "the host steps 2 s back during a silence, with GPS",
            host_ns: |t| after(t, -2 * S, 0),
            ..silent
        },
        Script { name: "the host steps an hour back during a silence", host_ns: |t| after(t, -HOUR, 0), ..silent },
        Script {
            name: "the host steps 2 s forward during a silence, without GPS",
            host_ns: |t| after(t, 2 * S, 0),
            right_ns: |t| after(t, 2 * S, 0),
            silence_ns: silent.silence_ns,
            healed_ns: silent.healed_ns,
            ..free
        },
        Script {
            name: "the host steps 2 s back during a silence, without GPS",
            silence_ns: silent.silence_ns,
            healed_ns: silent.silence_ns + back.healed_ns,
            ..back
        },
        Script {
            name: "the host steps an hour back before a silence and forward during it, without GPS",
            host_ns: |t| if (EVENT - 4_000_000..EVENT + REVOLUTION).contains(&t) { -HOUR } else { 0 },
            silence_ns: silent.silence_ns,
            healed_ns: silent.healed_ns,
            ..free
        },
        Script {
            name: "the host steps an hour forward, without GPS",
            host_ns: |t| after(t, HOUR, 0),
            right_ns: |t| after(t, HOUR, 0),
            ..free
        },
        Script {
            name: "the host steps an hour back, without GPS",
            host_ns: |t| after(t, -HOUR, 0),
            right_ns: |t| after(t, -HOUR, 0),
            ..back
        },
        Script { name: "the host steps 2 s back, without GPS", ..back },
        Script {
            name: "the host steps 2 s forward, without GPS",
            host_ns: |t| after(t, 2 * S, 0),
            right_ns: |t| after(t, 2 * S, 0),
            ..free
        },
        Script {
            name: "the host steps 0.2 s back, without GPS: stamps run at half speed until they are right",
            host_ns: |t| after(t, -200_000_000, 0),
            right_ns: |t| after(t, -200_000_000, 0),
            healed_ns: 9 * REVOLUTION,
            epochs: 0,
            ..back
        },
        grown(|t| after(t, 200_000_000, 0), "packets take 0.2 s longer, without GPS"),
        grown(|t| after(t, 400_000_000, 0), "packets take 0.4 s longer, without GPS"),
        grown(|t| after(t, 600_000_000, 0), "packets take 0.6 s longer, without GPS"),
        Script {
            healed_ns: 10 * REVOLUTION + 5 * REVOLUTION,
            tolerance_ns: 105_000_000,
            ..grown(|t| after(t, (t - EVENT).min(900_000_000), 0), "packets take longer by and by, without GPS")
        },
        Script {
            healed_ns: 6 * REVOLUTION + 5 * REVOLUTION,
            ..grown(
                |t| stood_still(t, S).max(after(t, 400_000_000, 0)),
                "the receiver stands still for 1 s, and its packets take 0.4 s longer from then on",
            )
        },
        Script {
            name: "the host steps an hour back for a second and a half, without GPS",
            host_ns: |t| if (S..S + 3 * S / 2).contains(&t) { -HOUR } else { 0 },
            right_ns: |_| 0,
            event_ns: S,
            healed_ns: 16 * REVOLUTION,
            last: Clock::Arrival,
            ..back
        },
        Script {
            name: "the receiver stands still for 1 s, and its packets have no stamps of the kernel",
            host_ns: |t| stood_still(t, S),
            ..free
        },
        Script {
            name: "the receiver stands still for 4 s, and its packets have no stamps of the kernel",
            host_ns: |t| stood_still(t, 4 * S),
            lasts_ns: 7 * S,
            ..free
        },
        Script {
            name: "a capture is played at ten times its speed for 5 s, and then the sensor sends",
            host_ns: |t| -t.min(5 * S) / 10 * 9,
            right_ns: |t| if t < 5 * S { 0 } else { -5 * S / 10 * 9 },
            tolerance_ns: REVOLUTION,
            event_ns: 5 * S,
            lasts_ns: 7 * S,
            ..back
        },
        Script {
            name: "GPS is found 20 s behind the host",
            device_ns: |t| after(t, NOON, 500 * S) + t,
            telemetry: |t| after(t, gps(NOON + t), None),
            host_ns: |_| 20 * S,
            right_ns: |t| after(t, 0, 20 * S),
            epochs: 1,
            ..BASE
        },
        Script {
            name: "the sensor is restarted",
            device_ns: |t| after(t, t - EVENT, 500 * S + t),
            tolerance_ns: 11_000_000,
            ..free
        },
        Script {
            name: "the sensor is restarted without GPS; the host is 7 s off",
            device_ns: |t| after(t, t - EVENT, NOON + t),
            telemetry: |t| after(t, None, gps(NOON + t)),
            host_ns: |_| 7 * S,
            tolerance_ns: 2_000_000,
            last: Clock::GpsUnlocked,
            ..BASE
        },
        Script {
            name: "only the pulse sets the fraction of a second, 0.7 s back",
            device_ns: |t| after(t, 499_300_000_000, 500 * S) + t,
            tolerance_ns: 11_000_000,
            ..free
        },
        Script {
            name: "a capture that is played at ten times its speed",
            host_ns: |t| -t / 10 * 9,
            tolerance_ns: REVOLUTION,
            last: Clock::Holdover,
            ..free
        },
        Script {
            name: "all arrivals equal",
            host_ns: |t| -t,
            tolerance_ns: REVOLUTION + 2_000_000,
            last: Clock::Holdover,
            ..free
        },
        Script {
            name: "the receiver sends the year 1980",
            telemetry: |t| dated(t, "060180"),
            last: Clock::Device,
            ..BASE
        },
        Script {
            name: "the receiver is 1024 weeks late",
            telemetry: |t| dated(t, "021013"),
            last: Clock::Device,
            ..BASE
        },
        Script {
            name: "an old capture, whose telemetry begins after its data",
            telemetry: |t| after(t, gps(NOON + t), None),
            host_ns: |_| 20_000 * HOUR + 1_000 * S,
            right_ns: |_| 20_000 * HOUR + 1_000 * S,
            last: Clock::Arrival,
            ..BASE
        },
        Script {
            name: "an old capture, in which the device's counter is set",
            device_ns: |t| after(t, NOON, 500 * S) + t,
            telemetry: |t| after(t, gps(NOON + t), None),
            host_ns: |_| 20_000 * HOUR + 1_000 * S,
            right_ns: |_| 20_000 * HOUR + 1_000 * S,
            tolerance_ns: 11_000_000,
            last: Clock::Arrival,
            ..BASE
        },
        Script {
            name: "a host whose clock was never set, with GPS",
            host_ns: |_| -MIDNIGHT,
            telemetry: |t| after(t, gps(NOON + t), None),
            right_ns: |t| after(t, 0, -MIDNIGHT),
            ..BASE
        },
        Script { name: "the device's time does not agree with its receiver", telemetry: |t| gps(NOON + t), ..free },
        Script {
            name: "a leap second, which the device counts past the hour and Unix time repeats",
            device_ns: |t| t + if t < 2 * S { HOUR - S } else { -2 * S },
            telemetry: |t| match t - 300_000_000 {
                0..S => Some((2, rmc(86_399, 'A', "180533"))),
                S..2_000_000_000 => Some((2, with_sum("GPRMC,235960,A,,,,,,,180533"))),
                _ => gps(LATE + t - S),
            },
            host_ns: |t| if t < 2 * S { 0 } else { -S },
            right_ns: |t| if t < 2 * S { 0 } else { -S },
            event_ns: 2 * S,
            lasts_ns: 5 * S,
            healed_ns: 2 * S + REVOLUTION,
            epochs: 1,
            ..late
        },
    ]
}
