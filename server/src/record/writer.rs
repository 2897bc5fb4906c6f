//! Every event and every map -> one MCAP file, on its own thread with its own queue.
//!
//! Chunks are closed by time, so that a crash loses at most `flush_ms`. A disk that fails ends the recording with a
//! reason; maps are still computed and served.

use std::fs::File;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, TrySendError, sync_channel};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use clearway_mapping::event::Event;
use clearway_proto::v1;
use mcap::McapError;

use super::mcap_file::{Disk, Header, McapFile};
use crate::config::Recorder as Options;
use crate::encode::EncodedMap;
use crate::file_advice::advised;
use crate::sync::locked;

/// A recording cannot begin.
#[derive(Debug, thiserror::Error)]
pub enum RecordError {
    /// The file or the recorder's thread cannot be created.
    #[error("recording {}: {source}", file.display())]
    Create {
        /// The recording.
        file: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
    /// The header cannot be written.
    #[error("recording {}: {source}", file.display())]
    Write {
        /// The recording.
        file: PathBuf,
        /// The reason.
        source: McapError,
    },
}

/// A recording ended before the last event or map.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("the recording is incomplete: {reason}")]
pub struct IncompleteRecordingError {
    /// The failure that ended the recording.
    pub reason: String,
}

/// The counts of one recording.
#[derive(Debug, Default)]
pub struct RecorderCounts {
    file: String,
    events: AtomicU64,
    maps: AtomicU64,
    lost: AtomicU64,
    stop_reason: Mutex<Option<String>>,
}

impl RecorderCounts {
    /// The failure that ended the recording; `None` while it goes on.
    pub fn stop_reason(&self) -> Option<String> {
        locked(&self.stop_reason).clone()
    }

    /// Number of events and maps that the recording lacks, because its queue was full or its disk failed.
    pub fn lost(&self) -> u64 {
        self.lost.load(Ordering::Relaxed)
    }

    /// The counts as the wire carries them.
    pub fn to_proto(&self) -> v1::RecorderStatus {
        v1::RecorderStatus {
            file: self.file.clone(),
            events: self.events.load(Ordering::Relaxed),
            maps: self.maps.load(Ordering::Relaxed),
            lost: self.lost(),
        }
    }

    fn record_loss(&self) {
        if self.lost.fetch_add(1, Ordering::Relaxed) == 0 {
            tracing::error!(file = %self.file, "the recording begins to lose events or maps");
        }
    }
}

/// One element of the recorder's queue: the vehicle's index, and its event or map.
enum Item {
    Event(usize, Event),
    Map(usize, Arc<EncodedMap>),
}

/// One vehicle's handle of the recording: sends its events and maps to the recorder's queue.
#[derive(Clone)]
pub struct RecordingHandle {
    vehicle: usize,
    queue: SyncSender<Item>,
    counts: Arc<RecorderCounts>,
    waits: bool,
}

impl RecordingHandle {
    /// Records an event.
    pub fn record_event(&self, event: &Event) {
        self.push(Item::Event(self.vehicle, event.clone()));
    }

    /// Records a map.
    pub fn record_map(&self, map: Arc<EncodedMap>) {
        self.push(Item::Map(self.vehicle, map));
    }

    fn push(&self, item: Item) {
        let is_queued = if self.waits {
            self.queue.send(item).is_ok()
        } else {
            match self.queue.try_send(item) {
                Ok(()) => true,
                Err(TrySendError::Full(_) | TrySendError::Disconnected(_)) => false,
            }
        };
        if !is_queued {
            self.counts.record_loss();
        }
    }
}

/// The running recorder.
#[derive(Debug)]
pub struct Recorder {
    counts: Arc<RecorderCounts>,
    thread: JoinHandle<()>,
}

impl Recorder {
    /// Creates the file, writes the header and starts the thread. Returns a handle for each vehicle, in the order of
    /// the header. With `waits` a full queue delays its sender and loses nothing: right for files, wrong for live data.
    ///
    /// # Errors
    /// [`RecordError::Create`] if the file or the thread cannot be created, [`RecordError::Write`] if the header cannot
    /// be written.
    pub fn start(options: &Options, header: &Header, waits: bool) -> Result<(Self, Vec<RecordingHandle>), RecordError> {
        let path = options.file.clone();
        let create = |source| RecordError::Create { file: path.clone(), source: advised(&path, source) };
        if let Some(folder) = path.parent().filter(|folder| !folder.as_os_str().is_empty()) {
            std::fs::create_dir_all(folder).map_err(create)?;
        }
        let file = File::create(&path).map_err(create)?;
        let (writer, handles) = RecordingWriter::new(file, options, header, waits)?;
        let counts = writer.counts();
        let thread = std::thread::Builder::new().name("recorder".into()).spawn(move || writer.run()).map_err(create)?;
        Ok((Self { counts, thread }, handles))
    }

    /// The counts of the recording.
    pub fn counts(&self) -> Arc<RecorderCounts> {
        self.counts.clone()
    }

    /// Waits until all handles are dropped and everything is in the file.
    ///
    /// # Errors
    /// [`IncompleteRecordingError`] if the disk failed or the recorder's thread panicked.
    pub fn finish(self) -> Result<(), IncompleteRecordingError> {
        let panicked = self.thread.join().is_err().then(|| "the recorder's thread panicked".to_owned());
        let reason = panicked.or_else(|| self.counts.stop_reason());
        reason.map_or(Ok(()), |reason| Err(IncompleteRecordingError { reason }))
    }
}

/// Writes a recording, without a thread or clock of its own: its owner passes the time. After a failure of the disk it
/// still empties its queue, and counts the elements as lost.
pub struct RecordingWriter<D: Disk> {
    /// `None` after a failure.
    file: Option<McapFile<D>>,
    items: Receiver<Item>,
    flush_period: Duration,
    flush_at: Option<Instant>,
    counts: Arc<RecorderCounts>,
}

impl<D: Disk> RecordingWriter<D> {
    /// Writes the header to `disk`. Returns a handle for each vehicle, as [`Recorder::start`] does.
    ///
    /// # Errors
    /// [`RecordError::Write`] if the header cannot be written.
    pub fn new(
        disk: D,
        options: &Options,
        header: &Header,
        waits: bool,
    ) -> Result<(Self, Vec<RecordingHandle>), RecordError> {
        let failed = |source| RecordError::Write { file: options.file.clone(), source };
        let file = Some(McapFile::create(disk, header).map_err(failed)?);
        let (queue, items) = sync_channel(options.queue);
        let counts = Arc::new(RecorderCounts { file: options.file.display().to_string(), ..RecorderCounts::default() });
        let handle = |vehicle| RecordingHandle { vehicle, queue: queue.clone(), counts: counts.clone(), waits };
        let handles = (0..header.vehicles.len()).map(handle).collect();
        let flush_period = Duration::from_millis(options.flush_ms);
        Ok((Self { file, items, flush_period, flush_at: None, counts }, handles))
    }

    /// The counts of the recording.
    pub fn counts(&self) -> Arc<RecorderCounts> {
        self.counts.clone()
    }

    /// Writes events and maps until all handles are dropped.
    fn run(mut self) {
        loop {
            let item = match self.flush_at {
                None => self.items.recv().map_err(|_| RecvTimeoutError::Disconnected),
                Some(at) => self.items.recv_timeout(at.saturating_duration_since(Instant::now())),
            };
            match item {
                Ok(item) => self.write(&item, Instant::now()),
                Err(RecvTimeoutError::Timeout) => self.flush_if_due(Instant::now()),
                Err(RecvTimeoutError::Disconnected) => break,
            }
        }
        self.finish();
    }

    /// Writes the first queued event or map, if there is one, at the time `now`. Returns true if there was one.
    pub fn write_next(&mut self, now: Instant) -> bool {
        let item = self.items.try_recv();
        match &item {
            Ok(item) => self.write(item, now),
            Err(_) => self.flush_if_due(now),
        }
        item.is_ok()
    }

    /// Ends the recording.
    pub fn finish(mut self) {
        if let Some(Err(error)) = self.file.take().map(McapFile::finish) {
            self.stop(&error);
        }
    }

    fn write(&mut self, item: &Item, now: Instant) {
        let Some(file) = &mut self.file else { return self.counts.record_loss() };
        let (written, count) = match item {
            Item::Event(vehicle, event) => (file.write_event(*vehicle, event), &self.counts.events),
            Item::Map(vehicle, map) => (file.write_map(*vehicle, map), &self.counts.maps),
        };
        if let Err(error) = written {
            return self.stop(&error);
        }
        count.fetch_add(1, Ordering::Relaxed);
        self.flush_at.get_or_insert(now + self.flush_period);
        // Checked after each element, so that a queue that is never empty does not postpone the flush.
        self.flush_if_due(now);
    }

    fn flush_if_due(&mut self, now: Instant) {
        if self.flush_at.is_none_or(|at| at > now) {
            return;
        }
        self.flush_at = None;
        if let Some(Err(error)) = self.file.as_mut().map(McapFile::flush) {
            self.stop(&error);
        }
    }

    fn stop(&mut self, error: &McapError) {
        // The library's error says that writing failed; its source has the reason.
        let reason = std::error::Error::source(error).map_or(error.to_string(), |source| format!("{error}: {source}"));
        tracing::error!(file = %self.counts.file, %reason, "the recording stops here; maps are still served");
        *locked(&self.counts.stop_reason) = Some(reason);
        (self.file, self.flush_at) = (None, None);
    }
}

/// The path of the recording; `None` if the configuration names no file.
pub fn recording_path(options: &Options) -> Option<&Path> {
    (!options.file.as_os_str().is_empty()).then_some(options.file.as_path())
}

/// `file`, or if it exists, the first of `name-1.mcap`, `name-2.mcap`, ... that does not exist, so that a server that
/// starts again does not overwrite an earlier recording.
pub fn next_free_name(file: &Path) -> PathBuf {
    let stem = file.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    let extension = file.extension().map_or("mcap".into(), |extension| extension.to_string_lossy().into_owned());
    let numbered = (1_u64..).map(|number| file.with_file_name(format!("{stem}-{number}.{extension}")));
    std::iter::once(file.to_owned()).chain(numbered).find(|file| !file.exists()).unwrap_or_else(|| file.to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_new_run_never_overwrites_an_earlier_recording() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("car.mcap");
        for expected in ["car.mcap", "car-1.mcap", "car-2.mcap"] {
            let found = next_free_name(&file);
            assert_eq!(found, folder.path().join(expected));
            File::create(found).unwrap();
        }
    }

    #[test]
    fn a_file_that_cannot_be_created_is_named() {
        let options = Options { file: "/proc/no/such.mcap".into(), ..Options::default() };
        let error = Recorder::start(&options, &Header::default(), false).map(|_| ()).unwrap_err().to_string();
        assert!(error.contains("/proc/no"), "{error}");
    }
}
