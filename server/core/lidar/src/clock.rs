//! When a sensor's firings were, and which clock says so.
//!
//! In: device time and arrival of every data packet, telemetry. Out: the stamps of each turn, [`Clock`], and by how
//! much the host's clock disagrees. A pure function of the datagrams and their arrivals.
//!
//! Device time runs on one [`Timeline`]; Unix time is that plus an *offset*, one a turn, chosen when the turn ends:
//!
//! - From GPRMC (an HDL-64E S2 or S3: from its status bytes), where the receiver calls it valid, the device's own
//!   minutes and seconds follow it, and it is older than its arrival by no more than
//!   [`crate::SensorConfig::gps_late_ns_max`]. The offset is then a whole number of hours and the same to the
//!   nanosecond whatever the arrivals are. It stays in force when GPS or the pulse is lost, over a restart, and against
//!   a host that says otherwise. An older GPRMC is an old capture's, played live, or a receiver's that has lost count
//!   of the weeks: then arrival tells the time, as the planners' clocks do. A GPRMC later than its arrival is believed:
//!   nothing comes before it was sent, so the host was never set.
//! - Else from arrival, by the packet of a turn that came quickest: a late packet is late by any amount, none comes
//!   before it was sent. The offset is held, not averaged: it changes when a turn's quickest packet is later by more
//!   than [`STEP_NS_MAX`] (the host's clock was set, or the first turn came from a full socket buffer), or when those
//!   of ten seconds agree on a difference above [`DRIFT_NS_MAX`]. Below that, arrivals change no stamp.
//! - Where that puts the device's own minutes and seconds within [`HOUR_ERROR_NS_MAX`] of UTC's, somebody has set them
//!   (GPS without telemetry, PTP), and the offset is the whole hours.
//!
//! A host's clock that is set while a device is silent is not believed about the silence (`timeline.rs`). One that is
//! set between the two packets between which the device's own clock jumps is: nobody else tells how long that took.
//! Stamps that went ahead by that are held until GPS, or the host, has caught up with them.
//!
//! GPS time that lies farther behind the stamps given than they catch up with ([`CATCH_UP_NS_MAX`]) is not waited for:
//! arrival goes on. Stamps always rise. A correction forward is made at once; one backward by running at half speed, up
//! to [`CATCH_UP_NS_MAX`]; beyond that it is not made. Host clocks that fall behind the device at once (set back, or a
//! capture played too fast) are not followed. [`Clock::Held`] says so while it lasts.

use crate::revolution::Firing;
use crate::telemetry::{Pps, Telemetry};
use crate::timeline::{NS_PER_HOUR, NS_PER_SECOND, Timeline, Went, nearest_hour};

/// GPRMC tells the second that has passed and is repeated until the next: 0.85 to 1.85 s old in the HDL-32E of the
/// recorded drives, 1.1 to 1.5 s in the VLP-16. A device farther from it has not been set by it.
const GPRMC_AGE_NS: std::ops::RangeInclusive<i64> = -500_000_000..=2_900_000_000;
/// Telemetry comes many times a second; after so long without any, GPS is lost.
const GPS_SILENCE_NS_MAX: i64 = 3 * NS_PER_SECOND;
/// 1 January 2005: no sensor of these is older. A receiver without a fix says 1980.
const EARLIEST_NS: i64 = 1_104_537_600 * NS_PER_SECOND;
/// A host's clock is wrong by hours (a time zone, a battery), not by days; receivers are wrong by 1024 weeks.
pub const GPS_LATE_NS_MAX: i64 = 24 * NS_PER_HOUR;
/// Arrivals later than 2096, where stamps would near the end of their 64 bits, are taken for that.
const ARRIVAL_NS_MAX: i64 = 4_000_000_000 * NS_PER_SECOND;
/// Above what networks and schedulers delay a whole turn by.
const STEP_NS_MAX: i64 = 500_000_000;
/// 100 ppm make it in 100 s; at 15 m/s it is 15 cm.
const DRIFT_NS_MAX: i64 = 10_000_000;
/// Over which drift is looked for.
const DRIFT_WINDOW_NS: i64 = 10 * NS_PER_SECOND;
/// Half of [`STEP_NS_MAX`], so that a device once believed is not doubted for a little more.
const HOUR_ERROR_NS_MAX: i64 = 250_000_000;
/// Stamps catch up with a clock set back by at most this, in twice the time.
const CATCH_UP_NS_MAX: i64 = 60 * NS_PER_SECOND;

/// Which clock a sensor's stamps follow.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Clock {
    /// The host's, at the arrival of the quickest packets; between them the device's oscillator (an HDL-64E S1: the
    /// nominal packet rate).
    #[default]
    Arrival,
    /// The device's minutes and seconds, which agree with the host's; the hour is the host's.
    Device,
    /// GPS: telemetry gives date and hour, and the pulse is locked (an HDL-32E does not say whether).
    Gps,
    /// GPS once set the device; since then it, or its pulse, was lost.
    GpsUnlocked,
    /// None: the clock to follow is behind stamps already given. They go on with the device's oscillator, at half speed
    /// where that lets the clock catch up.
    Held,
}

impl Clock {
    /// As the wire spells it.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Arrival => "arrival",
            Self::Device => "device",
            Self::Gps => "gps",
            Self::GpsUnlocked => "gps_unlocked",
            Self::Held => "held",
        }
    }
}

/// When a turn was.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Stamp {
    pub start_ns: i64,
    pub end_ns: i64,
    pub clock: Clock,
    /// Arrival of the turn's quickest packet less its stamp.
    pub clock_offset_ms: i64,
}

/// Keeps one sensor's time.
#[derive(Clone, Debug, Default)]
pub(crate) struct DeviceClock {
    gps_late_ns_max: i64,
    timeline: Timeline,
    gps: Option<Gps>,
    /// Telemetry from beyond a jump that no data packet has shown yet.
    ahead: Option<Ahead>,
    quickest: Quickest,
    /// The offset in force, and whose it is.
    anchor: Option<(i64, Clock)>,
    /// The device jumped: arrival is looked at anew.
    jumped: bool,
    newest: Option<Stamp>,
}

#[derive(Clone, Copy, Debug)]
struct Gps {
    offset_ns: i64,
    /// On the timeline.
    told_ns: i64,
    locked: bool,
}

#[derive(Clone, Copy, Debug)]
struct Ahead {
    device_us: u32,
    utc_ns: i64,
    locked: bool,
}

/// The least of arrival less device time: over the turn, and the extremes of the turns' over ten seconds.
#[derive(Clone, Copy, Debug, Default)]
struct Quickest {
    turn_ns: Option<i64>,
    /// Where on the timeline the window begins, least and greatest.
    window: Option<(i64, i64, i64)>,
}

impl DeviceClock {
    pub fn new(gps_late_ns_max: i64) -> Self {
        Self { gps_late_ns_max, ..Self::default() }
    }

    /// Takes telemetry that arrived at `arrival_ns`. `tells_pps`: whether the model's PPS state means anything.
    pub fn telemetry(&mut self, telemetry: &Telemetry, tells_pps: bool, arrival_ns: i64) {
        let locked = match telemetry.pps {
            Pps::Locked => true,
            Pps::Absent => !tells_pps,
            Pps::Attempting | Pps::Error | Pps::Unknown(_) => false,
        };
        let Some(utc_ns) = device_utc_ns(telemetry, arrival_ns, self.gps_late_ns_max) else {
            self.gps.iter_mut().for_each(|gps| gps.locked = false);
            return;
        };
        self.ahead = Some(Ahead { device_us: telemetry.device_us, utc_ns, locked });
        self.place_telemetry();
    }

    fn place_telemetry(&mut self) {
        let Some(Ahead { device_us, utc_ns, locked }) = self.ahead else { return };
        if let Some(told_ns) = self.timeline.at(device_us) {
            self.gps = Some(Gps { offset_ns: utc_ns - told_ns, told_ns, locked });
            self.ahead = None;
        }
    }

    /// The time of a packet's first firing on the timeline, ns. `device_us`: past the hour, if the sensor sends one;
    /// `elapsed_ns`: since the packet before as far as packets tell; `arrival_ns`: of the datagram that let it through;
    /// `span_ns`: from the packet's first firing to its sending.
    pub fn packet(&mut self, device_us: Option<u32>, elapsed_ns: i64, arrival_ns: i64, span_ns: i64) -> i64 {
        let sent_ns = arrival_ns.clamp(0, ARRIVAL_NS_MAX) - span_ns;
        let due_ns = self.anchor.map(|(offset_ns, _)| sent_ns.saturating_sub(offset_ns));
        let (time_ns, went) = self.timeline.follow(device_us, elapsed_ns, sent_ns, due_ns);
        if went == Went::Jumped {
            self.gps.iter_mut().for_each(|gps| gps.locked = false);
            (self.quickest, self.jumped) = (Quickest::default(), true);
        }
        if went != Went::On {
            self.place_telemetry();
        }
        let late_ns = sent_ns - time_ns;
        self.quickest.turn_ns = Some(self.quickest.turn_ns.map_or(late_ns, |least| least.min(late_ns)));
        time_ns
    }

    /// The stamps of a turn that began at `first_ns` on the timeline; where they must rise slower than the device's
    /// clock, the firings' offsets too.
    pub fn stamp(&mut self, first_ns: i64, firings: &mut [Firing]) -> Stamp {
        let turn_ns = self.quickest.end_turn(first_ns);
        let (offset_ns, mut clock) = self.choose(first_ns, turn_ns);
        let right_ns = offset_ns + first_ns;
        let start_ns = self.newest.map_or(right_ns, |newest| right_ns.max(newest.end_ns + 1));
        let early_ns = start_ns - right_ns;
        if early_ns > 0 {
            for firing in firings.iter_mut() {
                let device_ns = i64::from(firing.offset_ns);
                firing.offset_ns = (device_ns - early_ns).max(device_ns / 2) as u32;
            }
        }
        let end_ns = start_ns + firings.last().map_or(0, |firing| i64::from(firing.offset_ns));
        if early_ns > 0 && firings.last().is_some_and(|firing| i64::from(firing.offset_ns) < early_ns) {
            clock = Clock::Held;
        }
        let ms = |ns: i64| (ns + 500_000).div_euclid(1_000_000);
        let clock_offset_ms = match turn_ns {
            Some(quickest_ns) => ms(quickest_ns + first_ns - start_ns),
            None => self.newest.map_or(0, |newest| newest.clock_offset_ms),
        };
        let stamp = Stamp { start_ns, end_ns, clock, clock_offset_ms };
        self.newest = Some(stamp);
        stamp
    }

    /// The offset of a turn, and the clock it follows.
    fn choose(&mut self, first_ns: i64, turn_ns: Option<i64>) -> (i64, Clock) {
        let newest_ns = self.newest.map(|newest| newest.end_ns);
        let in_reach = |offset_ns: i64| newest_ns.is_none_or(|ns| ns - (offset_ns + first_ns) <= CATCH_UP_NS_MAX);
        let wanted = match self.gps.filter(|gps| in_reach(gps.offset_ns)) {
            Some(gps) => {
                let lost = !gps.locked || first_ns - gps.told_ns > GPS_SILENCE_NS_MAX;
                Some((gps.offset_ns, if lost { Clock::GpsUnlocked } else { Clock::Gps }))
            }
            None => self.by_arrival(first_ns, turn_ns),
        };
        match (wanted.filter(|(offset_ns, _)| in_reach(*offset_ns)), self.anchor) {
            (Some(wanted), _) => *self.anchor.insert(wanted),
            (None, held) => (held.map_or(0, |(offset_ns, _)| offset_ns), Clock::Held),
        }
    }

    /// The offset by arrival; `None` while arrival is not to be followed.
    fn by_arrival(&mut self, first_ns: i64, turn_ns: Option<i64>) -> Option<(i64, Clock)> {
        let (Some((offset_ns, clock)), Some(turn_ns)) = (self.anchor, turn_ns) else {
            return turn_ns.map(|turn_ns| self.lock(turn_ns)).or(self.anchor);
        };
        let later_ns = turn_ns - offset_ns;
        let jumped = std::mem::take(&mut self.jumped);
        if later_ns > STEP_NS_MAX || (jumped && (DRIFT_NS_MAX..=STEP_NS_MAX).contains(&later_ns.abs())) {
            return Some(self.lock(turn_ns));
        }
        let bound_ns = if clock == Clock::Arrival { DRIFT_NS_MAX } else { STEP_NS_MAX };
        if let Some(agreed_ns) = self.quickest.agreed(first_ns)
            && agreed_ns.abs_diff(offset_ns) > bound_ns as u64
        {
            return Some(self.lock(agreed_ns));
        }
        (later_ns >= -STEP_NS_MAX).then_some((offset_ns, clock))
    }

    /// The offset by arrival alone, or the whole hours that it is all but.
    fn lock(&self, arrival_offset_ns: i64) -> (i64, Clock) {
        match self.timeline.zero_by_hour_ns(arrival_offset_ns) {
            Some(hours_ns) if (hours_ns - arrival_offset_ns).abs() <= HOUR_ERROR_NS_MAX => (hours_ns, Clock::Device),
            _ => (arrival_offset_ns, Clock::Arrival),
        }
    }
}

impl Quickest {
    /// The quickest packet since the last turn ended.
    fn end_turn(&mut self, first_ns: i64) -> Option<i64> {
        let turn_ns = self.turn_ns.take()?;
        let (since_ns, least, greatest) = self.window.unwrap_or((first_ns, turn_ns, turn_ns));
        self.window = Some((since_ns, least.min(turn_ns), greatest.max(turn_ns)));
        Some(turn_ns)
    }

    /// At a window's end: the quickest packet's, if the turns agree.
    fn agreed(&mut self, first_ns: i64) -> Option<i64> {
        let (_, least, greatest) = self.window.take_if(|(since_ns, ..)| first_ns - *since_ns > DRIFT_WINDOW_NS)?;
        (greatest - least <= STEP_NS_MAX).then_some(least)
    }
}

/// UTC when the device's clock showed what telemetry says, if its GPRMC can be believed.
fn device_utc_ns(telemetry: &Telemetry, arrival_ns: i64, late_ns_max: i64) -> Option<i64> {
    let gprmc = telemetry.gprmc.as_ref().filter(|gprmc| gprmc.valid)?;
    let utc_ns = gprmc.utc_ns.filter(|utc_ns| *utc_ns >= EARLIEST_NS)?;
    if arrival_ns.saturating_sub(utc_ns) > late_ns_max {
        return None;
    }
    let age_ns = nearest_hour(i64::from(telemetry.device_us) * 1_000 - utc_ns, 0);
    GPRMC_AGE_NS.contains(&age_ns).then_some(utc_ns + age_ns)
}
