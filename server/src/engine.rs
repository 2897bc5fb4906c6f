//! One named OS thread a vehicle: events in, encoded maps out.
//!
//! The journal comes first, then the step: what was recorded is what was processed. The newest map goes into a
//! latest-value slot that every reader looks at in its own time; the recorder gets every map.

use std::sync::Arc;
use std::sync::mpsc::{Receiver, RecvTimeoutError, TryRecvError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use clearway_mapping::event::Event;
use clearway_mapping::error::EventError;
use clearway_mapping::pipeline::Pipeline;
use clearway_mapping::sensor::sweep::Sweep;
use tokio::sync::watch;

use crate::ingest::Queued;
use crate::ingest::receipt::Verdict;
use crate::record::writer::Journal;
use crate::status::VehicleStatus;
use crate::encode::{self, EncodedMap};

/// How often an engine without events looks whether somebody has come who wants the newest map.
const LOOK_AROUND: Duration = Duration::from_millis(20);

/// The newest map of one vehicle; `None` before the first.
pub type Newest = Option<Arc<EncodedMap>>;

/// The points of the newest map of one vehicle, ego frame, with their stamp; `None` before the first that somebody
/// took.
pub type NewestSweep = Option<Arc<(i64, Sweep)>>;

/// Sees the pipeline after each event that completed a revolution.
pub type Observer = Box<dyn FnMut(&Pipeline) + Send>;

/// One vehicle's engine, before it runs.
pub struct Engine {
    /// The vehicle's core.
    pub pipeline: Pipeline,
    /// Age after capture at which a map is stale.
    pub valid_ms: u32,
    /// Where the newest map goes.
    pub newest: watch::Sender<Newest>,
    /// The vehicle's part of the recording.
    pub journal: Option<Journal>,
    /// Where ledger, rates and latency go.
    pub status: Arc<VehicleStatus>,
    /// Looks at what the maps were made from.
    pub observer: Option<Observer>,
}

impl Engine {
    /// Runs until the last door of the vehicle is gone and its queue is empty.
    ///
    /// # Errors
    /// What the system says where it has no thread to give.
    pub fn start(mut self, events: Receiver<Queued>) -> std::io::Result<JoinHandle<()>> {
        std::thread::Builder::new().name(format!("engine {}", self.status.name)).spawn(move || {
            // Marks the end however it comes, so that a dead engine is seen as one.
            struct Stopped(Arc<VehicleStatus>);
            impl Drop for Stopped {
                fn drop(&mut self) {
                    self.0.engine_stopped();
                }
            }
            let _stopped = Stopped(self.status.clone());
            while let Some(queued) = self.next(&events) {
                self.take(queued);
            }
        })
    }

    /// Takes one event, without a thread: what [`Engine::start`] does with each.
    pub fn take(&mut self, Queued { event, ticket, .. }: Queued) {
        let outcome = self.step(&event);
        // Behind everything else: whoever hears that an event was taken finds its map, and finds it counted.
        if let Some(ticket) = ticket {
            self.rest();
            ticket.tell(Verdict::of(outcome));
        }
    }

    /// Brings the status up to date: what [`Engine::start`] does whenever nothing waits.
    pub fn rest(&self) {
        self.status.stepped(self.pipeline.ledger(), self.pipeline.sensors());
    }

    /// The next event; the status is brought up to date whenever there is nothing else to do.
    fn next(&mut self, events: &Receiver<Queued>) -> Option<Queued> {
        match events.try_recv() {
            Ok(queued) => return Some(queued),
            Err(TryRecvError::Empty) => self.rest(),
            Err(TryRecvError::Disconnected) => return self.last(),
        }
        loop {
            match events.recv_timeout(LOOK_AROUND) {
                Ok(queued) => return Some(queued),
                Err(RecvTimeoutError::Timeout) => self.make_late(),
                Err(RecvTimeoutError::Disconnected) => return self.last(),
            }
        }
    }

    /// A map for whoever came after the last event, where the newest was made for nobody.
    fn make_late(&mut self) {
        let started = Instant::now();
        self.want();
        if self.pipeline.remake_newest_map().is_some() {
            self.publish(started);
        }
    }

    fn last(&self) -> Option<Queued> {
        self.rest();
        None
    }

    fn step(&mut self, event: &Event) -> Result<(), EventError> {
        if let Some(journal) = &self.journal {
            journal.event(event);
        }
        let started = Instant::now();
        self.want();
        match self.pipeline.step(event) {
            Ok(Some(_)) => self.publish(started),
            Ok(None) => {}
            Err(rejected) => {
                tracing::debug!(vehicle = %self.status.name, sequence = event.sequence, %rejected, "refused");
                return Err(rejected);
            }
        }
        Ok(())
    }

    /// Encodes the newest map and puts it where readers and recorder find it.
    fn publish(&mut self, started: Instant) {
        let Some(map) = self.pipeline.newest_map() else { return };
        // Where every map is switched off, a revolution makes none; where nobody takes one, a header.
        let made = (!self.status.layers.is_empty()).then(|| {
            let states = map.sensors.iter().map(encode::sensor).collect();
            (Arc::new(EncodedMap::new(map, self.status.name.clone(), self.status.boot_id, self.valid_ms)), states)
        });
        let latency = started.elapsed();
        // Before its map: whoever has that finds them.
        if self.status.sweeps.receiver_count() > 0 {
            let sweep = self.pipeline.newest_sweep().clone();
            self.status.sweeps.send_replace(Some(Arc::new((map.capture_end_ns, sweep))));
        }
        // The status first: whoever has seen a map finds it counted.
        self.rest();
        if let Some((encoded, states)) = made {
            self.status.mapped(&encoded, states, latency);
            self.newest.send_replace(Some(encoded.clone()));
            if let Some(journal) = &self.journal {
                journal.map(encoded);
            }
        }
        if let Some(observer) = &mut self.observer {
            observer(&self.pipeline);
        }
    }

    /// Tells the pipeline which layers somebody takes. With a journal all are made: a replay knows nothing of the
    /// readers there were.
    fn want(&mut self) {
        let (all, demand) = (self.journal.is_some(), &self.status.demand);
        self.pipeline.set_active_layers(|layer| all || demand.is_taken(layer));
    }
}
