//! How old a map is, by two clocks.
//!
//! In: this machine's wall clock, which the server's stamps are compared with, and a steady one that only goes forward.
//! Out: the least age a map can have. Age counts from the end of the capture, which only the wall clock can tell; but a
//! wall clock can be set back. So a map is at least as old as it was when it came, and the time since by the steady
//! clock: no step of the wall clock makes a stale map fresh.

use std::fmt;
use std::sync::{Arc, LazyLock};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

/// How often a stream that waits looks at its clocks: a map is told as stale at most this late, and no step of the wall
/// clock goes unseen for longer. A fraction of the 50 ms that planners are promised.
pub(crate) const LOOK: Duration = Duration::from_millis(20);

static START: LazyLock<Instant> = LazyLock::new(Instant::now);

type Read = Arc<dyn Fn() -> i64 + Send + Sync>;

/// Where the time comes from.
#[derive(Clone)]
pub(crate) struct Clock {
    /// ns since the Unix epoch; may be stepped.
    pub wall_ns: Read,
    /// ns since some moment; never goes back.
    pub steady_ns: Read,
}

impl Default for Clock {
    /// This machine's.
    fn default() -> Self {
        let steady = || i64::try_from(START.elapsed().as_nanos()).unwrap_or(i64::MAX);
        Self { wall_ns: Arc::new(now_ns), steady_ns: Arc::new(steady) }
    }
}

impl fmt::Debug for Clock {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str("Clock")
    }
}

/// When a map came to this process.
#[derive(Clone, Debug)]
pub(crate) struct Arrival {
    clock: Clock,
    steady_ns: i64,
    /// By the wall clock, as it was then.
    age_ns: i64,
}

impl Arrival {
    /// Now, of a map captured at `capture_end_ns`.
    pub fn new(clock: Clock, capture_end_ns: i64) -> Self {
        let age_ns = (clock.wall_ns)().saturating_sub(capture_end_ns).max(0);
        Self { steady_ns: (clock.steady_ns)(), age_ns, clock }
    }

    /// What the map is old at least, whatever the wall clock says now.
    pub fn age_ns_min(&self) -> i64 {
        self.age_ns.saturating_add((self.clock.steady_ns)().saturating_sub(self.steady_ns))
    }

    /// What the wall clock says now, ns since the Unix epoch.
    pub fn now_ns(&self) -> i64 {
        (self.clock.wall_ns)()
    }
}

/// This machine's clock, ns since the Unix epoch.
pub fn now_ns() -> i64 {
    let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    i64::try_from(since.as_nanos()).unwrap_or(i64::MAX)
}
