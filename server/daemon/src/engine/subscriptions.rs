//! The layers of one vehicle that readers subscribe to, over gRPC, zenoh, ROS 2, Foxglove or the page.
//!
//! In: readers that come and go. Out: the set of subscribed layers, which the engine reads before each event. A layer
//! without a subscriber is not computed, unless a recorder runs. A new subscriber gets its layer with the next map. If
//! the newest map was computed for no reader at all, the engine computes it at once with the new layer; it does not do
//! so while other readers read other layers, because they would get the same scan again under another sequence number.

use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::Duration;

use tokio::sync::watch;

use crate::engine::newest::Newest;
use clearway_journal::encode::EncodedMap;

/// Longest wait for a map with a layer that was not computed so far. Ours: some revolutions of the slowest sensor.
pub const LAYER_TIMEOUT: Duration = Duration::from_secs(1);

/// The number of subscribers of each layer of one vehicle. Clones share the counts.
#[derive(Clone, Debug)]
pub struct LayerSubscriptions(Arc<[(&'static str, AtomicU32)]>);

impl LayerSubscriptions {
    /// The counts for `layers`, all 0.
    pub fn new(layers: &[&'static str]) -> Self {
        Self(layers.iter().map(|&layer| (layer, AtomicU32::new(0))).collect())
    }

    /// Subscribes to the named layers until the return value is dropped; to all layers if `layers` is empty. Unknown
    /// names are ignored.
    pub fn subscribe(&self, layers: &[String]) -> LayerSubscription {
        let is_named = |name: &str| layers.is_empty() || layers.iter().any(|layer| layer == name);
        let indices: Vec<usize> = (0..self.0.len()).filter(|&index| is_named(self.0[index].0)).collect();
        indices.iter().for_each(|&index| _ = self.0[index].1.fetch_add(1, Ordering::Relaxed));
        LayerSubscription { all: self.clone(), indices }
    }

    /// True if the layer has a subscriber.
    pub fn is_subscribed(&self, layer: &str) -> bool {
        self.0.iter().any(|(name, readers)| *name == layer && readers.load(Ordering::Relaxed) > 0)
    }
}

/// One reader's subscription to layers; it ends when it is dropped.
#[derive(Debug)]
pub struct LayerSubscription {
    all: LayerSubscriptions,
    indices: Vec<usize>,
}

impl LayerSubscription {
    /// True if `map` has all layers of the subscription.
    pub fn is_covered_by(&self, map: &EncodedMap) -> bool {
        self.indices.iter().all(|index| self.is_in(map, *index))
    }

    fn is_in(&self, map: &EncodedMap, index: usize) -> bool {
        map.layers.iter().any(|(name, _)| *name == self.all.0[index].0)
    }

    /// Waits for the newest map with all layers of the subscription. If none comes within [`LAYER_TIMEOUT`], because no
    /// data arrives, it is the newest one with some of them; `None` if that has none, or if the engine stops.
    pub async fn newest_map(&self, newest: &watch::Receiver<Newest>) -> Newest {
        let mut waiting = newest.clone();
        let covering = waiting.wait_for(|map| map.as_ref().is_some_and(|map| self.is_covered_by(map)));
        match tokio::time::timeout(LAYER_TIMEOUT, covering).await {
            Ok(covering) => covering.ok()?.clone(),
            Err(_) => {
                let newest = newest.borrow().clone();
                newest.filter(|map| self.indices.iter().any(|index| self.is_in(map, *index)))
            }
        }
    }
}

impl Drop for LayerSubscription {
    fn drop(&mut self) {
        self.indices.iter().for_each(|&index| _ = self.all.0[index].1.fetch_sub(1, Ordering::Relaxed));
    }
}
