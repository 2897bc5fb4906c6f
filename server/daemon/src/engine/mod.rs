//! The engine of one vehicle, on one named OS thread: events in, encoded maps out.
//!
//! Each event is journaled before the pipeline steps, so the journal contains what was processed. The newest map goes
//! into a latest-value slot that every reader looks at in its own time; the recorder gets every map.
//!
//! | file | in -> out |
//! |---|---|
//! | [`newest`] | contents of the latest-value slots between engine and readers |
//! | [`plans`] | plans of planners -> the event queue; the newest plan |
//! | [`subscriptions`] | readers -> layers to compute |
//! | [`acknowledgements`] | readers that acknowledge -> the maps that they have finished with |
//! | [`wires`] | the channels between the engine and its readers |
//! | [`compute_permits`] | engines with events -> the engines that compute at once |

pub mod acknowledgements;
pub mod compute_permits;
pub mod newest;
pub mod plans;
pub mod subscriptions;
pub mod wires;

use std::sync::Arc;
use std::sync::mpsc::{Receiver, RecvTimeoutError, TryRecvError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use bytes::Bytes;
use clearway_mapping::error::EventError;
use clearway_mapping::event::{Body, EgoPose, Event};
use clearway_mapping::pipeline::Pipeline;
use clearway_proto::v1;
use nalgebra::Vector3;
use tokio::sync::watch;

use crate::base::clock::now_ns;
use crate::engine::compute_permits::{ComputePermit, ComputePermits};
use crate::engine::newest::Newest;
use crate::engine::wires::Wires;
use crate::ingest::queue::QueuedEvent;
use crate::ingest::receipt::Outcome;
use crate::record::writer::RecordingHandle;
use crate::status::{MadeMap, VehicleStatus};
use crate::traces::StageTimes;
use clearway_journal::encode::{self, EncodedMap, Replayed};

/// Period at which an engine without events checks for new subscribers. Ours: short beside a revolution of 50 to 200
/// ms.
const POLL_INTERVAL: Duration = Duration::from_millis(20);

/// A function that is called with the pipeline after each event that completed a revolution.
pub type Observer = Box<dyn FnMut(&Pipeline) + Send>;

/// One vehicle's engine before its thread runs.
pub struct Engine {
    /// The core that makes the maps from the vehicle's events.
    pub pipeline: Pipeline,
    /// Age after the end of capture at which a map is stale, in milliseconds.
    pub valid_ms: u32,
    /// The latest-value slot of the map.
    pub newest: watch::Sender<Newest>,
    /// The other channels to the readers.
    pub wires: Wires,
    /// The vehicle's handle of the recording, if there is one.
    pub recording: Option<RecordingHandle>,
    /// The status that shows ledger, rates and latency.
    pub status: Arc<VehicleStatus>,
    /// Is called after each revolution.
    pub observer: Option<Observer>,
    /// The newest event with a plan, as it is recorded; `None` before the first.
    pub plan: Option<Bytes>,
    /// How the header of the next map differs from a live map's header; `None` if it does not.
    pub replayed: Option<Replayed>,
}

impl Engine {
    /// Starts the thread, which computes with a permit of `permits`. It ends when the vehicle's queue is closed and
    /// empty.
    ///
    /// # Errors
    /// [`std::io::Error`] if the system cannot create a thread.
    pub fn start(
        mut self,
        events: Receiver<QueuedEvent>,
        permits: Arc<ComputePermits>,
    ) -> std::io::Result<JoinHandle<()>> {
        std::thread::Builder::new().name(format!("engine {}", self.status.name)).spawn(move || {
            self.status.engine_beats();
            let mut permit = None;
            while let Some(queued) = self.next(&events, &mut permit) {
                self.status.engine_beats();
                permit.get_or_insert_with(|| permits.acquire());
                let maps = self.maps();
                self.step(queued);
                permit.take_if(|_| self.maps() != maps);
            }
        })
    }

    /// Handles one event in the calling thread.
    pub fn step(&mut self, QueuedEvent { event, receipt, .. }: QueuedEvent) {
        let outcome = self.step_event(&event);
        // After everything else: a client that receives the outcome finds the map published and counted.
        if let Some(receipt) = receipt {
            self.update_status();
            receipt.deliver(Outcome::from(outcome));
        }
    }

    /// Steps the pipeline without publishing or recording: a replay jumps. A refused event changes nothing but the
    /// counts, as in [`Engine::step`].
    pub fn step_silently(&mut self, event: &Event) {
        self.keep_plan(event);
        self.update_layers();
        let _ = self.pipeline.step(event);
    }

    /// Number of maps made so far.
    pub fn maps(&self) -> u64 {
        self.pipeline.newest_map().map_or(0, |map| map.sequence + 1)
    }

    /// Publishes the newest map of a pipeline that was exchanged, or stepped without publishing; if it has none,
    /// readers have none. The newest plan is published before it.
    pub fn publish_newest_map(&mut self) {
        self.publish_plan();
        if self.pipeline.newest_map().is_none() {
            self.newest.send_replace(None);
            self.wires.sweeps.send_replace(None);
        }
        self.publish(Instant::now(), None);
    }

    /// Copies the ledger and the sensors into the status; the thread of [`Engine::start`] does so whenever no event
    /// waits.
    pub fn update_status(&self) {
        let shift_ns = self.replayed.map_or(0, |replayed| replayed.shift_ns);
        let pose = self.pipeline.newest_pose().map(|pose| vehicle_pose(pose, shift_ns));
        self.status.stepped(self.pipeline.ledger(), self.pipeline.sensors(), pose);
    }

    /// Waits for the next event; `None` once the queue is closed and empty. Updates the status and releases the
    /// permit before it waits.
    fn next(&mut self, events: &Receiver<QueuedEvent>, permit: &mut Option<ComputePermit<'_>>) -> Option<QueuedEvent> {
        match events.try_recv() {
            Ok(queued) => return Some(queued),
            Err(TryRecvError::Empty | TryRecvError::Disconnected) => self.update_status(),
        }
        *permit = None;
        loop {
            match events.recv_timeout(POLL_INTERVAL) {
                Ok(queued) => return Some(queued),
                Err(RecvTimeoutError::Timeout) => {
                    self.status.engine_beats();
                    if let Some(recording) = &mut self.recording {
                        recording.idle(&mut self.pipeline);
                    }
                    self.complete_newest_map();
                }
                Err(RecvTimeoutError::Disconnected) => {
                    self.update_status();
                    return None;
                }
            }
        }
    }

    /// Computes the newest map again for readers that came after the last event, if it was computed without any reader.
    fn complete_newest_map(&mut self) {
        let began = Instant::now();
        self.update_layers();
        if self.pipeline.remake_newest_map().is_some() {
            self.publish(began, None);
        }
    }

    fn step_event(&mut self, event: &Event) -> Result<(), EventError> {
        if let Some(recording) = &mut self.recording {
            recording.record_event(event);
        }
        if self.keep_plan(event) {
            self.publish_plan();
        }
        let (began, waited) = (Instant::now(), duration(now_ns().saturating_sub(event.arrival_ns)));
        self.update_layers();
        let outcome = self.pipeline.step(event).map(|map| map.is_some());
        match &outcome {
            Ok(true) => self.publish(began, waited),
            Ok(false) => {}
            Err(error) => {
                tracing::debug!(vehicle = %self.status.name, sequence = event.sequence, %error, "refused");
                self.status.note_refusal(error);
            }
        }
        if let Some(recording) = &mut self.recording {
            recording.keep_up(event, &mut self.pipeline);
        }
        outcome.map(|_| ())
    }

    /// True if the event holds a plan.
    fn keep_plan(&mut self, event: &Event) -> bool {
        let Body::Plan(plan) = &event.body else { return false };
        self.plan = Some(plan.clone());
        true
    }

    fn publish_plan(&self) {
        self.wires.plans.publish(self.plan.as_ref(), self.replayed.map_or(0, |replayed| replayed.shift_ns));
    }

    /// Encodes the newest map and gives it to readers, recorder and observer. Its computation `began` after its event
    /// had `waited`; `None` if no event made the map.
    fn publish(&mut self, began: Instant, waited: Option<Duration>) {
        let computed = began.elapsed();
        let Some(map) = self.pipeline.newest_map() else { return };
        let (states, speed_m_s) = (map.present_sensors().map(encode::sensor).collect(), map.speed_mps);
        // Without any configured layer a revolution makes no map; without any subscriber it makes a header.
        let encoded = (!self.status.layers.is_empty()).then(|| {
            let (name, boot_id) = (self.status.name.clone(), self.status.boot_id);
            Arc::new(EncodedMap::replayed(map, name, boot_id, self.valid_ms, self.replayed))
        });
        let encoding = began.elapsed().saturating_sub(computed);
        // The points come before the map, so that a reader of the map finds its points.
        self.publish_points(encoded.as_ref().map_or(map.capture_end_ns, |encoded| encoded.capture_end_ns));
        // The status comes before the map too, so that a reader of the map finds it counted.
        self.update_status();
        if let Some(encoded) = encoded {
            // A map that is made again for a reader was not on its way since its capture.
            let total = waited.and_then(|_| duration(now_ns().saturating_sub(encoded.capture_end_ns)));
            let stages = StageTimes { receive: waited, map: Some(computed), encode: Some(encoding), total };
            self.publish_map(encoded, states, speed_m_s, stages);
        }
        if let Some(observer) = &mut self.observer {
            observer(&self.pipeline);
        }
    }

    /// Gives the points of the newest map, with its stamp, to readers that subscribe to them.
    fn publish_points(&self, stamp_ns: i64) {
        if self.wires.sweeps.receiver_count() > 0 {
            let sweep = self.pipeline.newest_sweep().clone();
            self.wires.sweeps.send_replace(Some(Arc::new((stamp_ns, sweep))));
        }
    }

    /// Gives the newest map to the status, the readers and the recorder.
    fn publish_map(
        &mut self,
        encoded: Arc<EncodedMap>,
        states: Vec<v1::SensorState>,
        speed_m_s: Option<f64>,
        StageTimes { receive, map, encode, total }: StageTimes,
    ) {
        // A jump of a replay as recorded has a header of its own too, with the recorded stamps.
        let is_shifted = self.replayed.is_some_and(|replayed| replayed.shift_ns != 0);
        // The stamps of a recording say nothing of this run.
        let is_live = !is_shifted && !self.status.is_from_files();
        let (receive, total) = (receive.filter(|_| is_live), total.filter(|_| is_live || is_shifted));
        self.status.mapped(MadeMap {
            encoded: &encoded,
            states,
            stages: StageTimes { receive, map, encode, total },
            validity: Duration::from_millis(self.valid_ms.into()),
            speed_m_s,
            has_pose: self.pipeline.newest_map().is_some_and(|map| map.map_from_ego.is_some()),
            is_shifted,
        });
        self.newest.send_replace(Some(encoded.clone()));
        if let Some(recording) = &mut self.recording {
            recording.record_map(&encoded, self.status.traces.hop(&encoded, "record", None));
        }
    }

    /// Records the phase of the replay that makes the maps, and tells readers of its end.
    pub fn set_replay_phase(&self, phase: v1::ReplayPhase) {
        self.status.set_replay_phase(phase);
        let ended = phase == v1::ReplayPhase::Ended;
        self.wires.replay_ended.send_if_modified(|was| std::mem::replace(was, ended) != ended);
    }

    /// Makes the pipeline compute the layers that have subscribers. While maps are recorded it computes all layers,
    /// because a replay does not have the readers of the recorded run.
    fn update_layers(&mut self) {
        let all = self.recording.as_ref().is_some_and(RecordingHandle::records_maps);
        let subscriptions = &self.wires.subscriptions;
        self.pipeline.set_active_layers(|layer| all || subscriptions.is_subscribed(layer));
    }
}

/// A time span in ns; `None` if it is negative, because the clocks of its ends differ.
fn duration(span_ns: i64) -> Option<Duration> {
    u64::try_from(span_ns).ok().map(Duration::from_nanos)
}

/// A pose on the wire, its stamp moved by `shift_ns`.
fn vehicle_pose(pose: &EgoPose, shift_ns: i64) -> v1::VehiclePose {
    let position = pose.map_from_ego.translation.vector;
    let forward = pose.map_from_ego.rotation * Vector3::x();
    v1::VehiclePose {
        x_m: position.x,
        y_m: position.y,
        heading_deg: forward.y.atan2(forward.x).to_degrees(),
        stamp_ns: pose.stamp_ns.saturating_add(shift_ns),
    }
}

/// Marks the engine as stopped, also if its thread panics.
impl Drop for Engine {
    fn drop(&mut self) {
        self.status.engine_stopped();
    }
}
