//! A recording or a ROS 2 bag -> its topics, maps and events, and what is wrong with it.

use std::collections::BTreeMap;
use std::fmt::Display;
use std::path::Path;

use anyhow::Result;
use clearway_client::MapView;
use clearway_journal::channel::Channel;
use clearway_journal::encode::event_from_bytes;
use clearway_journal::mcap_reader::{McapReader, Message};
use serde_json::{Map, Value, json};

use super::span::{Span, rounded};
use crate::terminal::counted;

/// What the messages of a recording hold.
#[derive(Default)]
struct RecordedContents {
    span: Span,
    /// By topic: the number of messages, and their times.
    topics: BTreeMap<String, (u64, Span)>,
    events: u64,
    scans: u64,
    /// Number of maps by vehicle and layer.
    maps: BTreeMap<String, BTreeMap<String, u64>>,
    /// The first map of each layer.
    grids: BTreeMap<String, Value>,
    /// By topic: the number of messages that cannot be decoded, and the fault of the first.
    unreadable: BTreeMap<String, (u64, String)>,
}

impl RecordedContents {
    fn add(&mut self, message: &Message) {
        let at = i64::try_from(message.log_ns).unwrap_or(i64::MAX);
        self.span.extend(at);
        let (messages, span) = self.topics.entry(message.channel.topic.clone()).or_default();
        *messages += 1;
        span.extend(at);
        if message.journal_of().is_some() {
            self.events += 1;
            if let Err(error) = event_from_bytes(message.data.clone()) {
                self.add_unreadable(message, &error);
            }
        }
        self.scans += u64::from(message.is_velodyne_scan());
        if let Some((vehicle, layer)) = message.map_of() {
            *self.maps.entry(vehicle.to_owned()).or_default().entry(layer.to_owned()).or_default() += 1;
            match grid(message, layer) {
                Ok(grid) => _ = self.grids.entry(layer.to_owned()).or_insert(grid),
                Err(error) => self.add_unreadable(message, &error),
            }
        }
    }

    fn add_unreadable(&mut self, message: &Message, reason: &dyn Display) {
        let of_topic = self.unreadable.entry(message.channel.topic.clone());
        of_topic.or_insert_with(|| (0, reason.to_string())).0 += 1;
    }

    /// The type, encoding, number of messages and rate of a channel's topic.
    fn topic(&self, channel: &Channel, count: u64) -> Value {
        let span = self.topics.get(&channel.topic).map(|(_, span)| *span).unwrap_or_default();
        let rate_hz = span.seconds().filter(|seconds| *seconds > 0.0).map(|seconds| (count - 1) as f64 / seconds);
        let (schema, encoding, rate_hz) = (&channel.schema, &channel.encoding, rate_hz.map(rounded));
        json!({"type": schema, "encoding": encoding, "messages": count, "rate_hz": rate_hz})
    }
}

/// The description of a recording; an error names the file.
pub fn describe(file: &Path) -> Result<Value> {
    let mut recording = McapReader::open(file)?;
    let mut contents = RecordedContents::default();
    for message in recording.by_ref() {
        contents.add(&message?);
    }
    let undecoded = contents.unreadable.iter().map(|(topic, (count, first))| {
        format!("{} of {topic} cannot be decoded, the first: {first}", counted(*count, "message"))
    });
    let faults: Vec<String> = recording.incomplete().into_iter().chain(undecoded).collect();
    let channels = recording.channels().into_iter();
    let topics = channels.map(|(channel, count)| (channel.topic.clone(), contents.topic(channel, count)));
    let messages = contents.topics.iter().map(|(topic, (count, _))| (topic.clone(), Value::from(*count)));
    let damages = recording.damages().into_iter().map(|damage| (format!("byte {}", damage.bytes.0), damage.to_json()));
    let (header, span) = (recording.header(), contents.span);
    Ok(json!({
        "kind": "recording",
        "complete": faults.is_empty(),
        "state": if faults.is_empty() { "complete".to_owned() } else { faults.join("; ") },
        "damage": damages.collect::<Map<_, _>>(),
        "repaired": recording.repaired(),
        "begins": span.begins(),
        "ends": span.ends(),
        "duration_s": span.seconds().map(rounded),
        "topics": topics.collect::<Map<_, _>>(),
        "run": header.metadata,
        "maps": contents.maps,
        "layers": contents.grids,
        "events": contents.events,
        "velodyne_scans": contents.scans,
        "messages": messages.collect::<Map<_, _>>(),
        "calibrations": header.calibrations.keys().collect::<Vec<_>>(),
        "config": header.config,
    }))
}

/// The shape, classes and channels of a recorded layer.
fn grid(message: &Message, layer: &str) -> Result<Value> {
    let map = MapView::decode(message.data.clone())?;
    let found = map.layer(layer)?;
    let (rows, columns) = found.grid.shape();
    let channels: Vec<_> = found.channels.iter().map(|channel| &channel.name).collect();
    let legend: Vec<_> = found.legend.iter().map(|class| &class.name).collect();
    Ok(json!({"rows": rows, "columns": columns, "legend": legend, "channels": channels}))
}
