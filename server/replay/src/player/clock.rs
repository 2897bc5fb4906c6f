//! Recorded time -> the time of this machine, for a replay at a rate, with pauses and jumps.

use std::time::{Duration, Instant};

use clearway_journal::encode::{Replayed, lag_ns};
use clearway_proto::v1;

/// When events of recorded time are due, and how far their stamps are from the present. It starts at the first event
/// that it is asked about. A pause stops it, also between two events; [`ReplayClock::restart`] begins elsewhere.
#[derive(Debug)]
pub struct ReplayClock {
    /// Speed relative to recorded time; infinite: as fast as possible.
    rate: f64,
    anchor: Option<Anchor>,
    /// Recorded time from which it goes on; `None`: the time of the next event.
    begins_ns: Option<i64>,
    lag: StampLag,
}

/// Time by which the stamps of a drive are behind the arrivals of its events, in ns, because its sensor followed
/// another clock than its host: the [`lag_ns`] of its first map. It is followed as soon as it is less, and after
/// [`LATE_MAPS_MAX`] maps if it is more: maps that were late on the way of the drive are late as live too.
#[derive(Debug, Default)]
struct StampLag {
    ns: Option<i64>,
    late_maps: u32,
}

/// Number of maps in a row after which a greater lag is a clock's. Ours: one second.
const LATE_MAPS_MAX: u32 = 10;

impl StampLag {
    /// Adds the lag of a map.
    fn add(&mut self, map_ns: i64) {
        let is_late = self.ns.is_some_and(|ns| map_ns > ns);
        self.late_maps = if is_late { self.late_maps + 1 } else { 0 };
        if !is_late || self.late_maps >= LATE_MAPS_MAX {
            (self.ns, self.late_maps) = (Some(map_ns), 0);
        }
    }
}

/// An event's recorded time, and the time at which it was replayed by both clocks of this machine.
#[derive(Clone, Copy, Debug)]
struct Anchor {
    recorded_ns: i64,
    steady: Instant,
    wall_ns: i64,
}

impl ReplayClock {
    /// A clock that runs at `rate` times recorded time.
    pub fn new(rate: f64) -> Self {
        Self { rate, anchor: None, begins_ns: None, lag: StampLag::default() }
    }

    /// Runs at `rate` from the next event on.
    pub fn set_rate(&mut self, rate: f64) {
        self.pause();
        self.rate = rate;
    }

    /// Stops until the next call of [`ReplayClock::due`]. What has passed of a silence between two events stays passed.
    pub fn pause(&mut self) {
        if let Some(anchor) = self.anchor.take() {
            let passed_ns = (anchor.steady.elapsed().as_secs_f64() * self.rate * 1e9) as i64;
            self.begins_ns = Some(anchor.recorded_ns.saturating_add(passed_ns));
        }
    }

    /// Begins again at a recorded time; `None`: at the time of the next event, whenever it comes.
    pub fn restart(&mut self, at_ns: Option<i64>) {
        (self.anchor, self.begins_ns) = (None, at_ns);
    }

    /// When the event is due; `None`: now. `wall_ns` is the wall clock's present time.
    pub fn due(&mut self, recorded_ns: i64, wall_ns: i64) -> Option<Instant> {
        if !self.rate.is_finite() {
            self.restart(None);
            return None;
        }
        // An event that was due before the pause is not late after it.
        let begins_ns = self.begins_ns.take().map_or(recorded_ns, |begins_ns| begins_ns.min(recorded_ns));
        let steady = Instant::now();
        let anchor = self.anchor.get_or_insert(Anchor { recorded_ns: begins_ns, steady, wall_ns });
        let passed_ns = recorded_ns.saturating_sub(anchor.recorded_ns).max(0);
        let after = Duration::try_from_secs_f64(passed_ns as f64 * 1e-9 / self.rate).unwrap_or(Duration::MAX);
        anchor.steady.checked_add(after)
    }

    /// Notes that the event of the recorded time `at_ns` has made a map whose capture ended at `capture_end_ns`.
    pub fn note_map(&mut self, at_ns: i64, capture_end_ns: i64) {
        self.lag.add(lag_ns(at_ns, capture_end_ns));
    }

    /// The header that a map of the recorded time `at_ns` is served with; `None` for the recorded map's own. As live
    /// its stamps follow this machine's clock, also if the drive's stamps are behind its arrivals.
    pub fn replayed(&self, state: &v1::ReplayState, boot_id: u64, at_ns: i64, wall_ns: i64) -> Option<Replayed> {
        let shift_ns = match state.as_live {
            true => self.shift_ns(at_ns, wall_ns).saturating_add(self.lag.ns.unwrap_or(0)),
            false => 0,
        };
        let boot_id = boot_id.wrapping_add(state.jumps);
        let first_at_ns = (state.as_live && self.lag.ns.is_none()).then_some(at_ns);
        (state.as_live || state.jumps > 0).then_some(Replayed { shift_ns, boot_id, first_at_ns })
    }

    /// What is added to a stamp of the event's time to move it to the time at which the event is due: one constant at
    /// rate 1. `wall_ns` is the wall clock's present time.
    pub fn shift_ns(&self, recorded_ns: i64, wall_ns: i64) -> i64 {
        match self.anchor.filter(|_| self.rate.is_finite()) {
            None => wall_ns.saturating_sub(recorded_ns),
            Some(anchor) => {
                let constant = anchor.wall_ns.saturating_sub(anchor.recorded_ns);
                let passed_ns = recorded_ns.saturating_sub(anchor.recorded_ns) as f64;
                // Exactly 0 at rate 1.
                constant.saturating_add((passed_ns * (1.0 / self.rate - 1.0)) as i64)
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn at_rate_one_all_stamps_move_by_one_constant() {
        let mut clock = ReplayClock::new(1.0);
        let due = clock.due(5_000_000_000, 1_000).unwrap();
        assert_eq!(clock.due(5_250_000_000, 777).unwrap() - due, Duration::from_millis(250));
        for recorded_ns in [5_000_000_000, 5_000_000_001, 9_123_456_789] {
            assert_eq!(clock.shift_ns(recorded_ns, 42), 1_000 - 5_000_000_000);
        }
    }

    #[test]
    fn maps_of_a_drive_whose_sensor_is_behind_its_host_are_fresh_as_live() {
        const MS: i64 = 1_000_000;
        let (mut clock, state) = (ReplayClock::new(1.0), v1::ReplayState { as_live: true, ..Default::default() });
        let mut map = |at: i64, behind: i64| {
            clock.due(at * MS, 0);
            let Replayed { shift_ns, first_at_ns, .. } = clock.replayed(&state, 0, at * MS, 0).expect("its own stamps");
            let shift_ns = shift_ns + first_at_ns.map_or(0, |at_ns| lag_ns(at_ns, (at - behind) * MS));
            clock.note_map(at * MS, (at - behind) * MS);
            // The drive began at 1000 ms, which is 0 of this machine.
            (at - 1_000) - ((at - behind) + shift_ns / MS)
        };
        assert_eq!(map(1_000, 950), 50, "the first map shows it");
        assert_eq!([map(1_100, 955), map(1_200, 930), map(1_300, 1_400)], [55, 30, 500], "one map was late");
        assert_eq!([map(1_400, -450), map(1_500, -450)], [-1_350, 50], "stamps of the future are followed at once");
        let ages: Vec<_> = (0..12).map(|n| map(1_600 + 100 * n, 20)).collect();
        assert_eq!((ages[9], ages[10]), (520, 20), "a clock that was set is followed after a second: {ages:?}");
    }

    #[test]
    fn a_pause_in_a_silence_does_not_shorten_it() {
        let mut clock = ReplayClock::new(1.0);
        clock.due(1_000_000_000, 0);
        let due = clock.due(7_000_000_000, 0).unwrap();
        for _ in 0..2 {
            clock.pause();
        }
        // The pause itself took no recorded time.
        let (due_after, now) = (clock.due(7_000_000_000, 0).unwrap(), Instant::now());
        assert!(due_after >= due && due_after - now > Duration::from_secs(5), "{:?}", due_after - now);
        clock.pause();
        // An event that has been passed is due at once.
        let passed = clock.due(500_000_000, 0).unwrap();
        assert!(passed <= Instant::now());
        clock.restart(Some(3_000_000_000));
        assert!(clock.due(7_000_000_000, 0).unwrap() - Instant::now() > Duration::from_secs(3), "4 s after a jump");
        clock.restart(None);
        assert!(clock.due(9_000_000_000, 0).unwrap() <= Instant::now());
        clock.pause();
        clock.set_rate(f64::INFINITY);
        assert_eq!(clock.due(10_000_000_000, 0), None);
        clock.set_rate(1.0);
        assert!(clock.due(60_000_000_000, 0).unwrap() <= Instant::now(), "the clock did not run meanwhile");
    }

    #[test]
    fn at_other_rates_a_stamp_moves_to_the_time_at_which_its_event_is_due() {
        let mut clock = ReplayClock::new(0.5);
        clock.due(1_000, 10_000);
        assert_eq!(1_400 + clock.shift_ns(1_400, 0), 10_800);
        clock.set_rate(f64::INFINITY);
        assert_eq!(clock.due(1_400, 20_000), None);
        assert_eq!(clock.shift_ns(1_400, 20_000), 18_600);
    }
}
