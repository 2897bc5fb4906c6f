//! One vehicle of a replay: its engine and its event queue.

use std::sync::mpsc::Receiver;

use bytes::Bytes;
use clearway_daemon::engine::Engine;
use clearway_daemon::ingest::queue::{EventQueue, QueuePosition, QueuedEvent};
use clearway_mapping::pipeline::Pipeline;

use crate::files::mcap::RefusedMessages;

/// One vehicle of a replay.
pub struct ReplayedVehicle {
    /// Engine that makes the vehicle's maps.
    pub engine: Engine,
    /// Receiver of the events on the engine's queue.
    pub events: Receiver<QueuedEvent>,
    /// Event queue of the engine.
    pub queue: EventQueue,
}

/// What a jump restores of a vehicle.
pub struct VehicleCopy {
    pipeline: Pipeline,
    plan: Option<Bytes>,
    position: QueuePosition,
}

impl ReplayedVehicle {
    /// A copy of the present state.
    pub(super) fn copy(&self) -> VehicleCopy {
        let Engine { pipeline, plan, .. } = &self.engine;
        VehicleCopy { pipeline: pipeline.clone(), plan: plan.clone(), position: self.queue.position() }
    }

    /// Goes back or on to the state of a copy.
    pub(super) fn restore(&mut self, copy: &VehicleCopy) {
        (self.engine.pipeline, self.engine.plan) = (copy.pipeline.clone(), copy.plan.clone());
        self.queue.set_position(copy.position);
    }
}

/// Counts the messages that the files' readers have refused.
pub(super) fn report_refused(queue: &EventQueue, refused: RefusedMessages) {
    for ((source, reason), count) in refused {
        queue.drops().record_refused_messages(source, reason, count);
    }
}
