//! One layer's key: samples as zenoh gives them -> the newest map, with what was missed on the way.
//!
//! The publisher's cache gives the current map to who comes late, and again when it is seen again after a cut. Nothing is
//! recovered: an old map is worth nothing, and zenoh would hold the newest one back until the lost ones had come. Only
//! where the last map got lost nothing newer follows that could show it: the publisher's heartbeat tells that there is one,
//! and it is asked for.
//!
//! Callbacks only put aside, each into a place of one: zenoh's queue of 256 would hand a slow planner maps that are seconds
//! old. Holes in the maps' own sequence are the skipped ones; those of them that zenoh has missed are the lost ones.

use std::sync::Arc;
use std::sync::atomic::{AtomicU32, AtomicU64, Ordering};

use tokio::sync::watch;
use zenoh::bytes::ZBytes;
use zenoh::pubsub::Subscriber;
use zenoh::sample::SampleKind;
use zenoh::{Session, Wait};
use zenoh_ext::{AdvancedSubscriber, AdvancedSubscriberBuilderExt, HistoryConfig, z_deserialize};

use super::{ANSWER_TIMEOUT, decode};
use crate::ClientError;
use crate::stream::{Between, Feed};

/// A subscription to one key, with what has come last.
pub(super) struct Tap {
    newest: watch::Receiver<Published>,
    /// The newest map where it had to be asked for.
    answer: watch::Receiver<ZBytes>,
    _subscriber: AdvancedSubscriber<()>,
    _heartbeats: Subscriber<()>,
}

#[derive(Clone, Default)]
struct Published {
    payload: ZBytes,
    /// Samples missed since the tap was opened, up to this one.
    missed: u64,
}

impl Tap {
    pub async fn open(session: &Session, key: &str) -> zenoh::Result<Self> {
        let (put_aside, newest) = watch::channel(Published::default());
        let (put_answer, answer) = watch::channel(ZBytes::default());
        let missed = Arc::new(AtomicU64::new(0));
        // The publisher's number of the sample that came last, or that was asked for last.
        let number = Arc::new(AtomicU32::new(u32::MAX));

        let take = session.declare_subscriber(key.to_owned()).callback({
            let (missed, number) = (missed.clone(), number.clone());
            move |sample| {
                if sample.kind() == SampleKind::Put {
                    if let Some(source) = sample.source_info() {
                        number.store(source.source_sn(), Ordering::Relaxed);
                    }
                    let missed = missed.load(Ordering::Relaxed);
                    put_aside.send_replace(Published { payload: sample.payload().clone(), missed });
                }
            }
        });
        let history = HistoryConfig::default().max_samples(1).detect_late_publishers();
        let subscriber = take.history(history).await?;
        // Called before the sample behind the hole is, under the same lock.
        let listen = subscriber.sample_miss_listener();
        let count = move |miss: zenoh_ext::Miss| _ = missed.fetch_add(miss.nb().into(), Ordering::Relaxed);
        listen.callback(count).background().await?;

        let heartbeats = session.declare_subscriber(format!("{key}/@adv/pub/**")).callback({
            let (session, key) = (session.clone(), key.to_owned());
            move |heartbeat| {
                let told = z_deserialize::<u32>(heartbeat.payload());
                let Ok(told) = told else { return };
                if number.swap(told, Ordering::Relaxed) == told {
                    return;
                }
                let put_answer = put_answer.clone();
                let ask = session.get(&key).timeout(ANSWER_TIMEOUT).callback(move |reply| {
                    if let Ok(sample) = reply.into_result() {
                        put_answer.send_replace(sample.payload().clone());
                    }
                });
                if let Err(error) = ask.wait() {
                    tracing::debug!(%error, %key, "the last map got lost, and cannot be asked for");
                }
            }
        });
        let heartbeats = heartbeats.await?;
        Ok(Self { newest, answer, _subscriber: subscriber, _heartbeats: heartbeats })
    }

    /// Puts every newer map into the feed until the session is closed.
    ///
    /// # Errors
    /// What is wrong with a map.
    pub async fn run(mut self, feed: Feed) -> Result<(), ClientError> {
        let mut last = None;
        let mut missed_before = 0;
        loop {
            let (payload, missed) = tokio::select! {
                // Ends with the subscriber, when the session does.
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
                // Another run of the server: its sequence begins anew.
                _ => 0,
            };
            last = Some((boot_id, sequence));
            // A missed one that was asked for is there, and none of the skipped ones.
            let lost = skipped.min(missed - missed_before);
            missed_before = missed;
            feed.put(map, Between { skipped, lost, left_out: 0 });
        }
    }
}
