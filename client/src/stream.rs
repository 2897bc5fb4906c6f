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

/// Longest wait for a map after the end of a replay was told. Ours: a seek takes less, and a test does not hang.
const AFTER_END: Duration = Duration::from_secs(2);

/// One map from a stream.
#[derive(Clone, Debug)]
pub struct Update {
    /// The newest map that the stream received.
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
    /// `Counters::maps` of the map that the reader has handled.
    handled: watch::Sender<u64>,
    task: JoinHandle<()>,
}

#[derive(Debug, Default)]
struct Slot {
    newest: Option<MapView>,
    counters: Counters,
    passed_over: PassedOver,
    reasons: Vec<String>,
    /// That no server publishes the vehicle or the layer.
    absence: Option<String>,
    ended: Option<ClientError>,
    /// How often a replay has reached its end, and how the reader is told.
    replay_ends: u64,
    replay_ended: Option<ClientError>,
    /// No map has come since the replay ended.
    is_at_end: bool,
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
    /// Maps of another run of the server while the present run sends fresh maps.
    pub other_run: u64,
    /// Maps that are not newer than the newest map (repeated maps).
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

/// Numbers of maps between a stored map and the stored map before it.
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
    pub(crate) fn spawn<F: Future<Output = ClientError> + Send + 'static>(
        clock: Clock,
        task: impl FnOnce(LatestSlot) -> F,
    ) -> Self {
        let slot = LatestSlot { has_one_server: true, ..LatestSlot::new(clock) };
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
        let handled = slot.handled.clone();
        Self { slot: receiver, seen: None, fresh: None, replay_ends: 0, handled, task }
    }

    /// Waits for a map newer than the last one returned, which counts as handled: a replay in lockstep goes on then.
    ///
    /// # Errors
    /// Why the stream has ended, after its last map was returned; subscribe again then. [`ClientError::Ended`] if the
    /// server ended it, [`ClientError::Unreachable`] if the connection failed, [`ClientError::Refused`] if the server
    /// refused a request, [`ClientError::Map`] if a map is invalid. [`ClientError::ReplayEnded`] after the last map of
    /// a replay; the stream has not ended then. The next call waits 2 s for a map of a replay that is set back, and
    /// then says so again.
    pub async fn next(&mut self) -> Result<Update, ClientError> {
        self.handled.send_replace(self.seen.map_or(0, |seen| seen.maps));
        loop {
            let told = {
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
                slot.replay_ended.clone().filter(|_| slot.is_at_end)
            };
            let changed = match told {
                None => self.slot.changed().await,
                Some(ended) => tokio::time::timeout(AFTER_END, self.slot.changed()).await.map_err(|_| ended)?,
            };
            if changed.is_err() {
                return Err(ClientError::Ended { address: "the background task".into() });
            }
        }
    }

    /// Waits for a map newer than the last returned map, or until that map is stale. A stale map is reported once, at
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

    /// Why no map comes, worst first: the reasons of the vehicle's state on the server, or why there is no connection
    /// ([`crate::Subscription::reconnects`]). Empty while maps come and in the first second without one.
    pub fn reasons(&self) -> Vec<String> {
        let slot = self.slot.borrow();
        slot.absence.iter().chain(&slot.reasons).cloned().collect()
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
    handled: watch::Sender<u64>,
}

impl LatestSlot {
    pub(crate) fn new(clock: Clock) -> Self {
        Self { slot: watch::Sender::new(Slot::default()), clock, has_one_server: false, handled: watch::Sender::new(0) }
    }

    /// Waits until the reader has handled the newest map.
    pub(crate) async fn handled(&self) {
        let newest = self.slot.borrow().counters.maps;
        // The sender is here, so it cannot be gone.
        let _ = self.handled.subscribe().wait_for(|handled| *handled >= newest).await;
    }

    /// Records that the replay has ended, for the reader of the stream.
    pub(crate) fn end_replay(&self, ended: ClientError) {
        self.slot.send_modify(|slot| {
            slot.replay_ends += 1;
            slot.replay_ended = Some(ended);
            slot.is_at_end = true;
        });
    }

    /// Stores a map as the newest, with the numbers of maps between it and the map before, or counts it as passed over
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
            slot.is_at_end = false;
            slot.reasons.clear();
            slot.absence = None;
            true
        });
    }

    /// Sets why no map comes, until one is stored. No reader that waits for a map is notified.
    pub(crate) fn set_reasons(&self, reasons: Vec<String>) {
        self.slot.send_if_modified(|slot| {
            slot.reasons = reasons;
            false
        });
    }

    /// Sets that no server publishes the vehicle or the layer: the worst reason why no map comes, until one is stored.
    #[cfg_attr(not(feature = "zenoh"), allow(dead_code, reason = "over gRPC the server refuses a wrong name"))]
    pub(crate) fn set_absence(&self, absence: Option<String>) {
        self.slot.send_if_modified(|slot| {
            slot.absence = absence.filter(|_| slot.newest.is_none());
            false
        });
    }

    /// True if a map was stored.
    #[cfg_attr(not(feature = "zenoh"), allow(dead_code, reason = "over gRPC the server refuses a wrong name"))]
    pub(crate) fn has_map(&self) -> bool {
        self.slot.borrow().newest.is_some()
    }

    /// True if the reader has dropped the stream: then nothing is said of its end.
    pub(crate) fn is_dropped(&self) -> bool {
        self.slot.is_closed()
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
mod tests;
