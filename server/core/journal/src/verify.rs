//! Verifies a recording: are the recorded maps the maps of the recorded events?
//!
//! Builds every vehicle's pipeline from the recorded configuration and calibrations, steps it with all events of the
//! journal, and compares the bytes of each map with the recorded map's bytes, or their digest with the recorded digest.
//! At a keyframe a new pipeline replaces the old one, as it did in the recorded run. Maps that follow from events which
//! the file lacks are counted as unjudged: the maps after a gap, until the next keyframe; and if messages of the file
//! are missing or not in their place, all recorded maps without a computed map, and the reverse.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use bytes::Bytes;
use clearway_lidar::calibration::Calibration;
use clearway_mapping::config::{ConfigValueError, VehicleConfig};
use clearway_mapping::event::Event;
use clearway_mapping::pipeline::{Handover, Pipeline};
use clearway_proto::v1;
use prost::Message;
use serde_json::{Value, json};

use crate::damage::Damage;
use crate::encode::{EncodedMap, as_served, as_served_with};
use crate::mcap_file::sha256;
use crate::reader::{Beginning, RecordedMessage, RecordingError, RecordingReader};
use crate::{RecordedMaps, RecordedVehicle};

mod difference;

use difference::first_difference;
pub use difference::{Difference, DifferenceKind};

/// Greatest number of differences in a report; all are counted. Ours: the first differences explain the others.
const DIFFERENCES_MAX: usize = 20;

/// The result of a verification.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Report {
    /// Number of events of all journals.
    pub events: u64,
    /// What the recording holds of the maps. Without any, only its events are checked.
    pub recorded: RecordedMaps,
    /// Number of recorded maps or digests, of one layer each, that equal the computed map or digest byte for byte.
    pub equal: u64,
    /// Number of maps computed from the events.
    pub maps: u64,
    /// Number of cells in the grids of all recorded maps that have a computed map.
    pub cells: u64,
    /// True if a crash cut the file; then the part before the cut is verified.
    pub cut: bool,
    /// Number of maps, of one layer each, that belong to the last event before the cut and are not recorded.
    pub beyond_cut: u64,
    /// Number of layers of maps that follow from events which the file lacks, and which do not equal the computed layer
    /// or are not recorded. They cannot be judged. A layer that is computed under another sequence than it is recorded
    /// with counts once.
    pub unjudged: u64,
    /// Number of messages that the recorder has dropped, as the file states it.
    pub dropped: u64,
    /// The first topic with dropped messages and why they were dropped; empty without any.
    pub dropped_because: String,
    /// True if the recorder has closed the file; always false in files of versions without counts.
    pub is_closed: bool,
    /// The damaged parts of the file.
    pub damages: Vec<Damage>,
    /// How the file is incomplete; `None` if it is whole.
    pub incomplete: Option<String>,
    /// What `clearway repair` could not read of the damaged file, if it wrote this file. The events and maps that are
    /// lost there are no differences.
    pub repaired: Vec<String>,
    /// Version of clearway that recorded the file, as its metadata states it; empty without one.
    pub made_by: String,
    /// The first differences, in file order.
    pub differences: Vec<Difference>,
    /// Number of all differences.
    pub different: u64,
}

/// A recording cannot be verified.
#[derive(Debug, thiserror::Error)]
pub enum VerifyError {
    /// The file cannot be read.
    #[error(transparent)]
    Recording(#[from] RecordingError),
    /// The recorded configuration of a vehicle is invalid.
    #[error(transparent)]
    Config(#[from] ConfigValueError),
}

impl Report {
    /// True if the readable part of the recording has events, every map in it is the map of its events, at least one of
    /// them can be judged, and the recorder has dropped nothing.
    pub fn is_good(&self) -> bool {
        let is_judged = self.equal > 0 || self.unjudged == 0;
        self.different == 0 && self.events > 0 && self.dropped == 0 && is_judged
    }

    /// The report as one JSON object.
    pub fn to_json(&self) -> Value {
        json!({
            "ok": self.is_good() && self.incomplete.is_none(),
            "events": self.events, "maps": self.maps, "equal": self.equal, "different": self.different,
            "cells": self.cells, "recorded_maps": self.recorded.as_str(),
            "cut": self.cut, "beyond_cut": self.beyond_cut, "unjudged": self.unjudged, "incomplete": self.incomplete,
            "dropped": self.dropped, "dropped_because": self.dropped_because, "made_by": self.made_by,
            "damage": self.damages.iter().map(Damage::to_json).collect::<Vec<_>>(), "repaired": self.repaired,
            "differences": self.differences.iter().map(Difference::to_json).collect::<Vec<_>>(),
        })
    }

    fn add(&mut self, vehicle: &str, sequence: u64, layer: &str, kind: DifferenceKind) {
        self.different += 1;
        if self.differences.len() < DIFFERENCES_MAX {
            self.differences.push(Difference { vehicle: vehicle.into(), sequence, layer: layer.into(), kind });
        }
    }
}

/// One vehicle whose maps are computed again.
struct VehicleReplay {
    name: Arc<str>,
    config: VehicleConfig,
    tables: Vec<Option<Calibration>>,
    /// Makes the maps; `None` where they do not follow from the events of the file: before the first keyframe of a part
    /// that is not the first, and after a gap until the next keyframe.
    pipeline: Option<Pipeline>,
    /// The pipeline of the next keyframe.
    warm_up: Option<Pipeline>,
    valid_ms: u32,
    records: RecordedMaps,
    /// Sequence of the next event; `None` before the first one.
    next_event: Option<u64>,
    /// True if events are missing, until the next keyframe; the recorded maps need not equal the computed maps.
    lacks_events: bool,
    /// Computed maps that are not compared yet, by sequence and layer.
    computed: BTreeMap<(u64, String), Bytes>,
    /// Recorded maps without a computed one, by sequence and layer.
    extra: BTreeSet<(u64, String)>,
    /// Number of recorded layers that cannot be judged, because events are missing before them.
    unjudged: u64,
}

/// Verifies a recording with the recorded configuration of its vehicles. A map that differs and a damaged part are
/// no errors; the [`Report`] contains them.
///
/// # Errors
/// [`VerifyError::Recording`] if the file is not a recording or cannot be read, [`VerifyError::Config`] if its
/// configuration is invalid.
pub fn verify(mut recording: RecordingReader, vehicles: Vec<RecordedVehicle>) -> Result<Report, VerifyError> {
    let has_maps = recording.maps() != RecordedMaps::None;
    let beginning = if has_maps { Beginning::of(recording.file())? } else { Beginning::default() };
    let stated_boot_id = recording.header().boot_id;
    let boot_id = beginning.boot_id.unwrap_or(stated_boot_id);
    let is_first_part = recording.part().map_or(beginning.first_event == Some(0), |part| part == 1);
    let replay = |vehicle| VehicleReplay::new(vehicle, recording.maps(), is_first_part);
    let mut replays = vehicles.into_iter().map(replay).collect::<Result<Vec<_>, _>>()?;
    let made_by = recording.header().value("version").to_owned();
    let mut report = Report { recorded: recording.maps(), made_by, ..Report::default() };
    let mut losses = 0;
    while let Some(message) = recording.next() {
        let losses_before = std::mem::replace(&mut losses, recording.loss_count());
        if losses > losses_before {
            replays.iter_mut().for_each(|replay| replay.lose_events(&mut report));
        }
        replay_message(&mut replays, message?, boot_id, &mut report)?;
    }
    report.cut = recording.is_cut();
    report.damages = recording.damages();
    report.incomplete = recording.incomplete();
    report.repaired = recording.repaired().to_vec();
    if boot_id != stated_boot_id && report.repaired.is_empty() {
        let differs = format!("its metadata has the boot id {stated_boot_id}, and its maps have {boot_id}");
        report.incomplete.get_or_insert(differs);
    }
    let mut has_changed = recording.lacks_messages() || recording.loss_count() > 0;
    // After a gap the maps that are computed have other numbers than the recorded maps.
    let is_early = |replay: &VehicleReplay| replay.extra.iter().any(|map| replay.computed.contains_key(map));
    if !has_changed && replays.iter().any(is_early) {
        has_changed = true;
        report.incomplete.get_or_insert("a map stands before its events, so the file was changed".into());
    }
    for replay in &replays {
        replay.end(has_changed || report.dropped > 0 || report.events == 0, &mut report);
    }
    Ok(report)
}

/// Steps or compares the vehicle of a message. A map of an unknown vehicle is a difference.
fn replay_message(
    replays: &mut [VehicleReplay],
    message: RecordedMessage,
    boot_id: u64,
    report: &mut Report,
) -> Result<(), ConfigValueError> {
    let of = |vehicle: &str| replays.iter().position(|replay| *replay.name == *vehicle);
    match message {
        RecordedMessage::Event { vehicle, event } => {
            let Some(index) = of(&vehicle) else { return Ok(()) };
            report.events += 1;
            replays[index].step(&event, boot_id, report);
        }
        RecordedMessage::Keyframe { vehicle, keyframe } => {
            of(&vehicle).map_or(Ok(()), |index| replays[index].apply(&keyframe))?;
        }
        RecordedMessage::Counts(counts) => {
            if let Some(topic) = counts.topics.iter().find(|topic| topic.dropped > 0) {
                report.dropped = counts.topics.iter().map(|topic| topic.dropped).sum();
                report.dropped_because = format!("{}: {}", topic.topic, counts.reason);
            }
            report.is_closed |= counts.closed;
        }
        RecordedMessage::Map { vehicle, layer, bytes } => match of(&vehicle) {
            Some(index) => replays[index].compare(&layer, &bytes, report),
            None => report.add(&vehicle, sequence_and_cells(&bytes).0, &layer, DifferenceKind::Extra),
        },
        RecordedMessage::Digest { vehicle, layer, digest } => match of(&vehicle) {
            Some(index) => replays[index].compare_digest(&layer, digest, report),
            None => {
                let sequence = digest.header.map_or(u64::MAX, |header| header.sequence);
                report.add(&vehicle, sequence, &layer, DifferenceKind::Extra);
            }
        },
        RecordedMessage::Ros { .. } => {}
    }
    Ok(())
}

impl VehicleReplay {
    fn new(vehicle: RecordedVehicle, records: RecordedMaps, is_first_part: bool) -> Result<Self, ConfigValueError> {
        let RecordedVehicle { config, tables } = vehicle;
        let pipeline = Pipeline::new(&config, tables.clone())?;
        Ok(Self {
            name: config.name.as_str().into(),
            tables,
            pipeline: is_first_part.then_some(pipeline),
            warm_up: None,
            valid_ms: config.maps.valid_ms,
            config,
            records,
            next_event: is_first_part.then_some(0),
            lacks_events: false,
            computed: BTreeMap::new(),
            extra: BTreeSet::new(),
            unjudged: 0,
        })
    }

    /// Takes note of a damaged part, which may have had the maps of the newest event.
    fn lose_events(&mut self, report: &mut Report) {
        self.lacks_events = true;
        report.unjudged += std::mem::take(&mut self.computed).len() as u64;
    }

    /// Begins a pipeline for the keyframe, or lets it make the maps from here on.
    fn apply(&mut self, keyframe: &v1::Keyframe) -> Result<(), ConfigValueError> {
        match keyframe.phase() {
            v1::KeyframePhase::WarmUp => {
                self.warm_up = Some(Pipeline::new(&self.config, self.tables.clone())?);
                self.next_event.get_or_insert(keyframe.first_event);
            }
            v1::KeyframePhase::Begin => {
                if let Some(mut pipeline) = self.warm_up.take() {
                    let newest = (keyframe.epoch, keyframe.newest_end_ns);
                    pipeline.take_over(Handover::from_recording(keyframe.next_map, newest, &keyframe.refused));
                    (self.pipeline, self.lacks_events) = (Some(pipeline), false);
                }
            }
            v1::KeyframePhase::Unspecified => {}
        }
        Ok(())
    }

    /// Steps the pipelines with an event and keeps the map that it completes. The reader of the file reports missing
    /// events.
    fn step(&mut self, event: &Event, boot_id: u64, report: &mut Report) {
        if let Some(warm_up) = &mut self.warm_up {
            // Refused as it was in the recorded run.
            let _ = warm_up.step(event);
        }
        let expected = self.next_event.unwrap_or(event.sequence);
        // An event that is repeated for a keyframe was processed before.
        if event.sequence < expected {
            return;
        }
        self.next_event = Some(event.sequence.saturating_add(1));
        if event.sequence > expected {
            (self.lacks_events, self.warm_up) = (true, None);
        }
        let Some(pipeline) = &mut self.pipeline else { return };
        if let Ok(Some(map)) = pipeline.step(event) {
            let map = EncodedMap::new(map, self.name.clone(), boot_id, self.valid_ms);
            report.maps += 1;
            let recorded = map.layers.iter().filter(|_| self.records != RecordedMaps::None);
            for (layer, chunk) in recorded {
                self.computed.insert((map.sequence, (*layer).to_owned()), map.layer(chunk));
            }
        }
    }

    /// Compares a recorded layer with the computed one.
    fn compare(&mut self, layer: &str, bytes: &Bytes, report: &mut Report) {
        let (sequence, cells) = sequence_and_cells(bytes);
        let computed = self.computed.remove(&(sequence, layer.to_owned()));
        report.cells += if computed.is_some() { cells } else { 0 };
        match computed.map(|computed| as_served(computed, bytes)) {
            Some(computed) if computed == *bytes => report.equal += 1,
            _ if self.lacks_events || self.pipeline.is_none() || self.records == RecordedMaps::None => {
                (self.unjudged, report.unjudged) = (self.unjudged + 1, report.unjudged + 1);
            }
            None => _ = self.extra.insert((sequence, layer.to_owned())),
            Some(computed) => report.add(&self.name, sequence, layer, first_difference(bytes, &computed)),
        }
    }

    /// Compares a recorded digest with the computed layer's digest.
    fn compare_digest(&mut self, layer: &str, digest: v1::MapDigest, report: &mut Report) {
        let v1::MapDigest { header, sha256: recorded } = digest;
        let sequence = header.as_ref().map_or(u64::MAX, |header| header.sequence);
        let computed = self.computed.remove(&(sequence, layer.to_owned()));
        report.cells += computed.as_ref().map_or(0, |computed| sequence_and_cells(computed).1);
        match computed.map(|computed| sha256(&as_served_with(computed, header))) {
            Some(computed) if computed == recorded => report.equal += 1,
            _ if self.lacks_events || self.pipeline.is_none() || self.records == RecordedMaps::None => {
                (self.unjudged, report.unjudged) = (self.unjudged + 1, report.unjudged + 1);
            }
            None => _ = self.extra.insert((sequence, layer.to_owned())),
            Some(computed) => {
                let hex = |bytes: &Bytes| bytes.iter().map(|byte| format!("{byte:02x}")).collect::<String>();
                let (recorded, computed) = (hex(&recorded), hex(&computed));
                report.add(
                    &self.name,
                    sequence,
                    layer,
                    DifferenceKind::Field { field: "sha256".into(), recorded, computed },
                );
            }
        }
    }

    /// Judges the maps that are only recorded or only computed. They are no differences if the file `lacks_messages`,
    /// as one with maps alone does.
    fn end(&self, lacks_messages: bool, report: &mut Report) {
        let is_unjudged = self.lacks_events || lacks_messages;
        for (sequence, layer) in &self.extra {
            match is_unjudged {
                true => report.unjudged += 1,
                false => report.add(&self.name, *sequence, layer, DifferenceKind::Extra),
            }
        }
        // The recorder writes an event before its map, so a cut can remove only the map of the last event.
        let tail = self.computed.last_key_value().map(|((sequence, _), _)| *sequence);
        let mut unrecorded = 0_u64;
        for (sequence, layer) in self.computed.keys() {
            if report.cut && Some(*sequence) == tail {
                report.beyond_cut += 1;
            } else if is_unjudged {
                unrecorded += 1;
            } else {
                report.add(&self.name, *sequence, layer, DifferenceKind::Missing);
            }
        }
        // After missing events a map has another sequence than it was recorded with, and is counted as recorded.
        report.unjudged += unrecorded.saturating_sub(self.unjudged);
    }
}

/// The sequence of a recorded map of one layer and the number of its cells; `u64::MAX` for an unreadable map, which
/// then counts as extra.
fn sequence_and_cells(bytes: &Bytes) -> (u64, u64) {
    let Ok(map) = v1::Map::decode(bytes.clone()) else { return (u64::MAX, 0) };
    let channels = map.layers.first().map(|layer| &layer.channels[..]).unwrap_or_default();
    let cells = channels.first().map_or(0, |channel| channel.cell_count.into());
    (map.header.map_or(u64::MAX, |header| header.sequence), cells)
}
