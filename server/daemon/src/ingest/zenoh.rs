//! Observations over zenoh: `clearway/<vehicle>/ingest/{scan,packet,end,sensor}/<sensor>` and `.../{pose,road}`;
//! reports go to `clearway/<vehicle>/ingest/report`.
//!
//! A source is the zenoh session that a sample names (zenoh's `source_info`). zenoh's callback only puts a sample into
//! the queue of its source, within bounds; samples that name no session share one queue. The samples of a queue are
//! decoded in their order, and do not wait for those of another queue ([`Source`]). A sample that exceeds a bound is
//! counted as `queue`, and its client learns of it because its numbers then have a gap. Reports are dropped under
//! congestion, so that a stopped peer does not delay the others; the newest acknowledgement is therefore repeated for a
//! while.
//!
//! With roles ([`Senders`]) a sample needs a certificate with the role of an ingester, as over gRPC. zenoh's access
//! control refuses the others first; this check also holds if it is configured otherwise. Without roles a sender may
//! name any session, also that of another sender.

use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use futures::StreamExt;
use futures::stream::FuturesUnordered;
use tokio::sync::mpsc::{Sender, UnboundedReceiver, UnboundedSender, channel, unbounded_channel};
use zenoh::Session;
use zenoh::bytes::{Encoding, ZBytes};
use zenoh::pubsub::Subscriber;
use zenoh::qos::CongestionControl;
use zenoh::sample::{Locality, SampleKind};
use zenoh::session::ZenohId;

use super::gateway::Gateway;
use super::zenoh_source::{Common, QueuedBytes, QueuedSample, SILENT_MAX, Source};
use crate::base::sync::locked;
use crate::zenoh_session::{Senders, ZenohError};

/// Greatest number of queued samples of one source.
const SAMPLES_MAX: usize = 256;
/// Greatest number of sources of one vehicle. A new source replaces the one that was silent longest, of those without
/// queued samples. Ours: the sensors of a vehicle seldom have more than one session each.
const SOURCES_MAX: usize = 16;
/// Part of the longest message's bytes that the queue of each source may have, however many bytes those of the others
/// have. Ours: a scan of 125,000 points with all fields, a revolution of an HDL-64E, also beside fifteen sources.
const OWN_PART: usize = 4;
/// A source that has sent within this time is not replaced, if an observation of it was ever accepted. Ours: ten
/// revolutions.
const RECENT: Duration = Duration::from_secs(1);
/// Period at which sources that were silent too long are ended.
const END_PERIOD: Duration = Duration::from_secs(1);

/// The subscription to the observations of one vehicle, and the publisher of its reports.
pub struct Ingest {
    common: Common,
    queues: Arc<Mutex<Queues>>,
    opened: UnboundedReceiver<Source>,
    // The last field, so that it is dropped last.
    _subscriber: Subscriber<()>,
}

impl Ingest {
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

        let (queues, opened) = Queues::new(gateway.clone());
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
                if !locked(&queues).push(source, key, sample.payload(), Instant::now()) {
                    gateway.record_refusal("queue");
                }
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
    /// Bytes of the queued samples of all sources.
    bytes: Arc<AtomicUsize>,
    /// Number of queues.
    count: Arc<AtomicUsize>,
    gateway: Arc<Gateway>,
}

/// The queue of one source; the source ends when this is dropped.
struct Queue {
    source: Option<ZenohId>,
    samples: Sender<QueuedSample>,
    /// Bytes of its queued samples.
    bytes: Arc<AtomicUsize>,
    /// When its newest sample came.
    heard: Instant,
    /// True if an observation of it was accepted.
    is_accepted: Arc<AtomicBool>,
}

impl Queues {
    fn new(gateway: Arc<Gateway>) -> (Self, UnboundedReceiver<Source>) {
        let (opened, receiver) = unbounded_channel();
        (Self { all: Vec::new(), opened, bytes: Arc::default(), count: Arc::default(), gateway }, receiver)
    }

    /// Queues a sample. False if it exceeds a bound: the samples of all sources together have at most the bytes of the
    /// vehicle's longest message, and beyond them each source a quarter of as many. Of a sample that is too long only
    /// the length is queued.
    fn push(&mut self, source: Option<ZenohId>, key: &str, payload: &ZBytes, now: Instant) -> bool {
        let bytes_max = self.gateway.limits.message_bytes_max;
        let of_vehicle = self.bytes.clone();
        let Some(queue) = self.get_or_open(source, now) else { return false };
        queue.heard = now;
        let length = payload.len();
        let payload = if length > bytes_max { ZBytes::new() } else { payload.clone() };
        let queued = QueuedBytes::new(payload.len(), [queue.bytes.clone(), of_vehicle.clone()]);
        let samples = queue.samples.clone();
        let [own, all] = [&queue.bytes, &of_vehicle].map(|count| count.load(Ordering::Relaxed));
        let fits = all <= bytes_max || own <= bytes_max / OWN_PART;
        fits && samples.try_send(QueuedSample { key: key.to_owned(), payload, length, queued }).is_ok()
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
                !holds && queue.bytes.load(Ordering::Relaxed) == 0
            };
            let ending = self.all.iter().enumerate().filter(may_end);
            let (longest, _) = ending.min_by_key(|(_, queue)| queue.heard)?;
            self.all.remove(longest);
        }
        let (samples, receiver) = channel(SAMPLES_MAX);
        let is_accepted = Arc::<AtomicBool>::default();
        let sender = self.gateway.time.sender();
        let opened = Source::new(source, receiver, self.count.clone(), is_accepted.clone(), sender);
        // An error means that the server stops.
        self.opened.send(opened).ok()?;
        self.count.store(self.all.len() + 1, Ordering::Relaxed);
        Some(self.all.push_mut(Queue { source, samples, bytes: Arc::default(), heard: now, is_accepted }))
    }

    /// Ends the sources that were silent for [`SILENT_MAX`].
    fn end_silent(&mut self, now: Instant) {
        self.all.retain(|queue| now.saturating_duration_since(queue.heard) <= SILENT_MAX);
        self.count.store(self.all.len(), Ordering::Relaxed);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Config;
    use crate::ingest::queue::event_queue;

    fn queues(points_max: usize) -> (Queues, UnboundedReceiver<Source>) {
        let mut vehicle = Config::of_one_vehicle("car", "top").vehicles.remove(0);
        vehicle.ingest.points_max = points_max;
        Queues::new(Arc::new(Gateway::new(&vehicle, &event_queue(16).0, Arc::default())))
    }

    fn session(number: u8) -> Option<ZenohId> {
        Some(ZenohId::try_from(&[number][..]).expect("one byte is an id"))
    }

    #[test]
    fn a_source_that_fills_its_queue_leaves_the_others_theirs() {
        // The longest message of 1,000 points has 97,536 bytes.
        let (mut queues, _opened) = queues(1000);
        let now = Instant::now();
        let large = ZBytes::from(vec![0; 40_000]);
        let flood: Vec<_> = (0..4).map(|_| queues.push(session(1), "scan/top", &large, now)).collect();
        assert_eq!(flood, [true, true, false, false]);
        assert!(queues.push(session(2), "scan/top", &ZBytes::from(vec![0; 24_000]), now));
        let small = ZBytes::from(vec![0; 10]);
        let samples = (0..300).filter(|_| queues.push(session(3), "pose", &small, now)).count();
        assert_eq!(samples, SAMPLES_MAX);
        assert!(queues.push(None, "pose", &small, now), "those without a session have one queue");
    }

    #[test]
    fn many_sources_together_are_bounded_and_each_has_a_part() {
        let (mut queues, mut opened) = queues(1000);
        let now = Instant::now();
        let small = ZBytes::from(vec![0; 1000]);
        assert!(queues.push(session(1), "scan/top", &ZBytes::from(vec![0; 97_000]), now));
        assert!(!queues.push(session(1), "pose", &small, now), "a longest message has 97,536 bytes");
        for source in 2..=SOURCES_MAX {
            let queued = (0..100).filter(|_| queues.push(session(source as u8), "pose", &small, now)).count();
            assert_eq!(queued, 24, "a quarter of it for source {source}");
        }
        let too_long = ZBytes::from(vec![0; 1 << 20]);
        let mut sources: Vec<_> = std::iter::from_fn(|| opened.try_recv().ok()).collect();
        drop(sources.split_off(1));
        assert!(queues.push(session(17), "scan/top", &too_long, now), "its client learns what is allowed");
        assert_eq!(queues.bytes.load(Ordering::Relaxed), 97_000, "a source that ends gives its bytes back");
        drop(sources);
    }

    #[test]
    fn a_new_source_replaces_the_longest_silent_one_and_none_that_sends_or_waits() {
        let (mut queues, mut opened) = queues(1000);
        let start = Instant::now();
        let at = |tenths: u32| start + tenths * RECENT / 10;
        let pose = ZBytes::from(vec![0; 10]);
        for source in 1..=SOURCES_MAX as u8 {
            assert!(queues.push(session(source), "pose", &pose, at(source.into())));
            queues.all.last().unwrap().is_accepted.store(true, Ordering::Relaxed);
        }
        assert!(!queues.push(session(99), "pose", &pose, at(11)), "source 1 has sent a second ago");
        assert!(!queues.push(session(99), "pose", &pose, at(12)), "source 1 has a queued sample");
        drop(opened.try_recv().unwrap());
        assert!(queues.push(session(99), "pose", &pose, at(12)));
        assert!(queues.all.iter().all(|queue| queue.source != session(1)) && queues.all.len() == SOURCES_MAX);
        let mut sources: Vec<_> = std::iter::from_fn(|| opened.try_recv().ok()).collect();
        assert_eq!(sources.len(), SOURCES_MAX);
        assert!(!queues.push(session(98), "pose", &pose, at(12)), "source 99 has a queued sample");
        drop(sources.pop());
        assert!(queues.push(session(98), "pose", &pose, at(12)), "nothing of source 99 was accepted");
        assert!(queues.all.iter().all(|queue| queue.source != session(99)));
        queues.all.last_mut().unwrap().heard = at(0);
        queues.end_silent(at(16) + SILENT_MAX);
        assert_eq!(queues.all.len(), 1, "all but source 16 were silent for more than ten minutes");
    }
}
