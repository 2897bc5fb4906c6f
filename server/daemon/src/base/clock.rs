//! The time of day, and the clock that stamps events. No other file reads the system's time of day; durations are
//! measured with [`std::time::Instant`] where they arise.

use std::fmt;
use std::sync::Arc;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use nix::time::{ClockId, clock_gettime};

/// The system's time, ns since the Unix epoch.
pub fn now_ns() -> i64 {
    match SystemTime::now().duration_since(UNIX_EPOCH) {
        Ok(since) => i64::try_from(since.as_nanos()).unwrap_or(i64::MAX),
        Err(before) => -i64::try_from(before.duration().as_nanos()).unwrap_or(i64::MAX),
    }
}

/// How long a thread has had a processor since a start. Reading it is a system call.
#[derive(Clone, Copy, Debug)]
pub struct WorkTime {
    before: Duration,
}

impl WorkTime {
    /// Starts in the calling thread, which reads it too.
    pub fn start() -> Self {
        Self { before: thread_time() }
    }

    /// The time for which the thread has had a processor since the start.
    pub fn worked(&self) -> Duration {
        thread_time().saturating_sub(self.before)
    }
}

/// The time for which the calling thread has had a processor; zero if the system does not tell.
fn thread_time() -> Duration {
    clock_gettime(ClockId::CLOCK_THREAD_CPUTIME_ID).map_or(Duration::ZERO, Duration::from)
}

/// A source of the time, ns since the Unix epoch: the system's by default, or the simulated time of a test.
#[derive(Clone)]
pub struct Clock(Arc<dyn Fn() -> i64 + Send + Sync>);

impl Clock {
    /// A clock whose time is the return value of `now_ns`.
    pub fn new(now_ns: impl Fn() -> i64 + Send + Sync + 'static) -> Self {
        Self(Arc::new(now_ns))
    }

    /// The clock's time, ns since the Unix epoch.
    pub fn now_ns(&self) -> i64 {
        (self.0)()
    }
}

impl Default for Clock {
    fn default() -> Self {
        Self::new(now_ns)
    }
}

impl fmt::Debug for Clock {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("Clock").field(&self.now_ns()).finish()
    }
}
