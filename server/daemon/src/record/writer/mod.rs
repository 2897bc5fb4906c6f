//! Every event and every map -> the parts of a recording, on a thread of its own with a queue of its own.
//!
//! | file | in -> out |
//! |---|---|
//! | `handle` | one vehicle's events and maps -> the queue; the pipeline of the vehicle's next keyframe |
//! | `recording` | the queue -> parts on the disk |
//! | `part` | one open part: its file, its counts |
//! | `folder` | parts -> files: names, links of saved parts, deletion of old parts |
//! | `counts` | what was offered, written, dropped and is durable |
//! | `control` | requests of operators -> the recorder's thread |
//!
//! A sync begins at most half of `flush_ms` after the one before it, and at once if a message comes later than that. So
//! a message is on the disk at most `flush_ms` after it was put on the queue, as long as a sync takes no more than the
//! other half; if it does, the status says that the disk is too slow. If the queue is full or the disk fails, maps are
//! still computed and served; what the recording lacks is counted by topic, in the status and in the recording, and a
//! keyframe lets the maps after it be verified again.

use std::io;
use std::sync::Arc;
use std::sync::mpsc::{RecvTimeoutError, SendError, channel};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use crate::base::file_advice::advised;
use crate::config::Recorder as Options;
use clearway_journal::mcap_file::RecordingHeader;

mod control;
mod counts;
mod folder;
mod handle;
mod part;
mod recording;

pub use control::{Command, ControlError, RecorderControl};
pub use counts::{IncompleteRecordingError, RecorderCounts};
pub use folder::{
    Files, Folder, RecordError, confirmation_of, is_being_written, is_same_file, later_part_of, next_free_name,
    parent_of, parts_of, recording_path, unfinished_name,
};
pub use handle::RecordingHandle;
pub use recording::RecordingWriter;

/// Longest wait for the disk at the start of a live recording; after it the server starts, and the recorder goes on
/// when the disk answers. Ours: a disk that works creates a file in milliseconds.
const START_TIME_MAX: Duration = Duration::from_millis(500);
/// Longest wait for the disk at the end of a live recording. Ours: a process supervisor kills after ten seconds.
const FINISH_TIME_MAX: Duration = Duration::from_secs(5);
/// Interval at which the end of the recorder's thread is looked for.
const FINISH_POLL_INTERVAL: Duration = Duration::from_millis(5);

/// The recorder of a running server, with its thread.
#[derive(Debug)]
pub struct Recorder {
    control: RecorderControl,
    thread: JoinHandle<()>,
    waits: bool,
}

impl Recorder {
    /// Starts the thread, which creates the file and writes the header. Returns a handle for each vehicle, in the order
    /// of the header. With `waits` a full queue delays its sender and loses nothing: right for files, wrong for live
    /// data. A live recording does not wait for a disk that hangs: events and maps wait in the queue.
    ///
    /// # Errors
    /// [`RecordError::Create`] if the file exists or it or the thread cannot be created, [`RecordError::Write`] if the
    /// header cannot be written.
    pub fn start(
        options: &Options,
        header: &RecordingHeader,
        waits: bool,
    ) -> Result<(Self, Vec<RecordingHandle>), RecordError> {
        let of_folder = options.clone();
        Self::start_in(move || Folder::open(&of_folder), options, header, waits)
    }

    /// As [`Recorder::start`], to the files that `open` opens.
    fn start_in<F: Files + 'static>(
        open: impl FnOnce() -> io::Result<F> + Send + 'static,
        options: &Options,
        header: &RecordingHeader,
        waits: bool,
    ) -> Result<(Self, Vec<RecordingHandle>), RecordError> {
        let path = options.file.clone();
        let create = move |source| RecordError::Create { file: path.clone(), source: advised(&path, source) };
        let (link, handles) = handle::link(options, header, waits);
        let counts = link.counts.clone();
        let (requests, received) = channel();
        let (begun, has_begun) = channel();
        let control = RecorderControl { requests, counts: counts.clone(), options: options.clone() };
        let failed = create.clone();
        let thread = std::thread::Builder::new().name("recorder".into()).spawn(move || {
            let writer = open().map_err(failed);
            let writer = writer.and_then(|files| RecordingWriter::begin(files, link, Instant::now()));
            let (outcome, writer) = writer.map_or_else(|error| (Err(error), None), |writer| (Ok(()), Some(writer)));
            // The start waits no longer if the disk was late; then its failure is in the status.
            if let Err(SendError(Err(error))) = begun.send(outcome) {
                counts.set_failed(&error.to_string());
                tracing::error!(%error, "nothing is recorded; maps are still served");
            }
            writer.into_iter().for_each(|writer| writer.run(&received));
        });
        let thread = thread.map_err(&create)?;
        let start_time_max = if waits { Duration::MAX } else { START_TIME_MAX };
        match has_begun.recv_timeout(start_time_max) {
            Ok(outcome) => outcome?,
            Err(RecvTimeoutError::Timeout) => {
                tracing::error!(file = %options.file.display(), "the disk does not answer; maps are served meanwhile");
            }
            Err(RecvTimeoutError::Disconnected) => {
                return Err(create(io::Error::other("the recorder's thread panicked")));
            }
        }
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
    use clearway_mapping::event::Event;

    #[test]
    fn a_file_that_cannot_be_created_is_named() {
        let options = Options { file: "/proc/no/such.mcap".into(), ..Options::default() };
        let error = Recorder::start(&options, &RecordingHeader::default(), false).map(|_| ()).unwrap_err().to_string();
        assert!(error.contains("/proc/no"), "{error}");
    }

    #[test]
    fn a_disk_that_hangs_at_the_start_delays_nothing_and_gets_everything_when_it_answers() {
        let temporary = tempfile::tempdir().unwrap();
        let options = Options { file: temporary.path().join("car.mcap"), ..Options::default() };
        let header = RecordingHeader { vehicles: vec![("car".into(), vec!["speed"])], ..RecordingHeader::default() };
        let (answers, is_answered) = channel();
        let of_folder = options.clone();
        let hanging = move || {
            is_answered.recv().unwrap();
            Folder::open(&of_folder)
        };
        // Returns although the disk does not answer.
        let (recorder, mut handles) = Recorder::start_in(hanging, &options, &header, false).unwrap();
        for sequence in 0..100 {
            let body = clearway_mapping::event::Body::End;
            handles[0].record_event(&Event { sequence, arrival_ns: 1 + sequence as i64, source: 0, body });
        }
        let counts = recorder.counts();
        while counts.problem().is_none() {
            std::thread::yield_now();
        }
        assert!(counts.problem().unwrap().contains("the disk has not answered for"), "{:?}", counts.problem());
        answers.send(()).unwrap();
        drop(handles);
        recorder.finish().unwrap();
        assert_eq!((counts.durable_events("car"), counts.lost(), counts.problem()), (100, 0, None));
        assert!(options.file.exists());
    }

    #[test]
    fn a_disk_that_fails_after_the_start_is_named_in_the_status() {
        let options = Options { file: "late.mcap".into(), ..Options::default() };
        let (answers, is_answered) = channel();
        let hanging = move || -> io::Result<Folder> {
            is_answered.recv().unwrap();
            Err(io::Error::other("pulled out"))
        };
        let (recorder, handles) = Recorder::start_in(hanging, &options, &RecordingHeader::default(), false).unwrap();
        answers.send(()).unwrap();
        drop(handles);
        let error = recorder.finish().unwrap_err().to_string();
        assert!(error.contains("late.mcap") && error.contains("pulled out"), "{error}");
    }

    #[test]
    fn a_file_that_exists_is_refused_and_kept() {
        let temporary = tempfile::tempdir().unwrap();
        let file = temporary.path().join("car.mcap");
        std::fs::write(&file, "precious").unwrap();
        let options = Options { file: file.clone(), ..Options::default() };
        let error = Recorder::start(&options, &RecordingHeader::default(), false).map(|_| ()).unwrap_err().to_string();
        assert!(error.contains("the file exists and is not overwritten"), "{error}");
        assert_eq!(std::fs::read(&file).unwrap(), b"precious");
    }
}
