//! What joins one vehicle's engine to its readers, beside the latest-value slot of the map.

use std::sync::Arc;

use tokio::sync::watch;

use super::acknowledgements::Acknowledgements;
use super::newest::NewestSweep;
use super::plans::Plans;
use super::subscriptions::LayerSubscriptions;
use crate::ingest::drops::DropCounters;
use crate::ingest::queue::EventQueue;

/// The channels between one vehicle's engine and its readers. Clones share them.
#[derive(Clone, Debug)]
pub struct Wires {
    /// Subscriptions of readers to the layers.
    pub subscriptions: LayerSubscriptions,
    /// The newest map that each acknowledging reader has finished with.
    pub acknowledgements: Acknowledgements,
    /// The points of the newest map, while a reader subscribes to them.
    pub sweeps: watch::Sender<NewestSweep>,
    /// The plans of the vehicle's planners.
    pub plans: Plans,
    /// True while a replay stands at its end.
    pub replay_ended: watch::Sender<bool>,
}

impl Wires {
    /// The channels of a vehicle whose maps have these layers, without readers.
    pub fn new(layers: &[&'static str]) -> Self {
        Self {
            subscriptions: LayerSubscriptions::new(layers),
            acknowledgements: Acknowledgements::default(),
            sweeps: watch::Sender::new(None),
            plans: Plans::new(None, Arc::default()),
            replay_ended: watch::Sender::new(false),
        }
    }

    /// The channels, with plans that go to this event queue if there is one, and whose refusals are counted in `drops`.
    pub fn with_plans(self, queue: Option<EventQueue>, drops: Arc<DropCounters>) -> Self {
        Self { plans: Plans::new(queue, drops), ..self }
    }
}
