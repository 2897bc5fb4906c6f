//! One vehicle of a replay: its engine and its event queue.

use std::sync::mpsc::Receiver;

use crate::engine::Engine;
use crate::ingest::files::mcap::RefusedMessages;
use crate::ingest::queue::{EventQueue, QueuedEvent};

/// One vehicle of a replay.
pub struct ReplayedVehicle {
    /// Its engine.
    pub engine: Engine,
    /// The events of its queue.
    pub events: Receiver<QueuedEvent>,
    /// Its queue.
    pub queue: EventQueue,
}

/// Counts the messages that the files' readers have refused.
pub(super) fn report_refused(queue: &EventQueue, refused: RefusedMessages) {
    for ((source, reason), count) in refused {
        queue.drops().record_refused_messages(source, reason, count);
    }
}
