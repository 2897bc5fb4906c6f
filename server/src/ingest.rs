//! The door: readings in, numbered [`Event`]s out, on one bounded queue a vehicle.
//!
//! Only this file (live and captured readings) and the recording's reader make an [`Event`]; nothing behind the queue
//! can tell them apart. A live reading gets the clock's stamp here; a captured one brings its own. A full queue costs
//! the newest readings: they are counted and become one [`Body::Lost`] as soon as there is space again.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, TrySendError, sync_channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, Weak};
use std::time::{SystemTime, UNIX_EPOCH};

use clearway_mapping::event::{Body, Event};

use ticket::{Ticket, Verdict};

pub mod capture;
pub mod entrance;
pub mod files;
pub mod grpc;
pub mod kitti;
pub mod mcap;
pub mod observation;
pub mod ticket;
pub mod udp;
#[cfg(feature = "zenoh")]
pub mod zenoh;

/// What a file source yields: an event without its number.
#[derive(Clone, Debug, PartialEq)]
pub struct Reading {
    /// Stamp of the capture, ns since the Unix epoch.
    pub arrival_ns: i64,
    /// Index of the sensor in the vehicle's configuration.
    pub source: u16,
    /// What happened.
    pub body: Body,
}

/// The queue's far end is gone: the engine has stopped.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("the vehicle's engine has stopped")]
pub struct Closed;

/// What waits for the engine.
#[derive(Debug)]
pub struct Queued {
    /// What happened.
    pub event: Event,
    /// Who wants to hear what became of it; the recording does not see this.
    pub ticket: Option<Ticket>,
}

/// One vehicle's door. Clones share numbering and queue; the queue ends when the last clone is dropped.
#[derive(Clone, Debug)]
pub struct Door {
    shared: Arc<Mutex<Inside>>,
    outside: Arc<Outside>,
}

/// A way to a door that does not keep it open.
#[derive(Clone, Debug)]
pub struct WeakDoor {
    shared: Weak<Mutex<Inside>>,
    outside: Arc<Outside>,
}

impl WeakDoor {
    /// The door, while somebody else keeps it open.
    pub fn door(&self) -> Option<Door> {
        Some(Door { shared: self.shared.upgrade()?, outside: self.outside.clone() })
    }

    /// What stayed outside, also when the door is gone.
    pub fn outside(&self) -> &Outside {
        &self.outside
    }
}

/// What stayed outside a door; outlives its queue.
#[derive(Debug, Default)]
pub struct Outside {
    refused: Mutex<BTreeMap<&'static str, u64>>,
    untold: AtomicU64,
}

impl Outside {
    /// Datagrams turned away before they became events, by reason.
    pub fn refused(&self) -> BTreeMap<&'static str, u64> {
        locked(&self.refused).clone()
    }

    /// Counts one.
    pub(crate) fn refuse(&self, reason: &'static str) {
        *locked(&self.refused).entry(reason).or_default() += 1;
    }

    /// Readings that found the queue full and that the engine has not been told of yet.
    pub fn untold(&self) -> u64 {
        self.untold.load(Ordering::Relaxed)
    }
}

#[derive(Debug)]
struct Inside {
    queue: SyncSender<Queued>,
    next_sequence: u64,
    /// Readings that found the queue full, by source, not yet told to the engine.
    untold: BTreeMap<u16, u64>,
}

/// A door and the queue behind it, `capacity` events long.
pub fn door(capacity: usize) -> (Door, Receiver<Queued>) {
    let (queue, events) = sync_channel(capacity);
    let inside = Inside { queue, next_sequence: 0, untold: BTreeMap::new() };
    (Door { shared: Arc::new(Mutex::new(inside)), outside: Arc::default() }, events)
}

impl Door {
    /// Takes a live reading, stamped now. Never waits: a full queue counts the reading as lost.
    ///
    /// # Errors
    /// [`Closed`] when the engine has stopped.
    pub fn enter(&self, source: u16, body: Body) -> Result<(), Closed> {
        self.enter_with(None, source, body, None).map(drop)
    }

    /// Takes an observation whose sender hears by `ticket` what becomes of it, be it that the queue was full. Stamped now
    /// unless it brings its own stamp; never waits. Gives whether it is on the queue.
    ///
    /// # Errors
    /// [`Closed`] when the engine has stopped; the ticket says so too.
    pub fn enter_observed(
        &self,
        captured_ns: Option<i64>,
        source: u16,
        body: Body,
        ticket: Ticket,
    ) -> Result<bool, Closed> {
        self.enter_with(captured_ns, source, body, Some(ticket))
    }

    fn enter_with(
        &self,
        captured_ns: Option<i64>,
        source: u16,
        body: Body,
        ticket: Option<Ticket>,
    ) -> Result<bool, Closed> {
        let mut inside = locked(&self.shared);
        let now_ns = now_ns();
        inside.tell_losses(now_ns)?;
        let lost = match inside.untold.is_empty() {
            true => inside.offer(captured_ns.unwrap_or(now_ns), source, body, ticket)?,
            false => Some(ticket),
        };
        let entered = lost.is_none();
        if let Some(ticket) = lost {
            *inside.untold.entry(source).or_default() += 1;
            if let Some(ticket) = ticket {
                let message = "the vehicle's queue is full: the engine does not keep up".to_owned();
                ticket.tell(Verdict::Refused { reason: "queue", message });
            }
        }
        self.outside.untold.store(inside.untold.values().sum(), Ordering::Relaxed);
        Ok(entered)
    }

    /// A way to this door that does not keep it open.
    pub fn weak(&self) -> WeakDoor {
        WeakDoor { shared: Arc::downgrade(&self.shared), outside: self.outside.clone() }
    }

    /// Takes a captured reading with its own stamp; waits while the queue is full, so that a file loses nothing.
    ///
    /// # Errors
    /// [`Closed`] when the engine has stopped.
    pub fn enter_captured(&self, reading: Reading) -> Result<(), Closed> {
        let Reading { arrival_ns, source, body } = reading;
        let mut inside = locked(&self.shared);
        let sequence = inside.next_sequence;
        let event = Event { sequence, arrival_ns, source, body };
        inside.queue.send(Queued { event, ticket: None }).map_err(|_| Closed)?;
        inside.next_sequence += 1;
        Ok(())
    }

    /// Counts a datagram that was turned away before it became an event.
    pub fn refuse(&self, reason: &'static str) {
        self.outside.refuse(reason);
    }

    /// What stayed outside.
    pub fn outside(&self) -> Arc<Outside> {
        self.outside.clone()
    }
}

/// Nothing under these locks panics between two related writes, so a poisoned lock still guards whole values.
pub(crate) fn locked<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Inside {
    /// Puts one event on the queue; gives its ticket back where the queue is full.
    fn offer(
        &mut self,
        arrival_ns: i64,
        source: u16,
        body: Body,
        ticket: Option<Ticket>,
    ) -> Result<Option<Option<Ticket>>, Closed> {
        let event = Event { sequence: self.next_sequence, arrival_ns, source, body };
        match self.queue.try_send(Queued { event, ticket }) {
            Ok(()) => {
                self.next_sequence += 1;
                Ok(None)
            }
            Err(TrySendError::Full(queued)) => Ok(Some(queued.ticket)),
            Err(TrySendError::Disconnected(_)) => Err(Closed),
        }
    }

    /// Turns the losses counted so far into events, as far as there is space.
    fn tell_losses(&mut self, arrival_ns: i64) -> Result<(), Closed> {
        while let Some((source, lost)) = self.untold.first_key_value().map(|(s, n)| (*s, *n)) {
            if self.offer(arrival_ns, source, Body::Lost(lost), None)?.is_some() {
                break;
            }
            self.untold.remove(&source);
        }
        Ok(())
    }
}

/// The system clock, ns since the Unix epoch. The door, the freshness stamps of the publishers and the status read it.
pub(crate) fn now_ns() -> i64 {
    match SystemTime::now().duration_since(UNIX_EPOCH) {
        Ok(since) => i64::try_from(since.as_nanos()).unwrap_or(i64::MAX),
        Err(before) => -i64::try_from(before.duration().as_nanos()).unwrap_or(i64::MAX),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn events_are_numbered_without_a_hole_and_a_full_queue_becomes_one_loss() {
        let (door, events) = door(2);
        for _ in 0..5 {
            door.enter(1, Body::End).unwrap();
        }
        assert_eq!(door.outside().untold(), 3);
        let taken: Vec<_> = events.try_iter().map(|queued| queued.event).collect();
        assert_eq!(taken.iter().map(|e| e.sequence).collect::<Vec<_>>(), [0, 1]);
        door.enter(0, Body::End).unwrap();
        let taken: Vec<_> = events.try_iter().map(|queued| queued.event).collect();
        assert_eq!(taken[0].body, Body::Lost(3));
        assert_eq!((taken[0].sequence, taken[0].source), (2, 1));
        assert_eq!((taken[1].sequence, taken[1].source), (3, 0));
        assert_eq!(door.outside().untold(), 0);
    }

    #[test]
    fn whoever_holds_a_ticket_hears_that_the_queue_was_full_or_the_engine_gone() {
        use super::ticket::Mark;
        let (verdicts, mut told) = tokio::sync::mpsc::unbounded_channel();
        let ticket = |number| Ticket::new(Mark { client: 0, number }, &verdicts);
        let (door, events) = door(1);
        door.enter_observed(Some(42), 0, Body::End, ticket(1)).unwrap();
        assert!(told.try_recv().is_err(), "the engine has not spoken");
        door.enter_observed(None, 0, Body::End, ticket(2)).unwrap();
        let (mark, verdict) = told.try_recv().unwrap();
        assert!(mark.number == 2 && matches!(verdict, Verdict::Refused { reason: "queue", .. }), "{verdict:?}");
        assert_eq!(door.outside().untold(), 1, "the engine is told too");

        let weak = door.weak();
        let Queued { event, ticket: waiting } = events.recv().unwrap();
        assert_eq!(event.arrival_ns, 42, "captured then");
        waiting.unwrap().tell(Verdict::Taken);
        assert_eq!(told.try_recv().unwrap().1, Verdict::Taken);
        drop(events);
        assert_eq!(weak.door().unwrap().enter_observed(None, 0, Body::End, ticket(3)), Err(Closed));
        assert!(matches!(told.try_recv().unwrap().1, Verdict::Refused { reason: "stopped", .. }));
        drop(door);
        assert!(weak.door().is_none(), "a weak way keeps no door open");
    }

    #[test]
    fn a_captured_reading_keeps_its_stamp() {
        let (door, events) = door(2);
        door.enter_captured(Reading { arrival_ns: 42, source: 0, body: Body::End }).unwrap();
        assert_eq!(events.recv().unwrap().event.arrival_ns, 42);
    }

    #[test]
    fn a_door_without_an_engine_says_so() {
        let (door, events) = door(2);
        drop(events);
        assert_eq!(door.enter(0, Body::End), Err(Closed));
    }
}
