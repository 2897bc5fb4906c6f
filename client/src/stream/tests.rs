//! What a stream reports of stale, skipped and false maps.

use std::sync::Arc;
use std::sync::atomic::{AtomicI64, Ordering};

use clearway_proto::map::encode_header;
use clearway_proto::v1;
use futures::FutureExt;
use tokio::sync::oneshot;

use super::*;
use crate::view::Staleness;

const MS: i64 = 1_000_000;
const START_NS: i64 = 1_700_000_000_000_000_000;
const VALID_MS: i64 = 300;

/// A stream, its slot, and the clocks of the planner's machine.
struct TestBed {
    wall_ns: Arc<AtomicI64>,
    steady_ns: Arc<AtomicI64>,
    slot: LatestSlot,
    end: Option<oneshot::Sender<ClientError>>,
    stream: MapStream,
}

impl TestBed {
    fn new() -> Self {
        let (wall_ns, steady_ns) = (Arc::new(AtomicI64::new(START_NS)), Arc::new(AtomicI64::new(0)));
        let read = |clock: &Arc<AtomicI64>| -> Arc<dyn Fn() -> i64 + Send + Sync> {
            let clock = clock.clone();
            Arc::new(move || clock.load(Ordering::SeqCst))
        };
        let clock = Clock { wall_ns: read(&wall_ns), steady_ns: read(&steady_ns), is_of_replay: false };
        let (end, ended) = oneshot::channel();
        let mut slot = None;
        let stream = MapStream::spawn_with_clock(clock, |given| {
            slot = Some(given);
            async move { ended.await.expect("the test ends the stream") }
        });
        Self { wall_ns, steady_ns, slot: slot.expect("given at once"), end: Some(end), stream }
    }

    fn pass(&self, ns: i64) {
        self.steady_ns.fetch_add(ns, Ordering::SeqCst);
        self.step(ns);
    }

    fn step(&self, ns: i64) {
        self.wall_ns.fetch_add(ns, Ordering::SeqCst);
    }

    /// Stores a map that was captured `age_ns` ago by the wall clock.
    fn store_aged(&self, boot_id: u64, sequence: u64, age_ns: i64) {
        self.store(boot_id, sequence, self.wall_ns.load(Ordering::SeqCst) - age_ns);
    }

    fn store(&self, boot_id: u64, sequence: u64, capture_end_ns: i64) {
        let header = v1::Header {
            vehicle: "alpha".into(),
            boot_id,
            sequence,
            capture_start_ns: capture_end_ns,
            capture_end_ns,
            completed_ns: capture_end_ns,
            valid_until_ns: capture_end_ns + VALID_MS * MS,
            ..Default::default()
        };
        self.slot.store(MapView::decode(encode_header(&header)).expect("a map"), |_| Missed::default());
    }

    /// Waits for the next event: (stale, sequence, age in ns).
    async fn next(&mut self) -> (bool, u64, i64) {
        let (stale, update) = match self.stream.next_or_stale().await.expect("no end") {
            StreamEvent::Fresh(update) => (false, update),
            StreamEvent::Stale(update) => (true, update),
        };
        let now_ns = self.wall_ns.load(Ordering::SeqCst);
        assert_eq!(stale, update.map.is_stale(now_ns), "the event and the map agree");
        (stale, update.map.sequence(), update.map.age_ns(now_ns))
    }

    /// True if the stream has no event at this moment.
    fn is_silent(&mut self) -> bool {
        self.stream.next_or_stale().now_or_never().is_none()
    }

    /// Checks that a map of 40 ms age is reported as stale after its last nanosecond, and once, if no map follows.
    async fn check_becomes_stale(&mut self, sequence: u64) {
        self.pass(260 * MS);
        assert!(self.is_silent(), "the map may be used in its last nanosecond");
        self.pass(1);
        assert_eq!(self.next().await, (true, sequence, VALID_MS * MS + 1));
        self.pass(1000 * MS);
        assert!(self.is_silent(), "a stale map is reported once");
    }
}

#[tokio::test]
async fn a_map_is_reported_as_stale_after_the_link_is_cut() {
    let mut bed = TestBed::new();
    assert!(bed.is_silent());
    bed.store_aged(7, 0, 40 * MS);
    assert_eq!(bed.next().await, (false, 0, 40 * MS));
    bed.check_becomes_stale(0).await;
    bed.store_aged(7, 20, 40 * MS);
    assert_eq!(bed.next().await, (false, 20, 40 * MS), "the link is restored");
}

#[tokio::test]
async fn the_last_map_of_a_stopped_server_becomes_stale() {
    let mut bed = TestBed::new();
    bed.store_aged(7, 0, 40 * MS);
    assert_eq!(bed.next().await, (false, 0, 40 * MS));
    let reason = ClientError::Ended { address: "alpha:1".into() };
    bed.end.take().expect("once").send(reason).expect("the stream lives");
    assert!(matches!(bed.stream.next_or_stale().await, Err(ClientError::Ended { .. })));
    bed.pass(261 * MS);
    let newest = bed.stream.newest().expect("a map was stored");
    assert!(newest.is_stale(bed.wall_ns.load(Ordering::SeqCst)));
}

#[tokio::test]
async fn a_growing_delay_is_reported_at_the_first_map_that_is_too_old() {
    let mut bed = TestBed::new();
    for sequence in 0..320 {
        bed.pass(100 * MS);
        bed.store_aged(7, sequence, sequence as i64 * MS);
        let event = bed.next().await;
        assert_eq!(event, (sequence as i64 > VALID_MS, sequence, sequence as i64 * MS));
        assert!(bed.is_silent());
    }
}

#[tokio::test]
async fn a_replayed_map_is_neither_newest_nor_fresh() {
    let mut bed = TestBed::new();
    bed.store_aged(7, 5, 40 * MS);
    assert_eq!(bed.next().await, (false, 5, 40 * MS));
    let first_ns = START_NS - 40 * MS;
    bed.pass(200 * MS);
    bed.store(7, 5, first_ns);
    bed.store(7, 4, first_ns - 100 * MS);
    assert!(bed.is_silent(), "it is not newer than the newest");
    // A replayed map with a new sequence number keeps its age.
    bed.pass(1000 * MS);
    assert_eq!(bed.next().await, (true, 5, 1240 * MS));
    bed.store(7, 6, first_ns);
    assert_eq!(bed.next().await, (true, 6, 1240 * MS));
}

#[tokio::test]
async fn the_first_map_of_a_restarted_server_is_the_newest() {
    let mut bed = TestBed::new();
    bed.store_aged(7, 900, 40 * MS);
    assert_eq!(bed.next().await, (false, 900, 40 * MS));
    bed.check_becomes_stale(900).await;
    bed.store_aged(8, 0, 40 * MS);
    assert_eq!(bed.next().await, (false, 0, 40 * MS));
    bed.check_becomes_stale(0).await;
}

#[tokio::test]
async fn a_step_of_the_wall_clock_makes_no_stale_map_fresh() {
    for step_ns in [-3600 * 1000 * MS, -200 * MS, -50 * MS] {
        let mut bed = TestBed::new();
        bed.store_aged(7, 0, 40 * MS);
        assert_eq!(bed.next().await, (false, 0, 40 * MS));
        bed.step(step_ns);
        if step_ns < -VALID_MS * MS {
            assert!(bed.next().await.0, "the age is not known by a clock this far behind");
        } else {
            bed.check_becomes_stale(0).await;
        }
        let stale = bed.stream.newest().expect("a map was stored");
        bed.pass(400 * MS);
        for further_ns in [0, step_ns, 10 * step_ns] {
            let now_ns = bed.wall_ns.load(Ordering::SeqCst) + further_ns;
            assert!(stale.is_stale(now_ns) && stale.age_ns(now_ns) >= 440 * MS, "stepped by {step_ns} ns");
        }
    }
    // A clock that was set forward may be right, so a map that seems too old is stale.
    let mut bed = TestBed::new();
    bed.store_aged(7, 0, 40 * MS);
    assert_eq!(bed.next().await, (false, 0, 40 * MS));
    bed.step(1000 * MS);
    assert_eq!(bed.next().await, (true, 0, 1040 * MS));
}

#[tokio::test]
async fn a_stale_map_says_whether_the_clocks_differ_or_no_newer_map_came() {
    let bed = TestBed::new();
    for (sequence, (age_ms, expected)) in (0..).zip([
        (40, None),
        (-40, None),
        (2000, Some(Staleness::OnArrival { age_ns: 2000 * MS })),
        (-2000, Some(Staleness::InTheFuture { ahead_ns: 2000 * MS })),
        (20, None),
    ]) {
        bed.pass(100 * MS);
        bed.store_aged(7, sequence, age_ms * MS);
        let newest = bed.stream.newest().expect("a map was stored");
        assert_eq!(newest.staleness(bed.wall_ns.load(Ordering::SeqCst)), expected, "aged {age_ms} ms");
    }
    bed.pass(300 * MS);
    let newest = bed.stream.newest().expect("a map was stored");
    assert_eq!(newest.staleness(bed.wall_ns.load(Ordering::SeqCst)), Some(Staleness::NoNewer));
}

#[tokio::test]
async fn the_words_for_a_stale_map_are_those_of_the_golden_file() {
    let cases: Vec<serde_json::Value> = serde_json::from_str(include_str!("../../golden/staleness.json")).unwrap();
    assert_eq!(cases.len(), 5);
    for case in cases {
        let ms = |name: &str| case[name].as_i64().expect(name) * MS;
        let bed = TestBed::new();
        bed.store_aged(7, 0, ms("age_on_arrival_ms"));
        bed.pass(ms("since_arrival_ms"));
        let newest = bed.stream.newest().expect("a map was stored");
        let why = newest.staleness(bed.wall_ns.load(Ordering::SeqCst)).map(|why| why.to_string());
        assert_eq!(serde_json::json!(why), case["stale_because"], "{case}");
    }
}

#[test]
fn a_stream_polls_its_clocks_often_enough_for_the_promised_50_ms() {
    assert!(POLL_INTERVAL * 2 <= Duration::from_millis(50));
}
