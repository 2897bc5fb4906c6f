//! The door: readings in, numbered [`Event`]s out, on one bounded queue a vehicle.
//!
//! Only this file (live and captured readings) and the recording's reader make an [`Event`]; nothing behind the queue
//! can tell them apart. A live reading gets the clock's stamp here; a captured one brings its own. What does not become
//! an event (the queue or the kernel's buffer was full, the sender is nobody's, the datagram too long) is counted, and
//! the counts become [`Body::Lost`] events: the journal, and every replay of it, knows all that stayed outside.

use std::net::SocketAddr;
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, Weak};
use std::time::{SystemTime, UNIX_EPOCH};

use clearway_mapping::event::{Body, Cause, Event};
use futures::executor::block_on;
use tokio::sync::{OwnedSemaphorePermit as Place, Semaphore};

use drops::{Untold, next_told};
use receipt::{Ticket, Verdict};

pub mod gateway;
pub mod files;
pub mod grpc;
pub mod observation;
mod drops;
pub mod ros;
pub mod receipt;
pub mod udp;
#[cfg(feature = "zenoh")]
pub mod zenoh;

pub use drops::{Outside, Stranger};

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
    /// Free again when this is dropped.
    _place: Place,
}

/// Gives the time, ns since the Unix epoch: the system's by default, a simulation's own.
#[derive(Clone)]
pub struct Clock(Arc<dyn Fn() -> i64 + Send + Sync>);

impl Clock {
    /// A clock that shows what `now` gives.
    pub fn new(now: impl Fn() -> i64 + Send + Sync + 'static) -> Self {
        Self(Arc::new(now))
    }

    fn now_ns(&self) -> i64 {
        (self.0)()
    }
}

impl Default for Clock {
    fn default() -> Self {
        Self::new(now_ns)
    }
}

impl std::fmt::Debug for Clock {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_tuple("Clock").field(&self.now_ns()).finish()
    }
}

/// One vehicle's door. Clones share numbering and queue; the queue ends when the last clone is dropped.
#[derive(Clone, Debug)]
pub struct Door {
    shared: Arc<Mutex<Inside>>,
    places: Arc<Semaphore>,
    outside: Arc<Outside>,
    clock: Clock,
}

/// A way to a door that does not keep it open.
#[derive(Clone, Debug)]
pub struct WeakDoor {
    shared: Weak<Mutex<Inside>>,
    places: Arc<Semaphore>,
    outside: Arc<Outside>,
    clock: Clock,
}

impl WeakDoor {
    /// The door, while somebody else keeps it open.
    pub fn door(&self) -> Option<Door> {
        let (places, outside, clock) = (self.places.clone(), self.outside.clone(), self.clock.clone());
        Some(Door { shared: self.shared.upgrade()?, places, outside, clock })
    }

    /// What stayed outside, also when the door is gone.
    pub fn outside(&self) -> &Outside {
        &self.outside
    }
}

/// A full queue is told of as soon as there is space, other causes this often: a flood from strangers must not fill the
/// journal.
const TELL_NS: u64 = 100_000_000;

/// What numbers the events. Whoever holds its lock does not wait: a place on the queue is there before.
#[derive(Debug)]
struct Inside {
    queue: SyncSender<Queued>,
    next_sequence: u64,
    told_ns: i64,
}

/// A door and the queue behind it, `capacity` events long.
pub fn door(capacity: usize) -> (Door, Receiver<Queued>) {
    door_by(Clock::default(), capacity)
}

/// A door that stamps what is live by `clock`.
pub fn door_by(clock: Clock, capacity: usize) -> (Door, Receiver<Queued>) {
    let (queue, events) = sync_channel(capacity);
    let inside = Inside { queue, next_sequence: 0, told_ns: 0 };
    let (shared, places) = (Arc::new(Mutex::new(inside)), Arc::new(Semaphore::new(capacity)));
    (Door { shared, places, outside: Arc::default(), clock }, events)
}

impl Door {
    /// Takes a live reading, stamped now. Never waits: a full queue counts the reading as lost.
    ///
    /// # Errors
    /// [`Closed`] when the engine has stopped.
    pub fn enter(&self, source: u16, body: Body) -> Result<(), Closed> {
        self.enter_all([(source, body)])
    }

    /// [`Door::enter`] for what was read at once: one stamp for all.
    ///
    /// # Errors
    /// [`Closed`] when the engine has stopped.
    pub fn enter_all(&self, readings: impl IntoIterator<Item = (u16, Body)>) -> Result<(), Closed> {
        self.enter_with(None, readings.into_iter().map(|(source, body)| (source, body, None))).map(drop)
    }

    /// Takes an observation whose sender hears by `ticket` what becomes of it, be it that the queue was full. Stamped
    /// now unless it brings its own stamp; never waits. Gives whether it is on the queue.
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
        self.enter_with(captured_ns, [(source, body, Some(ticket))])
    }

    /// Gives whether all of it is on the queue.
    fn enter_with(
        &self,
        captured_ns: Option<i64>,
        readings: impl IntoIterator<Item = (u16, Body, Option<Ticket>)>,
    ) -> Result<bool, Closed> {
        let mut inside = locked(&self.shared);
        let mut untold = locked(&self.outside.untold);
        // Losses are told at the same stamp: a captured drive's time does not jump to the clock's and back.
        let arrival_ns = captured_ns.unwrap_or_else(|| self.clock.now_ns());
        // Behind a loss that is not told yet nothing enters, so that the journal has it where it happened.
        let (is_due, mut has_space) = (inside.is_due(arrival_ns), true);
        while let Some(whose) = next_told(&untold, is_due).filter(|_| has_space) {
            match self.place() {
                Some(place) => inside.tell(place, &mut untold, whose, arrival_ns)?,
                None => has_space = false,
            }
        }
        for (source, body, ticket) in readings {
            match has_space.then(|| self.place()).flatten() {
                Some(place) => inside.put(place, Reading { arrival_ns, source, body }, ticket)?,
                None => {
                    has_space = false;
                    *untold.entry((Cause::Queue, source)).or_default() += 1;
                    if let Some(ticket) = ticket {
                        let message = "the vehicle's queue is full: the engine does not keep up".to_owned();
                        ticket.tell(Verdict::Refused { reason: "queue", message });
                    }
                }
            }
        }
        Ok(has_space)
    }

    /// A way to this door that does not keep it open.
    pub fn weak(&self) -> WeakDoor {
        let (places, outside, clock) = (self.places.clone(), self.outside.clone(), self.clock.clone());
        WeakDoor { shared: Arc::downgrade(&self.shared), places, outside, clock }
    }

    /// Takes a captured reading with its own stamp, behind what stayed outside and is due; waits while the queue is
    /// full, so that a file loses nothing.
    ///
    /// # Errors
    /// [`Closed`] when the engine has stopped.
    pub fn enter_captured(&self, reading: Reading) -> Result<(), Closed> {
        let arrival_ns = reading.arrival_ns;
        let is_due = locked(&self.shared).is_due(arrival_ns);
        loop {
            let place = self.wait_for_place()?;
            let (mut inside, mut untold) = (locked(&self.shared), locked(&self.outside.untold));
            match next_told(&untold, is_due) {
                Some(whose) => inside.tell(place, &mut untold, whose, arrival_ns)?,
                None => return inside.put(place, reading, None),
            }
        }
    }

    /// A place on the queue, where there is one.
    fn place(&self) -> Option<Place> {
        self.places.clone().try_acquire_owned().ok()
    }

    /// A place on the queue, once there is one. Holds no lock meanwhile: the live doors go on.
    fn wait_for_place(&self) -> Result<Place, Closed> {
        block_on(self.places.clone().acquire_owned()).map_err(|_| Closed)
    }

    /// Counts readings that stay outside.
    pub fn leave_outside(&self, source: u16, cause: Cause, count: u64) {
        self.outside.leave(source, cause, count);
    }

    /// Refuses a datagram whose sender is none of the vehicle's sensors, and remembers the sender.
    pub fn refuse_stranger(&self, address: SocketAddr) {
        self.leave_outside(0, Cause::Sender, 1);
        self.outside.meet(address, self.clock.now_ns());
    }

    /// Tells the engine of all that stayed outside, waiting for space; at the stamp of a capture where there is one,
    /// else now. For the end, when nothing will follow that would bring it along.
    ///
    /// # Errors
    /// [`Closed`] when the engine has stopped.
    pub fn close(&self, captured_ns: Option<i64>) -> Result<(), Closed> {
        let arrival_ns = captured_ns.unwrap_or_else(|| self.clock.now_ns());
        while !locked(&self.outside.untold).is_empty() {
            let place = self.wait_for_place()?;
            let (mut inside, mut untold) = (locked(&self.shared), locked(&self.outside.untold));
            if let Some(whose) = next_told(&untold, true) {
                inside.tell(place, &mut untold, whose, arrival_ns)?;
            }
        }
        Ok(())
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
    /// Whether what stayed outside for other causes than a full queue may be told again.
    fn is_due(&self, arrival_ns: i64) -> bool {
        self.told_ns.abs_diff(arrival_ns) >= TELL_NS
    }

    /// Turns what stayed outside for one cause into an event.
    fn tell(&mut self, place: Place, untold: &mut Untold, whose: (Cause, u16), arrival_ns: i64) -> Result<(), Closed> {
        let (cause, source) = whose;
        let body = Body::Lost { cause, count: untold.get(&whose).copied().unwrap_or_default() };
        self.put(place, Reading { arrival_ns, source, body }, None)?;
        untold.remove(&whose);
        self.told_ns = arrival_ns;
        Ok(())
    }

    /// Puts one event in its place on the queue.
    fn put(&mut self, place: Place, reading: Reading, ticket: Option<Ticket>) -> Result<(), Closed> {
        let Reading { arrival_ns, source, body } = reading;
        let event = Event { sequence: self.next_sequence, arrival_ns, source, body };
        // As many places as the queue is long, so that this does not wait.
        self.queue.send(Queued { event, ticket, _place: place }).map_err(|_| Closed)?;
        self.next_sequence += 1;
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
    use clearway_mapping::ledger::Ledger;

    use super::*;

    fn untold(door: &Door) -> Ledger {
        let mut ledger = Ledger::default();
        door.outside().add_to(&mut ledger, []);
        ledger
    }

    #[test]
    fn events_are_numbered_without_a_hole_and_a_full_queue_becomes_one_loss() {
        let (door, events) = door(2);
        door.enter_all((0..5).map(|_| (1, Body::End))).unwrap();
        assert_eq!(untold(&door).lost, 3);
        let taken: Vec<_> = events.try_iter().map(|queued| queued.event).collect();
        assert_eq!(taken.iter().map(|e| e.sequence).collect::<Vec<_>>(), [0, 1]);
        door.enter(0, Body::End).unwrap();
        let taken: Vec<_> = events.try_iter().map(|queued| queued.event).collect();
        assert_eq!(taken[0].body, Body::Lost { cause: Cause::Queue, count: 3 });
        assert_eq!((taken[0].sequence, taken[0].source), (2, 1));
        assert_eq!((taken[1].sequence, taken[1].source), (3, 0));
        assert_eq!(untold(&door), Ledger::default());
    }

    #[test]
    fn what_stays_outside_is_told_at_once_then_seldom_and_all_of_it_before_the_end() {
        let (door, events) = door(16);
        let flood = |door: &Door| (0..9).for_each(|port| door.refuse_stranger(([10, 0, 0, 9], port).into()));
        flood(&door);
        door.leave_outside(1, Cause::Length, 2);
        assert_eq!(
            (untold(&door).received, untold(&door).refused["source"], untold(&door).refused["length"]),
            (11, 9, 2)
        );
        door.enter(0, Body::End).unwrap();
        let bodies = |events: &Receiver<Queued>| events.try_iter().map(|queued| queued.event.body).collect::<Vec<_>>();
        let lost = |cause, count| Body::Lost { cause, count };
        assert_eq!(bodies(&events), [lost(Cause::Sender, 9), lost(Cause::Length, 2), Body::End]);
        flood(&door);
        door.leave_outside(0, Cause::Kernel, 5);
        door.close(None).unwrap();
        assert_eq!(bodies(&events), [lost(Cause::Kernel, 5), lost(Cause::Sender, 9)]);
        assert_eq!(untold(&door), Ledger::default());
        let strangers = door.outside().strangers();
        assert_eq!(strangers.iter().map(|s| s.address.port()).collect::<Vec<_>>(), [1, 2, 3, 4, 5, 6, 7, 8]);
        assert!(strangers.iter().all(|stranger| stranger.datagrams == 1), "the one that was forgotten pushed each out");
    }

    #[test]
    fn whoever_holds_a_ticket_hears_that_the_queue_was_full_or_the_engine_gone() {
        use super::receipt::Mark;
        let (verdicts, mut told) = tokio::sync::mpsc::unbounded_channel();
        let ticket = |number| Ticket::new(Mark { client: 0, number }, &verdicts);
        let (door, events) = door(1);
        door.enter_observed(Some(42), 0, Body::End, ticket(1)).unwrap();
        assert!(told.try_recv().is_err(), "the engine has not spoken");
        door.enter_observed(None, 0, Body::End, ticket(2)).unwrap();
        let (mark, verdict) = told.try_recv().unwrap();
        assert!(mark.number == 2 && matches!(verdict, Verdict::Refused { reason: "queue", .. }), "{verdict:?}");
        assert_eq!(untold(&door).lost, 1, "the engine is told too");

        let weak = door.weak();
        let Queued { event, ticket: waiting, .. } = events.recv().unwrap();
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
    fn a_captured_reading_comes_behind_what_was_refused_before_it_all_at_its_own_stamp() {
        let (door, events) = door(4);
        let reading = |arrival_ns| Reading { arrival_ns, source: 0, body: Body::End };
        let captured = |arrival_ns| door.enter_captured(reading(arrival_ns)).unwrap();
        let mut told = events.iter().map(|queued| (queued.event.arrival_ns, queued.event.body));
        let refused = |count| Body::Lost { cause: Cause::Observation, count };
        door.outside().leave_observations(1, "ros_message", 2);
        captured(TELL_NS as i64);
        assert_eq!(told.next(), Some((TELL_NS as i64, refused(2))));
        assert_eq!(told.next(), Some((TELL_NS as i64, Body::End)));
        door.outside().leave_observations(1, "ros_message", 3);
        captured(TELL_NS as i64 + 42);
        assert_eq!(told.next(), Some((TELL_NS as i64 + 42, Body::End)), "others than a full queue are told seldom");
        door.close(Some(7)).unwrap();
        assert_eq!(told.next(), Some((7, refused(3))));
        assert_eq!(untold(&door), Ledger::default());
    }

    #[test]
    fn while_a_captured_reading_waits_for_a_place_the_live_door_is_open_and_counts() {
        let (door, events) = door(1);
        door.enter(0, Body::End).unwrap();
        let waits = std::thread::spawn({
            let door = door.clone();
            move || door.enter_captured(Reading { arrival_ns: 42, source: 0, body: Body::End })
        });
        // Whether the other has begun to wait or not.
        for _ in 0..3 {
            door.enter(1, Body::End).unwrap();
        }
        assert_eq!(untold(&door).lost, 3);
        let taken: Vec<_> = events.iter().take(3).map(|queued| queued.event).collect();
        assert_eq!(waits.join().unwrap(), Ok(()));
        assert_eq!(taken[1].body, Body::Lost { cause: Cause::Queue, count: 3 });
        assert_eq!(taken.iter().map(|event| event.sequence).collect::<Vec<_>>(), [0, 1, 2]);
        assert_eq!(taken[2].arrival_ns, 42);

        door.enter(0, Body::End).unwrap();
        let waits = std::thread::spawn({
            let door = door.clone();
            move || door.enter_captured(Reading { arrival_ns: 43, source: 0, body: Body::End })
        });
        drop(events);
        assert_eq!(waits.join().unwrap(), Err(Closed), "nobody waits for an engine that is gone");
    }

    #[test]
    fn a_door_without_an_engine_says_so() {
        let (door, events) = door(2);
        drop(events);
        assert_eq!(door.enter(0, Body::End), Err(Closed));
    }
}
