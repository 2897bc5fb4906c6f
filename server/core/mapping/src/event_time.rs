//! The time of a vehicle as its events show it.
//!
//! In: arrival times of events, as the host's clock gave them. Out: [`EventTime`], which never runs backwards.

/// When an event arrived, in two clocks.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct EventTime {
    /// Time at which the event queue accepted the event, ns since the Unix epoch, host clock.
    pub arrival_ns: i64,
    /// Sum of all forward steps from arrival to arrival since the vehicle's first event, ns. It does not run backwards
    /// when the host's clock is set back.
    pub event_ns: i64,
}

/// The event time of one vehicle.
#[derive(Clone, Debug, Default)]
pub(crate) struct EventClock {
    /// Time of the newest event; `None` before the first.
    now: Option<EventTime>,
}

impl EventClock {
    /// Advances the clock to the arrival of the next event and returns the new time.
    pub fn advance(&mut self, arrival_ns: i64) -> EventTime {
        let event_ns = self.now.map_or(0, |before| {
            let step_ns = arrival_ns.saturating_sub(before.arrival_ns).max(0);
            before.event_ns.saturating_add(step_ns)
        });
        let now = EventTime { arrival_ns, event_ns };
        self.now = Some(now);
        now
    }
}
