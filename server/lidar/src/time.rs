//! Device time to stamps.
//!
//! In: microseconds past the hour in every packet, arrival stamps, and GPRMC from telemetry. Out: a device timeline that
//! goes on over the hour, and its place in Unix time. With a valid GPRMC the hour is UTC's; without one, and for an
//! HDL-64E S1, which sends no time, arrival stands in.

use crate::telemetry::Telemetry;

const NS_PER_US: i64 = 1_000;
const NS_PER_HOUR: i64 = 3_600_000_000_000;
const US_PER_HOUR: u32 = 3_600_000_000;
/// GPRMC tells the second that has passed; the datagram comes within a few.
const GPRMC_AGE_NS_MAX: i64 = 10_000_000_000;
/// A device whose time past the hour is this near to arrival's has been set by GPS: its hour is UTC's.
const SET_BY_GPS_NS_MAX: i64 = 2_000_000_000;
/// A timeline this far from arrival is anchored anew: the device was restarted, or its clock set.
const DRIFT_NS_MAX: i64 = 5_000_000_000;

/// Carries one sensor's device time.
#[derive(Clone, Debug, Default)]
pub(crate) struct DeviceClock {
    /// The last device time, on the timeline.
    last_ns: Option<i64>,
    /// Unix time of the timeline's zero.
    zero_ns: Option<i64>,
    /// The same, from GPRMC; takes over at the next turn.
    gps_zero_ns: Option<i64>,
    /// The last stamp given for a turn's end.
    newest_ns: i64,
}

impl DeviceClock {
    /// The time of a packet's first firing on the device's timeline, ns. `device_us`: past the hour, if the sensor
    /// sends one; `span_ns`: from the packet's first firing to its sending.
    pub fn timeline_ns(&mut self, device_us: Option<u32>, arrival_ns: i64, span_ns: i64) -> i64 {
        let sent_ns = arrival_ns.saturating_sub(span_ns);
        let time_ns = match device_us.filter(|us| *us < US_PER_HOUR) {
            Some(us) => self.past_hour_changes(i64::from(us) * NS_PER_US),
            None => sent_ns,
        };
        let anchored = self.zero_ns.is_some_and(|zero| {
            self.gps_zero_ns.is_some() || zero.saturating_add(time_ns).abs_diff(sent_ns) < DRIFT_NS_MAX as u64
        });
        if !anchored {
            let zero_ns = sent_ns.saturating_sub(time_ns);
            let hour_ns = zero_ns.saturating_add(NS_PER_HOUR / 2).div_euclid(NS_PER_HOUR) * NS_PER_HOUR;
            let set_by_gps = device_us.is_some() && zero_ns.abs_diff(hour_ns) < SET_BY_GPS_NS_MAX as u64;
            self.zero_ns = Some(if set_by_gps { hour_ns } else { zero_ns });
        }
        self.last_ns = Some(time_ns);
        time_ns
    }

    /// The candidate nearest to the last time, whatever the hour.
    fn past_hour_changes(&self, past_hour_ns: i64) -> i64 {
        let Some(last) = self.last_ns else { return past_hour_ns };
        let hours = last.saturating_sub(past_hour_ns).saturating_add(NS_PER_HOUR / 2).div_euclid(NS_PER_HOUR);
        past_hour_ns.saturating_add(hours.saturating_mul(NS_PER_HOUR))
    }

    /// Takes the hour from a telemetry datagram, if its GPRMC is valid and agrees with the device's own time.
    pub fn telemetry(&mut self, telemetry: &Telemetry) {
        let Some(utc_ns) = telemetry.gprmc.as_ref().filter(|fix| fix.valid).and_then(|fix| fix.utc_ns) else { return };
        let past_hour_ns = i64::from(telemetry.device_us) * NS_PER_US;
        let age_ns =
            (past_hour_ns - utc_ns.rem_euclid(NS_PER_HOUR) + NS_PER_HOUR / 2).rem_euclid(NS_PER_HOUR) - NS_PER_HOUR / 2;
        if telemetry.device_us >= US_PER_HOUR || age_ns.abs() > GPRMC_AGE_NS_MAX {
            return;
        }
        let time_ns = self.past_hour_changes(past_hour_ns);
        self.gps_zero_ns = Some(utc_ns + age_ns - time_ns);
    }

    /// The stamp of a turn that starts at `time_ns` on the timeline, and by how much it is late: stamps never go back
    /// before the end of the turn before, so that they stand still while a clock set back catches up.
    pub fn turn_starts(&mut self, time_ns: i64) -> (i64, i64) {
        if self.gps_zero_ns.is_some() {
            self.zero_ns = self.gps_zero_ns;
        }
        let stamp_ns = self.zero_ns.unwrap_or(0).saturating_add(time_ns);
        self.newest_ns = stamp_ns.max(self.newest_ns);
        (self.newest_ns, self.newest_ns - stamp_ns)
    }

    /// Takes note of the stamp at which a turn ended.
    pub fn turn_ended(&mut self, stamp_ns: i64) {
        self.newest_ns = self.newest_ns.max(stamp_ns);
    }
}
