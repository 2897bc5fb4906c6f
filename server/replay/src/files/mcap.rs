//! One MCAP file -> readings: the journal of one vehicle if the file is a recording of this server, otherwise the ROS 2
//! messages of the topics that [`AvailableTopics::choose`] chooses for its bag.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use clearway_daemon::base::counted::counted;
use clearway_daemon::ingest::queue::Reading;
use clearway_daemon::ingest::ros::decoder::TopicDecoder;
use clearway_journal::reader::{RecordedMessage, RecordingError, RecordingReader};
use clearway_ros::RefusedPart;

use super::late_poses::LatePoses;
use super::pose_gap::PoseGap;
use super::unread_topics::unread_topics;
use crate::topics::available::AvailableTopics;
use crate::topics::choice::ChoiceError;

/// Number of refused messages that are not reported to the event queue yet, by sensor and reason.
pub type RefusedMessages = BTreeMap<(u16, &'static str), u64>;

/// The part of MCAP files that is read.
#[derive(Clone, Debug, Default)]
pub struct McapOptions {
    /// The vehicle whose journal is read from a recording of several vehicles; the vehicle of the first event if
    /// `None`.
    pub vehicle: Option<String>,
    /// ROS topics; chosen automatically if empty.
    pub topics: Vec<String>,
    /// Greatest number of sensors of the vehicle; topics of further sensors are ignored.
    pub sensors_max: usize,
    /// The topics of the bag, if they are known; else they are read when the bag is opened.
    pub available: Option<Arc<AvailableTopics>>,
}

/// An open MCAP file; an iterator over its readings.
pub struct Source {
    recording: RecordingReader,
    vehicle: Option<String>,
    /// Decodes the ROS messages; `None` if the file is a recording of this server.
    decoder: Option<TopicDecoder>,
    notes: Vec<String>,
    /// Topics of the journals of other vehicles.
    ignored: BTreeSet<String>,
    /// By topic: the number of refused messages, and the fault of the first.
    refused_topics: BTreeMap<String, (u64, String)>,
    refused: RefusedMessages,
    /// By topic and kind of part: the number of refused parts of used messages, and the fault of the first.
    refused_parts: BTreeMap<(String, &'static str), (u64, String)>,
    /// The readings of the newest message.
    decoded: VecDeque<Reading>,
    late_poses: LatePoses,
    has_ended: bool,
    pose_gap: PoseGap,
    is_journal: bool,
    is_later_part: bool,
    /// Sequence of the event after the newest one of the journal.
    next_event: u64,
}

/// What the next file continues: the bag or the recording of the files before it.
#[derive(Default)]
pub struct Before {
    /// Decodes the ROS messages of several files of one bag.
    decoder: Option<TopicDecoder>,
    part: Option<Part>,
}

/// A part of a recording that was read.
struct Part {
    boot_id: u64,
    number: u64,
    /// Sequence of the event after its newest one.
    next_event: u64,
}

/// An MCAP file cannot be read further.
#[derive(Debug, thiserror::Error)]
pub enum McapError {
    /// The file cannot be read or is damaged.
    #[error(transparent)]
    Recording(#[from] RecordingError),
    /// The topics of the file cannot be chosen.
    #[error(transparent)]
    Choice(#[from] ChoiceError),
}

impl Source {
    /// Opens the file after those `before` it and before those that `follow`: several files of one bag are decoded as
    /// one, and a later part of a recording begins with events that the part before it has, which are passed over.
    ///
    /// # Errors
    /// [`McapError::Recording`] if the file cannot be read or is not an MCAP file, [`McapError::Choice`] if it does not
    /// have a requested topic.
    pub fn open(file: &Path, options: &McapOptions, before: Before, follow: &[PathBuf]) -> Result<Self, McapError> {
        let recording = RecordingReader::open(file)?;
        let (mut decoder, mut notes) = (before.decoder, Vec::new());
        let is_later_part = |before: &Part| {
            before.boot_id == recording.header().boot_id && recording.part().is_some_and(|part| part > before.number)
        };
        let next_event = before.part.filter(is_later_part).map_or(0, |before| before.next_event);
        if recording.header().config.is_some() {
            decoder = None;
        } else if decoder.is_none() {
            let available = match &options.available {
                Some(available) => available.clone(),
                None => Arc::new(AvailableTopics::from_files(&[&[file.to_owned()], follow].concat())?),
            };
            let choice = available.choose(&options.topics, options.sensors_max)?;
            notes.clone_from(&choice.notes);
            decoder = Some(choice.decoder());
        }
        Ok(Self {
            recording,
            vehicle: options.vehicle.clone(),
            decoder,
            notes,
            ignored: BTreeSet::new(),
            refused_topics: BTreeMap::new(),
            refused: RefusedMessages::new(),
            refused_parts: BTreeMap::new(),
            decoded: VecDeque::new(),
            late_poses: LatePoses::default(),
            has_ended: false,
            pose_gap: PoseGap::default(),
            is_journal: false,
            is_later_part: next_event > 0,
            next_event,
        })
    }

    /// The reader of the file.
    pub fn recording(&self) -> &RecordingReader {
        &self.recording
    }

    /// Arrival of the first reading that waits for a pose.
    pub fn waiting_ns(&self) -> Option<i64> {
        self.late_poses.waiting_ns()
    }

    /// True if the readings so far came from a journal, which also contains the ends of its sources.
    pub fn is_journal(&self) -> bool {
        self.is_journal
    }

    /// True if the file is a later part of the recording of the file before it.
    pub fn is_later_part(&self) -> bool {
        self.is_later_part
    }

    /// What was read, ignored and refused, for people.
    pub fn notes(&self) -> Vec<String> {
        let ignored = self.ignored.iter().map(|topic| format!("{topic} is not used"));
        let refused = self.refused_topics.iter();
        let refused = refused
            .map(|(topic, (n, first))| format!("{topic}: {} refused, the first: {first}", counted(*n, "message")));
        let parts = self.refused_parts.iter().map(|((topic, what), (n, first))| {
            format!("{topic}: {n} {what} of messages refused and the rest used, the first: {first}")
        });
        // A journal was made of readings whose gap was told then.
        let topic_of = |source| self.decoder.as_ref().and_then(|of| of.topic(source)).unwrap_or("a sensor").to_owned();
        let gaps = if self.is_journal { Vec::new() } else { self.pose_gap.notes(topic_of) };
        let unread = if self.decoder.is_some() { unread_topics(&self.recording.channels()) } else { Vec::new() };
        self.notes.iter().cloned().chain(ignored).chain(refused).chain(parts).chain(gaps).chain(unread).collect()
    }

    /// Returns the refused messages since the last call.
    pub fn drain_refused(&mut self) -> RefusedMessages {
        std::mem::take(&mut self.refused)
    }

    /// What the next file may continue.
    pub fn into_before(self) -> Before {
        let (boot_id, next_event) = (self.recording.header().boot_id, self.next_event);
        let part = self.recording.part().map(|number| Part { boot_id, number, next_event });
        Before { decoder: self.decoder, part: part.filter(|_| self.is_journal) }
    }

    fn push(&mut self, message: RecordedMessage) {
        match message {
            RecordedMessage::Event { vehicle, event } => {
                if *self.vehicle.get_or_insert_with(|| vehicle.clone()) == vehicle {
                    self.is_journal = true;
                    // A keyframe repeats events that were read before.
                    if event.sequence < self.next_event {
                        return;
                    }
                    self.next_event = event.sequence.saturating_add(1);
                    let (arrival_ns, source, body) = (event.arrival_ns, event.source, event.body);
                    self.decoded.push_back(Reading { arrival_ns, source, body });
                } else {
                    self.ignored.insert(format!("/{vehicle}/journal"));
                }
            }
            RecordedMessage::Ros { topic, kind, log_ns, bytes } => {
                let Some(decoder) = self.decoder.as_mut().filter(|decoder| decoder.accepts(&topic, kind)) else {
                    return;
                };
                match decoder.decode(&topic, kind, log_ns, &bytes, &mut self.decoded) {
                    Ok(parts) => {
                        for RefusedPart { what, count, fault } in parts {
                            let of_topic = self.refused_parts.entry((topic.clone(), what));
                            of_topic.or_insert_with(|| (0, fault.to_string())).0 += count;
                        }
                    }
                    Err(error) => {
                        *self.refused.entry((decoder.source(&topic), error.reason())).or_default() += 1;
                        self.refused_topics.entry(topic).or_insert_with(|| (0, error.to_string())).0 += 1;
                    }
                }
            }
            RecordedMessage::Map { .. }
            | RecordedMessage::Digest { .. }
            | RecordedMessage::Keyframe { .. }
            | RecordedMessage::Counts(_) => {}
        }
    }
}

impl Iterator for Source {
    type Item = Result<Reading, McapError>;

    fn next(&mut self) -> Option<Self::Item> {
        // A journal has the order in which the engine took its events.
        let has_poses = self.decoder.as_ref().is_some_and(TopicDecoder::has_poses);
        loop {
            self.decoded.drain(..).for_each(|reading| self.late_poses.push(reading));
            let late = &mut self.late_poses;
            if let Some(reading) = if has_poses && !self.has_ended { late.pop() } else { late.pop_waiting() } {
                self.pose_gap.note(&reading);
                return Some(Ok(reading));
            }
            if self.has_ended {
                return None;
            }
            match self.recording.next() {
                Some(Ok(message)) => self.push(message),
                Some(Err(error)) => return Some(Err(error.into())),
                None => self.has_ended = true,
            }
        }
    }
}
