//! The counts of a recorder, which every publisher of the status reads: offered, written, dropped, durable.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant, SystemTime};

use clearway_proto::v1;

use crate::base::counted::counted;
use crate::base::sync::locked;
use clearway_journal::RecordedMaps;
use clearway_journal::mcap_file::topic_of_layer;

/// A recording ended before the last event or map.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("the recording is incomplete: {reason}")]
pub struct IncompleteRecordingError {
    /// The failure that made it incomplete.
    pub reason: String,
}

/// Longest time between two signs of life of a recorder that does not hang. Ours: it looks for messages twenty times a
/// second, and a sync that takes longer is an alarm of its own.
const SILENT_MAX: Duration = Duration::from_secs(2);

/// What the recorder does.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum RecorderState {
    /// It writes a file.
    #[default]
    Recording,
    /// It was stopped by request.
    Stopped,
    /// The disk has failed; the recorder tries again to begin a part.
    Failed,
}

impl RecorderState {
    /// The name in status and metrics.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Recording => "recording",
            Self::Stopped => "stopped",
            Self::Failed => "failed",
        }
    }
}

/// Counts of one topic since the server started.
#[derive(Debug, Default)]
struct TopicCounters {
    name: String,
    offered: AtomicU64,
    written: AtomicU64,
    dropped: AtomicU64,
}

/// The counts of one recorder. Topics are numbered: of each vehicle the journal, then its layers.
#[derive(Debug)]
pub struct RecorderCounts {
    topics: Vec<TopicCounters>,
    /// The index of each vehicle's first topic.
    first_topics: Vec<usize>,
    vehicles: Vec<Arc<str>>,
    /// By vehicle: number of events that are on the disk for certain.
    durable: Vec<AtomicU64>,
    is_late: AtomicBool,
    started: Instant,
    /// Time of the newest sign of life of the recorder's thread, in ms after `started`.
    beat_ms: AtomicU64,
    has_ended: AtomicBool,
    store: StoreCounters,
    changing: Mutex<Changing>,
}

/// Parts that the long-term store has confirmed, those that wait for it, attempts that failed, and why the newest did
/// and since when they do.
#[derive(Debug, Default)]
struct StoreCounters {
    confirmed: AtomicU64,
    waiting: AtomicU64,
    failures: AtomicU64,
    problem: Mutex<Option<(String, SystemTime)>>,
}

/// What changes seldom.
#[derive(Clone, Debug, Default)]
struct Changing {
    state: RecorderState,
    file: String,
    folder: PathBuf,
    part: u64,
    reason: Option<String>,
    /// The first failure of the disk, which later success does not make undone.
    failure: Option<String>,
}

impl RecorderCounts {
    /// Counts of a recorder of these vehicles, with the layers that are recorded of their maps.
    pub fn new(vehicles: &[(Arc<str>, Vec<&'static str>)], maps: RecordedMaps) -> Self {
        let mut counts = Self {
            topics: Vec::new(),
            first_topics: Vec::new(),
            vehicles: Vec::new(),
            durable: Vec::new(),
            is_late: AtomicBool::new(false),
            started: Instant::now(),
            beat_ms: AtomicU64::new(0),
            has_ended: AtomicBool::new(false),
            store: StoreCounters::default(),
            changing: Mutex::default(),
        };
        for (vehicle, layers) in vehicles {
            counts.first_topics.push(counts.topics.len());
            counts.vehicles.push(vehicle.clone());
            counts.durable.push(AtomicU64::new(0));
            let journal = format!("/{vehicle}/journal");
            let of_layers = layers.iter().map(|layer| topic_of_layer(vehicle, layer, maps));
            let names = std::iter::once(journal).chain(of_layers);
            counts.topics.extend(names.map(|name| TopicCounters { name, ..TopicCounters::default() }));
        }
        counts
    }

    /// The index of a vehicle's first topic, its journal.
    pub(super) fn first_topic(&self, vehicle: usize) -> usize {
        self.first_topics[vehicle]
    }

    /// True if something is recorded of the vehicle's maps.
    pub(super) fn has_maps(&self, vehicle: usize) -> bool {
        let end = self.first_topics.get(vehicle + 1).copied().unwrap_or(self.topics.len());
        end > self.first_topics[vehicle] + 1
    }

    /// The names of all topics.
    pub(super) fn topics(&self) -> impl ExactSizeIterator<Item = &str> {
        self.topics.iter().map(|topic| &*topic.name)
    }

    pub(super) fn add_offered(&self, topic: usize) {
        self.topics[topic].offered.fetch_add(1, Ordering::Relaxed);
    }

    pub(super) fn add_written(&self, topic: usize) {
        self.topics[topic].written.fetch_add(1, Ordering::Relaxed);
    }

    pub(super) fn add_dropped(&self, topic: usize) {
        if self.topics[topic].dropped.fetch_add(1, Ordering::Relaxed) == 0 {
            tracing::error!(topic = %self.topics[topic].name, "the recording begins to lose messages");
        }
    }

    /// Counts written messages as dropped, by topic: the disk has failed before it had them for certain.
    pub(super) fn move_to_dropped(&self, topics: &[u64]) {
        for (topic, count) in self.topics.iter().zip(topics) {
            topic.written.fetch_sub(*count, Ordering::Relaxed);
            topic.dropped.fetch_add(*count, Ordering::Relaxed);
        }
    }

    pub(super) fn set_durable(&self, vehicle: usize, events: u64) {
        self.durable[vehicle].store(events, Ordering::Release);
    }

    /// Notes that the recorder's thread is at work, or waits for messages.
    pub(super) fn beat(&self) {
        let ms = u64::try_from(self.started.elapsed().as_millis()).unwrap_or(u64::MAX);
        self.beat_ms.store(ms, Ordering::Relaxed);
    }

    /// Notes that the recorder has ended in order: its silence means nothing.
    pub(super) fn set_ended(&self) {
        self.has_ended.store(true, Ordering::Relaxed);
    }

    /// How long the recorder's thread has been silent, if that is too long: it waits for the disk, or has stopped.
    fn hung(&self) -> Option<Duration> {
        let beat = Duration::from_millis(self.beat_ms.load(Ordering::Relaxed));
        let silent = self.started.elapsed().saturating_sub(beat);
        (silent > SILENT_MAX && !self.has_ended.load(Ordering::Relaxed)).then_some(silent)
    }

    /// Notes that the disk takes much longer than it should, or that it no longer does.
    pub(super) fn set_late(&self, is_late: bool) {
        self.is_late.store(is_late, Ordering::Relaxed);
    }

    pub(super) fn set_file(&self, file: String, part: u64) {
        let mut changing = locked(&self.changing);
        changing.folder = Path::new(&file).parent().map(Path::to_owned).unwrap_or_default();
        (changing.file, changing.part, changing.state, changing.reason) = (file, part, RecorderState::Recording, None);
    }

    pub(super) fn set_stopped(&self) {
        let mut changing = locked(&self.changing);
        (changing.file, changing.state) = (String::new(), RecorderState::Stopped);
    }

    pub(super) fn set_failed(&self, reason: &str) {
        let mut changing = locked(&self.changing);
        (changing.file, changing.state, changing.reason) =
            (String::new(), RecorderState::Failed, Some(reason.to_owned()));
        changing.failure.get_or_insert_with(|| reason.to_owned());
    }

    /// The folder of the newest part, also after its disk has failed; empty: the working folder.
    pub fn folder(&self) -> PathBuf {
        locked(&self.changing).folder.clone()
    }

    /// The first failure of the disk; `None` without one.
    pub fn stop_reason(&self) -> Option<String> {
        locked(&self.changing).failure.clone()
    }

    /// What is wrong with the recording now; `None` if nothing is.
    pub fn problem(&self) -> Option<String> {
        let changing = locked(&self.changing).clone();
        let lost = self.lost();
        let hung = self.hung().map(|silent| format!("the disk has not answered for {} s", silent.as_secs()));
        let late = || self.is_late.load(Ordering::Relaxed).then(|| "the disk is too slow".to_owned());
        let lost = || (lost > 0).then(|| format!("{lost} events and maps are lost to the recording"));
        changing.reason.or(hung).or_else(late).or_else(lost)
    }

    /// What is wrong with the long-term store now; `None` if nothing is.
    pub fn store_problem(&self) -> Option<String> {
        let (reason, _) = locked(&self.store.problem).clone()?;
        let waiting = self.store.waiting.load(Ordering::Relaxed);
        Some(format!("{} not yet in the store: {reason}", counted(waiting, "part")))
    }

    /// Number of events and maps that the recording lacks, because its queue was full or its disk failed. A map counts
    /// once for each of its layers.
    pub fn lost(&self) -> u64 {
        self.topics.iter().map(|topic| topic.dropped.load(Ordering::Relaxed)).sum()
    }

    /// The number of the vehicle's events that survive a power cut: every event with a lower sequence that is not
    /// counted as dropped.
    pub fn durable_events(&self, vehicle: &str) -> u64 {
        let index = self.vehicles.iter().position(|name| **name == *vehicle);
        index.map_or(0, |index| self.durable[index].load(Ordering::Acquire))
    }

    /// The counts of each topic.
    pub fn topic_counts(&self) -> Vec<v1::TopicCount> {
        let counts = |topic: &TopicCounters| {
            // A message is offered before it is written or dropped, so these are read in the opposite order.
            let [dropped, written, offered] =
                [&topic.dropped, &topic.written, &topic.offered].map(|count| count.load(Ordering::Acquire));
            v1::TopicCount { topic: topic.name.clone(), offered, written, dropped }
        };
        self.topics.iter().map(counts).collect()
    }

    /// Number of events in the journals, and of maps, which have one message in each of their layers.
    fn written(&self) -> (u64, u64) {
        let (mut events, mut maps) = (0, 0);
        for (vehicle, &first) in self.first_topics.iter().enumerate() {
            let end = self.first_topics.get(vehicle + 1).copied().unwrap_or(self.topics.len());
            let mut written = self.topics[first..end].iter().map(|topic| topic.written.load(Ordering::Relaxed));
            events += written.next().unwrap_or(0);
            maps += written.max().unwrap_or(0);
        }
        (events, maps)
    }

    /// The counts as the wire carries them.
    pub fn to_proto(&self) -> v1::RecorderStatus {
        let changing = locked(&self.changing).clone();
        let (events, maps) = self.written();
        let store_problem = locked(&self.store.problem).clone();
        let since = store_problem.as_ref().and_then(|(_, since)| since.duration_since(SystemTime::UNIX_EPOCH).ok());
        let durable = self.vehicles.iter().zip(&self.durable);
        v1::RecorderStatus {
            file: changing.file,
            events,
            maps,
            lost: self.lost(),
            state: changing.state.as_str().to_owned(),
            reason: self.problem().unwrap_or_default(),
            part: changing.part,
            topics: self.topic_counts(),
            durable_events: durable
                .map(|(vehicle, events)| (vehicle.to_string(), events.load(Ordering::Acquire)))
                .collect::<BTreeMap<_, _>>(),
            store_confirmed: self.store.confirmed.load(Ordering::Relaxed),
            store_waiting: self.store.waiting.load(Ordering::Relaxed),
            store_failures: self.store.failures.load(Ordering::Relaxed),
            store_problem: store_problem.map(|(reason, _)| reason).unwrap_or_default(),
            store_problem_since_ns: since.map_or(0, |since| since.as_nanos() as u64),
        }
    }
}

/// What the uploads of the store report.
#[cfg(feature = "store")]
impl RecorderCounts {
    /// Notes how many finished parts the store has not confirmed.
    pub(crate) fn set_waiting_for_store(&self, parts: u64) {
        self.store.waiting.store(parts, Ordering::Relaxed);
    }

    /// Counts a part that the store has confirmed; `waiting` are left.
    pub(crate) fn add_confirmed(&self, waiting: u64) {
        self.store.confirmed.fetch_add(1, Ordering::Relaxed);
        self.set_waiting_for_store(waiting);
    }

    /// Counts an attempt to store a part that failed.
    pub(crate) fn add_store_failure(&self) {
        self.store.failures.fetch_add(1, Ordering::Relaxed);
    }

    /// Notes why the store has not confirmed a part; `None`: nothing is wrong.
    pub(crate) fn set_store_problem(&self, reason: Option<String>) {
        let mut problem = locked(&self.store.problem);
        let since = problem.take().map_or_else(SystemTime::now, |(_, since)| since);
        *problem = reason.map(|reason| (reason, since));
    }
}
