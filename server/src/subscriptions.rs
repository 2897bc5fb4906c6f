//! Which layers of a vehicle somebody takes, over gRPC, zenoh, ROS 2, Foxglove or the page.
//!
//! In: readers that come and go. Out: a set the engine looks at before each event. A map that nobody takes and nobody
//! records is not made ([`clearway_mapping::pipeline::Pipeline::want`]); one that is taken from now on comes with the
//! next map, and at once where the newest was made for nobody. Where others read other layers it is not made at once:
//! they would be given the same turn a second time, under another number, for each who comes.

use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::Duration;

use tokio::sync::watch;

use crate::engine::Newest;
use crate::encode::EncodedMap;

/// For a layer that was not made so far: some revolutions of the slowest sensor.
pub const PATIENCE: Duration = Duration::from_secs(1);

/// Readers of each layer of one vehicle.
#[derive(Clone, Debug)]
pub struct Demand(Arc<[(&'static str, AtomicU32)]>);

impl Demand {
    /// Nobody takes any of these layers yet.
    pub fn new(layers: &[&'static str]) -> Self {
        Self(layers.iter().map(|&layer| (layer, AtomicU32::new(0))).collect())
    }

    /// Takes these layers, all where none is named, until what it gives is dropped. Names nobody knows are left out.
    pub fn take(&self, layers: &[String]) -> Taken {
        let named = |name: &str| layers.is_empty() || layers.iter().any(|layer| layer == name);
        let taken: Vec<usize> = (0..self.0.len()).filter(|&index| named(self.0[index].0)).collect();
        taken.iter().for_each(|&index| _ = self.0[index].1.fetch_add(1, Ordering::Relaxed));
        Taken { demand: self.clone(), taken }
    }

    /// Whether somebody takes the layer.
    pub fn is_taken(&self, layer: &str) -> bool {
        self.0.iter().any(|(name, readers)| *name == layer && readers.load(Ordering::Relaxed) > 0)
    }
}

/// One reader's layers; they are made while it lives.
#[derive(Debug)]
pub struct Taken {
    demand: Demand,
    taken: Vec<usize>,
}

impl Taken {
    /// Whether the map has all of them.
    pub fn are_in(&self, map: &EncodedMap) -> bool {
        let held = |index: &usize| map.layers.iter().any(|(name, _)| *name == self.demand.0[*index].0);
        self.taken.iter().all(held)
    }

    /// The newest map as soon as it has all of them; `None` where the engine stops, or gives none for
    /// [`PATIENCE`].
    pub async fn newest(&self, newest: &watch::Receiver<Newest>) -> Newest {
        let mut newest = newest.clone();
        let has = newest.wait_for(|map| map.as_ref().is_some_and(|map| self.are_in(map)));
        tokio::time::timeout(PATIENCE, has).await.ok()?.ok()?.clone()
    }
}

impl Drop for Taken {
    fn drop(&mut self) {
        self.taken.iter().for_each(|&index| _ = self.demand.0[index].1.fetch_sub(1, Ordering::Relaxed));
    }
}
