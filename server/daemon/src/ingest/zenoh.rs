//! Observations over zenoh: `clearway/<vehicle>/ingest/{scan,packet,end,sensor}/<sensor>` and `.../{pose,road}`;
//! reports go to `clearway/<vehicle>/ingest/report`.
//!
//! A source is the zenoh session that a sample names (zenoh's `source_info`). zenoh's callback only puts a sample into
//! the queue of its source ([`SourceQueue`]); samples that name no session share one queue. A sample that exceeds a
//! bound, or waits when a newer scan needs its space, is counted as `queue`, and its client learns of it because its
//! numbers then have a gap. Reports are dropped under congestion, so that a stopped peer does not delay the others; the
//! newest acknowledgement is therefore repeated for a while.
//!
//! With roles ([`Senders`]) a sample needs a certificate with the role of an ingester, as over gRPC. zenoh's access
//! control refuses the others first; this check also holds if it is configured otherwise. Without roles a sender may
//! name any session, also another sender's session.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use futures::StreamExt;
use futures::stream::FuturesUnordered;
use tokio::sync::mpsc::{UnboundedReceiver, UnboundedSender, unbounded_channel};
use zenoh::Session;
use zenoh::bytes::{Encoding, ZBytes};
use zenoh::pubsub::Subscriber;
use zenoh::qos::CongestionControl;
use zenoh::sample::{Locality, SampleKind};
use zenoh::session::ZenohId;

use super::admission::{QueueBytes, SourceQueue};
use super::gateway::Gateway;
use super::zenoh_source::{Common, SILENT_MAX, SOURCES_MAX, Sample, Source};
use crate::base::sync::locked;
use crate::zenoh_session::{Senders, ZenohError};

/// A source that has sent within this time is not replaced, if an observation of it was ever accepted. Ours: ten
/// revolutions.
const RECENT: Duration = Duration::from_secs(1);
/// Period at which sources that were silent too long are ended.
const END_PERIOD: Duration = Duration::from_secs(1);

/// The subscription to the observations of one vehicle, and the publisher of its reports.
pub struct ZenohIngest {
    common: Common,
    queues: Arc<Mutex<Queues>>,
    opened: UnboundedReceiver<Source>,
    // The last field, so that it is dropped last.
    _subscriber: Subscriber<()>,
}

impl ZenohIngest {
    /// Subscribes to the keys of a vehicle. Without `senders` every peer may send.
    ///
    /// # Errors
    /// [`ZenohError`] if the publisher or the subscriber cannot be declared.
    pub async fn subscribe(
        session: &Session,
        gateway: Arc<Gateway>,
        senders: Option<Senders>,
    ) -> Result<Self, ZenohError> {
        let prefix = format!("clearway/{}/ingest/", gateway.vehicle);
        let key = format!("{prefix}report");
        let reports = session.declare_publisher(key.clone()).congestion_control(CongestionControl::Drop);
        let reports = reports.encoding(Encoding::APPLICATION_PROTOBUF.with_schema("clearway.v1.IngestReport"));
        let reports = reports.await.map_err(ZenohError::of(format!("publisher {key}")))?;

        let (queues, opened) = Queues::new(gateway.limits.message_bytes_max);
        let queues = Arc::new(Mutex::new(queues));
        let keys = format!("{prefix}**");
        let subscriber = session.declare_subscriber(keys.clone()).allowed_origin(Locality::Remote).callback({
            let (gateway, queues) = (gateway.clone(), queues.clone());
            move |sample| {
                let key = sample.key_expr().as_str().strip_prefix(&prefix).unwrap_or_default();
                if key == "report" || sample.kind() != SampleKind::Put {
                    return;
                }
                let source = sample.source_info().map(|source| source.source_id().zid());
                let lost = locked(&queues).push(source, key, sample.payload(), Instant::now());
                (0..lost).for_each(|_| gateway.record_refusal("queue"));
            }
        });
        let subscriber = subscriber.await.map_err(ZenohError::of(format!("subscribe to {keys}")))?;
        let common = Common { gateway, reports, senders: senders.map(tokio::sync::Mutex::new) };
        Ok(Self { common, queues, opened, _subscriber: subscriber })
    }

    /// Decodes samples and sends reports until the future is dropped.
    pub async fn run(self) {
        let Self { common, queues, mut opened, _subscriber } = self;
        let mut sources = FuturesUnordered::new();
        let mut end = tokio::time::interval(END_PERIOD);
        loop {
            tokio::select! {
                Some(source) = opened.recv() => sources.push(source.run(&common)),
                Some(()) = sources.next() => {}
                _ = end.tick() => locked(&queues).end_silent(Instant::now()),
            }
        }
    }
}

/// The queues of the sources of one vehicle.
struct Queues {
    all: Vec<Queue>,
    /// Where a new source is sent.
    opened: UnboundedSender<Source>,
    bytes: QueueBytes,
    message_bytes_max: usize,
}

/// The queue of one source; the source ends when this is dropped.
struct Queue {
    source: Option<ZenohId>,
    samples: Arc<SourceQueue<Sample>>,
    /// Time at which the queue's newest sample came.
    heard: Instant,
    /// True if an observation of it was accepted.
    is_accepted: Arc<AtomicBool>,
}

impl Drop for Queue {
    fn drop(&mut self) {
        self.samples.close();
    }
}

impl Queues {
    fn new(message_bytes_max: usize) -> (Self, UnboundedReceiver<Source>) {
        let (opened, receiver) = unbounded_channel();
        (Self { all: Vec::new(), opened, bytes: QueueBytes::new(message_bytes_max), message_bytes_max }, receiver)
    }

    /// Queues a sample; of a sample that is too long only the length is queued. Returns the number of samples that are
    /// lost.
    fn push(&mut self, source: Option<ZenohId>, key: &str, payload: &ZBytes, now: Instant) -> u64 {
        let length = payload.len();
        let payload = if length > self.message_bytes_max { ZBytes::new() } else { payload.clone() };
        let Some(queue) = self.get_or_open(source, now) else { return 1 };
        queue.heard = now;
        let bytes = payload.len();
        queue.samples.push(key, Sample { payload, length }, bytes)
    }

    /// The queue of this source; `None` if it is new and no other may end for it.
    fn get_or_open(&mut self, source: Option<ZenohId>, now: Instant) -> Option<&mut Queue> {
        if let Some(at) = self.all.iter().position(|queue| queue.source == source) {
            return self.all.get_mut(at);
        }
        if self.all.len() >= SOURCES_MAX {
            let may_end = |(_, queue): &(usize, &Queue)| {
                let is_recent = now.saturating_duration_since(queue.heard) <= RECENT;
                let holds = is_recent && queue.is_accepted.load(Ordering::Relaxed);
                !holds && queue.samples.is_empty()
            };
            let ending = self.all.iter().enumerate().filter(may_end);
            let (longest, _) = ending.min_by_key(|(_, queue)| queue.heard)?;
            self.all.remove(longest);
        }
        let (samples, is_accepted) = (Arc::new(SourceQueue::new(&self.bytes)), Arc::<AtomicBool>::default());
        // An error means that the server stops.
        self.opened.send(Source::new(source, samples.clone(), is_accepted.clone())).ok()?;
        Some(self.all.push_mut(Queue { source, samples, heard: now, is_accepted }))
    }

    /// Ends the sources that were silent for [`SILENT_MAX`].
    fn end_silent(&mut self, now: Instant) {
        self.all.retain(|queue| now.saturating_duration_since(queue.heard) <= SILENT_MAX);
    }
}

#[cfg(test)]
mod tests {
    use futures::FutureExt;

    use super::*;
    use crate::ingest::admission::Admission;

    fn session(number: u8) -> Option<ZenohId> {
        Some(ZenohId::try_from(&[number][..]).expect("one byte is an id"))
    }

    #[test]
    fn a_new_source_replaces_the_longest_silent_one_and_none_that_sends_or_waits() {
        let (mut queues, _opened) = Queues::new(100_000);
        let start = Instant::now();
        let at = |tenths: u32| start + tenths * RECENT / 10;
        let pose = ZBytes::from(vec![0; 10]);
        let take = |queue: &Queue| queue.samples.next(&Admission::default()).now_or_never().flatten().expect("a pose");
        for source in 1..=SOURCES_MAX as u8 {
            assert_eq!(queues.push(session(source), "pose", &pose, at(source.into())), 0);
            queues.all.last().unwrap().is_accepted.store(true, Ordering::Relaxed);
        }
        assert_eq!(queues.push(session(99), "pose", &pose, at(11)), 1, "source 1 has sent a second ago");
        assert_eq!(queues.push(session(99), "pose", &pose, at(12)), 1, "source 1 has a queued sample");
        take(&queues.all[0]);
        assert_eq!(queues.push(session(99), "pose", &pose, at(12)), 0);
        assert!(queues.all.iter().all(|queue| queue.source != session(1)) && queues.all.len() == SOURCES_MAX);
        assert_eq!(queues.push(session(98), "pose", &pose, at(12)), 1, "source 99 has a queued sample");
        take(queues.all.last().unwrap());
        assert_eq!(queues.push(session(98), "pose", &pose, at(12)), 0, "nothing of source 99 was accepted");
        assert!(queues.all.iter().all(|queue| queue.source != session(99)));
        let too_long = ZBytes::from(vec![0; 1 << 20]);
        assert_eq!(queues.push(None, "scan/top", &too_long, at(12)), 1, "the samples without a session are a source");
        assert_eq!(queues.push(session(16), "scan/top", &too_long, at(12)), 0, "its client learns what is allowed");
        queues.all.last_mut().unwrap().heard = at(0);
        queues.end_silent(at(13) + SILENT_MAX);
        assert!(queues.all.iter().all(|queue| queue.source != session(98)), "silent for more than ten minutes");
        assert!(!queues.all.is_empty());
    }
}
