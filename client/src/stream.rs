//! Maps from a background task -> the newest map.
//!
//! In: maps at the rate of the server. Out: the newest one at the rate of the reader, with the number of maps in
//! missed. There is no queue, so a slow reader never gets an old map. A waiting reader is notified when its map becomes
//! stale, also if no further map arrives.

use std::time::Duration;

use tokio::sync::watch;
use tokio::task::JoinHandle;

use crate::error::ClientError;
use crate::freshness::{Clock, POLL_INTERVAL};
use crate::view::MapView;

/// One map from a stream.
#[derive(Clone, Debug)]
pub struct Update {
    /// The newest map.
    pub map: MapView,
    /// Number of maps made since the update before that this reader did not get, because it or its link was slow.
    pub skipped: u64,
    /// Number of the skipped maps that the link lost (zenoh drops maps on a congested or cut link). It is 0 over gRPC,
    /// where the server skips maps instead.
    pub lost: u64,
    /// Number of maps made since the update before that [`crate::Subscription::max_rate_hz`] excluded.
    pub left_out: u64,
}

/// What a stream reports: a fresh map, or that the newest map is stale.
#[derive(Clone, Debug)]
pub enum StreamEvent {
    /// A new map that may be used.
    Fresh(Update),
    /// A map that must not be used: the last map has become stale and there is no newer one, or a new map was stale on
    /// arrival.
    Stale(Update),
}

/// The newest map of one vehicle. A background task updates it until the stream is dropped.
#[derive(Debug)]
pub struct MapStream {
    slot: watch::Receiver<Slot>,
    /// `Slot::counters` at the update before; `None` before the first.
    seen: Option<Counters>,
    /// The last map returned, until it is reported as stale.
    fresh: Option<MapView>,
    /// `Slot::replay_ends` at the last call.
    replay_ends: u64,
    task: JoinHandle<()>,
}

#[derive(Debug, Default)]
struct Slot {
    newest: Option<MapView>,
    counters: Counters,
    passed_over: PassedOver,
    ended: Option<ClientError>,
    /// How often a replay has reached its end, and how the reader is told.
    replay_ends: u64,
    replay_ended: Option<ClientError>,
}

/// Numbers of received maps that a stream passed over since its start, by reason. None of them was shown to the reader.
///
/// A peer of a zenoh network without access control can put anything on the key of a map.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct PassedOver {
    /// Messages that are no valid map.
    pub undecodable: u64,
    /// Maps of another vehicle or layer than their key names, and messages on a key with wildcards.
    pub misplaced: u64,
    /// Maps without a signature of the expected publisher ([`crate::signature`]).
    pub unsigned: u64,
    /// Maps of another run of the server while the present run sends fresh ones.
    pub other_run: u64,
    /// Maps that are not newer than the newest (repeated ones).
    pub not_newer: u64,
}

impl PassedOver {
    /// Number of all messages that were passed over and that no honest publisher sends: without
    /// [`PassedOver::not_newer`], because zenoh itself repeats the newest map.
    pub fn hostile(&self) -> u64 {
        self.undecodable + self.misplaced + self.unsigned + self.other_run
    }
}

/// Time after which a silent run of the server holds its place no longer against maps of another run. Ours: several
/// maps, and no longer than a planner is without maps after a restart.
const RUN_HOLD_NS: i64 = 1_000_000_000;
/// A map that is stamped farther ahead of this machine's clock is no reason to refuse maps with earlier stamps.
const AHEAD_NS_MAX: i64 = 1_000_000_000;
/// Most maps that a server makes in a millisecond, and between two equal stamps: a sequence that jumps farther says
/// nothing about skipped maps.
const SKIPPED_MAX: (u64, u64) = (1, 1000);

/// Numbers of maps since the start of the stream.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct Counters {
    /// Maps stored and maps skipped.
    maps: u64,
    /// Skipped maps that the link lost.
    lost: u64,
    /// Maps that the requested rate excluded.
    left_out: u64,
}

/// Numbers of maps between one stored map and the one before.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Missed {
    /// Maps that this reader did not get.
    pub skipped: u64,
    /// Skipped maps that the link lost.
    pub lost: u64,
    /// Maps that the requested rate excluded.
    pub left_out: u64,
}

impl MapStream {
    /// Runs a task in the background that stores the maps of one server in the slot. Its result is the reason why it
    /// ended.
    pub(crate) fn spawn<F: Future<Output = ClientError> + Send + 'static>(task: impl FnOnce(LatestSlot) -> F) -> Self {
        let slot = LatestSlot { has_one_server: true, ..LatestSlot::new(Clock::default()) };
        let task = task(slot.clone());
        Self::of_slot(&slot, task)
    }

    #[cfg(test)]
    fn spawn_with_clock<F: Future<Output = ClientError> + Send + 'static>(
        clock: Clock,
        task: impl FnOnce(LatestSlot) -> F,
    ) -> Self {
        let slot = LatestSlot::new(clock);
        let task = task(slot.clone());
        Self::of_slot(&slot, task)
    }

    /// The stream of a slot that was made before. The result of the task is the reason why the stream ended.
    pub(crate) fn of_slot(slot: &LatestSlot, task: impl Future<Output = ClientError> + Send + 'static) -> Self {
        let (receiver, sender) = (slot.slot.subscribe(), slot.slot.clone());
        let task = tokio::spawn(async move {
            let reason = task.await;
            sender.send_modify(|slot| slot.ended = Some(reason));
        });
        Self { slot: receiver, seen: None, fresh: None, replay_ends: 0, task }
    }

    /// Waits for a map newer than the last one returned.
    ///
    /// # Errors
    /// Why the stream has ended, after its last map was returned; subscribe again then. [`ClientError::Ended`] if the
    /// server ended it, [`ClientError::Unreachable`] if the connection failed, [`ClientError::Refused`] if the server
    /// refused a request, [`ClientError::Map`] if a map is invalid. [`ClientError::ReplayEnded`] once after the last
    /// map of a replay; the stream has not ended then.
    pub async fn next(&mut self) -> Result<Update, ClientError> {
        loop {
            {
                let slot = self.slot.borrow_and_update();
                let counters = slot.counters;
                if let Some(map) = slot.newest.as_ref().filter(|_| self.seen != Some(counters)) {
                    // The first update has skipped nothing: the reader was not subscribed before.
                    let before = self.seen.unwrap_or(Counters { maps: counters.maps - 1, ..counters });
                    (self.seen, self.fresh) = (Some(counters), Some(map.clone()));
                    let skipped = counters.maps - before.maps - 1;
                    let (lost, left_out) = (counters.lost - before.lost, counters.left_out - before.left_out);
                    return Ok(Update { map: map.clone(), skipped, lost, left_out });
                }
                if let Some(ended) = slot.replay_ended.clone().filter(|_| slot.replay_ends > self.replay_ends) {
                    self.replay_ends = slot.replay_ends;
                    return Err(ended);
                }
                if let Some(reason) = &slot.ended {
                    return Err(reason.clone());
                }
            }
            if self.slot.changed().await.is_err() {
                return Err(ClientError::Ended { address: "the background task".into() });
            }
        }
    }

    /// Waits for a map newer than the last one returned, or until that one is stale. A stale map is reported once, at
    /// most 20 ms late, by this machine's clocks, also if no further map arrives.
    ///
    /// # Errors
    /// As [`MapStream::next`].
    pub async fn next_or_stale(&mut self) -> Result<StreamEvent, ClientError> {
        let last = self.fresh.clone();
        tokio::select! {
            biased;
            update = self.next() => {
                let update = update?;
                if update.map.fresh_for_ns().is_some() {
                    return Ok(StreamEvent::Fresh(update));
                }
                self.fresh = None;
                Ok(StreamEvent::Stale(update))
            }
            map = wait_stale(last) => {
                self.fresh = None;
                Ok(StreamEvent::Stale(Update { map, skipped: 0, lost: 0, left_out: 0 }))
            }
        }
    }

    /// The newest map at this moment; `None` before the first. It does not wait and does not change the counts of the
    /// next update. The map may be stale ([`MapView::is_stale`]).
    pub fn newest(&self) -> Option<MapView> {
        self.slot.borrow().newest.clone()
    }

    /// Numbers of received maps that were passed over since the start of the stream, by reason.
    pub fn passed_over(&self) -> PassedOver {
        self.slot.borrow().passed_over
    }

    /// Why the stream has ended; `None` if it has not.
    pub fn ended(&self) -> Option<ClientError> {
        self.slot.borrow().ended.clone()
    }
}

impl Drop for MapStream {
    fn drop(&mut self) {
        self.task.abort();
    }
}

/// Waits until the map is stale, and returns it.
async fn wait_stale(map: Option<MapView>) -> MapView {
    let Some(map) = map else { return std::future::pending().await };
    while let Some(left_ns) = map.fresh_for_ns() {
        // A map is stale after its last nanosecond.
        let left = Duration::from_nanos(left_ns.unsigned_abs().saturating_add(1));
        tokio::time::sleep(left.min(POLL_INTERVAL)).await;
    }
    map
}

/// The slot of a [`MapStream`], in which the background task stores the newest map.
#[derive(Clone, Debug)]
pub(crate) struct LatestSlot {
    slot: watch::Sender<Slot>,
    clock: Clock,
    /// True if all maps come from one server that is known: another run is then a jump of its replay.
    has_one_server: bool,
}

impl LatestSlot {
    pub(crate) fn new(clock: Clock) -> Self {
        Self { slot: watch::channel(Slot::default()).0, clock, has_one_server: false }
    }

    /// Records that the replay has ended, for the reader of the stream.
    pub(crate) fn end_replay(&self, ended: ClientError) {
        self.slot.send_modify(|slot| {
            slot.replay_ends += 1;
            slot.replay_ended = Some(ended);
        });
    }

    /// Stores a map as the newest, with the numbers of maps between it and the one before, or counts it as passed over
    /// ([`refuse`]). `missed` gets the number of maps that the sequence skips, and is called only if the map is stored.
    pub(crate) fn store(&self, map: MapView, missed: impl FnOnce(u64) -> Missed) {
        let map = map.with_arrival(&self.clock);
        self.slot.send_if_modified(|slot| {
            let is_jump = |newest: &MapView| self.has_one_server && newest.header().boot_id != map.header().boot_id;
            let newest = slot.newest.as_ref().filter(|newest| !is_jump(newest));
            if let Some(reason) = newest.and_then(|newest| refuse(newest, &map)) {
                *reason(&mut slot.passed_over) += 1;
                return false;
            }
            let missed = missed(slot.newest.as_ref().map_or(0, |newest| skipped(newest, &map)));
            let counters = &mut slot.counters;
            counters.maps = counters.maps.saturating_add(missed.skipped).saturating_add(1);
            counters.lost = counters.lost.saturating_add(missed.lost);
            counters.left_out = counters.left_out.saturating_add(missed.left_out);
            slot.newest = Some(map);
            true
        });
    }

    /// Counts a message that is not stored.
    #[cfg_attr(not(feature = "zenoh"), allow(dead_code, reason = "over gRPC the server itself is known"))]
    pub(crate) fn pass_over(&self, reason: Reason) {
        self.slot.send_if_modified(|slot| {
            *reason(&mut slot.passed_over) += 1;
            false
        });
    }
}

/// The counter of one reason to pass over a map.
pub(crate) type Reason = fn(&mut PassedOver) -> &mut u64;

/// Why `map` does not replace `newest`; `None` if it does.
///
/// Within one run of the server a map is newer by its sequence, or, if that goes back, by its stamp: one forged
/// sequence does not refuse the true maps after it. Another run has to wait until the present one is stale or silent
/// for [`RUN_HOLD_NS`]: a forged run is not shown beside a true one.
fn refuse(newest: &MapView, map: &MapView) -> Option<Reason> {
    let ahead_ns = |map: &MapView| map.header().capture_end_ns.saturating_sub(map.now_ns());
    let is_ahead = ahead_ns(newest) > AHEAD_NS_MAX;
    if newest.header().boot_id != map.header().boot_id {
        let holds = newest.fresh_for_ns().is_some() && !is_ahead && newest.since_arrival_ns() < RUN_HOLD_NS;
        return holds.then_some(|passed| &mut passed.other_run);
    }
    let is_next = map.sequence() > newest.sequence();
    let is_later = map.header().capture_end_ns > newest.header().capture_end_ns;
    let resynchronises = map.fresh_for_ns().is_some() && (is_later || is_ahead || newest.fresh_for_ns().is_none());
    (!is_next && !resynchronises).then_some(|passed| &mut passed.not_newer)
}

/// Number of maps between two of one run, by their sequences; 0 if the sequence goes back, or jumps farther than the
/// stamps explain.
fn skipped(newest: &MapView, map: &MapView) -> u64 {
    let between_ns = map.header().capture_end_ns.saturating_sub(newest.header().capture_end_ns).max(0);
    let skipped_max = SKIPPED_MAX.1 + SKIPPED_MAX.0 * between_ns.unsigned_abs() / 1_000_000;
    let skipped = match newest.header().boot_id == map.header().boot_id {
        true => map.sequence().saturating_sub(newest.sequence()).saturating_sub(1),
        // Another run of the server: its sequence starts at 0.
        false => 0,
    };
    if skipped > skipped_max { 0 } else { skipped }
}

/// Situations in which a map is older than it seems, with clocks that the tests set.
#[cfg(test)]
mod tests {
    use std::sync::Arc;
    use std::sync::atomic::{AtomicI64, Ordering};

    use clearway_proto::map::encode_header;
    use clearway_proto::v1;
    use futures::FutureExt;
    use tokio::sync::oneshot;

    use super::*;

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
            let clock = Clock { wall_ns: read(&wall_ns), steady_ns: read(&steady_ns) };
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

    #[test]
    fn a_stream_polls_its_clocks_often_enough_for_the_promised_50_ms() {
        assert!(POLL_INTERVAL * 2 <= Duration::from_millis(50));
    }
}
