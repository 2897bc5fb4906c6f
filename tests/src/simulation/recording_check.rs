//! The recording of one run: a disk in memory that fails as planned, and what it must hold.

use std::io::{self, Write};
use std::sync::{Arc, Mutex, PoisonError};

use clearway::record::mcap_file::Disk;
use clearway::record::verify::{VerifyError, verify};
use clearway::record::writer::RecorderCounts;

use super::checks::{Violation, violation};
use super::fault_plan::DiskFault;

/// A disk in memory; clones share its bytes.
#[derive(Clone, Debug)]
pub struct MemoryDisk {
    bytes: Arc<Mutex<Vec<u8>>>,
    fault: DiskFault,
    failed: bool,
}

impl MemoryDisk {
    /// An empty disk with a planned fault.
    pub fn new(fault: DiskFault) -> Self {
        Self { bytes: Arc::default(), fault, failed: false }
    }

    /// The content of the disk.
    pub fn bytes(&self) -> Vec<u8> {
        self.bytes.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }
}

impl Write for MemoryDisk {
    fn write(&mut self, data: &[u8]) -> io::Result<usize> {
        let mut bytes = self.bytes.lock().unwrap_or_else(PoisonError::into_inner);
        let room = match self.fault {
            DiskFault::Full(most) => most.saturating_sub(bytes.len()),
            DiskFault::Hiccup(at) if !self.failed => at.saturating_sub(bytes.len()),
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
    fn sync(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// A finished recording, and what it is expected to hold.
pub struct Recorded {
    /// Content of the disk.
    pub bytes: Vec<u8>,
    /// Counts of the recorder.
    pub counts: Arc<RecorderCounts>,
    /// Events, and maps of one layer, that were passed to the recorder.
    pub expected: (u64, u64),
    /// Events that must be recorded in any case: those older than one flush interval when the machine crashed.
    pub confirmed: u64,
    /// True if the machine crashed.
    pub crashed: bool,
}

impl Recorded {
    /// Checks that the recorded maps are the maps of the recorded events, byte for byte, and that the recording reports
    /// every loss.
    /// Returns true if the recording is complete.
    pub fn check(&self) -> Result<bool, Violation> {
        let wrong = |what: String| Err(violation("recording", what));
        let file = tempfile::NamedTempFile::new().and_then(|mut file| file.write_all(&self.bytes).map(|()| file));
        let file = file.map_err(|error| violation("recording", format!("no temporary file: {error}")))?;
        let report = match verify(file.path()) {
            Ok(report) => report,
            // The machine crashed or the disk failed before the header was written.
            Err(VerifyError::Recording(_))
                if self.confirmed == 0 && (self.crashed || self.counts.stop_reason().is_some()) =>
            {
                return Ok(false);
            }
            Err(error) => return wrong(error.to_string()),
        };
        let lost = self.counts.lost();
        let complete = (report.events, report.equal) == self.expected;
        let summary = format!(
            "{} of {} events, {} of {} layers are equal, {} differ, cut {}; lost {lost}, stopped {:?}: {:?}",
            report.events,
            self.expected.0,
            report.equal,
            self.expected.1,
            report.different,
            report.cut,
            self.counts.stop_reason(),
            report.differences.first(),
        );
        if report.events < self.confirmed {
            return wrong(format!("{} events were confirmed: {summary}", self.confirmed));
        }
        let good = match (self.crashed, self.counts.stop_reason(), lost) {
            (true, _, 0) => report.is_good() && report.cut,
            (false, Some(_), _) => report.cut || !report.is_good(),
            (false, None, 0) => report.is_good() && !report.cut && complete,
            // Events lost because the recorder's queue was full are missing in the file.
            (false, None, _) => !report.is_good() && !report.cut,
            (true, _, _) => report.cut,
        };
        if good { Ok(complete) } else { wrong(summary) }
    }
}
