//! Device microseconds past the hour to one timeline that goes on whatever happens to the device.
//!
//! In: device time and arrival of every packet, in order. Out: nanoseconds since some packet of the past, which run
//! with the device's oscillator: over the hour, over a silence, over a restart, and when a GPS receiver sets the
//! counter.
//!
//! The counter is an oscillator's, zero at power-on, until minutes and seconds come from GPRMC and the part of a second
//! from the pulse (VLP-32C manual, appendix G.2: two counters, set apart from each other); so it may jump by less than
//! a second, by minutes, or to 0. Unset it drifts by 5 s a day, 58 ppm (HDL-64E S3 manual 63-HDL64ES3, "Timestamp
//! Accuracy Rules").

pub(crate) const NS_PER_SECOND: i64 = 1_000_000_000;
pub(crate) const NS_PER_HOUR: i64 = 3_600 * NS_PER_SECOND;
const NS_PER_US: i64 = 1_000;

/// A step that needs no arrival to bear it out: 75 packets of a VLP-16 lost, or the blind half of a turn at 300 rpm.
const STEP_NS_MAX: i64 = 100_000_000;
/// A longer silence: device time and arrival tell of the same one if they differ by less than this and a hundredth of
/// it.
const SILENCE_ERROR_NS_MAX: i64 = 100_000_000;
/// A device starts up for longer than this: one whose count went on by less was silent, whatever a host's clock that
/// was set meanwhile says.
const START_UP_NS_MIN: i64 = 10 * NS_PER_SECOND;
/// Longer silences are not measured by arrival: a host's clock that steps by years is no silence.
const SILENCE_NS_MAX: i64 = 24 * NS_PER_HOUR;
/// During a leap second the counter may go on past the hour.
const US_MAX: u32 = 3_601_000_000;
/// Telemetry this far from the data packets is from before or after a jump.
const TELEMETRY_NS_MAX: i64 = NS_PER_SECOND;

/// How a packet's time follows from the one before.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Went {
    /// It is the first.
    Started,
    /// By the device's count.
    On,
    /// The device's count jumped (or was silent, where there is none): arrival told how long it took.
    Jumped,
}

/// Follows one sensor's device time.
#[derive(Clone, Debug, Default)]
pub(crate) struct Timeline {
    last: Option<Last>,
    suspect: Option<Suspect>,
}

/// The newest packet's times.
#[derive(Clone, Copy, Debug)]
struct Last {
    /// Past the hour; `None` where the sensor tells none.
    past_hour_ns: Option<i64>,
    time_ns: i64,
    sent_ns: i64,
}

/// A device time that fits nothing before: a jump if the next packet goes on from it, else damage.
#[derive(Clone, Copy, Debug)]
struct Suspect {
    past_hour_ns: i64,
    /// By how much more arrival went on than the timeline did.
    missing_ns: i64,
}

impl Timeline {
    /// The time of a packet. `device_us`: past the hour, if the sensor sends one; `elapsed_ns`: since the packet before
    /// as far as packets tell; `sent_ns`: arrival, less what the packet took to fill; `due_ns`: what the
    /// timeline shows at `sent_ns` if host and device have gone on as before.
    pub fn follow(
        &mut self,
        device_us: Option<u32>,
        elapsed_ns: i64,
        sent_ns: i64,
        due_ns: Option<i64>,
    ) -> (i64, Went) {
        let past_hour_ns = device_us.filter(|us| *us < US_MAX).map(|us| i64::from(us) * NS_PER_US % NS_PER_HOUR);
        let Some(last) = self.last else {
            let time_ns = past_hour_ns.unwrap_or(0);
            self.last = Some(Last { past_hour_ns, time_ns, sent_ns });
            return (time_ns, Went::Started);
        };
        let host_ns = sent_ns - last.sent_ns;
        let arrived_ns = host_ns.clamp(0, SILENCE_NS_MAX);
        let (step_ns, went) = match (past_hour_ns, last.past_hour_ns) {
            (Some(now), Some(before)) => {
                let due_in_ns = due_ns.map_or(host_ns, |due_ns| due_ns.saturating_sub(last.time_ns));
                self.step_ns([now, before], elapsed_ns, host_ns, due_in_ns)
            }
            (_, None) if arrived_ns > STEP_NS_MAX => (elapsed_ns, Went::Jumped),
            _ => (elapsed_ns, Went::On),
        };
        let time_ns = last.time_ns + step_ns;
        // An earlier packet that comes late has its own time and changes nothing.
        if step_ns >= 0 {
            // A suspect's own device time counts only once the next packet bears it out.
            let reckoned = last.past_hour_ns.map(|before| (before + step_ns).rem_euclid(NS_PER_HOUR));
            let past_hour_ns = if went == Went::Jumped { past_hour_ns } else { reckoned.or(past_hour_ns) };
            self.last = Some(Last { past_hour_ns, time_ns, sent_ns });
        }
        (time_ns, went)
    }

    fn step_ns(&mut self, [now_ns, before_ns]: [i64; 2], elapsed_ns: i64, host_ns: i64, due_in_ns: i64) -> (i64, Went) {
        let arrived_ns = host_ns.clamp(0, SILENCE_NS_MAX);
        let ahead_ns = nearest_hour(now_ns - before_ns, 0);
        if ahead_ns.abs() <= STEP_NS_MAX {
            self.suspect = None;
            return (ahead_ns, Went::On);
        }
        // A host that was set just before the silence, and back during it, tells of whole hours nobody was silent for.
        if let Some(silence_ns) = [host_ns, due_in_ns].into_iter().filter_map(|told| silence_ns(ahead_ns, told)).min() {
            self.suspect = None;
            return (silence_ns, Went::On);
        }
        // A host that went on by less than the device counted was not set: the device's counter was.
        let host_was_set = !(-SILENCE_ERROR_NS_MAX..=ahead_ns).contains(&host_ns);
        if host_was_set && (0..START_UP_NS_MIN).contains(&ahead_ns) {
            self.suspect = None;
            return (ahead_ns, Went::On);
        }
        let goes_on = |suspect: &Suspect| (0..=STEP_NS_MAX).contains(&nearest_hour(now_ns - suspect.past_hour_ns, 0));
        match self.suspect.take().filter(goes_on) {
            Some(suspect) => (arrived_ns.max(elapsed_ns) + suspect.missing_ns, Went::Jumped),
            None => {
                let missing_ns = (arrived_ns - elapsed_ns).max(0);
                self.suspect = Some(Suspect { past_hour_ns: now_ns, missing_ns });
                (elapsed_ns, Went::On)
            }
        }
    }

    /// The time at which the device's clock shows `device_us`, if that is near the newest packet.
    pub fn at(&self, device_us: u32) -> Option<i64> {
        let last = self.last?;
        let ahead_ns = nearest_hour(i64::from(device_us) * NS_PER_US - last.past_hour_ns?, 0);
        (device_us < US_MAX && ahead_ns.abs() <= TELEMETRY_NS_MAX).then_some(last.time_ns + ahead_ns)
    }

    /// Unix time of the timeline's zero, were the device's hour UTC's: of all the hours the one nearest to `zero_ns`.
    pub fn zero_by_hour_ns(&self, zero_ns: i64) -> Option<i64> {
        let last = self.last?;
        Some(nearest_hour(last.past_hour_ns? - last.time_ns, zero_ns))
    }
}

/// How long a device was silent that counts `ahead_ns`, give or take hours; `None` where the host tells of no silence
/// like that.
fn silence_ns(ahead_ns: i64, told_ns: i64) -> Option<i64> {
    let told_ns = told_ns.clamp(0, SILENCE_NS_MAX);
    let silence_ns = nearest_hour(ahead_ns, told_ns);
    let differ_ns = (silence_ns - told_ns).abs();
    (silence_ns > 0 && differ_ns < SILENCE_ERROR_NS_MAX + told_ns / 100).then_some(silence_ns)
}

/// `ns` and whole hours more or less, as near to `to_ns` as can be.
pub(crate) fn nearest_hour(ns: i64, to_ns: i64) -> i64 {
    ns + (to_ns - ns + NS_PER_HOUR / 2).div_euclid(NS_PER_HOUR) * NS_PER_HOUR
}
