//! The clock of a sensor: the stamps of its revolutions in Unix time, and the clock that these stamps follow.
//!
//! In: device time and arrival of every data packet, and telemetry. Out: the [`Stamp`] of each revolution. The stamps
//! are a pure function of the datagrams and their arrivals.
//!
//! Device time runs on one timeline (`timeline.rs`). Unix time is that timeline plus an *offset*. There is one offset
//! per revolution; it is chosen when the revolution ends.
//!
//! # States
//!
//! The state is the [`Clock`] of the newest revolution. The first row that applies decides it.
//!
//! | condition when a revolution ends | state | offset |
//! |---|---|---|
//! | A GPRMC is within reach, at most 3 s old, and the pulse is locked. | `gps` | from the GPRMC |
//! | A GPRMC is within reach. | `gps_unlocked` | from the GPRMC |
//! | Arrival is within reach, and agrees with the device's minutes to 250 ms. | `device` | whole hours |
//! | Arrival is within reach. | `arrival` | the least delay of a revolution |
//! | None of these, or arrival must not be followed yet. | `holdover` | unchanged |
//!
//! A GPRMC is *within reach* if it is at most 60 s behind the stamps already given; arrival always is. If the chosen
//! clock is behind the stamps during the whole revolution, the state is `holdover` with the offset of that clock, and:
//!
//! - behind by at most [`crate::SensorConfig::ahead_ns_max`], the stamps run at half speed until they are right;
//! - behind by more, they go back to that clock at once: a new *epoch* begins, and the revolution states its number.
//!
//! Within an epoch stamps always rise. Epochs begin at least a second of the timeline apart.
//!
//! # Transitions
//!
//! | event | `gps` | `gps_unlocked` | `device`, `arrival` | `holdover` |
//! |---|---|---|---|---|
//! | valid GPRMC, pulse locked | - | `gps` | `gps` | `gps` if within reach |
//! | valid GPRMC, pulse not locked | `gps_unlocked` | - | `gps_unlocked` | `gps_unlocked` if within reach |
//! | GPRMC invalid; telemetry silent for 3 s; device counter jumps | `gps_unlocked` | - | - | - |
//! | no valid GPRMC for 3 s, the last agreed for less than 0.5 s or are ahead | new offset | new offset | - | - |
//! | device counter jumps, and arrival differs by 10 to 500 ms | `gps_unlocked` | - | new offset | new offset |
//! | least delay rises by more than 500 ms | - | - | new offset | new offset |
//! | least delay rises by more than 500 ms, in a burst | - | - | - | - |
//! | least delay falls by more than 500 ms | - | - | `holdover` | - |
//! | 0.35 s agree on a delay less by 100 ms (`device`: 250 ms) | - | - | new offset | new offset |
//! | 0.35 s agree on a delay more by 100 ms, not in a burst (`device`: 5 s, 250 ms) | - | - | new offset | new offset |
//! | ten seconds agree on another delay, by 10 ms (`device`: 250 ms) | - | - | new offset | new offset |
//! | the stamps reach the offset again | - | - | - | state of that offset |
//!
//! "New offset" leads to `device` or `arrival`, as in the first table. Between these events arrivals change no stamp.
//!
//! # Why
//!
//! - A GPRMC counts as valid if the receiver reports a valid fix, the device's minutes and seconds agree with it, and
//!   it is at most [`crate::SensorConfig::gps_late_ns_max`] older than its arrival. An older GPRMC comes from an old
//!   capture, or from a receiver that has lost count of its weeks; arrival then gives the time, as for the planner. A
//!   GPRMC that is later than its arrival by less than that, less six hours, is valid: no packet arrives before it is
//!   sent, so the host's clock is wrong. A GPRMC that is later by more has a wrong date, unless the host's clock was
//!   never set: it then shows a time before the first of these sensors.
//! - The offset of a GPRMC is a whole number of hours. It is the same to the nanosecond for all arrivals, and it stays
//!   in force if GPS or the pulse is lost, over a restart, and if the host is ahead of it. If it is not within reach,
//!   the stamps go on by arrival. So do they if GPS is lost and nothing vouches for its hour or its date: its sentences
//!   agreed for less than half a second, or it is ahead of the host by more than `ahead_ns_max`, so that no reader
//!   there can use a map.
//! - The offset by arrival is held and not averaged. A rise of the delay means that the host's clock was set forward.
//!   If the packets come faster than they were sent, they have waited (a receiver that stood still, a network): then
//!   the rise is an age and no offset, and the stamps must show it. A rise that stays cannot be told from a clock that
//!   was set; if the device's minutes agree with UTC, they decide for five seconds.
//! - A delay that stays less than the offset means that the host's clock was set back, or that the offset came from
//!   packets that had waited. While the delay goes on falling (a capture that is sent too fast, a burst), there is no
//!   clock to follow.
//! - If the device's minutes and seconds agree with UTC, a receiver without telemetry, or PTP, has set them.
//! - If the host's clock is set while the device is silent, that is no longer silence (`timeline.rs`). If it is set
//!   between the two packets between which the device's counter jumps, the host's step is used, because nothing else
//!   measures the jump. Stamps that are too far ahead for that reason wait until GPS or the host reaches them.
//! - A correction forward applies at once. A reader whose clock is behind the stamps cannot tell the age of a map, so
//!   it uses none: stamps that are too far ahead must go back soon, and must not do so silently.
//! - If `ahead_ns_max` is 0, no epoch begins: for a clock that is at most 60 s behind, the stamps run at half speed,
//!   and no other is followed. Recordings made before there were epochs are replayed so.

use super::gps::{EARLIEST_NS, Gps, device_utc_ns, gps_ahead_ns, is_plausible};
use super::minimum_delay::{MinimumDelay, STEP_NS_MAX};
use super::timeline::{NS_PER_SECOND, StepKind, Timeline};
use crate::datagram::telemetry::{Pps, Telemetry};

/// Latest arrival, in ns since the Unix epoch: the year 2096. Later arrivals are replaced by it, because stamps near
/// the end of 64 bits would overflow.
const ARRIVAL_NS_MAX: i64 = 4_000_000_000 * NS_PER_SECOND;
/// Drift, in ns, above which the offset by arrival is chosen again. At 100 ppm it is reached in 100 s; at 15 m/s it is
/// 15 cm.
const DRIFT_NS_MAX: i64 = 10_000_000;
/// Greatest difference, in ns, between whole hours and the offset by arrival of a device that was set. It is half of
/// [`STEP_NS_MAX`], so that a small later difference does not change the state again.
const HOUR_ERROR_NS_MAX: i64 = 250_000_000;
/// Greatest time, in ns, by which stamps may be ahead of an offset that is within reach. Ours: a receiver that differs
/// by more from the host is less likely to be right.
const REACH_NS_MAX: i64 = 60 * NS_PER_SECOND;
/// Default of [`crate::SensorConfig::ahead_ns_max`], in ns: less than the 300 ms for which a map is valid, and at half
/// speed the stamps are right again after twice this time.
pub const AHEAD_NS_MAX: i64 = 250_000_000;
/// Least time, in ns of the timeline, between the beginnings of two epochs. Ours: telemetry that contradicts itself
/// does not make the stamps go back more often.
const EPOCH_NS_MIN: i64 = NS_PER_SECOND;
/// Change of the delay, in ns, that is followed as soon as revolutions agree on it. Ours: a smaller one is drift, for
/// which ten seconds are soon enough.
const CHANGE_NS_MIN: i64 = 100_000_000;

/// Time, in ns, after which a delay that has risen means that the host's clock was set, although the device's minutes
/// agree with UTC. Ours: packets that wait for so long on their way do not all wait for the same time.
const RISE_NS: i64 = 5 * NS_PER_SECOND;

/// The clock that the stamps of a revolution follow.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Clock {
    /// The host's clock at the arrival of the packets with the least delay, and between them the device's oscillator
    /// (of an HDL-64E S1: the nominal packet rate).
    #[default]
    Arrival,
    /// The device's minutes and seconds, which agree with the host's clock; the hour is the host's.
    Device,
    /// GPS: telemetry gives date and hour, and the pulse is locked (an HDL-32E does not report whether it is).
    Gps,
    /// GPS, which has set the device; since then GPS or its pulse was lost.
    GpsUnlocked,
    /// No clock: the clock to follow is behind the stamps already given. The stamps advance with the device's
    /// oscillator, at half speed if the clock is within reach.
    Holdover,
}

impl Clock {
    /// Name of the clock in configuration, maps and logs.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Arrival => "arrival",
            Self::Device => "device",
            Self::Gps => "gps",
            Self::GpsUnlocked => "gps_unlocked",
            Self::Holdover => "holdover",
        }
    }
}

/// The stamps of a revolution.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Stamp {
    /// Stamp of the first firing, in ns since the Unix epoch.
    pub start_ns: i64,
    /// Stamp of the last firing, in ns since the Unix epoch.
    pub end_ns: i64,
    pub clock: Clock,
    /// Least delay of the revolution's packets: arrival less stamp, in ms.
    pub clock_offset_ms: i64,
    /// Number of the epoch: how often stamps have gone back since the first.
    pub epoch: u32,
    /// Time, in ns, by which `start_ns` is ahead of the clock, so that stamps rise.
    early_ns: i64,
}

impl Stamp {
    /// Offset of a firing from `start_ns`, from its offset by device time; both in ns. They differ if the revolution
    /// runs at half speed.
    pub fn offset_ns(&self, device_offset_ns: u32) -> u32 {
        if self.early_ns <= 0 {
            return device_offset_ns;
        }
        let device_ns = i64::from(device_offset_ns);
        (device_ns - self.early_ns).max(device_ns / 2) as u32
    }
}

/// The clock of one sensor.
#[derive(Clone, Debug, Default)]
pub(crate) struct DeviceClock {
    gps_late_ns_max: i64,
    ahead_ns_max: i64,
    timeline: Timeline,
    gps: Option<Gps>,
    /// Time by which the newest GPRMC is ahead of its arrival, if it was refused for that.
    gps_ahead_ns: Option<i64>,
    /// Telemetry from behind a jump that no data packet has shown yet.
    pending: Option<PendingGps>,
    minimum_delay: MinimumDelay,
    /// Offset in force, and the clock that it follows.
    offset: Option<(i64, Clock)>,
    /// True if the device's counter has jumped since the offset was chosen.
    jumped: bool,
    newest: Option<Stamp>,
    /// Beginning of the newest epoch on the timeline; `None` in the first.
    epoch_began_ns: Option<i64>,
}

/// A valid GPRMC whose device time is not on the timeline yet.
#[derive(Clone, Copy, Debug)]
struct PendingGps {
    device_us: u32,
    utc_ns: i64,
    locked: bool,
}

impl DeviceClock {
    /// The clock of a sensor before its first datagram. The arguments are defined by [`crate::SensorConfig`].
    pub fn new(gps_late_ns_max: i64, ahead_ns_max: i64) -> Self {
        Self { gps_late_ns_max, ahead_ns_max, ..Self::default() }
    }

    /// Applies telemetry that arrived at `arrival_ns`. `reports_pps`: true if the model reports the state of the pulse.
    pub fn apply_telemetry(&mut self, telemetry: &Telemetry, reports_pps: bool, arrival_ns: i64) {
        let locked = match telemetry.pps {
            Pps::Locked => true,
            Pps::Absent => !reports_pps,
            Pps::Attempting | Pps::Error | Pps::Unknown(_) => false,
        };
        let is_set = arrival_ns >= EARLIEST_NS;
        let ahead_ns = gps_ahead_ns(telemetry, arrival_ns);
        self.gps_ahead_ns = ahead_ns.filter(|ahead_ns| !is_plausible(*ahead_ns, is_set, self.gps_late_ns_max));
        let Some(utc_ns) = device_utc_ns(telemetry).filter(|_| self.gps_ahead_ns.is_none()) else {
            self.gps.iter_mut().for_each(|gps| gps.locked = false);
            return;
        };
        self.pending = Some(PendingGps { device_us: telemetry.device_us, utc_ns, locked });
        self.apply_pending();
    }

    /// Time by which GPS time is ahead of its arrival, in ns, if it is not used for that.
    pub fn gps_ahead_ns(&self) -> Option<i64> {
        self.gps_ahead_ns
    }

    /// Applies the pending GPRMC if its device time is on the timeline now.
    fn apply_pending(&mut self) {
        let Some(PendingGps { device_us, utc_ns, locked }) = self.pending else { return };
        if let Some(received_ns) = self.timeline.time_at(device_us) {
            self.gps = Some(Gps::new(utc_ns - received_ns, received_ns, locked, self.gps));
            self.pending = None;
        }
    }

    /// Adds a packet and returns the time of its first firing on the timeline, in ns. `device_us`: device time past the
    /// hour, if the sensor sends one; `elapsed_ns`: time since the packet before, as far as packets show it;
    /// `arrival_ns`: arrival of the datagram; `span_ns`: time from the first firing of the packet to its sending.
    pub fn push_packet(&mut self, device_us: Option<u32>, elapsed_ns: i64, arrival_ns: i64, span_ns: i64) -> i64 {
        let sent_ns = arrival_ns.clamp(0, ARRIVAL_NS_MAX) - span_ns;
        let due_ns = self.offset.map(|(offset_ns, _)| sent_ns.saturating_sub(offset_ns));
        let (time_ns, step) = self.timeline.push(device_us, elapsed_ns, sent_ns, due_ns);
        if step == StepKind::Jumped {
            self.gps.iter_mut().for_each(|gps| gps.locked = false);
            (self.minimum_delay, self.jumped) = (MinimumDelay::default(), true);
        }
        if step != StepKind::Continuous {
            self.apply_pending();
        }
        self.minimum_delay.push(time_ns, sent_ns - time_ns);
        time_ns
    }

    /// Ends a revolution and returns its stamps. `first_ns`: time of its first firing on the timeline;
    /// `last_offset_ns`: time from its first to its last firing; `None` without firings.
    pub fn end_revolution(&mut self, first_ns: i64, last_offset_ns: Option<u32>) -> Stamp {
        let delay_ns = self.minimum_delay.end_revolution(first_ns);
        let (offset_ns, clock) = self.choose(first_ns, delay_ns);
        let right_ns = offset_ns + first_ns;
        let begins_epoch = self.begin_epoch_if_ahead(first_ns, right_ns);
        let start_ns = match self.newest {
            Some(newest) if !begins_epoch => right_ns.max(newest.end_ns + 1),
            _ => right_ns,
        };
        let epoch = self.newest.map_or(0, |newest| newest.epoch.saturating_add(u32::from(begins_epoch)));
        let early_ns = start_ns - right_ns;
        let mut stamp = Stamp { start_ns, end_ns: start_ns, clock, clock_offset_ms: 0, epoch, early_ns };
        if let Some(last_offset_ns) = last_offset_ns {
            let last_offset_ns = i64::from(stamp.offset_ns(last_offset_ns));
            stamp.end_ns += last_offset_ns;
            if stamp.early_ns > 0 && last_offset_ns < stamp.early_ns {
                stamp.clock = Clock::Holdover;
            }
        }
        let ms = |ns: i64| (ns + 500_000).div_euclid(1_000_000);
        stamp.clock_offset_ms = match delay_ns {
            Some(delay_ns) => ms(delay_ns + first_ns - start_ns),
            None => self.newest.map_or(0, |newest| newest.clock_offset_ms),
        };
        self.newest = Some(stamp);
        stamp
    }

    /// Begins an epoch if the right stamp of a revolution is so far behind the newest stamp that stamps go back to it.
    fn begin_epoch_if_ahead(&mut self, first_ns: i64, right_ns: i64) -> bool {
        let is_ahead = self.newest.is_some_and(|newest| newest.end_ns - right_ns > self.ahead_ns_max);
        let begins = self.ahead_ns_max > 0 && is_ahead && self.may_begin_epoch(first_ns);
        if begins {
            self.epoch_began_ns = Some(first_ns);
        }
        begins
    }

    /// True if the newest epoch is old enough for another epoch to begin at `first_ns` on the timeline.
    fn may_begin_epoch(&self, first_ns: i64) -> bool {
        self.epoch_began_ns.is_none_or(|began_ns| first_ns - began_ns >= EPOCH_NS_MIN)
    }

    /// Chooses the offset of a revolution, and the clock that it follows.
    fn choose(&mut self, first_ns: i64, delay_ns: Option<i64>) -> (i64, Clock) {
        if self.ahead_ns_max > 0 && self.gps.is_some_and(|gps| gps.is_doubtful(first_ns, delay_ns, self.ahead_ns_max)) {
            (self.gps, self.offset) = (None, None);
        }
        let newest_ns = self.newest.map(|newest| newest.end_ns);
        let is_ahead = |offset_ns: i64, ns_max: i64| newest_ns.is_some_and(|ns| ns - (offset_ns + first_ns) > ns_max);
        let wanted = match self.gps.filter(|gps| !is_ahead(gps.offset_ns, REACH_NS_MAX)) {
            Some(gps) => {
                let lost = !gps.locked || gps.is_silent(first_ns);
                Some((gps.offset_ns, if lost { Clock::GpsUnlocked } else { Clock::Gps }))
            }
            None => self.choose_by_arrival(first_ns, delay_ns),
        };
        let ahead_ns_max = match self.ahead_ns_max {
            0 => REACH_NS_MAX,
            _ if self.may_begin_epoch(first_ns) => i64::MAX,
            ahead_ns_max => ahead_ns_max,
        };
        match (wanted.filter(|(offset_ns, _)| !is_ahead(*offset_ns, ahead_ns_max)), self.offset) {
            (Some(wanted), _) => *self.offset.insert(wanted),
            (None, before) => (before.map_or(0, |(offset_ns, _)| offset_ns), Clock::Holdover),
        }
    }

    /// The offset by arrival; `None` while arrival cannot be followed.
    fn choose_by_arrival(&mut self, first_ns: i64, delay_ns: Option<i64>) -> Option<(i64, Clock)> {
        let (Some((offset_ns, clock)), Some(delay_ns)) = (self.offset, delay_ns) else {
            return delay_ns.map(|delay_ns| self.offset_by_arrival(delay_ns)).or(self.offset);
        };
        let later_ns = delay_ns - offset_ns;
        let jumped = std::mem::take(&mut self.jumped);
        let (has_epochs, is_burst) = (self.ahead_ns_max > 0, self.minimum_delay.is_burst());
        if later_ns > STEP_NS_MAX && !(has_epochs && is_burst)
            || (jumped && (DRIFT_NS_MAX..=STEP_NS_MAX).contains(&later_ns.abs()))
        {
            return Some(self.offset_by_arrival(delay_ns));
        }
        let (change_ns_min, rises_for_ns) = match clock {
            Clock::Arrival => (CHANGE_NS_MIN, if is_burst { i64::MAX } else { 0 }),
            _ => (HOUR_ERROR_NS_MAX, RISE_NS),
        };
        if let Some((agreed_ns, for_ns)) = self.minimum_delay.agreed(first_ns).filter(|_| has_epochs)
            && (offset_ns - agreed_ns > change_ns_min
                || agreed_ns - offset_ns > change_ns_min && for_ns >= rises_for_ns)
        {
            return Some(self.offset_by_arrival(agreed_ns));
        }
        let bound_ns = if clock == Clock::Arrival { DRIFT_NS_MAX } else { HOUR_ERROR_NS_MAX };
        if let Some(agreed_ns) = self.minimum_delay.end_window(first_ns)
            && agreed_ns.abs_diff(offset_ns) > bound_ns as u64
        {
            return Some(self.offset_by_arrival(agreed_ns));
        }
        (later_ns >= -STEP_NS_MAX).then_some((offset_ns, clock))
    }

    /// The offset of whole hours if it is near the offset by arrival, else the offset by arrival.
    fn offset_by_arrival(&mut self, arrival_offset_ns: i64) -> (i64, Clock) {
        self.minimum_delay.restart_window();
        match self.timeline.zero_by_hour_ns(arrival_offset_ns) {
            Some(hours_ns) if (hours_ns - arrival_offset_ns).abs() <= HOUR_ERROR_NS_MAX => (hours_ns, Clock::Device),
            _ => (arrival_offset_ns, Clock::Arrival),
        }
    }
}
