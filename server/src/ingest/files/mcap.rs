//! One MCAP file -> readings: the journal of one vehicle where the file is a recording of ours, else the ROS 2 messages
//! of the topics that [`super::ros`] chooses.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::path::Path;

use crate::ingest::queue::Reading;
use crate::ingest::ros::{ChoiceError, Intake, Offered};
use crate::record::reader::{RecordedMessage, RecordingError, RecordingReader};

/// Messages refused that the door has not been told of yet, by sensor and reason.
pub type Untold = BTreeMap<(u16, &'static str), u64>;

/// What is read of MCAP files.
#[derive(Clone, Debug, Default)]
pub struct Wanted {
    /// The vehicle whose journal is read out of recordings of several; the first one met where `None`.
    pub vehicle: Option<String>,
    /// ROS topics; chosen where none is named.
    pub topics: Vec<String>,
    /// Sensors the vehicle may have; a topic more is left alone.
    pub sensors_max: usize,
}

/// An open MCAP file; an iterator over its readings.
pub struct Source {
    recording: RecordingReader,
    vehicle: Option<String>,
    /// What takes the ROS messages; `None` where the file is a recording of ours.
    intake: Option<Intake>,
    notes: Vec<String>,
    ignored: BTreeSet<String>,
    /// By topic: messages that were not taken, and what was wrong with the first.
    refused: BTreeMap<String, (u64, String)>,
    untold: Untold,
    waiting: VecDeque<Reading>,
    is_journal: bool,
}

/// Why an MCAP file cannot be read on.
#[derive(Debug, thiserror::Error)]
pub enum McapError {
    /// The file cannot be read.
    #[error(transparent)]
    Recording(#[from] RecordingError),
    /// Its topics cannot be chosen.
    #[error(transparent)]
    Choice(#[from] ChoiceError),
}

impl Source {
    /// Opens the file. `intake` comes from the file before, so that a bag in several files is one; where there is none,
    /// the topics are chosen.
    ///
    /// # Errors
    /// [`McapError`] where the file cannot be read, is no MCAP, or has not the topics wanted.
    pub fn open(file: &Path, wanted: &Wanted, intake: Option<Intake>) -> Result<Self, McapError> {
        let recording = RecordingReader::open(file)?;
        let (mut intake, mut notes) = (intake, Vec::new());
        if recording.header().config.is_some() {
            intake = None;
        } else if intake.is_none() {
            let choice = Offered::look(file)?.choose(file, &wanted.topics, wanted.sensors_max)?;
            notes.clone_from(&choice.notes);
            intake = Some(choice.intake());
        }
        Ok(Self {
            recording,
            vehicle: wanted.vehicle.clone(),
            intake,
            notes,
            ignored: BTreeSet::new(),
            refused: BTreeMap::new(),
            untold: Untold::new(),
            waiting: VecDeque::new(),
            is_journal: false,
        })
    }

    /// The recording underneath.
    pub fn recording(&self) -> &RecordingReader {
        &self.recording
    }

    /// Whether the readings so far came out of a journal: then the ends of sources are in it too.
    pub fn is_journal(&self) -> bool {
        self.is_journal
    }

    /// What was taken, left alone and refused.
    pub fn notes(&self) -> Vec<String> {
        let ignored = self.ignored.iter().map(|topic| format!("{topic} was left alone"));
        let refused = self.refused.iter();
        let refused = refused.map(|(topic, (n, first))| format!("{topic}: {n} messages refused, the first: {first}"));
        self.notes.iter().cloned().chain(ignored).chain(refused).collect()
    }

    /// Messages that were refused since this was last asked.
    pub fn untold(&mut self) -> Untold {
        std::mem::take(&mut self.untold)
    }

    /// What takes the ROS messages of the bag's next file.
    pub fn into_intake(self) -> Option<Intake> {
        self.intake
    }

    fn take(&mut self, entry: RecordedMessage) {
        match entry {
            RecordedMessage::Event { vehicle, event } => {
                if *self.vehicle.get_or_insert_with(|| vehicle.clone()) == vehicle {
                    self.is_journal = true;
                    let (arrival_ns, source, body) = (event.arrival_ns, event.source, event.body);
                    self.waiting.push_back(Reading { arrival_ns, source, body });
                } else {
                    self.ignored.insert(format!("/{vehicle}/journal"));
                }
            }
            RecordedMessage::Ros { topic, kind, log_ns, bytes } => {
                let Some(intake) = self.intake.as_mut().filter(|intake| intake.wants(&topic, kind)) else {
                    return;
                };
                if let Err(refused) = intake.take(&topic, kind, log_ns, &bytes, &mut self.waiting) {
                    *self.untold.entry((intake.source(&topic), refused.reason())).or_default() += 1;
                    self.refused.entry(topic).or_insert_with(|| (0, refused.to_string())).0 += 1;
                }
            }
            RecordedMessage::Map { .. } => {}
        }
    }
}

impl Iterator for Source {
    type Item = Result<Reading, McapError>;

    fn next(&mut self) -> Option<Self::Item> {
        loop {
            if let Some(reading) = self.waiting.pop_front() {
                return Some(Ok(reading));
            }
            match self.recording.next()? {
                Ok(entry) => self.take(entry),
                Err(error) => return Some(Err(error.into())),
            }
        }
    }
}
