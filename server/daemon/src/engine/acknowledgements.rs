//! The newest map that each reader of one vehicle has finished with, for a replay in lockstep.
//!
//! In: readers that acknowledge, and the maps that they have finished with. Out: the readers that a map still waits
//! for. Readers that never acknowledge are not in it.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};

use tokio::sync::watch;

use crate::base::sync::locked;

/// A map: boot id and sequence.
pub type MapId = (u64, u64);

/// The acknowledging readers of one vehicle. Clones share them.
#[derive(Clone, Debug)]
pub struct Acknowledgements {
    readers: Arc<Mutex<Readers>>,
    changed: Arc<watch::Sender<()>>,
    is_lockstep: Arc<AtomicBool>,
    /// Why the replay has ended, if a reader did not acknowledge a map in time.
    timed_out: Arc<watch::Sender<Option<String>>>,
}

#[derive(Debug, Default)]
struct Readers {
    next: u64,
    by_number: BTreeMap<u64, (String, Option<MapId>)>,
}

/// One reader; it is removed when this is dropped.
#[derive(Debug)]
pub struct AcknowledgingReader {
    all: Acknowledgements,
    number: u64,
}

impl Default for Acknowledgements {
    fn default() -> Self {
        Self {
            readers: Arc::default(),
            changed: Arc::new(watch::Sender::new(())),
            is_lockstep: Arc::default(),
            timed_out: Arc::default(),
        }
    }
}

impl Acknowledgements {
    /// Adds a reader; `name` is for people.
    pub fn add(&self, name: String) -> AcknowledgingReader {
        let mut readers = locked(&self.readers);
        let number = readers.next;
        readers.next += 1;
        readers.by_number.insert(number, (name, None));
        drop(readers);
        self.changed.send_replace(());
        AcknowledgingReader { all: self.clone(), number }
    }

    /// Says whether a replay waits for the acknowledgements.
    pub fn set_lockstep(&self, is_lockstep: bool) {
        self.is_lockstep.store(is_lockstep, Ordering::Relaxed);
    }

    /// Tells all readers why the replay ends: a map was not acknowledged in time.
    pub fn time_out(&self, why: String) {
        self.timed_out.send_replace(Some(why));
    }

    /// Why the replay ends, if a map was not acknowledged in time.
    pub fn why_timed_out(&self) -> Option<String> {
        self.timed_out.borrow().clone()
    }

    /// Names of the readers that have not finished with `map`; `None` if no reader acknowledges.
    pub fn awaited(&self, map: MapId) -> Option<Vec<String>> {
        let readers = locked(&self.readers);
        let awaited = readers.by_number.values().filter(|(_, finished)| *finished != Some(map));
        (!readers.by_number.is_empty()).then(|| awaited.map(|(name, _)| name.clone()).collect())
    }

    /// Notified whenever a reader comes, leaves or acknowledges.
    pub fn changes(&self) -> watch::Receiver<()> {
        self.changed.subscribe()
    }
}

impl AcknowledgingReader {
    /// True if a replay waits for the acknowledgement of each map.
    pub fn is_in_lockstep(&self) -> bool {
        self.all.is_lockstep.load(Ordering::Relaxed)
    }

    /// Waits until the replay ends because a map was not acknowledged in time; returns why.
    pub async fn timed_out(&self) -> String {
        let mut timed_out = self.all.timed_out.subscribe();
        // Cannot fail: this holds the sender.
        let why = timed_out.wait_for(Option::is_some).await.map(|why| why.clone());
        why.ok().flatten().unwrap_or_default()
    }

    /// Records that the reader has finished with `map` and all before it.
    pub fn finished(&self, map: MapId) {
        if let Some((_, finished)) = locked(&self.all.readers).by_number.get_mut(&self.number) {
            *finished = Some(map);
        }
        self.all.changed.send_replace(());
    }
}

impl Drop for AcknowledgingReader {
    fn drop(&mut self) {
        locked(&self.all.readers).by_number.remove(&self.number);
        self.all.changed.send_replace(());
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_map_waits_for_every_reader_that_is_there() {
        let all = Acknowledgements::default();
        assert_eq!(all.awaited((1, 0)), None);
        let (first, second) = (all.add("first".into()), all.add("second".into()));
        first.finished((1, 0));
        assert_eq!(all.awaited((1, 0)), Some(vec!["second".to_owned()]));
        second.finished((1, 0));
        assert_eq!(all.awaited((1, 0)), Some(vec![]));
        assert_eq!(all.awaited((1, 1)).unwrap().len(), 2);
        drop(first);
        assert_eq!(all.awaited((1, 1)), Some(vec!["second".to_owned()]));
    }
}
