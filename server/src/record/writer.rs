//! Every event and every map -> one MCAP file, on its own thread behind its own queue.
//!
//! Layout: metadata `clearway` (boot id, version, vehicles, where each calibration came from), attachments
//! `config.toml` (effective) and `calibration/<vehicle>/<sensor>.yaml` (the configured tables), then the channels
//! `/<vehicle>/journal` (`clearway.v1.Event`) and `/<vehicle>/map/<layer>` (`clearway.v1.Map`, the very bytes that
//! zenoh carries). Log time is the arrival. Chunks are closed by time, so that a crash costs no more than `flush_ms`.
//! A disk that fails ends the recording with a stated reason; maps go on being made and served.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, TrySendError, sync_channel};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use bytes::Bytes;
use clearway_mapping::event::Event;
use clearway_proto::{DESCRIPTORS, v1};
use mcap::records::{MessageHeader, Metadata};
use mcap::write::NoSeek;
use mcap::{Attachment, Compression, McapError, WriteOptions};
use prost::Message;

use crate::config::Recorder as Options;
use crate::ingest::locked;
use crate::encode::{self, EncodedMap};

/// What a recording says before its first event.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Preface {
    /// Names the run of the server whose maps these are.
    pub boot_id: u64,
    /// The effective configuration, TOML.
    pub config: String,
    /// The vehicles, in the order of the configuration, with the layers of their maps.
    pub vehicles: Vec<(Arc<str>, Vec<&'static str>)>,
    /// The configured calibration tables: vehicle, sensor, ROS YAML.
    pub calibrations: Vec<(String, String, String)>,
    /// Anything else worth knowing, by name.
    pub notes: BTreeMap<String, String>,
}

/// Why nothing is recorded.
#[derive(Debug, thiserror::Error)]
pub enum RecordError {
    /// The file cannot be created.
    #[error("recording {}: {source}", file.display())]
    Create {
        /// The recording.
        file: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// The preface cannot be written.
    #[error("recording {}: {source}", file.display())]
    Write {
        /// The recording.
        file: PathBuf,
        /// Why.
        source: McapError,
    },
}

/// What the recording holds so far.
#[derive(Debug, Default)]
pub struct RecorderCounts {
    file: String,
    events: AtomicU64,
    maps: AtomicU64,
    lost: AtomicU64,
    stopped: Mutex<Option<String>>,
}

impl RecorderCounts {
    /// Why the recording ended before its time; `None` while all is well.
    pub fn stopped(&self) -> Option<String> {
        locked(&self.stopped).clone()
    }

    /// Events and maps the recording does not hold: its queue was full, or its disk failed.
    pub fn lost(&self) -> u64 {
        self.lost.load(Ordering::Relaxed)
    }

    /// As the wire carries it.
    pub fn to_proto(&self) -> v1::RecorderStatus {
        v1::RecorderStatus {
            file: self.file.clone(),
            events: self.events.load(Ordering::Relaxed),
            maps: self.maps.load(Ordering::Relaxed),
            lost: self.lost(),
        }
    }

    fn lose(&self) {
        if self.lost.fetch_add(1, Ordering::Relaxed) == 0 {
            tracing::error!(file = %self.file, "the recording has begun to lose events or maps");
        }
    }
}

enum Entry {
    Event(usize, Event),
    Map(usize, Arc<EncodedMap>),
}

/// One vehicle's way into the recording.
#[derive(Clone)]
pub struct Journal {
    vehicle: usize,
    queue: SyncSender<Entry>,
    counts: Arc<RecorderCounts>,
    wait: bool,
}

impl Journal {
    /// Records an event.
    pub fn event(&self, event: &Event) {
        self.enter(Entry::Event(self.vehicle, event.clone()));
    }

    /// Records a map.
    pub fn map(&self, map: Arc<EncodedMap>) {
        self.enter(Entry::Map(self.vehicle, map));
    }

    fn enter(&self, entry: Entry) {
        let taken = if self.wait {
            self.queue.send(entry).is_ok()
        } else {
            match self.queue.try_send(entry) {
                Ok(()) => true,
                Err(TrySendError::Full(_) | TrySendError::Disconnected(_)) => false,
            }
        };
        if !taken {
            self.counts.lose();
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
    /// Creates the file, writes the preface, and gives each vehicle its way in, in the order of the preface. With
    /// `wait` a full queue holds its writer up instead of losing anything: for files, never for live data.
    ///
    /// # Errors
    /// [`RecordError`] when the file cannot be created or written.
    pub fn start(options: &Options, preface: &Preface, wait: bool) -> Result<(Self, Vec<Journal>), RecordError> {
        let path = options.file.clone();
        if let Some(folder) = path.parent().filter(|folder| !folder.as_os_str().is_empty()) {
            std::fs::create_dir_all(folder).map_err(|source| RecordError::Create { file: path.clone(), source })?;
        }
        let file = File::create(&path).map_err(|source| RecordError::Create { file: path.clone(), source })?;
        let (scribe, journals) = Scribe::new(file, options, preface, wait)?;
        let counts = scribe.counts();
        let thread = std::thread::Builder::new()
            .name("recorder".into())
            .spawn(move || scribe.run())
            .map_err(|source| RecordError::Create { file: path, source })?;
        Ok((Self { counts, thread }, journals))
    }

    /// What the recording holds so far.
    pub fn counts(&self) -> Arc<RecorderCounts> {
        self.counts.clone()
    }

    /// Waits until all journals are dropped and everything is in the file; gives the reason where it is not.
    ///
    /// # Errors
    /// Why the recording is not whole.
    pub fn finish(self) -> Result<(), String> {
        if self.thread.join().is_err() {
            return Err("the recorder's thread panicked".into());
        }
        self.counts.stopped().map_or(Ok(()), Err)
    }
}

/// Where a recording's bytes go.
pub trait Disk: Write + Send {
    /// Makes sure that what was written outlives a crash of the machine.
    ///
    /// # Errors
    /// What the disk says.
    fn keep(&mut self) -> io::Result<()>;
}

impl Disk for File {
    fn keep(&mut self) -> io::Result<()> {
        self.sync_all()
    }
}

/// A disk that has failed once is not written again: the library closes what it drops, and a disk that has recovered
/// would then hold a file that ends in order and lacks the rest.
struct OnceFailed<D: Disk> {
    disk: D,
    failed: Option<io::ErrorKind>,
}

impl<D: Disk> OnceFailed<D> {
    fn unless_failed<T>(&mut self, act: impl FnOnce(&mut D) -> io::Result<T>) -> io::Result<T> {
        match self.failed {
            Some(kind) => Err(kind.into()),
            // An interrupted call is made again, and has failed nothing.
            None => act(&mut self.disk).inspect_err(|error| {
                self.failed = Some(error.kind()).filter(|kind| *kind != io::ErrorKind::Interrupted);
            }),
        }
    }
}

impl<D: Disk> Write for OnceFailed<D> {
    fn write(&mut self, data: &[u8]) -> io::Result<usize> {
        self.unless_failed(|disk| disk.write(data))
    }

    fn flush(&mut self) -> io::Result<()> {
        self.unless_failed(Write::flush)
    }
}

/// What writes a recording, without thread and clock: whoever has it says when. A failing disk ends the writing, not
/// the listening.
pub struct Scribe<D: Disk> {
    tape: Option<Tape<D>>,
    entries: Receiver<Entry>,
    flush: Duration,
    flush_at: Option<Instant>,
    counts: Arc<RecorderCounts>,
}

impl<D: Disk> Scribe<D> {
    /// Writes the preface to `disk`, and gives each vehicle its way in, as [`Recorder::start`] does.
    ///
    /// # Errors
    /// [`RecordError::Write`] when the preface cannot be written.
    pub fn new(disk: D, options: &Options, preface: &Preface, wait: bool) -> Result<(Self, Vec<Journal>), RecordError> {
        let wrong = |source| RecordError::Write { file: options.file.clone(), source };
        let tape = Some(Tape::new(disk, preface).map_err(wrong)?);
        let (queue, entries) = sync_channel(options.queue);
        let counts = Arc::new(RecorderCounts { file: options.file.display().to_string(), ..RecorderCounts::default() });
        let journal = |vehicle| Journal { vehicle, queue: queue.clone(), counts: counts.clone(), wait };
        let journals = (0..preface.vehicles.len()).map(journal).collect();
        Ok((Self { tape, entries, flush: Duration::from_millis(options.flush_ms), flush_at: None, counts }, journals))
    }

    /// What the recording holds so far.
    pub fn counts(&self) -> Arc<RecorderCounts> {
        self.counts.clone()
    }

    /// Writes what comes until nobody is left to send.
    fn run(mut self) {
        loop {
            let entry = match self.flush_at {
                None => self.entries.recv().map_err(|_| RecvTimeoutError::Disconnected),
                Some(at) => self.entries.recv_timeout(at.saturating_duration_since(Instant::now())),
            };
            match entry {
                Ok(entry) => self.write(&entry, Instant::now()),
                Err(RecvTimeoutError::Timeout) => self.flush_if_due(Instant::now()),
                Err(RecvTimeoutError::Disconnected) => break,
            }
        }
        self.finish();
    }

    /// Writes one of the events and maps that wait, if any, as at `now`; gives whether there was one.
    pub fn take(&mut self, now: Instant) -> bool {
        let entry = self.entries.try_recv();
        match &entry {
            Ok(entry) => self.write(entry, now),
            Err(_) => self.flush_if_due(now),
        }
        entry.is_ok()
    }

    /// Ends the recording, once all journals are dropped.
    pub fn finish(mut self) {
        if let Some(Err(error)) = self.tape.take().map(Tape::finish) {
            self.stop(&error);
        }
    }

    fn write(&mut self, entry: &Entry, now: Instant) {
        let Some(tape) = &mut self.tape else { return self.counts.lose() };
        if let Err(error) = tape.write(entry, &self.counts) {
            return self.stop(&error);
        }
        self.flush_at.get_or_insert(now + self.flush);
        // Looked at after each: a queue that never runs dry must not put the flush off.
        self.flush_if_due(now);
    }

    fn flush_if_due(&mut self, now: Instant) {
        if self.flush_at.is_none_or(|at| at > now) {
            return;
        }
        self.flush_at = None;
        if let Some(Err(error)) = self.tape.as_mut().map(Tape::flush) {
            self.stop(&error);
        }
    }

    fn stop(&mut self, error: &McapError) {
        // The library says that writing failed, and only its source says why.
        let reason = std::error::Error::source(error).map_or(error.to_string(), |source| format!("{error}: {source}"));
        tracing::error!(file = %self.counts.file, %reason, "the recording stops here; maps are still served");
        *locked(&self.counts.stopped) = Some(reason);
        (self.tape, self.flush_at) = (None, None);
    }
}

/// The open file.
struct Tape<D: Disk> {
    writer: mcap::Writer<NoSeek<BufWriter<OnceFailed<D>>>>,
    vehicles: Vec<VehicleChannels>,
}

struct VehicleChannels {
    journal: u16,
    maps: BTreeMap<&'static str, u16>,
}

impl<D: Disk> Tape<D> {
    fn new(disk: D, preface: &Preface) -> Result<Self, McapError> {
        let mut writer = WriteOptions::new()
            .profile("")
            .library(concat!("clearway/", env!("CARGO_PKG_VERSION")))
            .compression(Some(Compression::Zstd))
            // In the recorder's own thread: by default each writer starts a thread a core.
            .compression_threads(0)
            // A chunk goes to the file whole, its length first: else a crash would leave one with a length of 0, which
            // no reader can tell from damage.
            .disable_seeking(true)
            .create(NoSeek::new(BufWriter::new(OnceFailed { disk, failed: None })))?;
        let names: Vec<&str> = preface.vehicles.iter().map(|(name, _)| &**name).collect();
        let mut metadata = preface.notes.clone();
        metadata.insert("boot_id".into(), preface.boot_id.to_string());
        metadata.insert("version".into(), env!("CARGO_PKG_VERSION").into());
        metadata.insert("vehicles".into(), names.join(","));
        writer.write_metadata(&Metadata { name: "clearway".into(), metadata })?;
        let mut attach = |name: String, media_type: &str, text: &str| {
            let data = text.as_bytes().into();
            writer.attach(&Attachment { log_time: 0, create_time: 0, name, media_type: media_type.into(), data })
        };
        attach("config.toml".into(), "application/toml", &preface.config)?;
        for (vehicle, sensor, yaml) in &preface.calibrations {
            attach(format!("calibration/{vehicle}/{sensor}.yaml"), "application/yaml", yaml)?;
        }
        let event = writer.add_schema("clearway.v1.Event", "protobuf", DESCRIPTORS)?;
        let map = writer.add_schema("clearway.v1.Map", "protobuf", DESCRIPTORS)?;
        let mut vehicles = Vec::new();
        for (vehicle, layers) in &preface.vehicles {
            let mut channel = |schema, topic: String| writer.add_channel(schema, &topic, "protobuf", &BTreeMap::new());
            let journal = channel(event, format!("/{vehicle}/journal"))?;
            let maps = layers
                .iter()
                .map(|&layer| Ok((layer, channel(map, format!("/{vehicle}/map/{layer}"))?)))
                .collect::<Result<_, McapError>>()?;
            vehicles.push(VehicleChannels { journal, maps });
        }
        writer.flush()?;
        Ok(Self { writer, vehicles })
    }

    fn write(&mut self, entry: &Entry, counts: &RecorderCounts) -> Result<(), McapError> {
        match entry {
            Entry::Event(vehicle, event) => {
                let bytes = encode::event_to_proto(event).encode_to_vec();
                self.message(self.vehicles[*vehicle].journal, event.sequence, event.arrival_ns, &bytes)?;
                counts.events.fetch_add(1, Ordering::Relaxed);
            }
            Entry::Map(vehicle, map) => {
                for (layer, chunk) in &map.layers {
                    let Some(&channel) = self.vehicles[*vehicle].maps.get(layer) else { continue };
                    let bytes: Bytes = map.layer(chunk);
                    self.message(channel, map.sequence, map.completed_ns, &bytes)?;
                }
                counts.maps.fetch_add(1, Ordering::Relaxed);
            }
        }
        Ok(())
    }

    fn message(&mut self, channel_id: u16, sequence: u64, arrival_ns: i64, data: &[u8]) -> Result<(), McapError> {
        // MCAP counts in 32 bits and from 1970 on; the message itself has the whole figures.
        let sequence = sequence as u32;
        let log_time = u64::try_from(arrival_ns).unwrap_or(0);
        let header = MessageHeader { channel_id, sequence, log_time, publish_time: log_time };
        self.writer.write_to_known_channel(&header, data)
    }

    fn flush(&mut self) -> Result<(), McapError> {
        self.writer.flush()
    }

    fn finish(mut self) -> Result<(), McapError> {
        self.writer.finish()?;
        // `finish` leaves the last bytes to the file's own buffer.
        let buffer = self.writer.into_inner().into_inner();
        let mut whole = buffer.into_inner().map_err(|error| McapError::Io(error.into_error()))?;
        whole.disk.keep().map_err(McapError::Io)
    }
}

/// The recording's path, or nothing where nothing is to be recorded.
pub fn wanted(options: &Options) -> Option<&Path> {
    (!options.file.as_os_str().is_empty()).then_some(options.file.as_path())
}

/// `file`, or where that exists, the first of `name-1.mcap`, `name-2.mcap`, … that does not: a server that starts again
/// must not write over what it recorded before.
pub fn unused(file: &Path) -> PathBuf {
    let stem = file.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    let extension = file.extension().map_or("mcap".into(), |extension| extension.to_string_lossy().into_owned());
    let numbered = (1_u64..).map(|number| file.with_file_name(format!("{stem}-{number}.{extension}")));
    std::iter::once(file.to_owned()).chain(numbered).find(|file| !file.exists()).unwrap_or_else(|| file.to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_new_run_never_writes_over_an_earlier_recording() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("car.mcap");
        for expected in ["car.mcap", "car-1.mcap", "car-2.mcap"] {
            let found = unused(&file);
            assert_eq!(found, folder.path().join(expected));
            File::create(found).unwrap();
        }
    }

    #[test]
    fn a_file_that_cannot_be_created_is_named() {
        let options = Options { file: "/proc/no/such.mcap".into(), ..Options::default() };
        let error = Recorder::start(&options, &Preface::default(), false).map(|_| ()).unwrap_err().to_string();
        assert!(error.contains("/proc/no"), "{error}");
    }
}
