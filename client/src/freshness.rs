//! Age of a map by two clocks.
//!
//! In: this machine's wall clock, which is compared with the server's stamps, and a steady clock, which never goes
//! back. Out: the least age that a map can have. The age starts at the end of the capture, which is a stamp of the wall
//! clock; but a wall clock can be set back. So a map is at least as old as its age on arrival plus the time since then
//! by the steady clock. No step of the wall clock makes a stale map fresh.

use std::fmt;
use std::sync::{Arc, LazyLock};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

/// Interval at which a waiting stream reads its clocks: it reports a stale map, and notices a step of the wall clock,
/// at most this late. Ours, because planners are promised 50 ms.
pub(crate) const POLL_INTERVAL: Duration = Duration::from_millis(20);

static START: LazyLock<Instant> = LazyLock::new(Instant::now);

type Read = Arc<dyn Fn() -> i64 + Send + Sync>;

/// The clocks of a stream.
#[derive(Clone)]
pub(crate) struct Clock {
    /// Wall clock, ns since the Unix epoch; it can be set forward and back.
    pub wall_ns: Read,
    /// Steady clock, ns since the start of the process; it never goes back.
    pub steady_ns: Read,
    /// True: the wall clock is the replay's, which stood at the end of the making of each map when it came.
    pub is_of_replay: bool,
}

impl Default for Clock {
    /// The clocks of this machine.
    fn default() -> Self {
        let steady = || i64::try_from(START.elapsed().as_nanos()).unwrap_or(i64::MAX);
        Self { wall_ns: Arc::new(now_ns), steady_ns: Arc::new(steady), is_of_replay: false }
    }
}

impl fmt::Debug for Clock {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str("Clock")
    }
}

/// Arrival of a map at this process.
#[derive(Clone, Debug)]
pub(crate) struct Arrival {
    clock: Clock,
    steady_ns: i64,
    /// Age of the map on arrival, by the wall clock.
    age_ns: i64,
}

impl Arrival {
    /// Arrival, now, of a map captured at `capture_end_ns` and made at `completed_ns`.
    pub fn new(mut clock: Clock, capture_end_ns: i64, completed_ns: i64) -> Self {
        if clock.is_of_replay {
            let (steady, came_ns) = (clock.steady_ns.clone(), (clock.steady_ns)());
            clock.wall_ns = Arc::new(move || completed_ns.saturating_add(steady().saturating_sub(came_ns)));
        }
        let age_ns = (clock.wall_ns)().saturating_sub(capture_end_ns).max(0);
        Self { steady_ns: (clock.steady_ns)(), age_ns, clock }
    }

    /// Least age of the map; it does not depend on the present wall clock.
    pub fn age_ns_min(&self) -> i64 {
        self.age_ns.saturating_add(self.since_ns())
    }

    /// Age of the map when it arrived, in ns, by the wall clock; 0 if it was captured in that clock's future.
    pub fn age_on_arrival_ns(&self) -> i64 {
        self.age_ns
    }

    /// Time since the arrival, in ns, by the steady clock.
    pub fn since_ns(&self) -> i64 {
        (self.clock.steady_ns)().saturating_sub(self.steady_ns)
    }

    /// Present time of the wall clock, ns since the Unix epoch.
    pub fn now_ns(&self) -> i64 {
        (self.clock.wall_ns)()
    }
}

/// Present time of this machine's wall clock, ns since the Unix epoch.
pub fn now_ns() -> i64 {
    let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    i64::try_from(since.as_nanos()).unwrap_or(i64::MAX)
}
