//! The newest valid GPRMC of a sensor: its time beside the arrival and the device's clock, and whether it is trusted.

use super::timeline::{NS_PER_HOUR, NS_PER_SECOND, nearest_hour};
use crate::datagram::telemetry::Telemetry;

/// Age of a GPRMC on the device's clock, in ns. A GPRMC names the second that has passed and is repeated until the next
/// one: it is 0.85 to 1.85 s old in the recorded drives of an HDL-32E and 1.1 to 1.5 s in the drives of a VLP-16. A
/// device whose time differs by more was not set by this receiver.
const GPRMC_AGE_NS: std::ops::RangeInclusive<i64> = -500_000_000..=2_900_000_000;
/// Time without telemetry, in ns, after which GPS is lost. Sensors send telemetry many times per second.
const GPS_SILENCE_NS_MAX: i64 = 3 * NS_PER_SECOND;
/// Time, in ns, for which sentences must agree on an offset that stays in force when GPS is lost. Ours: a forged
/// datagram or the first date of a receiver does not outlive [`GPS_SILENCE_NS_MAX`].
const GPS_AGREED_NS_MIN: i64 = NS_PER_SECOND / 2;
/// 1 January 2005, in ns since the Unix epoch: none of these sensors is older. A receiver without a fix sends 1980.
pub(super) const EARLIEST_NS: i64 = 1_104_537_600 * NS_PER_SECOND;
/// Default of [`crate::SensorConfig::gps_late_ns_max`], in ns: 24 hours. The clock of a host may be wrong by hours
/// (time zone, battery) but not by days, while the error of a receiver is 1024 weeks.
pub(crate) const GPS_LATE_NS_MAX: i64 = 24 * NS_PER_HOUR;
/// Time, in ns, by which the limit of GPS time ahead of arrival is less than the limit behind. Ours: a receiver with
/// the date of tomorrow is then beyond it, and a host whose time zone is wrong is within it.
const GPS_AHEAD_LESS_NS: i64 = 6 * NS_PER_HOUR;

/// The newest valid GPRMC.
#[derive(Clone, Copy, Debug)]
pub(super) struct Gps {
    /// Unix time of the zero of the timeline, in ns.
    pub offset_ns: i64,
    /// Time of the first of the telemetry that agrees on the offset, on the timeline.
    agreed_from_ns: i64,
    /// Time of the telemetry on the timeline.
    received_ns: i64,
    /// True if the pulse is locked.
    pub locked: bool,
}

impl Gps {
    /// The GPRMC that the device had received at `received_ns` on the timeline, after the GPRMC `before`.
    pub fn new(offset_ns: i64, received_ns: i64, locked: bool, before: Option<Self>) -> Self {
        let agreed = before.filter(|before| before.offset_ns == offset_ns);
        Self { offset_ns, agreed_from_ns: agreed.map_or(received_ns, |of| of.agreed_from_ns), received_ns, locked }
    }

    /// True if no telemetry had a valid GPRMC in the last seconds before `first_ns` on the timeline.
    pub fn is_silent(&self, first_ns: i64) -> bool {
        first_ns - self.received_ns > GPS_SILENCE_NS_MAX
    }

    /// True if GPS is lost, and its hour or date may be wrong: too few sentences had them, or they are ahead of arrival
    /// by more than `ahead_ns_max`. `delay_ns`: least delay of the revolution that began at `first_ns`.
    pub fn is_doubtful(&self, first_ns: i64, delay_ns: Option<i64>, ahead_ns_max: i64) -> bool {
        let is_ahead = delay_ns.is_some_and(|delay_ns| self.offset_ns - delay_ns > ahead_ns_max);
        self.is_silent(first_ns) && (self.received_ns - self.agreed_from_ns < GPS_AGREED_NS_MIN || is_ahead)
    }
}

/// True if GPS time may be ahead of its arrival by this time; `is_set`: the host's clock was set; `gps_late_ns_max`: as
/// in [`crate::SensorConfig`].
pub(super) fn is_plausible(ahead_ns: i64, is_set: bool, gps_late_ns_max: i64) -> bool {
    let ahead_ns_max = if is_set { (gps_late_ns_max - GPS_AHEAD_LESS_NS).max(0) } else { i64::MAX };
    (-gps_late_ns_max..=ahead_ns_max).contains(&ahead_ns)
}

/// Time by which the GPRMC of the telemetry is ahead of its arrival; `None` without a valid one.
pub(super) fn gps_ahead_ns(telemetry: &Telemetry, arrival_ns: i64) -> Option<i64> {
    let gprmc = telemetry.gprmc.as_ref().filter(|gprmc| gprmc.valid)?;
    let utc_ns = gprmc.utc_ns.filter(|utc_ns| *utc_ns >= EARLIEST_NS)?;
    Some(utc_ns.saturating_sub(arrival_ns))
}

/// UTC at which the device's clock showed the time of the telemetry; `None` if its GPRMC is not valid.
pub(super) fn device_utc_ns(telemetry: &Telemetry) -> Option<i64> {
    let utc_ns = gps_ahead_ns(telemetry, 0)?;
    let age_ns = nearest_hour(i64::from(telemetry.device_us) * 1_000 - utc_ns, 0);
    GPRMC_AGE_NS.contains(&age_ns).then_some(utc_ns + age_ns)
}
