//! The recording of one run: a disk in memory that fails as told, and what must be found on it.

use std::io::{self, Write};
use std::sync::{Arc, Mutex, PoisonError};

use clearway::record::writer::{Disk, RecorderCounts};
use clearway::record::verify::{VerifyError, verify};

use super::checks::{Breach, breach};
use super::fate::DiskFate;

/// A disk whose bytes outlive it.
#[derive(Clone, Debug)]
pub struct MemoryDisk {
    bytes: Arc<Mutex<Vec<u8>>>,
    fate: DiskFate,
    failed: bool,
}

impl MemoryDisk {
    /// An empty one.
    pub fn new(fate: DiskFate) -> Self {
        Self { bytes: Arc::default(), fate, failed: false }
    }

    /// What is on it.
    pub fn bytes(&self) -> Vec<u8> {
        self.bytes.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }
}

impl Write for MemoryDisk {
    fn write(&mut self, data: &[u8]) -> io::Result<usize> {
        let mut bytes = self.bytes.lock().unwrap_or_else(PoisonError::into_inner);
        let room = match self.fate {
            DiskFate::Full(most) => most.saturating_sub(bytes.len()),
            DiskFate::Hiccup(at) if !self.failed => at.saturating_sub(bytes.len()),
            _ => data.len(),
        };
        if room == 0 && !data.is_empty() {
            self.failed = true;
            return Err(io::ErrorKind::StorageFull.into());
        }
        let taken = room.min(data.len());
        bytes.extend_from_slice(&data[..taken]);
        Ok(taken)
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

impl Disk for MemoryDisk {
    fn keep(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// What the engine told the recorder, and what came of it.
pub struct Recorded {
    /// On the disk, as it was left.
    pub bytes: Vec<u8>,
    /// The recorder's own word.
    pub counts: Arc<RecorderCounts>,
    /// Events and maps of one layer that it was given.
    pub given: (u64, u64),
    /// Events that must be there whatever happened: those older than the recorder's flush when the machine died.
    pub confirmed: u64,
    /// Whether the machine died.
    pub died: bool,
}

impl Recorded {
    /// The recording is the maps of its events, byte for byte, or what it lacks is named. Gives whether it is whole.
    pub fn check(&self) -> Result<bool, Breach> {
        let wrong = |what: String| Err(breach("recording", what));
        let file = tempfile::NamedTempFile::new().and_then(|mut file| file.write_all(&self.bytes).map(|()| file));
        let file = file.map_err(|error| breach("recording", format!("no temporary file: {error}")))?;
        let report = match verify(file.path()) {
            Ok(report) => report,
            // Died or failed before its preface was written.
            Err(VerifyError::Recording(_)) if self.confirmed == 0 && (self.died || self.counts.stopped().is_some()) => {
                return Ok(false);
            }
            Err(error) => return wrong(error.to_string()),
        };
        let lost = self.counts.lost();
        let complete = (report.events, report.equal) == self.given;
        let says = format!(
            "{} of {} events, {} of {} layers are equal, {} differ, cut {}; lost {lost}, stopped {:?}: {:?}",
            report.events,
            self.given.0,
            report.equal,
            self.given.1,
            report.different,
            report.cut,
            self.counts.stopped(),
            report.differences.first(),
        );
        if report.events < self.confirmed {
            return wrong(format!("{} events were confirmed: {says}", self.confirmed));
        }
        let good = match (self.died, self.counts.stopped(), lost) {
            (true, _, 0) => report.is_good() && report.cut,
            (false, Some(_), _) => report.cut || !report.is_good(),
            (false, None, 0) => report.is_good() && !report.cut && complete,
            // What the recorder's queue had no room for is missed in the file.
            (false, None, _) => !report.is_good() && !report.cut,
            (true, _, _) => report.cut,
        };
        if good { Ok(complete) } else { wrong(says) }
    }
}
