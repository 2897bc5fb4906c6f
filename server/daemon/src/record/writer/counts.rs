//! The counts of a recorder, which every publisher of the status reads: offered, written, dropped, durable.

use std::ops::Range;
use std::path::{Path, PathBuf};
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
    /// The first failure, which made the recording incomplete.
    pub reason: String,
}

/// Longest time between two signs of life of a recorder that does not hang. Ours: it looks for messages twenty times a
/// second, and a sync that takes longer is an alarm of its own.
const SILENT_MAX: Duration = Duration::from_secs(2);

/// The counts of one recorder. Topics are numbered: of each vehicle the journal, then its layers.
#[derive(Debug)]
pub struct RecorderCounts {
    topics: Vec<String>,
    /// The index of each vehicle's first topic, and then the number of all topics.
    first_topics: Vec<usize>,
    vehicles: Vec<Arc<str>>,
    changing: Mutex<Changing>,
}

/// What changes while the recorder works.
#[derive(Debug)]
struct Changing {
    /// The counts as the wire carries them, without the fields that follow from these counts and from the others here.
    status: v1::RecorderStatus,
    folder: PathBuf,
    /// The failure of the disk that stops the recording now.
    reason: Option<String>,
    /// The first failure of the disk, which later success does not make undone.
    failure: Option<String>,
    /// Why the newest attempt to store a part failed, and since when attempts fail.
    store_problem: Option<(String, SystemTime)>,
    is_late: bool,
    /// Number of dropped messages of each topic before this part and the failure that it follows: what was dropped
    /// since is an alarm until the part ends.
    dropped_before: Vec<u64>,
    /// The newest sign of life of the recorder's thread.
    beat: Instant,
    has_ended: bool,
}

impl Changing {
    /// Goes to another state: `recording`, `stopped` or `failed`.
    fn set_state(&mut self, state: &str, file: String) {
        (self.status.state, self.status.file) = (state.to_owned(), file);
    }

    fn lost(&self) -> u64 {
        self.status.topics.iter().map(|topic| topic.dropped).sum()
    }

    /// What is wrong now with the recording of these topics.
    fn problem(&self, topics: Range<usize>) -> Option<String> {
        let silent = self.beat.elapsed();
        let dropped = self.status.topics[topics.clone()].iter().map(|topic| topic.dropped).sum::<u64>();
        let lost = dropped - self.dropped_before[topics].iter().sum::<u64>();
        let is_hung = silent > SILENT_MAX && !self.has_ended;
        let hung = || is_hung.then(|| format!("the disk has not answered for {} s", silent.as_secs()));
        let stopped = || (self.status.state == "stopped").then(|| "stopped by a request".to_owned());
        let late = || self.is_late.then(|| "the disk is too slow".to_owned());
        let lost = || (lost > 0).then(|| format!("{lost} events and maps are lost to this part of the recording"));
        self.reason.clone().or_else(hung).or_else(stopped).or_else(late).or_else(lost)
    }
}

impl RecorderCounts {
    /// Counts of a recorder of these vehicles, with the layers that are recorded of their maps.
    pub fn new(vehicles: &[(Arc<str>, Vec<&'static str>)], maps: RecordedMaps) -> Self {
        let (mut topics, mut first_topics) = (Vec::new(), vec![0]);
        for (vehicle, layers) in vehicles {
            topics.push(format!("/{vehicle}/journal"));
            topics.extend(layers.iter().map(|layer| topic_of_layer(vehicle, layer, maps)));
            first_topics.push(topics.len());
        }
        let counts = |topic: &String| v1::TopicCount { topic: topic.clone(), ..v1::TopicCount::default() };
        let status = v1::RecorderStatus {
            state: "recording".to_owned(),
            topics: topics.iter().map(counts).collect(),
            durable_events: vehicles.iter().map(|(vehicle, _)| (vehicle.to_string(), 0)).collect(),
            ..v1::RecorderStatus::default()
        };
        let changing = Changing {
            status,
            folder: PathBuf::new(),
            reason: None,
            failure: None,
            store_problem: None,
            is_late: false,
            dropped_before: vec![0; topics.len()],
            beat: Instant::now(),
            has_ended: false,
        };
        let vehicles = vehicles.iter().map(|(vehicle, _)| vehicle.clone()).collect();
        Self { topics, first_topics, vehicles, changing: Mutex::new(changing) }
    }

    /// The index of a vehicle's first topic, its journal.
    pub(super) fn first_topic(&self, vehicle: usize) -> usize {
        self.first_topics[vehicle]
    }

    /// True if something is recorded of the vehicle's maps.
    pub(super) fn has_maps(&self, vehicle: usize) -> bool {
        self.first_topics[vehicle + 1] > self.first_topics[vehicle] + 1
    }

    /// The names of all topics.
    pub(super) fn topics(&self) -> &[String] {
        &self.topics
    }

    pub(super) fn add_offered(&self, topic: usize) {
        locked(&self.changing).status.topics[topic].offered += 1;
    }

    pub(super) fn add_written(&self, topic: usize) {
        locked(&self.changing).status.topics[topic].written += 1;
    }

    pub(super) fn add_dropped(&self, topic: usize) {
        let dropped = &mut locked(&self.changing).status.topics[topic].dropped;
        *dropped += 1;
        if *dropped == 1 {
            tracing::error!(topic = %self.topics[topic], "the recording begins to lose messages");
        }
    }

    /// Counts written messages as dropped, by topic: the disk has failed before it had them for certain.
    pub(super) fn move_to_dropped(&self, topics: &[u64]) {
        for (topic, count) in locked(&self.changing).status.topics.iter_mut().zip(topics) {
            topic.written -= count;
            topic.dropped += count;
        }
    }

    pub(super) fn set_durable(&self, vehicle: usize, events: u64) {
        locked(&self.changing).status.durable_events.insert(self.vehicles[vehicle].to_string(), events);
    }

    /// Notes that the recorder's thread is at work, or waits for messages.
    pub(super) fn beat(&self) {
        locked(&self.changing).beat = Instant::now();
    }

    /// Notes that the recorder has ended in order: its silence means nothing.
    pub(super) fn set_ended(&self) {
        locked(&self.changing).has_ended = true;
    }

    /// Notes that the disk takes much longer than it should, or that it no longer does.
    pub(super) fn set_late(&self, is_late: bool) {
        locked(&self.changing).is_late = is_late;
    }

    pub(super) fn set_file(&self, file: String, part: u64) {
        let mut changing = locked(&self.changing);
        changing.folder = Path::new(&file).parent().map(Path::to_owned).unwrap_or_default();
        // What was dropped since the disk has failed counts for the part that is then begun.
        if changing.status.state != "failed" {
            changing.dropped_before = changing.status.topics.iter().map(|topic| topic.dropped).collect();
        }
        (changing.status.part, changing.reason) = (part, None);
        changing.set_state("recording", file);
    }

    pub(super) fn set_stopped(&self) {
        locked(&self.changing).set_state("stopped", String::new());
    }

    /// The disk has failed; the recorder tries again to begin a part.
    pub(super) fn set_failed(&self, reason: &str) {
        let mut changing = locked(&self.changing);
        changing.set_state("failed", String::new());
        changing.reason = Some(reason.to_owned());
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
        locked(&self.changing).problem(0..self.topics.len())
    }

    /// What is wrong with the recording of a vehicle now; `None` if nothing is.
    pub fn problem_of(&self, vehicle: &str) -> Option<String> {
        let number = self.vehicles.iter().position(|name| **name == *vehicle)?;
        locked(&self.changing).problem(self.first_topics[number]..self.first_topics[number + 1])
    }

    /// What is wrong with the long-term store now; `None` if nothing is.
    pub fn store_problem(&self) -> Option<String> {
        let changing = locked(&self.changing);
        let (reason, _) = changing.store_problem.as_ref()?;
        Some(format!("{} not yet in the store: {reason}", counted(changing.status.store_waiting, "part")))
    }

    /// Number of events and maps that the recording lacks, because its queue was full or its disk failed. A map counts
    /// once for each of its layers.
    pub fn lost(&self) -> u64 {
        locked(&self.changing).lost()
    }

    /// The number of the vehicle's events that survive a power cut: every event with a lower sequence that is not
    /// counted as dropped.
    pub fn durable_events(&self, vehicle: &str) -> u64 {
        locked(&self.changing).status.durable_events.get(vehicle).copied().unwrap_or(0)
    }

    /// The counts of each topic.
    pub fn topic_counts(&self) -> Vec<v1::TopicCount> {
        locked(&self.changing).status.topics.clone()
    }

    /// The counts as the wire carries them.
    pub fn to_proto(&self) -> v1::RecorderStatus {
        let changing = locked(&self.changing);
        let mut status = v1::RecorderStatus {
            lost: changing.lost(),
            reason: changing.problem(0..self.topics.len()).unwrap_or_default(),
            ..changing.status.clone()
        };
        // A map has one message in each of its layers.
        for topics in self.first_topics.windows(2).map(|of| &changing.status.topics[of[0]..of[1]]) {
            status.events += topics[0].written;
            status.maps += topics[1..].iter().map(|layer| layer.written).max().unwrap_or(0);
        }
        if let Some((reason, since)) = &changing.store_problem {
            status.store_problem.clone_from(reason);
            let since = since.duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
            status.store_problem_since_ns = since.as_nanos() as u64;
        }
        status
    }
}

/// What the uploads of the store report.
#[cfg(feature = "store")]
impl RecorderCounts {
    /// Notes how many finished parts the store has not confirmed.
    pub(crate) fn set_waiting_for_store(&self, parts: u64) {
        locked(&self.changing).status.store_waiting = parts;
    }

    /// Counts a part that the store has confirmed; `waiting` are left.
    pub(crate) fn add_confirmed(&self, waiting: u64) {
        let status = &mut locked(&self.changing).status;
        (status.store_confirmed, status.store_waiting) = (status.store_confirmed + 1, waiting);
    }

    /// Counts an attempt to store a part that failed.
    pub(crate) fn add_store_failure(&self) {
        locked(&self.changing).status.store_failures += 1;
    }

    /// Notes why the store has not confirmed a part; `None`: nothing is wrong.
    pub(crate) fn set_store_problem(&self, reason: Option<String>) {
        let problem = &mut locked(&self.changing).store_problem;
        let since = problem.take().map_or_else(SystemTime::now, |(_, since)| since);
        *problem = reason.map(|reason| (reason, since));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_loss_is_an_alarm_of_its_vehicle_until_the_part_ends() {
        let vehicles = [("car".into(), vec!["speed"]), ("van".into(), Vec::new())];
        let counts = RecorderCounts::new(&vehicles, RecordedMaps::default());
        let begin = |part| counts.set_file(format!("{part}.mcap"), part);
        let is_alarm = |lost: u64| {
            let text = format!("{lost} events and maps are lost to this part of the recording");
            assert_eq!((counts.problem_of("car"), counts.problem_of("van")), (Some(text), None));
        };
        let is_quiet = || assert_eq!((counts.problem_of("car"), counts.problem()), (None, None));
        begin(1);
        counts.add_dropped(counts.first_topic(0));
        is_alarm(1);
        begin(2);
        is_quiet();
        // What the failed disk did not take is named while the next part lasts.
        counts.set_failed("the disk is full");
        assert_eq!(counts.problem_of("van").as_deref(), Some("the disk is full"));
        (0..2).for_each(|_| counts.add_dropped(counts.first_topic(0)));
        begin(3);
        is_alarm(2);
        begin(4);
        is_quiet();
        assert_eq!(counts.lost(), 3, "the count stays");
    }
}
