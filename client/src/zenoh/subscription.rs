//! Samples of one layer's key -> the newest map, with the numbers of missed maps.
//!
//! The publisher's cache gives the current map to a new subscriber, and again after a lost connection is restored. Lost
//! maps are not recovered: an old map has no use, and zenoh would delay the newest map until the lost maps had arrived.
//! Only if the last map is lost, no newer sample follows that shows the loss. Then the publisher's heartbeat states its
//! number, and this file queries it.
//!
//! Callbacks check and decode each sample, and store its map in a slot of one: from zenoh's queue of 256 a slow planner
//! would get maps that are seconds old. What does not belong on the key is counted and takes no map's place. Gaps in
//! the maps' sequence numbers are skipped maps; skipped maps that zenoh missed are lost maps.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU32, AtomicU64, Ordering};

use tokio::sync::oneshot;
use zenoh::pubsub::Subscriber;
use zenoh::query::{ConsolidationMode, QueryTarget};
use zenoh::sample::{Sample, SampleKind};
use zenoh::{Session, Wait};
use zenoh_ext::{AdvancedSubscriber, AdvancedSubscriberBuilderExt, HistoryConfig, z_deserialize};

use crate::stream::{LatestSlot, Missed};
use crate::zenoh::query::{LayerKey, QUERY_TIMEOUT};

/// A subscription to the key of one layer, which stores the newest map in a slot.
pub(super) struct LayerSubscription {
    /// Its sender lives in the subscriber's callback, and so as long as the session.
    open: oneshot::Receiver<()>,
    _subscriber: AdvancedSubscriber<()>,
    _heartbeats: Subscriber<()>,
}

impl LayerSubscription {
    pub async fn open(session: &Session, layer: LayerKey, slot: LatestSlot) -> zenoh::Result<Self> {
        let (held, open) = oneshot::channel();
        let key = layer.key.clone();
        // Samples missed since the newest map.
        let missed = Arc::new(AtomicU64::new(0));
        // The publisher's number of the sample that was received or queried last.
        let number = Arc::new(AtomicU32::new(u32::MAX));

        let declaration = session.declare_subscriber(key.clone()).callback({
            let (missed, number, slot, layer) = (missed.clone(), number.clone(), slot.clone(), layer.clone());
            move |sample| {
                let _lives_with_the_callback = &held;
                if sample.kind() != SampleKind::Put {
                    return;
                }
                let is_stored = store(&slot, &layer, &sample, |skipped| {
                    // A missed map that was queried has arrived, so it is not a skipped one.
                    let lost = skipped.min(missed.swap(0, Ordering::Relaxed));
                    Missed { skipped, lost, left_out: 0 }
                });
                if let Some(source) = sample.source_info().filter(|_| is_stored) {
                    number.store(source.source_sn(), Ordering::Relaxed);
                }
            }
        });
        let history = HistoryConfig::default().max_samples(1).detect_late_publishers();
        let subscriber = declaration.history(history).await?;
        // zenoh calls this before the sample after the gap, under the same lock.
        let listen = subscriber.sample_miss_listener();
        let count = move |miss: zenoh_ext::Miss| _ = missed.fetch_add(miss.nb().into(), Ordering::Relaxed);
        listen.callback(count).background().await?;

        let heartbeats = session.declare_subscriber(format!("{key}/@adv/pub/**")).callback({
            let session = session.clone();
            // One query at a time, however many heartbeats a peer sends.
            let is_querying = Arc::new(AtomicBool::new(false));
            move |heartbeat| {
                let newest = z_deserialize::<u32>(heartbeat.payload());
                let Ok(newest) = newest else { return };
                if number.load(Ordering::Relaxed) == newest || is_querying.swap(true, Ordering::Relaxed) {
                    return;
                }
                number.store(newest, Ordering::Relaxed);
                let (slot, layer) = (slot.clone(), layer.clone());
                let querying = ClearOnDrop(is_querying.clone());
                let query = session.get(&key).timeout(QUERY_TIMEOUT).target(QueryTarget::All);
                let query = query.consolidation(ConsolidationMode::None).callback(move |reply| {
                    let _ends_with_the_query = &querying;
                    if let Ok(sample) = reply.result() {
                        store(&slot, &layer, sample, |skipped| Missed { skipped, ..Missed::default() });
                    }
                });
                if let Err(error) = query.wait() {
                    tracing::debug!(%error, %key, "the last map was lost and cannot be queried");
                }
            }
        });
        let heartbeats = heartbeats.await?;
        Ok(Self { open, _subscriber: subscriber, _heartbeats: heartbeats })
    }

    /// Waits until the session is closed.
    pub async fn closed(self) {
        // The sender is dropped without a message.
        let _ = self.open.await;
    }
}

/// Stores the map of a sample, or counts why it is passed over. Returns true if the sample was a map of this key.
fn store(slot: &LatestSlot, layer: &LayerKey, sample: &Sample, missed: impl FnOnce(u64) -> Missed) -> bool {
    match layer.map(sample) {
        Ok(map) => slot.store(map, missed),
        Err((reason, error)) => {
            tracing::debug!(?error, key = %sample.key_expr(), "passed over");
            slot.pass_over(reason);
            return false;
        }
    }
    true
}

/// Clears a flag when it is dropped.
struct ClearOnDrop(Arc<AtomicBool>);

impl Drop for ClearOnDrop {
    fn drop(&mut self) {
        self.0.store(false, Ordering::Relaxed);
    }
}
