//! One vehicle's end of the recorder's queue, and the pipeline that begins the vehicle's next keyframe.
//!
//! A part, and what follows a loss of events, must be replayable without any earlier event. So a second pipeline is
//! made from nothing and processes the events of a warm-up time beside the first. Then it replaces the first one, at
//! an event that the recording names. A replay does the same, so its maps are equal byte for byte. What happened
//! before the warm-up has no influence on the maps after it.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use clearway_lidar::calibration::Calibration;
use clearway_mapping::config::VehicleConfig;
use clearway_mapping::event::{Body, Event};
use clearway_mapping::pipeline::{Handover, Pipeline};
use flume::{Receiver, Sender, TrySendError};

use super::counts::RecorderCounts;
use crate::config::Recorder as Options;
use crate::traces::Hop;
use clearway_journal::RecordedMaps;
use clearway_journal::encode::EncodedMap;
use clearway_journal::mcap_file::RecordingHeader;

/// Greatest difference of the stamps of the newest maps of both pipelines at a handover, ns. Ours: far below the period
/// of a sensor, so that the stamps of the maps rise across the handover.
const STAMPS_NS_MAX: u64 = 20_000_000;
/// A handover takes place after this many warm-up times in any case, also if the stamps differ.
const WARM_UPS_MAX: i64 = 3;

/// Time without a loss after which a new pipeline starts, ns. Ours: making one takes as long as a map, so a queue that
/// is full again and again must not cost the vehicle its maps.
const AFTER_LOSS_NS: u64 = 1_000_000_000;

/// One element of the recorder's queue.
pub(super) enum Item {
    /// An event of the vehicle with this index.
    Event(usize, Event),
    /// A map, and the hop that ends when it is written.
    Map(usize, Arc<EncodedMap>, Hop),
    /// A new pipeline starts for this part at this time (ns since the Unix epoch), with the event of this sequence as
    /// the first that is not repeated.
    WarmUp { vehicle: usize, part: u64, from_ns: i64, first_event: u64, repeated: Vec<Event> },
    /// From here on the vehicle's events and maps belong to this part.
    Begin { vehicle: usize, part: u64, handover: Handover },
    /// Messages of this vehicle that did not fit into the queue before this item: topic, number.
    Dropped { vehicle: usize, topics: Vec<(usize, u64)> },
    /// The vehicle's messages belong to no part from here on.
    Leave { vehicle: usize },
}

/// The part that the handles are to record, shared by the writer and its handles; 0: none.
pub(super) type WantedPart = Arc<AtomicU64>;

/// The writer's end of the queue, and what it shares with the handles.
pub(super) struct Link {
    pub items: Receiver<Item>,
    pub counts: Arc<RecorderCounts>,
    pub wanted: WantedPart,
    pub options: Options,
    pub header: RecordingHeader,
    pub waits: bool,
}

/// The queue of a recording, with a handle for each vehicle of the header. What the handles send belongs to part 1.
pub(super) fn link(options: &Options, header: &RecordingHeader, waits: bool) -> (Link, Vec<RecordingHandle>) {
    let (queue, items) = flume::bounded(options.queue);
    let mut header = header.clone();
    if options.maps == RecordedMaps::None {
        header.vehicles.iter_mut().for_each(|(_, layers)| layers.clear());
    }
    let counts = Arc::new(RecorderCounts::new(&header.vehicles, options.maps));
    let wanted = Arc::new(AtomicU64::new(1));
    let warm_up = Duration::from_millis(options.warm_up_ms);
    let handle = |vehicle| RecordingHandle::new(vehicle, queue.clone(), counts.clone(), waits, wanted.clone(), warm_up);
    let handles = (0..header.vehicles.len()).map(handle).collect();
    let options = options.clone();
    (Link { items, counts, wanted, options, header, waits }, handles)
}

/// A new pipeline that processes events beside the vehicle's own.
struct WarmUp {
    part: u64,
    pipeline: Pipeline,
    from_ns: i64,
    began: Instant,
}

/// One vehicle's handle of the recording: sends its events and maps to the recorder's queue.
pub struct RecordingHandle {
    vehicle: usize,
    queue: Sender<Item>,
    counts: Arc<RecorderCounts>,
    waits: bool,
    wanted: WantedPart,
    warm_up_time: Duration,
    /// The part that the vehicle's messages belong to; `None`: nothing is recorded.
    part: Option<u64>,
    /// Sequence of the next event, and arrival of the newest one, in ns.
    next_event: (u64, i64),
    /// Arrival of the newest event that the part lacks since its last keyframe, ns.
    gap_ns: Option<i64>,
    /// Messages that did not fit into the queue since the last item in it, by topic.
    dropped: Vec<u64>,
    /// The configuration of new pipelines; without it there are no keyframes.
    config: Option<(VehicleConfig, Vec<Option<Calibration>>)>,
    /// Events that are in force until others replace them: declared sensors, roads.
    in_force: Vec<Event>,
    warm_up: Option<Box<WarmUp>>,
}

impl RecordingHandle {
    pub(super) fn new(
        vehicle: usize,
        queue: Sender<Item>,
        counts: Arc<RecorderCounts>,
        waits: bool,
        wanted: WantedPart,
        warm_up_time: Duration,
    ) -> Self {
        let part = Some(wanted.load(Ordering::Acquire)).filter(|part| *part > 0);
        let dropped = vec![0; counts.topics().len()];
        Self {
            vehicle,
            queue,
            counts,
            waits,
            wanted,
            warm_up_time,
            part,
            next_event: (0, 0),
            gap_ns: None,
            dropped,
            config: None,
            in_force: Vec::new(),
            warm_up: None,
        }
    }

    /// Makes keyframes possible: new pipelines get this configuration and these tables.
    pub fn set_config(&mut self, config: VehicleConfig, calibrations: Vec<Option<Calibration>>) {
        self.config = Some((config, calibrations));
    }

    /// True if maps are recorded, or will be after a warm-up: then all layers are computed.
    pub fn records_maps(&self) -> bool {
        self.is_recording() && self.counts.has_maps(self.vehicle)
    }

    /// True if events are recorded, or will be after a warm-up.
    pub fn is_recording(&self) -> bool {
        self.part.is_some() || self.warm_up.is_some()
    }

    /// Records an event, before the pipeline processes it.
    pub fn record_event(&mut self, event: &Event) {
        self.follow(event.sequence, event.arrival_ns);
        self.next_event = (event.sequence + 1, event.arrival_ns);
        if self.is_recording() {
            let topic = self.counts.first_topic(self.vehicle);
            self.counts.add_offered(topic);
            if !self.push(Item::Event(self.vehicle, event.clone())) {
                self.drop_message(topic);
                // A new pipeline that the file cannot follow is of no use.
                (self.gap_ns, self.warm_up) = (Some(event.arrival_ns), None);
            }
        }
        self.keep_in_force(event);
    }

    /// Records a map; `hop` ends when it is written or lost.
    pub fn record_map(&mut self, map: &Arc<EncodedMap>, hop: Hop) {
        if self.part.is_none() || !self.counts.has_maps(self.vehicle) {
            return;
        }
        let first = self.counts.first_topic(self.vehicle) + 1;
        let topics = first..first + map.layers.len();
        topics.clone().for_each(|topic| self.counts.add_offered(topic));
        if !self.push(Item::Map(self.vehicle, map.clone(), hop)) {
            topics.for_each(|topic| self.drop_message(topic));
        }
    }

    /// Follows the processed `event`: steps the new pipeline, if there is one, and lets it replace the vehicle's own
    /// when it has seen enough.
    pub fn keep_up(&mut self, event: &Event, own: &mut Pipeline) {
        let Some(warm_up) = &mut self.warm_up else { return };
        // Its outcome equals the outcome of the vehicle's own pipeline, which is reported.
        let _ = warm_up.pipeline.step(event);
        // After a step back of the host's clock the time counts again from there.
        warm_up.from_ns = warm_up.from_ns.min(event.arrival_ns);
        let passed_ns = event.arrival_ns.saturating_sub(warm_up.from_ns);
        let warm_up_ns = i64::try_from(self.warm_up_time.as_nanos()).unwrap_or(i64::MAX);
        let stamp = |pipeline: &Pipeline| pipeline.newest_map().map(|map| map.capture_end_ns);
        let are_near = match (stamp(own), stamp(&warm_up.pipeline)) {
            (Some(own), Some(new)) => own.abs_diff(new) <= STAMPS_NS_MAX,
            (own, new) => own == new,
        };
        let is_overdue = passed_ns >= warm_up_ns.saturating_mul(WARM_UPS_MAX);
        if (passed_ns >= warm_up_ns && are_near) || is_overdue {
            self.hand_over(own);
        }
    }

    /// To be called now and then while no event comes: follows a request to stop, or to begin another part.
    pub fn idle(&mut self, own: &mut Pipeline) {
        let (first_event, arrival_ns) = self.next_event;
        self.follow(first_event, arrival_ns);
        if self.warm_up.as_ref().is_some_and(|warm_up| warm_up.began.elapsed() >= self.warm_up_time * 2) {
            self.hand_over(own);
        }
    }

    /// Lets the new pipeline replace the vehicle's own, if the queue takes the keyframe.
    fn hand_over(&mut self, own: &mut Pipeline) {
        let Some(mut warm_up) = self.warm_up.take() else { return };
        let (vehicle, part, handover) = (self.vehicle, warm_up.part, own.handover());
        if self.push(Item::Begin { vehicle, part, handover: handover.clone() }) {
            warm_up.pipeline.take_over(handover);
            *own = warm_up.pipeline;
            (self.part, self.gap_ns) = (Some(part), None);
        } else {
            self.warm_up = Some(warm_up);
        }
    }

    /// Starts a new pipeline if another part is wanted or the part lacks an event; it begins with the event of this
    /// sequence.
    fn follow(&mut self, first_event: u64, from_ns: i64) {
        self.leave_if_stopped();
        let wanted = self.wanted.load(Ordering::Acquire);
        let is_needed = wanted > 0 && (self.part != Some(wanted) || self.gap_ns.is_some());
        let is_under_way = self.warm_up.as_ref().is_some_and(|warm_up| warm_up.part == wanted);
        let is_soon = self.gap_ns.is_some_and(|gap_ns| from_ns.abs_diff(gap_ns) < AFTER_LOSS_NS);
        if !is_needed || is_under_way || is_soon || self.config.is_none() {
            return;
        }
        let (vehicle, repeated) = (self.vehicle, self.in_force.clone());
        let warm_up = Item::WarmUp { vehicle, part: wanted, from_ns, first_event, repeated };
        if self.push(warm_up) {
            let Some((config, calibrations)) = &self.config else { return };
            let Ok(mut pipeline) = Pipeline::new(config, calibrations.clone()) else { return };
            for event in &self.in_force {
                // Refused now as it was before.
                let _ = pipeline.step(event);
            }
            self.warm_up = Some(Box::new(WarmUp { part: wanted, pipeline, from_ns, began: Instant::now() }));
        }
    }

    fn leave_if_stopped(&mut self) {
        let is_stopped = self.wanted.load(Ordering::Acquire) == 0;
        if is_stopped && self.is_recording() && self.push(Item::Leave { vehicle: self.vehicle }) {
            (self.part, self.warm_up) = (None, None);
        }
    }

    /// Remembers an event that stays in force, in place of the event that it replaces.
    fn keep_in_force(&mut self, event: &Event) {
        match &event.body {
            Body::Sensor(_) => {
                let is_same = |other: &Event| other.source == event.source && other.body == event.body;
                if !self.in_force.iter().any(is_same) {
                    self.in_force.push(event.clone());
                }
            }
            Body::Withdrawn => {
                let is_same = |other: &Event| matches!(other.body, Body::Sensor(_)) && other.source == event.source;
                self.in_force.retain(|other| !is_same(other));
            }
            Body::Road(road) => {
                let is_same = |other: &Event| matches!(&other.body, Body::Road(known) if known.purpose == road.purpose);
                self.in_force.retain(|other| !is_same(other));
                self.in_force.push(event.clone());
            }
            _ => {}
        }
    }

    /// Puts an item on the queue, after a note of what did not fit before it. Returns false if it does not fit.
    fn push(&mut self, item: Item) -> bool {
        if self.dropped.iter().any(|count| *count > 0) {
            let note = Item::Dropped { vehicle: self.vehicle, topics: self.dropped_topics() };
            if !self.try_push(note) {
                return false;
            }
            self.dropped.fill(0);
        }
        self.try_push(item)
    }

    fn try_push(&self, item: Item) -> bool {
        if self.waits {
            return self.queue.send(item).is_ok();
        }
        match self.queue.try_send(item) {
            Ok(()) => true,
            Err(TrySendError::Full(_) | TrySendError::Disconnected(_)) => false,
        }
    }

    fn drop_message(&mut self, topic: usize) {
        self.dropped[topic] += 1;
        self.counts.add_dropped(topic);
    }

    fn dropped_topics(&self) -> Vec<(usize, u64)> {
        let topics = self.dropped.iter().copied().enumerate();
        topics.filter(|(_, count)| *count > 0).collect()
    }
}

impl Drop for RecordingHandle {
    fn drop(&mut self) {
        let vehicle = self.vehicle;
        // Waits for a place in the queue: nothing comes after these. They fail only if the recorder has ended.
        let topics = self.dropped_topics();
        if !topics.is_empty() {
            let _ = self.queue.send(Item::Dropped { vehicle, topics });
        }
        let _ = self.queue.send(Item::Leave { vehicle });
    }
}
