//! The timeline of a device: its microseconds past the hour, continued over every hour, silence, restart and
//! correction.
//!
//! In: device time and arrival of every packet, in order. Out: nanoseconds since an arbitrary zero. They advance with
//! the oscillator of the device.
//!
//! The device's counter starts at zero at power-on and counts an oscillator. A GPRMC sentence sets its minutes and
//! seconds, and the pulse sets its fraction of a second: two counters that are set separately (VLP-32C manual 63-9325,
//! appendix G.2). So the counter may jump by less than a second, by minutes, or to 0. If it is not set, it drifts by 5
//! s a day, 58 ppm (HDL-64E S3 manual 63-HDL64ES3, "Timestamp Accuracy Rules").
//!
//! | device time since the packet before | arrival since the packet before | step |
//! |---|---|---|
//! | within ±100 ms | any | the device's |
//! | any | the same ± whole hours, 100 ms and 1 % | the device's: the sensor was silent |
//! | forward by less than 10 s | back by over 100 ms, or more than device time | the device's: the host was set |
//! | other, and the packet before was the first such | any | arrival's: the device's counter jumped |
//! | other | any | one packet period; the next packet must confirm the jump |

pub(super) const NS_PER_SECOND: i64 = 1_000_000_000;
pub(super) const NS_PER_HOUR: i64 = 3_600 * NS_PER_SECOND;
const NS_PER_US: i64 = 1_000;

/// Greatest step of device time, in ns, that no arrival needs to confirm: 75 lost packets of a VLP-16, or the blind
/// half of a revolution at 300 rpm.
const STEP_NS_MAX: i64 = 100_000_000;
/// Greatest difference, in ns, between device time and arrival over the same silence, besides 1 % of it. Ours: a
/// network delays a packet by less, and 1 % is far above the drift of an oscillator.
const SILENCE_ERROR_NS_MAX: i64 = 100_000_000;
/// Least time, in ns, that a device takes to start (ours: real devices take longer). If the counter advances by less,
/// the device was silent and did not restart, even if the clock of the host was set meanwhile.
const START_UP_NS_MIN: i64 = 10 * NS_PER_SECOND;
/// Longest silence, in ns, that is measured by arrival: a host's clock that steps by years is not a silence.
const SILENCE_NS_MAX: i64 = 24 * NS_PER_HOUR;
/// Greatest valid device time, in microseconds: during a leap second the counter may go one second past the hour.
const US_MAX: u32 = 3_601_000_000;
/// Greatest difference, in ns, between telemetry and data packets of the same counter. Telemetry that differs by more
/// was sent before or after a jump.
const TELEMETRY_NS_MAX: i64 = NS_PER_SECOND;

/// How the time of a packet follows from the time of the packet before.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum StepKind {
    /// The packet is the first one.
    First,
    /// The step comes from the device's counter, or is a packet period while a jump is not confirmed.
    Continuous,
    /// The device's counter jumped (or the sensor was silent and sends no time): the step follows from arrivals.
    Jumped,
}

/// The timeline of one sensor.
#[derive(Clone, Debug, Default)]
pub(super) struct Timeline {
    last: Option<Last>,
    suspect: Option<Suspect>,
}

/// Times of the newest packet.
#[derive(Clone, Copy, Debug)]
struct Last {
    /// Device time past the hour; `None` if the sensor sends no time.
    past_hour_ns: Option<i64>,
    time_ns: i64,
    sent_ns: i64,
}

/// A device time that does not follow from the time before. If the next packet follows from it, the counter has jumped;
/// otherwise the packet was damaged.
#[derive(Clone, Copy, Debug)]
struct Suspect {
    past_hour_ns: i64,
    /// Time by which arrival advanced more than the timeline.
    missing_ns: i64,
}

impl Timeline {
    /// Adds a packet and returns its time on the timeline and how that follows. `device_us`: device time past the hour,
    /// if the sensor sends one; `elapsed_ns`: time since the packet before, as far as packets show it; `sent_ns`:
    /// arrival less the time in which the packet was filled; `due_ns`: the timeline's time at `sent_ns` if the offset
    /// between host and device has not changed.
    pub fn push(
        &mut self,
        device_us: Option<u32>,
        elapsed_ns: i64,
        sent_ns: i64,
        due_ns: Option<i64>,
    ) -> (i64, StepKind) {
        let past_hour_ns = device_us.filter(|us| *us < US_MAX).map(|us| i64::from(us) * NS_PER_US % NS_PER_HOUR);
        let Some(last) = self.last else {
            let time_ns = past_hour_ns.unwrap_or(0);
            self.last = Some(Last { past_hour_ns, time_ns, sent_ns });
            return (time_ns, StepKind::First);
        };
        let host_ns = sent_ns - last.sent_ns;
        let arrived_ns = host_ns.clamp(0, SILENCE_NS_MAX);
        let (step_ns, kind) = match (past_hour_ns, last.past_hour_ns) {
            (Some(now), Some(before)) => {
                let due_in_ns = due_ns.map_or(host_ns, |due_ns| due_ns.saturating_sub(last.time_ns));
                self.step_ns([now, before], elapsed_ns, host_ns, due_in_ns)
            }
            (_, None) if arrived_ns > STEP_NS_MAX => (elapsed_ns, StepKind::Jumped),
            _ => (elapsed_ns, StepKind::Continuous),
        };
        let time_ns = last.time_ns + step_ns;
        // An earlier packet that arrives late has its own time and changes nothing.
        if step_ns >= 0 {
            // The device time of a suspect is used only after the next packet has confirmed it.
            let expected_ns = last.past_hour_ns.map(|before| (before + step_ns).rem_euclid(NS_PER_HOUR));
            let past_hour_ns = if kind == StepKind::Jumped { past_hour_ns } else { expected_ns.or(past_hour_ns) };
            self.last = Some(Last { past_hour_ns, time_ns, sent_ns });
        }
        (time_ns, kind)
    }

    fn step_ns(
        &mut self,
        [now_ns, before_ns]: [i64; 2],
        elapsed_ns: i64,
        host_ns: i64,
        due_in_ns: i64,
    ) -> (i64, StepKind) {
        let arrived_ns = host_ns.clamp(0, SILENCE_NS_MAX);
        let ahead_ns = nearest_hour(now_ns - before_ns, 0);
        if ahead_ns.abs() <= STEP_NS_MAX {
            self.suspect = None;
            return (ahead_ns, StepKind::Continuous);
        }
        // If the host's clock was set before the silence and set back during it, its own step shows hours without a
        // silence, and `due_in_ns` shows the true time: so the shorter silence is right.
        if let Some(silence_ns) = [host_ns, due_in_ns].into_iter().filter_map(|by| silence_ns(ahead_ns, by)).min() {
            self.suspect = None;
            return (silence_ns, StepKind::Continuous);
        }
        // If the host advanced by less than the device counted, the device's counter was set, not the host's clock.
        let host_was_set = !(-SILENCE_ERROR_NS_MAX..=ahead_ns).contains(&host_ns);
        if host_was_set && (0..START_UP_NS_MIN).contains(&ahead_ns) {
            self.suspect = None;
            return (ahead_ns, StepKind::Continuous);
        }
        let follows = |suspect: &Suspect| (0..=STEP_NS_MAX).contains(&nearest_hour(now_ns - suspect.past_hour_ns, 0));
        match self.suspect.take().filter(follows) {
            Some(suspect) => (arrived_ns.max(elapsed_ns) + suspect.missing_ns, StepKind::Jumped),
            None => {
                let missing_ns = (arrived_ns - elapsed_ns).max(0);
                self.suspect = Some(Suspect { past_hour_ns: now_ns, missing_ns });
                (elapsed_ns, StepKind::Continuous)
            }
        }
    }

    /// Time on the timeline at which the device's counter is `device_us`; `None` if that is not near the newest packet.
    pub fn time_at(&self, device_us: u32) -> Option<i64> {
        let last = self.last?;
        let ahead_ns = nearest_hour(i64::from(device_us) * NS_PER_US - last.past_hour_ns?, 0);
        (device_us < US_MAX && ahead_ns.abs() <= TELEMETRY_NS_MAX).then_some(last.time_ns + ahead_ns)
    }

    /// Unix time of the timeline's zero if the device's minutes and seconds are UTC, with the hour that is nearest to
    /// `zero_ns`. `None` if the sensor sends no time.
    pub fn zero_by_hour_ns(&self, zero_ns: i64) -> Option<i64> {
        let last = self.last?;
        Some(nearest_hour(last.past_hour_ns? - last.time_ns, zero_ns))
    }
}

/// Length of a silence over which the device counted `ahead_ns` (± whole hours) and the host `host_ns`;
/// `None` if they do not agree.
fn silence_ns(ahead_ns: i64, host_ns: i64) -> Option<i64> {
    let host_ns = host_ns.clamp(0, SILENCE_NS_MAX);
    let silence_ns = nearest_hour(ahead_ns, host_ns);
    let differ_ns = (silence_ns - host_ns).abs();
    (silence_ns > 0 && differ_ns < SILENCE_ERROR_NS_MAX + host_ns / 100).then_some(silence_ns)
}

/// `ns` plus or minus whole hours, as near to `to_ns` as possible.
pub(super) fn nearest_hour(ns: i64, to_ns: i64) -> i64 {
    ns + (to_ns - ns + NS_PER_HOUR / 2).div_euclid(NS_PER_HOUR) * NS_PER_HOUR
}
