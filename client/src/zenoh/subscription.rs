//! Samples of one layer's key -> the newest map, with the numbers of missed maps.
//!
//! The publisher's cache gives the current map to a new subscriber, and again after a lost connection is restored. Lost
//! maps are not recovered: an old map has no use, and zenoh would delay the newest one until the lost ones had arrived.
//! Only if the last map is lost, no newer sample follows that shows the loss. Then the publisher's heartbeat states its
//! number, and this file queries it.
//!
//! Callbacks store each sample in a slot of one: from zenoh's queue of 256 a slow planner would get maps that are
//! seconds old. Gaps in the maps' sequence numbers are skipped maps; those among them that zenoh missed are lost maps.

use std::sync::Arc;
use std::sync::atomic::{AtomicU32, AtomicU64, Ordering};

use tokio::sync::watch;
use zenoh::bytes::ZBytes;
use zenoh::pubsub::Subscriber;
use zenoh::sample::SampleKind;
use zenoh::{Session, Wait};
use zenoh_ext::{AdvancedSubscriber, AdvancedSubscriberBuilderExt, HistoryConfig, z_deserialize};

use crate::error::ClientError;
use crate::stream::{LatestSlot, Missed};
use crate::zenoh::query::{QUERY_TIMEOUT, decode};

/// A subscription to the key of one layer, with its newest sample.
pub(super) struct LayerSubscription {
    newest: watch::Receiver<Published>,
    /// The newest map, if it had to be queried.
    answer: watch::Receiver<ZBytes>,
    _subscriber: AdvancedSubscriber<()>,
    _heartbeats: Subscriber<()>,
}

#[derive(Clone, Default)]
struct Published {
    payload: ZBytes,
    /// Samples missed since the subscription was opened, up to this one.
    missed: u64,
}

impl LayerSubscription {
    pub async fn open(session: &Session, key: &str) -> zenoh::Result<Self> {
        let (sample_slot, newest) = watch::channel(Published::default());
        let (answer_slot, answer) = watch::channel(ZBytes::default());
        let missed = Arc::new(AtomicU64::new(0));
        // The publisher's number of the sample that was received or queried last.
        let number = Arc::new(AtomicU32::new(u32::MAX));

        let declaration = session.declare_subscriber(key.to_owned()).callback({
            let (missed, number) = (missed.clone(), number.clone());
            move |sample| {
                if sample.kind() == SampleKind::Put {
                    if let Some(source) = sample.source_info() {
                        number.store(source.source_sn(), Ordering::Relaxed);
                    }
                    let missed = missed.load(Ordering::Relaxed);
                    sample_slot.send_replace(Published { payload: sample.payload().clone(), missed });
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
            let (session, key) = (session.clone(), key.to_owned());
            move |heartbeat| {
                let newest = z_deserialize::<u32>(heartbeat.payload());
                let Ok(newest) = newest else { return };
                if number.swap(newest, Ordering::Relaxed) == newest {
                    return;
                }
                let answer_slot = answer_slot.clone();
                let query = session.get(&key).timeout(QUERY_TIMEOUT).callback(move |reply| {
                    if let Ok(sample) = reply.into_result() {
                        answer_slot.send_replace(sample.payload().clone());
                    }
                });
                if let Err(error) = query.wait() {
                    tracing::debug!(%error, %key, "the last map was lost and cannot be queried");
                }
            }
        });
        let heartbeats = heartbeats.await?;
        Ok(Self { newest, answer, _subscriber: subscriber, _heartbeats: heartbeats })
    }

    /// Stores every newer map in the slot until the session is closed.
    ///
    /// # Errors
    /// [`ClientError::Map`] if a map is invalid.
    pub async fn run(mut self, slot: LatestSlot) -> Result<(), ClientError> {
        let mut last = None;
        let mut missed_before = 0;
        loop {
            let (payload, missed) = tokio::select! {
                // Fails when the session is closed.
                changed = self.newest.changed() => {
                    if changed.is_err() {
                        return Ok(());
                    }
                    let Published { payload, missed } = self.newest.borrow_and_update().clone();
                    (payload, missed)
                }
                Ok(()) = self.answer.changed() => (self.answer.borrow_and_update().clone(), missed_before),
            };
            let map = decode(&payload)?;
            let (boot_id, sequence) = (map.header().boot_id, map.sequence());
            let skipped = match last {
                Some((boot, seen)) if boot == boot_id && sequence <= seen => continue,
                Some((boot, seen)) if boot == boot_id => sequence - seen - 1,
                // Another run of the server: its sequence starts at 0.
                _ => 0,
            };
            last = Some((boot_id, sequence));
            // A missed map that was queried has arrived, so it is not a skipped one.
            let lost = skipped.min(missed - missed_before);
            missed_before = missed;
            slot.store(map, Missed { skipped, lost, left_out: 0 });
        }
    }
}
