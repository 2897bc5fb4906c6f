//! The events of a recording -> the maps of one vehicle that a configuration makes of them.

use std::sync::Arc;

use bytes::Bytes;
use clearway_mapping::event::Event;
use clearway_mapping::pipeline::Pipeline;

use crate::encode::EncodedMap;

/// One vehicle whose maps are computed.
pub(super) struct Computing {
    pub name: Arc<str>,
    pub boot_id: u64,
    pub valid_ms: u32,
    pub pipeline: Pipeline,
    /// Sequence from which events are new; earlier events are repeated for a keyframe.
    pub next_event: u64,
}

impl Computing {
    /// True if events between the last event and `event` are missing. A part of a recording may begin with any event.
    pub fn lacks_events_before(&self, event: &Event) -> bool {
        self.next_event > 0 && event.sequence > self.next_event
    }

    /// The layers of the map that an event completes: name and bytes of each.
    pub fn step(&mut self, event: &Event) -> Vec<(String, Bytes)> {
        if event.sequence < self.next_event {
            return Vec::new();
        }
        self.next_event = event.sequence.saturating_add(1);
        // Refused events make no map, here and in the recorded run.
        let Ok(Some(map)) = self.pipeline.step(event) else { return Vec::new() };
        let map = EncodedMap::new(map, self.name.clone(), self.boot_id, self.valid_ms);
        map.layers.iter().map(|(layer, chunk)| ((*layer).to_owned(), map.layer(chunk))).collect()
    }
}
