//! Updates, as fast as they come, to the newest map, as fast as it is asked for.
//!
//! In: maps from a background task. Out: the newest one, with the number of those in between. A reader that is
//! slow, or that only looks now and then, never gets an old map from a queue: there is none. And a reader that waits is
//! told when the map it has becomes stale, also where nothing comes any more.

use std::time::Duration;

use tokio::sync::watch;
use tokio::task::JoinHandle;

use crate::ClientError;
use crate::freshness::{Clock, LOOK};
use crate::view::MapView;

/// One look at the stream.
#[derive(Clone, Debug)]
pub struct Update {
    /// The newest map.
    pub map: MapView,
    /// Maps made since the previous look and not seen by this reader: it, or its link, was slow.
    pub skipped: u64,
    /// Those of the skipped ones that got lost on the link (zenoh drops what a congested or cut link does not take);
    /// over gRPC the server skips instead, and this is 0.
    pub lost: u64,
    /// Maps made since the previous look that [`crate::Subscription::max_rate_hz`] left out.
    pub left_out: u64,
}

/// A look at the stream that knows how old its map is.
#[derive(Clone, Debug)]
pub enum Sight {
    /// A new map, which may be used.
    Fresh(Update),
    /// A map that must not be used: the one given last has become too old and no newer one is there, or a new one came
    /// too late.
    Stale(Update),
}

/// The newest map of one vehicle, kept up to date in the background until this is dropped.
#[derive(Debug)]
pub struct MapStream {
    slot: watch::Receiver<Slot>,
    /// `Slot::made` at the previous look; `None` before the first.
    seen: Option<Made>,
    /// The map given last, until it is told as stale.
    fresh: Option<MapView>,
    task: JoinHandle<()>,
}

#[derive(Debug, Default)]
struct Slot {
    newest: Option<MapView>,
    made: Made,
    ended: Option<ClientError>,
}

/// Maps since the start of the stream.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct Made {
    /// Those given and those skipped.
    maps: u64,
    /// Of the skipped ones, those that the link lost.
    lost: u64,
    /// Those left out at the reader's wish.
    left_out: u64,
}

/// Maps between one map and the one before.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Between {
    /// Not seen by this reader.
    pub skipped: u64,
    /// Those of them that the link lost.
    pub lost: u64,
    /// Not wanted by this reader.
    pub left_out: u64,
}

impl MapStream {
    /// Runs `feed` in the background; it ends with the reason why there are no more maps.
    pub(crate) fn spawn<F: Future<Output = ClientError> + Send + 'static>(feed: impl FnOnce(Feed) -> F) -> Self {
        Self::spawn_by(Clock::default(), feed)
    }

    fn spawn_by<F: Future<Output = ClientError> + Send + 'static>(clock: Clock, feed: impl FnOnce(Feed) -> F) -> Self {
        let (sender, slot) = watch::channel(Slot::default());
        let feed = feed(Feed { slot: sender.clone(), clock });
        let task = tokio::spawn(async move {
            let reason = feed.await;
            sender.send_modify(|slot| slot.ended = Some(reason));
        });
        Self { slot, seen: None, fresh: None, task }
    }

    /// Waits for a map newer than the one given last.
    ///
    /// # Errors
    /// Why the stream is over, once its last map has been given: then subscribe again.
    pub async fn next(&mut self) -> Result<Update, ClientError> {
        loop {
            {
                let slot = self.slot.borrow_and_update();
                let made = slot.made;
                if let Some(map) = slot.newest.as_ref().filter(|_| self.seen != Some(made)) {
                    // The first look has missed nothing: the reader was not there before.
                    let before = self.seen.unwrap_or(Made { maps: made.maps - 1, ..made });
                    (self.seen, self.fresh) = (Some(made), Some(map.clone()));
                    let skipped = made.maps - before.maps - 1;
                    let (lost, left_out) = (made.lost - before.lost, made.left_out - before.left_out);
                    return Ok(Update { map: map.clone(), skipped, lost, left_out });
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

    /// Waits for a map newer than the one given last, or until that one is stale, which is told once, at most 20 ms
    /// late, by this machine's clocks and whether or not anything comes.
    ///
    /// # Errors
    /// As [`MapStream::next`].
    pub async fn next_or_stale(&mut self) -> Result<Sight, ClientError> {
        let given = self.fresh.clone();
        tokio::select! {
            biased;
            update = self.next() => {
                let update = update?;
                if update.map.fresh_for_ns().is_some() {
                    return Ok(Sight::Fresh(update));
                }
                self.fresh = None;
                Ok(Sight::Stale(update))
            }
            map = gone_stale(given) => {
                self.fresh = None;
                Ok(Sight::Stale(Update { map, skipped: 0, lost: 0, left_out: 0 }))
            }
        }
    }

    /// The newest map at this moment, without waiting and without counting as a look; `None` before the first. It may
    /// be stale: ask [`MapView::is_stale`].
    pub fn newest(&self) -> Option<MapView> {
        self.slot.borrow().newest.clone()
    }

    /// Why there will be no more maps; `None` while the stream goes on.
    pub fn ended(&self) -> Option<ClientError> {
        self.slot.borrow().ended.clone()
    }
}

impl Drop for MapStream {
    fn drop(&mut self) {
        self.task.abort();
    }
}

/// The map, as soon as it is stale.
async fn gone_stale(map: Option<MapView>) -> MapView {
    let Some(map) = map else { return std::future::pending().await };
    while let Some(left_ns) = map.fresh_for_ns() {
        // A map is stale after its last nanosecond.
        let left = Duration::from_nanos(left_ns.unsigned_abs().saturating_add(1));
        tokio::time::sleep(left.min(LOOK)).await;
    }
    map
}

/// The background task's end of a [`MapStream`].
pub(crate) struct Feed {
    slot: watch::Sender<Slot>,
    clock: Clock,
}

impl Feed {
    /// Makes a map the newest, with what lies between it and the one before. A map that is no newer than the newest of
    /// the same run of the server (a replayed one) is passed over.
    pub(crate) fn put(&self, map: MapView, between: Between) {
        let map = map.arrived(&self.clock);
        self.slot.send_if_modified(|slot| {
            let of = |map: &MapView| (map.header().boot_id, map.sequence());
            let is_old = slot
                .newest
                .as_ref()
                .map(of)
                .is_some_and(|(boot_id, newest)| boot_id == map.header().boot_id && newest >= map.sequence());
            if !is_old {
                slot.made.maps += 1 + between.skipped;
                slot.made.lost += between.lost;
                slot.made.left_out += between.left_out;
                slot.newest = Some(map);
            }
            !is_old
        });
    }
}

/// The six ways a map can be older than it looks, with clocks that the tests set.
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

    /// A planner's machine and the server it reads from.
    struct House {
        wall_ns: Arc<AtomicI64>,
        steady_ns: Arc<AtomicI64>,
        feed: Feed,
        end: Option<oneshot::Sender<ClientError>>,
        stream: MapStream,
    }

    impl House {
        fn new() -> Self {
            let (wall_ns, steady_ns) = (Arc::new(AtomicI64::new(START_NS)), Arc::new(AtomicI64::new(0)));
            let read = |clock: &Arc<AtomicI64>| -> Arc<dyn Fn() -> i64 + Send + Sync> {
                let clock = clock.clone();
                Arc::new(move || clock.load(Ordering::SeqCst))
            };
            let clock = Clock { wall_ns: read(&wall_ns), steady_ns: read(&steady_ns) };
            let (end, ended) = oneshot::channel();
            let mut feed = None;
            let stream = MapStream::spawn_by(clock, |given| {
                feed = Some(given);
                async move { ended.await.expect("the test tells") }
            });
            Self { wall_ns, steady_ns, feed: feed.expect("given at once"), end: Some(end), stream }
        }

        fn pass(&self, ns: i64) {
            self.steady_ns.fetch_add(ns, Ordering::SeqCst);
            self.step(ns);
        }

        fn step(&self, ns: i64) {
            self.wall_ns.fetch_add(ns, Ordering::SeqCst);
        }

        /// A map comes that was captured so long ago, as the wall clock has it.
        fn comes(&self, boot_id: u64, sequence: u64, age_ns: i64) {
            self.came(boot_id, sequence, self.wall_ns.load(Ordering::SeqCst) - age_ns);
        }

        fn came(&self, boot_id: u64, sequence: u64, capture_end_ns: i64) {
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
            self.feed.put(MapView::decode(encode_header(&header)).expect("a map"), Between::default());
        }

        /// What the stream says, waiting for it: (stale, sequence, age in ns).
        async fn says(&mut self) -> (bool, u64, i64) {
            let (stale, update) = match self.stream.next_or_stale().await.expect("no end") {
                Sight::Fresh(update) => (false, update),
                Sight::Stale(update) => (true, update),
            };
            let now_ns = self.wall_ns.load(Ordering::SeqCst);
            assert_eq!(stale, update.map.is_stale(now_ns), "both ways to ask agree");
            (stale, update.map.sequence(), update.map.age_ns(now_ns))
        }

        /// That it has nothing to say at this moment.
        fn is_silent(&mut self) -> bool {
            self.stream.next_or_stale().now_or_never().is_none()
        }

        /// Nothing comes any more; the map that was captured 40 ms before it came is told as stale after its last
        /// nanosecond, and once.
        async fn goes_stale(&mut self, sequence: u64) {
            self.pass(260 * MS);
            assert!(self.is_silent(), "in its last nanosecond it may be used");
            self.pass(1);
            assert_eq!(self.says().await, (true, sequence, VALID_MS * MS + 1));
            self.pass(1000 * MS);
            assert!(self.is_silent(), "it is told once");
        }
    }

    #[tokio::test]
    async fn a_cut_link_leaves_a_map_that_is_told_as_stale_though_nothing_comes() {
        let mut house = House::new();
        assert!(house.is_silent());
        house.comes(7, 0, 40 * MS);
        assert_eq!(house.says().await, (false, 0, 40 * MS));
        house.goes_stale(0).await;
        house.comes(7, 20, 40 * MS);
        assert_eq!(house.says().await, (false, 20, 40 * MS), "the link is there again");
    }

    #[tokio::test]
    async fn a_stopped_server_is_named_and_its_last_map_grows_stale_all_the_same() {
        let mut house = House::new();
        house.comes(7, 0, 40 * MS);
        assert_eq!(house.says().await, (false, 0, 40 * MS));
        let reason = ClientError::Ended { address: "alpha:1".into() };
        house.end.take().expect("once").send(reason).expect("the stream lives");
        assert!(matches!(house.stream.next_or_stale().await, Err(ClientError::Ended { .. })));
        house.pass(261 * MS);
        let newest = house.stream.newest().expect("still there");
        assert!(newest.is_stale(house.wall_ns.load(Ordering::SeqCst)));
    }

    #[tokio::test]
    async fn a_delay_that_grows_by_a_millisecond_a_map_is_told_at_the_first_map_that_is_too_old() {
        let mut house = House::new();
        for turn in 0..320 {
            house.pass(100 * MS);
            house.comes(7, turn, turn as i64 * MS);
            let told = house.says().await;
            assert_eq!(told, (turn as i64 > VALID_MS, turn, turn as i64 * MS));
            assert!(house.is_silent());
        }
    }

    #[tokio::test]
    async fn an_old_map_that_is_replayed_is_neither_the_newest_nor_fresh() {
        let mut house = House::new();
        house.comes(7, 5, 40 * MS);
        assert_eq!(house.says().await, (false, 5, 40 * MS));
        let first_ns = START_NS - 40 * MS;
        house.pass(200 * MS);
        house.came(7, 5, first_ns);
        house.came(7, 4, first_ns - 100 * MS);
        assert!(house.is_silent(), "it is no newer than what is there");
        // Also one with a number of its own has its age.
        house.pass(1000 * MS);
        assert_eq!(house.says().await, (true, 5, 1240 * MS));
        house.came(7, 6, first_ns);
        assert_eq!(house.says().await, (true, 6, 1240 * MS));
    }

    #[tokio::test]
    async fn a_restarted_server_is_another_boot_whose_first_map_is_the_newest() {
        let mut house = House::new();
        house.comes(7, 900, 40 * MS);
        assert_eq!(house.says().await, (false, 900, 40 * MS));
        house.goes_stale(900).await;
        house.comes(8, 0, 40 * MS);
        assert_eq!(house.says().await, (false, 0, 40 * MS));
        house.goes_stale(0).await;
    }

    #[tokio::test]
    async fn a_step_of_the_wall_clock_makes_no_stale_map_fresh() {
        for step_ns in [-3600 * 1000 * MS, -200 * MS, -50 * MS] {
            let mut house = House::new();
            house.comes(7, 0, 40 * MS);
            assert_eq!(house.says().await, (false, 0, 40 * MS));
            house.step(step_ns);
            if step_ns < -VALID_MS * MS {
                assert!(house.says().await.0, "a clock this far behind cannot tell the age");
            } else {
                house.goes_stale(0).await;
            }
            let stale = house.stream.newest().expect("it is there");
            house.pass(400 * MS);
            for further_ns in [0, step_ns, 10 * step_ns] {
                let now_ns = house.wall_ns.load(Ordering::SeqCst) + further_ns;
                assert!(stale.is_stale(now_ns) && stale.age_ns(now_ns) >= 440 * MS, "stepped by {step_ns} ns");
            }
        }
        // Set forward, it may be right, so what seems too old is.
        let mut house = House::new();
        house.comes(7, 0, 40 * MS);
        assert_eq!(house.says().await, (false, 0, 40 * MS));
        house.step(1000 * MS);
        assert_eq!(house.says().await, (true, 0, 1040 * MS));
    }

    #[test]
    fn a_stream_looks_at_its_clocks_often_enough_for_what_planners_are_promised() {
        assert!(LOOK * 2 <= Duration::from_millis(50));
    }
}
