//! The time of a vehicle as its events show it.
//!
//! In: arrival times of events, as the host's clock gave them. Out: [`EventTime`], which never runs backwards.
//!
//! Events of different sources may be out of order: the kernel stamps a datagram when it arrives, an observation is
//! stamped when it is read, and a server that stood still reads the datagrams of one socket after the datagrams of
//! another socket. The arrivals of one source and kind (a *lane*) are in order, unless the host's clock is set back.
//!
//! | arrival | event time |
//! |---|---|
//! | later than all arrivals before | advances by the difference |
//! | earlier, but not earlier than the arrival before in its lane | stays: the event was read late |
//! | earlier than the arrival before in its lane, or by more than 10 s than any | stays; later arrivals count from it |

use std::collections::BTreeMap;

/// When an event arrived, in two clocks.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct EventTime {
    /// Time at which the event queue accepted the event, ns since the Unix epoch, host clock.
    pub arrival_ns: i64,
    /// Sum of all forward steps of arrivals since the vehicle's first event, ns. It does not run backwards when the
    /// host's clock is set back.
    pub event_ns: i64,
}

/// Greatest time by which an event that was read late is behind the latest one, ns. Ours: a server that stands still
/// for longer is restarted, and a single event with a stamp in the future must not stop the event time for longer.
const LATE_NS_MAX: i64 = 10_000_000_000;

/// The event time of one vehicle.
#[derive(Clone, Debug, Default)]
pub(crate) struct EventClock {
    /// Latest arrival since the host's clock was set back, and the event time then; `None` before the first event.
    latest: Option<EventTime>,
    /// Newest arrival of each lane, ns.
    lanes: BTreeMap<(u16, u8), i64>,
}

impl EventClock {
    /// Advances the clock to the arrival of the next event and returns its time. `lane` is the source of the event and
    /// [`crate::event::Body::lane`].
    pub fn advance(&mut self, arrival_ns: i64, lane: (u16, u8)) -> EventTime {
        let before_ns = self.lanes.insert(lane, arrival_ns);
        let latest = self.latest.get_or_insert(EventTime { arrival_ns, event_ns: 0 });
        let step_ns = arrival_ns.saturating_sub(latest.arrival_ns);
        let is_set_back = before_ns.is_some_and(|before_ns| arrival_ns < before_ns) || step_ns < -LATE_NS_MAX;
        if step_ns > 0 || is_set_back {
            latest.event_ns = latest.event_ns.saturating_add(step_ns.max(0));
            latest.arrival_ns = arrival_ns;
        }
        EventTime { arrival_ns, event_ns: latest.event_ns }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: i64 = 1_000_000;

    fn advance(clock: &mut EventClock, source: u16, arrival_ms: i64) -> i64 {
        let now = clock.advance(arrival_ms * MS, (source, 1));
        assert_eq!(now.arrival_ns, arrival_ms * MS);
        now.event_ns / MS
    }

    #[test]
    fn events_that_are_read_late_do_not_advance_the_event_time_twice() {
        let mut clock = EventClock::default();
        let times = [(0, 100), (1, 100), (1, 4100), (0, 200), (1, 4200), (0, 300), (0, 4250), (1, 4300)];
        let event_ms: Vec<_> = times.iter().map(|(source, ms)| advance(&mut clock, *source, *ms)).collect();
        assert_eq!(event_ms, [0, 0, 4000, 4000, 4100, 4100, 4150, 4200]);
    }

    #[test]
    fn the_event_time_goes_on_at_once_when_the_clock_is_set_back() {
        let mut clock = EventClock::default();
        let times = [(0, 9000), (1, 9001), (0, 7010), (1, 7011), (0, 7020), (1, 7021)];
        let event_ms: Vec<_> = times.iter().map(|(source, ms)| advance(&mut clock, *source, *ms)).collect();
        assert_eq!(event_ms, [0, 1, 1, 2, 11, 12]);
    }

    #[test]
    fn one_event_of_the_future_does_not_stop_the_event_time() {
        let mut clock = EventClock::default();
        let times = [(0, 0), (1, 3_600_000), (0, 100), (0, 200), (0, 300)];
        let event_ms: Vec<_> = times.iter().map(|(source, ms)| advance(&mut clock, *source, *ms)).collect();
        assert_eq!(event_ms, [0, 3_600_000, 3_600_000, 3_600_100, 3_600_200]);
    }
}
