//! Recorded time -> the time of this machine, for a replay at one rate without interruption.

use std::time::{Duration, Instant};

use clearway_proto::v1;

use crate::encode::Replayed;

/// When events of recorded time are due, and how far their stamps are from the present. It starts at the first event
/// that it is asked about, and again after [`ReplayClock::restart`].
#[derive(Debug)]
pub struct ReplayClock {
    /// Speed relative to recorded time; infinite: as fast as possible.
    rate: f64,
    anchor: Option<Anchor>,
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
        Self { rate, anchor: None }
    }

    /// Runs at `rate` from the next event on.
    pub fn set_rate(&mut self, rate: f64) {
        (self.rate, self.anchor) = (rate, None);
    }

    /// Begins again at the next event: after a pause, a jump or any other wait.
    pub fn restart(&mut self) {
        self.anchor = None;
    }

    /// When the event is due; `None`: now. `wall_ns` is the wall clock's present time.
    pub fn due(&mut self, recorded_ns: i64, wall_ns: i64) -> Option<Instant> {
        if !self.rate.is_finite() {
            return None;
        }
        let anchor = self.anchor.get_or_insert_with(|| Anchor { recorded_ns, steady: Instant::now(), wall_ns });
        let passed_ns = recorded_ns.saturating_sub(anchor.recorded_ns).max(0);
        let after = Duration::try_from_secs_f64(passed_ns as f64 * 1e-9 / self.rate).unwrap_or(Duration::MAX);
        anchor.steady.checked_add(after)
    }

    /// The header that a map of the recorded time `at_ns` is served with; `None` for that of the recorded map.
    pub fn replayed(&self, state: &v1::ReplayState, boot_id: u64, at_ns: i64, wall_ns: i64) -> Option<Replayed> {
        let shift_ns = if state.as_live { self.shift_ns(at_ns, wall_ns) } else { 0 };
        let boot_id = boot_id.wrapping_add(state.jumps);
        (state.as_live || state.jumps > 0).then_some(Replayed { shift_ns, boot_id })
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
    fn at_other_rates_a_stamp_moves_to_the_time_at_which_its_event_is_due() {
        let mut clock = ReplayClock::new(0.5);
        clock.due(1_000, 10_000);
        assert_eq!(1_400 + clock.shift_ns(1_400, 0), 10_800);
        clock.set_rate(f64::INFINITY);
        assert_eq!(clock.due(1_400, 20_000), None);
        assert_eq!(clock.shift_ns(1_400, 20_000), 18_600);
    }
}
