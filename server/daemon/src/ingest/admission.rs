//! Admission of observations: who may have how much of a vehicle's event queue, and whose turn it is.
//!
//! A source is a stream over gRPC or a session over zenoh. Each has a bounded queue of its own: the flow control of its
//! stream, which makes the sender wait, or a [`SourceQueue`], where the newest scan replaces an older one. One
//! observation of a source waits for a permit of [`Admission`] at a time, and permits are given in the order of the
//! requests, so sources that always send are admitted in turn. No more than [`QUEUED_MAX`] admitted observations are on
//! the event queue, so that a packet that comes over UDP is not late behind them. A scan that is too large is refused
//! by its number of points (`vehicle.ingest.points_max`).

use std::collections::{BTreeMap, VecDeque};
use std::net::IpAddr;
use std::sync::{Arc, Mutex};

use tokio::sync::{Notify, OwnedSemaphorePermit, Semaphore};

use crate::base::sync::locked;

/// Number of admitted observations that wait for the engine or that it works on. Ours: the engine always has one while
/// another is decoded.
const QUEUED_MAX: usize = 2;
/// Greatest number of samples on the queue of one source.
const SAMPLES_MAX: usize = 256;
/// Part of the longest message's bytes that each source may queue, however many bytes the others have. Ours: a scan of
/// 125,000 points with all fields, a revolution of an HDL-64E, also beside fifteen sources.
const OWN_PART: usize = 4;

/// Permit for one observation to be on the event queue, released on drop; `None` for an observation that needs none.
pub type AdmissionPermit = Option<OwnedSemaphorePermit>;

/// The permits of one vehicle's event queue for observations.
#[derive(Debug)]
pub struct Admission(Arc<Semaphore>);

impl Default for Admission {
    fn default() -> Self {
        Self(Arc::new(Semaphore::new(QUEUED_MAX)))
    }
}

impl Admission {
    /// Waits until the event queue has a permit for an observation. A light one (a pose, an end of data) is little work
    /// for the engine and needs none.
    pub async fn admit(&self, is_light: bool) -> AdmissionPermit {
        // Fails only for a closed semaphore, and none is closed.
        if is_light { None } else { self.0.clone().acquire_owned().await.ok() }
    }
}

/// The bytes that the queues of all sources of one vehicle may hold.
#[derive(Debug)]
pub struct QueueBytes {
    /// A permit a byte, for all sources together.
    shared: Arc<Semaphore>,
    /// Bytes that each source may have beyond them.
    own: usize,
}

impl QueueBytes {
    /// As many bytes as one longest message for all sources together, and a quarter of as many for each.
    pub fn new(message_bytes_max: usize) -> Self {
        Self { shared: Arc::new(Semaphore::new(message_bytes_max)), own: message_bytes_max / OWN_PART }
    }
}

/// The bounded queue of one source that cannot be made to wait.
#[derive(Debug)]
pub struct SourceQueue<S> {
    shared_bytes: Arc<Semaphore>,
    own_bytes: Arc<Semaphore>,
    state: Mutex<QueueState<S>>,
    changed: Notify,
}

#[derive(Debug)]
struct QueueState<S> {
    waiting: VecDeque<QueuedSample<S>>,
    is_closed: bool,
}

#[derive(Debug)]
struct QueuedSample<S> {
    /// What the sample is about, as `scan/top`.
    key: String,
    sample: S,
    _bytes: OwnedSemaphorePermit,
}

impl<S> SourceQueue<S> {
    /// An empty queue that shares the bytes of `bytes` with the other sources.
    pub fn new(bytes: &QueueBytes) -> Self {
        Self {
            shared_bytes: bytes.shared.clone(),
            own_bytes: Arc::new(Semaphore::new(bytes.own)),
            state: Mutex::new(QueueState { waiting: VecDeque::new(), is_closed: false }),
            changed: Notify::new(),
        }
    }

    /// Puts a sample of so many bytes behind the others. If there is no space, a scan takes the place of the oldest
    /// scans with its key. Returns the number of samples that are lost, the new one included.
    pub fn push(&self, key: &str, sample: S, bytes: usize) -> u64 {
        let mut state = locked(&self.state);
        let mut lost = 0;
        let bytes = loop {
            if let Some(bytes) = self.space(&state, bytes) {
                break bytes;
            }
            lost += 1;
            let older = state.waiting.iter().position(|older| key.starts_with("scan/") && older.key == key);
            let Some(older) = older else { return lost };
            state.waiting.remove(older);
        };
        state.waiting.push_back(QueuedSample { key: key.to_owned(), sample, _bytes: bytes });
        self.changed.notify_one();
        lost
    }

    /// Permits for so many bytes of one more sample, if there is space for it.
    fn space(&self, state: &QueueState<S>, bytes: usize) -> Option<OwnedSemaphorePermit> {
        let bytes = u32::try_from(bytes).ok().filter(|_| state.waiting.len() < SAMPLES_MAX)?;
        let of = |semaphore: &Arc<Semaphore>| semaphore.clone().try_acquire_many_owned(bytes).ok();
        of(&self.shared_bytes).or_else(|| of(&self.own_bytes))
    }

    /// True if no sample waits.
    pub fn is_empty(&self) -> bool {
        locked(&self.state).waiting.is_empty()
    }

    /// Closes the queue: [`SourceQueue::next`] returns the samples that wait, and then `None`.
    pub fn close(&self) {
        locked(&self.state).is_closed = true;
        self.changed.notify_one();
    }

    /// Waits for the oldest sample and for its admission; the sample may be replaced meanwhile. Returns the key, the
    /// sample and the permit; `None` if the queue is closed and empty. For one caller at a time.
    pub async fn next(&self, admission: &Admission) -> Option<(String, S, AdmissionPermit)> {
        let is_light = |key: &str| key == "pose" || key.starts_with("end/");
        let mut permit = None;
        loop {
            let is_empty = {
                let mut state = locked(&self.state);
                let is_admitted = |oldest: &mut QueuedSample<S>| permit.is_some() || is_light(&oldest.key);
                if let Some(QueuedSample { key, sample, .. }) = state.waiting.pop_front_if(is_admitted) {
                    return Some((key, sample, permit));
                }
                if state.waiting.is_empty() && state.is_closed {
                    return None;
                }
                state.waiting.is_empty()
            };
            if is_empty { self.changed.notified().await } else { permit = admission.admit(false).await }
        }
    }
}

/// The open streams of a vehicle or of a server by host, limited in number for each host and for all.
#[derive(Debug)]
pub struct StreamLimits {
    /// Greatest number of open streams of all hosts.
    pub streams_max: usize,
    /// Number of streams that one host may have; the others are kept for other hosts.
    host_max: usize,
    /// By host: one reference a stream, and one here.
    hosts: Mutex<BTreeMap<IpAddr, Arc<()>>>,
}

/// One open stream; it counts until this is dropped.
#[derive(Debug)]
pub struct OpenStream(#[expect(dead_code, reason = "its references are counted")] Arc<()>);

/// A stream exceeds a limit.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum StreamLimitError {
    /// The limit of all hosts together.
    #[error("all {streams_max} streams are open")]
    All {
        /// Greatest number of streams.
        streams_max: usize,
    },
    /// The limit of one host.
    #[error("{host} has {streams} of {streams_max} streams open, and the others are kept for other senders")]
    Host {
        /// Address of the host.
        host: IpAddr,
        /// Number of open streams of the host.
        streams: usize,
        /// Greatest number of streams of all hosts.
        streams_max: usize,
    },
}

impl StreamLimits {
    /// At most `streams_max` streams; one host has at most all but `kept` of them, and may always have one.
    pub fn new(streams_max: usize, kept: usize) -> Self {
        Self { streams_max, host_max: streams_max.saturating_sub(kept).max(1), hosts: Mutex::default() }
    }

    /// Opens a stream of this host.
    ///
    /// # Errors
    /// [`StreamLimitError`] if the stream exceeds a limit.
    pub fn open(&self, host: IpAddr) -> Result<OpenStream, StreamLimitError> {
        let (streams_max, mut hosts) = (self.streams_max, locked(&self.hosts));
        let open = |streams: &Arc<()>| Arc::strong_count(streams) - 1;
        hosts.retain(|_, streams| open(streams) > 0);
        if hosts.values().map(open).sum::<usize>() >= streams_max {
            return Err(StreamLimitError::All { streams_max });
        }
        let of_host = hosts.entry(host).or_default();
        let streams = open(of_host);
        if streams >= self.host_max {
            return Err(StreamLimitError::Host { host, streams, streams_max });
        }
        Ok(OpenStream(of_host.clone()))
    }
}

#[cfg(test)]
mod tests;
