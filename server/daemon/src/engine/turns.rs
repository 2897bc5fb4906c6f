//! Turns of the engines: as many work at once as there are processors.
//!
//! If more engines work than there are processors, the system divides the time among them, and each of their maps is
//! as late as the last one. In turn, one map after the other is finished. An engine keeps its turn while events wait
//! for it, at most until it has made a map. It does not wait for long: an engine that stands still must not stop the
//! others.

use std::num::NonZero;
use std::sync::{Condvar, Mutex, PoisonError};
use std::time::Duration;

use crate::base::sync::locked;

/// Longest wait for a turn. Ours: two or three maps of other vehicles.
const PATIENCE: Duration = Duration::from_millis(20);

/// The turns of all engines of a process.
#[derive(Debug)]
pub struct Turns {
    free: Mutex<usize>,
    freed: Condvar,
}

/// One engine's turn; it ends when this is dropped. `None` is that of an engine that has waited in vain.
#[derive(Debug)]
pub struct Turn<'a>(Option<&'a Turns>);

impl Turns {
    /// This many turns at once.
    pub fn new(turns: usize) -> Self {
        Self { free: Mutex::new(turns), freed: Condvar::new() }
    }

    /// As many turns at once as this process may use processors.
    pub fn of_processors() -> Self {
        Self::new(std::thread::available_parallelism().map_or(1, NonZero::get))
    }

    /// Waits for a turn. After 20 ms the engine works beside those that have one.
    pub fn wait(&self) -> Turn<'_> {
        self.wait_for(PATIENCE)
    }

    fn wait_for(&self, patience: Duration) -> Turn<'_> {
        let is_taken = |free: &mut usize| *free == 0;
        let waited = self.freed.wait_timeout_while(locked(&self.free), patience, is_taken);
        let (mut free, _) = waited.unwrap_or_else(PoisonError::into_inner);
        let left = free.checked_sub(1);
        *free = left.unwrap_or(0);
        Turn(left.map(|_| self))
    }
}

impl Drop for Turn<'_> {
    fn drop(&mut self) {
        if let Some(turns) = self.0 {
            *locked(&turns.free) += 1;
            turns.freed.notify_one();
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc::channel;

    use super::*;

    #[test]
    fn no_more_turns_are_taken_than_there_are_and_each_is_free_again() {
        let turns = Turns::new(2);
        let (first, second) = (turns.wait(), turns.wait());
        assert!(first.0.is_some() && second.0.is_some());
        assert!(turns.wait_for(Duration::ZERO).0.is_none());
        drop(first);
        assert!(turns.wait_for(Duration::ZERO).0.is_some());
        assert!(turns.wait_for(Duration::ZERO).0.is_some());
    }

    #[test]
    fn a_waiting_engine_has_its_turn_when_another_ends() {
        let turns = Turns::new(1);
        let held = turns.wait();
        let (began, waits) = channel();
        std::thread::scope(|scope| {
            let waiting = scope.spawn(|| {
                began.send(()).unwrap();
                turns.wait_for(Duration::from_secs(60)).0.is_some()
            });
            waits.recv().unwrap();
            drop(held);
            assert!(waiting.join().unwrap());
        });
    }

    #[test]
    fn an_engine_that_stands_still_does_not_stop_the_others() {
        let turns = Turns::new(1);
        let _stands_still = turns.wait();
        assert!(turns.wait().0.is_none());
    }
}
