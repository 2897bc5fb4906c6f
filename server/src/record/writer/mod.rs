//! Every event and every map -> the parts of a recording, on a thread of its own with a queue of its own.
//!
//! | file | in -> out |
//! |---|---|
//! | `handle` | one vehicle's events and maps -> the queue; the pipeline of the vehicle's next keyframe |
//! | `recording` | the queue -> parts on the disk |
//! | `folder` | parts -> files: names, links of saved parts, deletion of old ones |
//! | `counts` | what was offered, written, dropped and is durable |
//! | `control` | requests of operators -> the recorder's thread |
//!
//! At least every `flush_ms` the disk is told to have everything, so a power cut costs at most that. If the queue is
//! full or the disk fails, maps are still computed and served; what the recording lacks is counted by topic, in the
//! status and in the recording, and a keyframe lets the maps after it be verified again.

use std::sync::Arc;
use std::sync::mpsc::channel;
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use super::mcap_file::Header;
use crate::config::Recorder as Options;
use crate::file_advice::advised;

mod control;
mod counts;
mod folder;
mod handle;
mod recording;

pub use control::{Command, ControlError, RecorderControl};
pub use counts::{IncompleteRecordingError, RecorderCounts, RecorderState};
pub use folder::{Files, Folder, RecordError, is_same_file, next_free_name, parts_of, recording_path};
pub use handle::RecordingHandle;
pub use recording::RecordingWriter;

/// Longest wait for the disk at the end of a live recording. Ours: a process supervisor kills after ten seconds.
const FINISH_TIME_MAX: Duration = Duration::from_secs(5);
/// Interval at which the end of the recorder's thread is looked for.
const FINISH_POLL_INTERVAL: Duration = Duration::from_millis(5);

/// The running recorder.
#[derive(Debug)]
pub struct Recorder {
    control: RecorderControl,
    thread: JoinHandle<()>,
    waits: bool,
}

impl Recorder {
    /// Creates the file, writes the header and starts the thread. Returns a handle for each vehicle, in the order of
    /// the header. With `waits` a full queue delays its sender and loses nothing: right for files, wrong for live data.
    ///
    /// # Errors
    /// [`RecordError::Create`] if the file exists or it or the thread cannot be created, [`RecordError::Write`] if the
    /// header cannot be written.
    pub fn start(options: &Options, header: &Header, waits: bool) -> Result<(Self, Vec<RecordingHandle>), RecordError> {
        let path = options.file.clone();
        let create = |source| RecordError::Create { file: path.clone(), source: advised(&path, source) };
        let folder = Folder::open(options).map_err(create)?;
        let (writer, handles) = RecordingWriter::new(folder, options, header, waits, Instant::now())?;
        let (requests, received) = channel();
        let control = RecorderControl { requests, counts: writer.counts(), options: options.clone() };
        let thread = std::thread::Builder::new().name("recorder".into());
        let thread = thread.spawn(move || writer.run(&received)).map_err(create)?;
        Ok((Self { control, thread, waits }, handles))
    }

    /// The counts of the recording.
    pub fn counts(&self) -> Arc<RecorderCounts> {
        self.control.counts.clone()
    }

    /// Sends requests to the recorder.
    pub fn control(&self) -> RecorderControl {
        self.control.clone()
    }

    /// Waits until all handles are dropped and everything is in the file; for a live recording at most 5 s.
    ///
    /// # Errors
    /// [`IncompleteRecordingError`] if the disk failed or was too slow, or if the recorder's thread panicked.
    pub fn finish(self) -> Result<(), IncompleteRecordingError> {
        let began = Instant::now();
        while !self.waits && !self.thread.is_finished() {
            if began.elapsed() > FINISH_TIME_MAX {
                let reason = format!("the disk has not taken the rest within {} s", FINISH_TIME_MAX.as_secs());
                return Err(IncompleteRecordingError { reason });
            }
            std::thread::sleep(FINISH_POLL_INTERVAL);
        }
        let counts = self.counts();
        let panicked = self.thread.join().is_err().then(|| "the recorder's thread panicked".to_owned());
        let reason = panicked.or_else(|| counts.stop_reason());
        reason.map_or(Ok(()), |reason| Err(IncompleteRecordingError { reason }))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_that_cannot_be_created_is_named() {
        let options = Options { file: "/proc/no/such.mcap".into(), ..Options::default() };
        let error = Recorder::start(&options, &Header::default(), false).map(|_| ()).unwrap_err().to_string();
        assert!(error.contains("/proc/no"), "{error}");
    }

    #[test]
    fn a_file_that_exists_is_refused_and_kept() {
        let temporary = tempfile::tempdir().unwrap();
        let file = temporary.path().join("car.mcap");
        std::fs::write(&file, "precious").unwrap();
        let options = Options { file: file.clone(), ..Options::default() };
        let error = Recorder::start(&options, &Header::default(), false).map(|_| ()).unwrap_err().to_string();
        assert!(error.contains("the file exists and is not overwritten"), "{error}");
        assert_eq!(std::fs::read(&file).unwrap(), b"precious");
    }
}
