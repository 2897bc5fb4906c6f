//! The events and maps of a recording, in file order -> whether they stand where their recorder has written them.
//!
//! A recorder writes the events of a vehicle, and the maps of a layer, in the order of their sequences, and every event
//! that it has not dropped. A keyframe repeats earlier events, which are in force.

use std::collections::{BTreeMap, BTreeSet};

use clearway_proto::v1;
use prost::Message;

use super::channel::{Channel, Content};

/// The fields of an event that give its place: decoding it is much cheaper than decoding the event.
#[derive(Message)]
struct EventPlace {
    #[prost(uint64, tag = "1")]
    sequence: u64,
}

/// The fields of a map, or of its digest, that give its place.
#[derive(Message)]
struct MapPlace {
    #[prost(message, optional, tag = "1")]
    header: Option<HeaderPlace>,
}

/// The fields of a map's header that give its place.
#[derive(Message)]
struct HeaderPlace {
    #[prost(uint64, tag = "3")]
    sequence: u64,
}

/// The order of the messages that were read so far.
#[derive(Default)]
pub(super) struct MessageOrder {
    /// Sequence that the next message of a topic has, or for maps at least has.
    next: BTreeMap<String, u64>,
    /// The vehicles whose events a keyframe repeats now.
    repeating: BTreeSet<String>,
    /// The topics with messages lost since their last read message.
    with_loss: BTreeSet<String>,
    /// Number of messages so far.
    messages: u64,
    /// Places with missing events.
    gaps: Places,
    /// Places with messages that belong elsewhere.
    moved: Places,
}

/// Places of the file: how many, and the first, by the number of messages before it.
#[derive(Default)]
struct Places {
    count: u64,
    first: (u64, String),
}

impl Places {
    fn add(&mut self, at: u64, text: impl FnOnce() -> String) {
        self.count += 1;
        if self.count == 1 {
            self.first = (at, text());
        }
    }
}

impl MessageOrder {
    /// Adds a message; `has_loss` is true if a part of the file was lost since the last one.
    pub(super) fn add(&mut self, channel: &Channel, data: &[u8], has_loss: bool) {
        self.messages += 1;
        if has_loss {
            self.with_loss = self.next.keys().cloned().collect();
        }
        match &channel.content {
            Content::Journal { vehicle } => {
                let Ok(EventPlace { sequence }) = EventPlace::decode(data) else { return };
                self.add_event(&channel.topic, vehicle, sequence);
            }
            Content::Map { .. } | Content::Digest { .. } => {
                let Ok(MapPlace { header: Some(HeaderPlace { sequence }) }) = MapPlace::decode(data) else { return };
                let next = self.next.entry(channel.topic.clone()).or_default();
                let is_moved = sequence < *next;
                *next = sequence.saturating_add(1);
                if is_moved {
                    let text = || format!("map {sequence} of {} stands behind a later one", channel.topic);
                    self.moved.add(self.messages, text);
                }
            }
            Content::Keyframe { vehicle } => {
                let Ok(keyframe) = v1::Keyframe::decode(data) else { return };
                if keyframe.phase() == v1::KeyframePhase::WarmUp {
                    self.next.entry(format!("/{vehicle}/journal")).or_insert(keyframe.first_event);
                    self.repeating.insert(vehicle.clone());
                }
            }
            Content::Counts | Content::Ros(_) | Content::Other => {}
        }
    }

    fn add_event(&mut self, topic: &str, vehicle: &str, sequence: u64) {
        let expected = self.next.get(topic).copied().unwrap_or(sequence);
        if sequence < expected && self.repeating.contains(vehicle) {
            return;
        }
        self.repeating.remove(vehicle);
        let has_loss = self.with_loss.remove(topic);
        self.next.insert(topic.to_owned(), sequence.saturating_add(1));
        let text = || format!("event {sequence} of {topic} stands in the place of event {expected}");
        match sequence.cmp(&expected) {
            std::cmp::Ordering::Less => self.moved.add(self.messages, text),
            std::cmp::Ordering::Greater if !has_loss => self.gaps.add(self.messages, text),
            _ => {}
        }
    }

    /// How the order differs from the recorder's order, `None` if it does not. Gaps are allowed if the recorder
    /// `has_dropped` messages.
    pub(super) fn fault(&self, has_dropped: bool) -> Option<String> {
        let gaps = Some(&self.gaps).filter(|_| !has_dropped);
        let found = || gaps.into_iter().chain([&self.moved]).filter(|places| places.count > 0);
        let (_, first) = found().map(|places| &places.first).min()?;
        Some(match found().map(|places| places.count).sum::<u64>() {
            1 => format!("its messages are not as they were written: {first}"),
            places => format!("its messages are not as they were written in {places} places, the first: {first}"),
        })
    }
}
