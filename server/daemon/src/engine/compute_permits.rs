//! Compute permits: a semaphore of the engines of a process, with a permit for each processor.
//!
//! If more engines compute than there are processors, the system divides the time among them, and each of their maps is
//! as late as the last one. With permits one map after the other is finished. An engine keeps its permit while events
//! wait for it, at most until it has made a map. It does not wait for long: an engine that stands still must not stop
//! the others.

use std::num::NonZero;
use std::sync::{Condvar, Mutex, PoisonError};
use std::time::Duration;

use crate::base::sync::locked;

/// Longest wait for a permit. Ours: two or three maps of other vehicles.
const PATIENCE: Duration = Duration::from_millis(20);

/// The semaphore of all engines of a process.
#[derive(Debug)]
pub struct ComputePermits {
    free: Mutex<usize>,
    released: Condvar,
}

/// Permit to compute, released on drop. `None`: granted after the time-out, beside the permits of the semaphore.
#[derive(Debug)]
pub struct ComputePermit<'a>(Option<&'a ComputePermits>);

impl ComputePermits {
    /// A semaphore with so many permits.
    pub fn new(permits: usize) -> Self {
        Self { free: Mutex::new(permits), released: Condvar::new() }
    }

    /// A semaphore with a permit for each processor that this process may use.
    pub fn of_processors() -> Self {
        Self::new(std::thread::available_parallelism().map_or(1, NonZero::get))
    }

    /// Waits for a permit, 20 ms at most.
    pub fn acquire(&self) -> ComputePermit<'_> {
        self.acquire_within(PATIENCE)
    }

    fn acquire_within(&self, patience: Duration) -> ComputePermit<'_> {
        let waited = self.released.wait_timeout_while(locked(&self.free), patience, |free| *free == 0);
        let (mut free, timed_out) = waited.unwrap_or_else(PoisonError::into_inner);
        if timed_out.timed_out() {
            return ComputePermit(None);
        }
        *free -= 1;
        ComputePermit(Some(self))
    }
}

impl Drop for ComputePermit<'_> {
    fn drop(&mut self) {
        if let Some(permits) = self.0 {
            *locked(&permits.free) += 1;
            permits.released.notify_one();
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc::channel;

    use super::*;

    #[test]
    fn no_more_permits_are_granted_than_there_are_and_each_is_free_again() {
        let permits = ComputePermits::new(2);
        let (first, second) = (permits.acquire(), permits.acquire());
        assert!(first.0.is_some() && second.0.is_some());
        assert!(permits.acquire_within(Duration::ZERO).0.is_none());
        drop(first);
        assert!(permits.acquire_within(Duration::ZERO).0.is_some());
        assert!(permits.acquire_within(Duration::ZERO).0.is_some());
    }

    #[test]
    fn a_waiting_engine_has_its_permit_when_another_is_released() {
        let permits = ComputePermits::new(1);
        let held = permits.acquire();
        let (began, waits) = channel();
        std::thread::scope(|scope| {
            let waiting = scope.spawn(|| {
                began.send(()).unwrap();
                permits.acquire_within(Duration::from_secs(60)).0.is_some()
            });
            waits.recv().unwrap();
            drop(held);
            assert!(waiting.join().unwrap());
        });
    }

    #[test]
    fn an_engine_that_stands_still_does_not_stop_the_others() {
        let permits = ComputePermits::new(1);
        let _stands_still = permits.acquire();
        assert!(permits.acquire().0.is_none());
    }
}
