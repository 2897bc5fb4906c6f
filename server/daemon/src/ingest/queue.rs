//! Readings in, numbered [`Event`]s out, on one bounded queue a vehicle.
//!
//! Only this file and the reader of recordings create an [`Event`]; the engine cannot tell live and captured events
//! apart. The queue stamps a live reading with its clock, or with the kernel's stamp of the datagram if that is
//! plausible; a captured reading keeps its own stamp. A reading that does
//! not become an event is counted, because the queue or the kernel's buffer was full, the sender is unknown, or the
//! datagram is too long. The queue turns these counts into [`Body::Lost`] events, so the journal and every replay of it
//! contain all drops.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Arc, Mutex};

use clearway_mapping::event::{Body, Cause, Event};
use futures::executor::block_on;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};

use super::drops::{DropCounters, Unreported, next_unreported};
use super::receipt::{Outcome, Receipt};
use crate::base::clock::Clock;
use crate::base::sync::locked;

/// Least time between two reports of drops to the engine, in ns. Drops by a full queue are reported at once; a flood of
/// datagrams from unknown senders must not fill the journal. Ours: ten reports a second are fine enough for a rate.
const REPORT_PERIOD_NS: u64 = 100_000_000;

/// Greatest age of a datagram by the kernel's stamp, in ns. Ours: no server stands still for longer and goes on; a
/// stamp that differs by more comes from a clock that was set between the kernel's stamp and the reading.
const RECEIVED_AGE_NS_MAX: i64 = 60_000_000_000;

/// An event without its number: what a source of readings yields.
#[derive(Clone, Debug, PartialEq)]
pub struct Reading {
    /// Stamp of the capture, ns since the Unix epoch.
    pub arrival_ns: i64,
    /// Index of the sensor in the vehicle's configuration.
    pub source: u16,
    /// Content of the reading.
    pub body: Body,
}

/// When a live reading arrived.
#[derive(Clone, Copy, Debug)]
pub enum Arrival {
    /// At the present, by the queue's clock.
    Now,
    /// A datagram, when the kernel received it, in ns since the Unix epoch. A time that is not plausible by the queue's
    /// clock, or unknown, is replaced by the present. The datagram takes space of its sensor's share of the queue.
    Received(Option<i64>),
    /// At the stamp of its capture, in ns since the Unix epoch.
    Captured(i64),
}

/// A reading that cannot be made to wait.
#[derive(Debug)]
pub struct LiveReading {
    /// When the reading arrived.
    pub arrival: Arrival,
    /// Index of the sensor in the vehicle's configuration.
    pub source: u16,
    /// Content of the event.
    pub body: Body,
    /// Delivers the outcome to the client that sent it.
    pub receipt: Option<Receipt>,
}

impl LiveReading {
    /// A reading without a client.
    pub fn new(arrival: Arrival, source: u16, body: Body) -> Self {
        Self { arrival, source, body, receipt: None }
    }
}

/// The queue accepts no more events, because the engine has stopped or the queue is closed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("the vehicle's engine has stopped")]
pub struct QueueClosedError;

/// One event on the queue.
#[derive(Debug)]
pub struct QueuedEvent {
    /// The event, as the pipeline gets it.
    pub event: Event,
    /// Delivers the outcome to the client that sent the event. A recording does not contain it.
    pub receipt: Option<Receipt>,
    /// This event's space on the queue, free again when this is dropped.
    _space: Space,
}

/// The space of one event.
#[derive(Debug)]
struct Space {
    _place: OwnedSemaphorePermit,
    /// In the share of the event's sensor; `None` for events that belong to no share.
    _share: Option<OwnedSemaphorePermit>,
}

impl From<OwnedSemaphorePermit> for Space {
    fn from(place: OwnedSemaphorePermit) -> Self {
        Self { _place: place, _share: None }
    }
}

/// The equal shares of a vehicle's sensors in the part of the queue that is for datagrams.
#[derive(Debug)]
struct Shares {
    events_max: usize,
    /// By sensor; a sensor without datagrams has none.
    free: Mutex<BTreeMap<u16, Arc<Semaphore>>>,
}

impl Shares {
    /// Space in a sensor's share, if there is any now.
    fn try_acquire(&self, source: u16) -> Option<OwnedSemaphorePermit> {
        let mut free = locked(&self.free);
        let free = free.entry(source).or_insert_with(|| Arc::new(Semaphore::new(self.events_max)));
        free.clone().try_acquire_owned().ok()
    }
}

/// The sending end of one vehicle's event queue. Clones share numbers, space and drop counters. The queue ends when it
/// is closed or when the last clone is dropped.
#[derive(Clone, Debug)]
pub struct EventQueue {
    state: Arc<Mutex<State>>,
    space: Arc<Semaphore>,
    capacity: usize,
    shares: Option<Arc<Shares>>,
    drops: Arc<DropCounters>,
    clock: Clock,
}

/// Numbers the events. A thread that holds its lock never waits, because it acquires space on the queue before.
#[derive(Debug)]
struct State {
    /// `None` once the queue is closed.
    sender: Option<Sender<QueuedEvent>>,
    next_sequence: u64,
    /// Arrival of the newest report of drops, ns since the Unix epoch.
    reported_ns: i64,
    /// Arrival of the newest event, ns since the Unix epoch; `None` before the first.
    newest_ns: Option<i64>,
}

/// The space of a queue.
#[derive(Clone, Debug)]
pub struct QueueSpace {
    free: Arc<Semaphore>,
    /// Events for which the queue has space.
    pub capacity: usize,
}

impl QueueSpace {
    /// Number of events that wait for the engine, or that it works on.
    pub fn waiting(&self) -> usize {
        self.capacity.saturating_sub(self.free.available_permits())
    }
}

/// What a queue remembers of the events before.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct QueuePosition {
    next_sequence: u64,
    reported_ns: i64,
}

/// Creates a queue of `capacity` events that stamps live readings with the system's clock.
pub fn event_queue(capacity: usize) -> (EventQueue, Receiver<QueuedEvent>) {
    event_queue_with_clock(Clock::default(), capacity)
}

/// Creates a queue of `capacity` events that stamps live readings with `clock`.
pub fn event_queue_with_clock(clock: Clock, capacity: usize) -> (EventQueue, Receiver<QueuedEvent>) {
    let (sender, events) = channel();
    let state = State { sender: Some(sender), next_sequence: 0, reported_ns: 0, newest_ns: None };
    let (state, space) = (Arc::new(Mutex::new(state)), Arc::new(Semaphore::new(capacity)));
    (EventQueue { state, space, capacity, shares: None, drops: Arc::default(), clock }, events)
}

impl EventQueue {
    /// Divides the space for `events` datagrams among `sensors`, so that a flood from the address of one leaves the
    /// shares of the others free.
    pub fn with_shares(self, events: usize, sensors: usize) -> Self {
        let events_max = (events / sensors.max(1)).max(1);
        Self { shares: Some(Arc::new(Shares { events_max, free: Mutex::default() })), ..self }
    }

    /// The time of the queue's clock, ns since the Unix epoch.
    pub fn now_ns(&self) -> i64 {
        self.clock.now_ns()
    }

    /// Pushes an event that is no reading, if the queue has space. Its stamp is the newest event's stamp, so that the
    /// time of a captured drive does not jump. Never waits, and counts nothing: the caller tries again. True if the
    /// event is on the queue.
    pub fn push_if_space(&self, source: u16, body: Body) -> bool {
        let mut state = locked(&self.state);
        let Some(place) = self.try_acquire() else { return false };
        let arrival_ns = state.newest_ns.unwrap_or_else(|| self.clock.now_ns());
        state.push(place.into(), Reading { arrival_ns, source, body }, None).is_ok()
    }

    /// Pushes live readings that arrived together. Never waits: if the queue, or the sensor's share of it, is full, a
    /// reading is counted as lost and its receipt delivers the refusal. Returns true if the queue had space for all.
    ///
    /// # Errors
    /// [`QueueClosedError`] if the engine has stopped; the receipts deliver that too.
    pub fn push(&self, readings: impl IntoIterator<Item = LiveReading>) -> Result<bool, QueueClosedError> {
        let mut readings = readings.into_iter().peekable();
        let mut state = locked(&self.state);
        let mut unreported = locked(&self.drops.unreported);
        // Reports of drops get the same stamp, so that the time of a captured drive never jumps to the clock's and
        // back.
        let now_ns = match readings.peek() {
            Some(LiveReading { arrival: Arrival::Captured(captured_ns), .. }) => *captured_ns,
            _ => self.clock.now_ns(),
        };
        // Reports come before the readings, so that the journal has the drops where they happened.
        let (is_due, mut has_space) = (state.is_report_due(now_ns), true);
        while let Some(key) = next_unreported(&unreported, is_due).filter(|_| has_space) {
            match self.try_acquire() {
                Some(permit) => state.push_report(permit.into(), &mut unreported, key, now_ns)?,
                None => has_space = false,
            }
        }
        for LiveReading { arrival, source, body, receipt } in readings {
            let arrival_ns = match arrival {
                Arrival::Received(Some(received_ns)) if is_age_plausible(now_ns, received_ns) => received_ns,
                Arrival::Captured(captured_ns) => captured_ns,
                _ => now_ns,
            };
            let shares = self.shares.as_ref().filter(|_| matches!(arrival, Arrival::Received(_)));
            let share = shares.map(|shares| shares.try_acquire(source));
            if let Some(None) = share {
                *unreported.entry((Cause::Queue, source)).or_default() += 1;
                continue;
            }
            match has_space.then(|| self.try_acquire()).flatten() {
                Some(place) => {
                    let space = Space { _place: place, _share: share.flatten() };
                    state.push(space, Reading { arrival_ns, source, body }, receipt)?;
                }
                None => {
                    has_space = false;
                    *unreported.entry((Cause::Queue, source)).or_default() += 1;
                    if let Some(receipt) = receipt {
                        let message = "the vehicle's queue is full: the engine does not keep up".to_owned();
                        receipt.deliver(Outcome::Refused { reason: "queue", message });
                    }
                }
            }
        }
        Ok(has_space)
    }

    /// Pushes a captured reading with its own stamp, after the reports of drops that are due. Waits while the queue is
    /// full, so that no reading of a file is lost.
    ///
    /// # Errors
    /// [`QueueClosedError`] if the engine has stopped.
    pub fn push_captured(&self, reading: Reading) -> Result<(), QueueClosedError> {
        let arrival_ns = reading.arrival_ns;
        let is_due = locked(&self.state).is_report_due(arrival_ns);
        loop {
            let permit = self.acquire()?.into();
            let (mut state, mut unreported) = (locked(&self.state), locked(&self.drops.unreported));
            match next_unreported(&unreported, is_due) {
                Some(key) => state.push_report(permit, &mut unreported, key, arrival_ns)?,
                None => return state.push(permit, reading, None),
            }
        }
    }

    /// Space for one event, if there is any now.
    fn try_acquire(&self) -> Option<OwnedSemaphorePermit> {
        self.space.clone().try_acquire_owned().ok()
    }

    /// Waits for space for one event. Holds no lock meanwhile, so that live readings are not delayed.
    fn acquire(&self) -> Result<OwnedSemaphorePermit, QueueClosedError> {
        block_on(self.space.clone().acquire_owned()).map_err(|_| QueueClosedError)
    }

    /// Counts `count` readings of a sensor that did not become events.
    pub fn record_drop(&self, source: u16, cause: Cause, count: u64) {
        self.drops.record(source, cause, count);
    }

    /// Refuses a datagram whose sender is none of the vehicle's sensors, and remembers the sender.
    pub fn refuse_unknown_sender(&self, address: SocketAddr) {
        self.record_drop(0, Cause::Sender, 1);
        self.drops.record_unknown_sender(address, self.clock.now_ns());
    }

    /// Reports all drops to the engine, stamped `captured_ns` or now, and waits for space. Needed at the end of a
    /// drive, because no later reading brings the reports along.
    ///
    /// # Errors
    /// [`QueueClosedError`] if the engine has stopped.
    pub fn report_drops(&self, captured_ns: Option<i64>) -> Result<(), QueueClosedError> {
        let arrival_ns = captured_ns.unwrap_or_else(|| self.clock.now_ns());
        while !locked(&self.drops.unreported).is_empty() {
            let permit = self.acquire()?;
            let (mut state, mut unreported) = (locked(&self.state), locked(&self.drops.unreported));
            if let Some(key) = next_unreported(&unreported, true) {
                state.push_report(permit.into(), &mut unreported, key, arrival_ns)?;
            }
        }
        Ok(())
    }

    /// What the queue remembers of the events so far.
    pub fn position(&self) -> QueuePosition {
        let state = locked(&self.state);
        QueuePosition { next_sequence: state.next_sequence, reported_ns: state.reported_ns }
    }

    /// Goes on as if the events so far were the events before `position`: a replay jumps.
    pub fn set_position(&self, position: QueuePosition) {
        let mut state = locked(&self.state);
        (state.next_sequence, state.reported_ns) = (position.next_sequence, position.reported_ns);
    }

    /// Closes the queue for all clones: the engine handles the events on the queue and then ends.
    pub fn close(&self) {
        locked(&self.state).sender = None;
    }

    /// The space of the queue, which outlives it.
    pub fn space(&self) -> QueueSpace {
        QueueSpace { free: self.space.clone(), capacity: self.capacity }
    }

    /// The counts of readings that did not become events.
    pub fn drops(&self) -> Arc<DropCounters> {
        self.drops.clone()
    }
}

/// True if a datagram that is read at `now_ns` can have been received at `received_ns`.
fn is_age_plausible(now_ns: i64, received_ns: i64) -> bool {
    (0..=RECEIVED_AGE_NS_MAX).contains(&now_ns.saturating_sub(received_ns))
}

impl State {
    /// True if drops for other causes than a full queue may be reported again.
    fn is_report_due(&self, arrival_ns: i64) -> bool {
        self.reported_ns.abs_diff(arrival_ns) >= REPORT_PERIOD_NS
    }

    /// Pushes the drops of one cause and source as an event.
    fn push_report(
        &mut self,
        space: Space,
        unreported: &mut Unreported,
        key: (Cause, u16),
        arrival_ns: i64,
    ) -> Result<(), QueueClosedError> {
        let (cause, source) = key;
        let body = Body::Lost { cause, count: unreported.get(&key).copied().unwrap_or_default() };
        self.push(space, Reading { arrival_ns, source, body }, None)?;
        unreported.remove(&key);
        self.reported_ns = arrival_ns;
        Ok(())
    }

    /// Pushes one event into the space that was acquired for it.
    fn push(&mut self, space: Space, reading: Reading, receipt: Option<Receipt>) -> Result<(), QueueClosedError> {
        let Reading { arrival_ns, source, body } = reading;
        let event = Event { sequence: self.next_sequence, arrival_ns, source, body };
        let sender = self.sender.as_ref().ok_or(QueueClosedError)?;
        // There are as many permits as the channel is long, so this does not wait.
        sender.send(QueuedEvent { event, receipt, _space: space }).map_err(|_| QueueClosedError)?;
        self.next_sequence += 1;
        self.newest_ns = Some(arrival_ns);
        Ok(())
    }
}

#[cfg(test)]
mod tests;
