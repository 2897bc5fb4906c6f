//! The recording of one run: a disk in memory that fails as planned, and what it must hold.

use std::collections::{BTreeMap, BTreeSet};
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use clearway_daemon::record::verify;
use clearway_daemon::record::writer::{Files, RecorderCounts};
use clearway_journal::mcap_file::Disk;
use clearway_journal::reader::{RecordedMessage, RecordingReader};
use clearway_journal::verify::{Difference, DifferenceKind, Report};

use super::checks::{Violation, violation};
use super::fault_plan::DiskFault;

/// One file on the disk in memory.
#[derive(Clone, Debug, Default)]
pub struct MemoryFile {
    /// All bytes that were written.
    pub bytes: Vec<u8>,
    /// Number of bytes that survive a power cut for certain.
    pub synced: usize,
    /// True if the file has its final name.
    pub is_complete: bool,
}

#[derive(Debug, Default)]
struct State {
    files: BTreeMap<u64, MemoryFile>,
    /// Number of bytes of all files.
    written: usize,
    has_failed: bool,
}

/// A disk in memory; clones share its files. It loses what was not synced.
#[derive(Clone, Debug)]
pub struct MemoryDisk {
    state: Arc<Mutex<State>>,
    fault: DiskFault,
}

/// An open file of a [`MemoryDisk`].
pub struct OpenFile {
    disk: MemoryDisk,
    part: u64,
}

impl MemoryDisk {
    /// An empty disk with a planned fault.
    pub fn new(fault: DiskFault) -> Self {
        Self { state: Arc::default(), fault }
    }

    /// The files by part.
    pub fn files(&self) -> BTreeMap<u64, MemoryFile> {
        self.state().files.clone()
    }

    /// The files after a power cut: each keeps its synced bytes and at most `torn` bytes more.
    pub fn files_after_crash(&self, torn: usize) -> BTreeMap<u64, MemoryFile> {
        let mut files = self.files();
        files.values_mut().for_each(|file| file.bytes.truncate(file.synced + torn));
        files
    }

    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Files for MemoryDisk {
    type File = OpenFile;

    fn create(&mut self, part: u64) -> io::Result<OpenFile> {
        let is_new = self.state().files.insert(part, MemoryFile::default()).is_none();
        let file = OpenFile { disk: self.clone(), part };
        if is_new { Ok(file) } else { Err(io::ErrorKind::AlreadyExists.into()) }
    }

    fn complete(&mut self, part: u64) -> io::Result<()> {
        let mut state = self.state();
        state.files.get_mut(&part).ok_or(io::ErrorKind::NotFound)?.is_complete = true;
        Ok(())
    }

    fn path(&self, part: u64) -> PathBuf {
        format!("part-{part}").into()
    }
}

impl Write for OpenFile {
    fn write(&mut self, data: &[u8]) -> io::Result<usize> {
        let mut state = self.disk.state();
        let room = match self.disk.fault {
            DiskFault::Full(most) => most.saturating_sub(state.written),
            DiskFault::Hiccup(at) if !state.has_failed => at.saturating_sub(state.written),
            _ => data.len(),
        };
        if room == 0 && !data.is_empty() {
            state.has_failed = true;
            return Err(io::ErrorKind::StorageFull.into());
        }
        let taken = room.min(data.len());
        state.written += taken;
        state.files.entry(self.part).or_default().bytes.extend_from_slice(&data[..taken]);
        Ok(taken)
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

impl Disk for OpenFile {
    fn sync(&mut self) -> io::Result<()> {
        let mut state = self.disk.state();
        let file = state.files.entry(self.part).or_default();
        file.synced = file.bytes.len();
        Ok(())
    }
}

/// A recording at the end of a run, or when the machine crashed, and what it is expected to hold.
pub struct Recorded {
    /// The files by part.
    pub files: BTreeMap<u64, MemoryFile>,
    /// Counts of the recorder.
    pub counts: Arc<RecorderCounts>,
    /// Events, and maps of one layer, that were passed to the recorder; `None` if the machine crashed.
    pub expected: Option<(u64, u64)>,
    /// Number of events that were durable by the recorder's own status.
    pub durable: u64,
    /// Number of messages that were dropped by the recorder's own status.
    pub lost: u64,
}

impl Recorded {
    /// Checks that the recorded maps are the maps of the recorded events, byte for byte, that what was durable is
    /// there, and that the recording reports every loss. Returns true if the recording is complete.
    ///
    /// # Errors
    /// [`Violation`] of the check `recording`.
    pub fn check(&self) -> Result<bool, Violation> {
        let failed = |error: &dyn std::fmt::Display| violation("recording", error.to_string());
        let folder = tempfile::tempdir().map_err(|error| failed(&error))?;
        let (mut events, mut equal, mut dropped) = (BTreeSet::new(), 0, 0);
        let mut all_closed = true;
        for (part, file) in &self.files {
            let path = folder.path().join(format!("{part}.mcap"));
            std::fs::write(&path, &file.bytes).map_err(|error| failed(&error))?;
            // The machine crashed or the disk failed before the header was durable; what follows checks what that cost.
            if file.synced == 0 {
                continue;
            }
            let report = verify(&path).map_err(|error| failed(&format!("part {part}: {error}")))?;
            self.check_report(*part, file, &report)?;
            events.extend(events_of(&path).map_err(|error| failed(&error))?);
            (equal, dropped) = (equal + report.equal, dropped + report.dropped);
            all_closed &= report.is_closed;
        }
        let missing = (0..self.durable).filter(|sequence| !events.contains(sequence)).count() as u64;
        if missing > self.lost {
            let found =
                format!("{missing} of {} durable events are missing, {} messages lost", self.durable, self.lost);
            return Err(violation("recording", found));
        }
        let Some((all_events, layers)) = self.expected else { return Ok(false) };
        let topics = self.counts.topic_counts();
        if let Some(topic) = topics.iter().find(|topic| topic.offered != topic.written + topic.dropped) {
            return Err(violation("recording", format!("{topic:?}")));
        }
        let found = (events.len() as u64, equal);
        let summary = format!("{found:?} of {:?}, lost {}", self.expected, self.lost);
        if self.lost == 0 && (found != (all_events, layers) || !all_closed) {
            return Err(violation("recording", summary));
        }
        // A disk that has failed cannot be told what it lacks.
        if self.lost > 0 && dropped == 0 && self.counts.stop_reason().is_none() {
            return Err(violation("recording", format!("the files report no loss: {summary}")));
        }
        Ok(found == (all_events, layers))
    }

    fn check_report(&self, part: u64, file: &MemoryFile, report: &Report) -> Result<(), Violation> {
        let is_loss = |of: &Difference| of.kind == DifferenceKind::Missing;
        let wrong = report.differences.iter().find(|difference| self.lost == 0 || !is_loss(difference));
        if let Some(difference) = wrong {
            return Err(violation("recording", format!("part {part}, lost {}: {difference}", self.lost)));
        }
        if let Some(incomplete) = report.incomplete.as_ref().filter(|_| self.lost == 0 && file.is_complete) {
            return Err(violation("recording", format!("part {part}: {incomplete}")));
        }
        if file.is_complete && (report.cut || !report.is_closed) {
            return Err(violation("recording", format!("part {part} has its name and is not whole")));
        }
        Ok(())
    }
}

/// The sequences of the events of a recording.
fn events_of(file: &Path) -> Result<Vec<u64>, clearway_journal::reader::RecordingError> {
    let mut events = Vec::new();
    for message in RecordingReader::open(file)? {
        if let RecordedMessage::Event { event, .. } = message? {
            events.push(event.sequence);
        }
    }
    Ok(events)
}
