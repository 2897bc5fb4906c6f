//! One MCAP file -> readings: the journal of one vehicle where the file is a recording of ours, else the
//! `velodyne_msgs/VelodyneScan` messages of its first such topic, packet by packet with their own stamps.

use std::collections::{BTreeSet, VecDeque};
use std::path::{Path, PathBuf};

use clearway_lidar::velodyne_scan::{VelodyneScan, VelodyneScanError};
use clearway_mapping::event::Body;

use super::Reading;
use crate::recording::{Entry, Recording, RecordingError};

/// An open MCAP file; an iterator over its readings.
pub struct Source {
    file: PathBuf,
    recording: Recording,
    /// The vehicle whose journal is read; the first one met where `None`.
    vehicle: Option<String>,
    topic: Option<String>,
    ignored: BTreeSet<String>,
    waiting: VecDeque<Reading>,
    is_journal: bool,
}

/// Why an MCAP file cannot be read on.
#[derive(Debug, thiserror::Error)]
pub enum McapError {
    /// The file cannot be read.
    #[error(transparent)]
    Recording(#[from] RecordingError),
    /// A message is no VelodyneScan.
    #[error("{}: {topic}: {source}", file.display())]
    VelodyneScan {
        /// The file.
        file: PathBuf,
        /// The topic.
        topic: String,
        /// What is wrong.
        source: VelodyneScanError,
    },
}

impl Source {
    /// Opens the file; `vehicle` names the one whose journal is wanted.
    ///
    /// # Errors
    /// [`McapError`] where the file cannot be read or is no MCAP.
    pub fn open(file: &Path, vehicle: Option<&str>) -> Result<Self, McapError> {
        Ok(Self {
            file: file.to_owned(),
            recording: Recording::open(file)?,
            vehicle: vehicle.map(str::to_owned),
            topic: None,
            ignored: BTreeSet::new(),
            waiting: VecDeque::new(),
            is_journal: false,
        })
    }

    /// The recording underneath.
    pub fn recording(&self) -> &Recording {
        &self.recording
    }

    /// Whether the readings so far came out of a journal: then the ends of sources are in it too.
    pub fn is_journal(&self) -> bool {
        self.is_journal
    }

    /// Journals and topics that were left alone.
    pub fn ignored(&self) -> &BTreeSet<String> {
        &self.ignored
    }

    fn take(&mut self, entry: Entry) -> Result<(), McapError> {
        match entry {
            Entry::Event { vehicle, event } => {
                if *self.vehicle.get_or_insert_with(|| vehicle.clone()) == vehicle {
                    self.is_journal = true;
                    let (arrival_ns, source, body) = (event.arrival_ns, event.source, event.body);
                    self.waiting.push_back(Reading { arrival_ns, source, body });
                } else {
                    self.ignored.insert(format!("/{vehicle}/journal"));
                }
            }
            Entry::VelodyneScan { topic, bytes } => {
                let first = self.topic.get_or_insert_with(|| topic.clone());
                if self.is_journal || *first != topic {
                    self.ignored.insert(topic);
                    return Ok(());
                }
                let wrong = |source| McapError::VelodyneScan { file: self.file.clone(), topic: topic.clone(), source };
                for packet in VelodyneScan::new(&bytes).map_err(wrong)?.packets() {
                    let (arrival_ns, payload) = packet.map_err(wrong)?;
                    let body = Body::Datagram(bytes.slice_ref(payload));
                    self.waiting.push_back(Reading { arrival_ns, source: 0, body });
                }
            }
            Entry::Map { .. } => {}
        }
        Ok(())
    }
}

impl Iterator for Source {
    type Item = Result<Reading, McapError>;

    fn next(&mut self) -> Option<Self::Item> {
        loop {
            if let Some(reading) = self.waiting.pop_front() {
                return Some(Ok(reading));
            }
            let taken = match self.recording.next()? {
                Ok(entry) => self.take(entry),
                Err(error) => Err(error.into()),
            };
            if let Err(error) = taken {
                return Some(Err(error));
            }
        }
    }
}
