//! Verifies a recording: are the recorded maps the maps of the recorded events?
//!
//! Builds every vehicle's pipeline from the recorded configuration and calibrations, steps it with all events of the
//! journal, and compares the bytes of each map with those of the recorded map, or their digest with the recorded one.
//! At a keyframe a new pipeline replaces the old one, as it did in the recorded run. Maps that follow from events which
//! the file lacks are counted as unjudged: those after a gap, until the next keyframe. An event or a map that is not in
//! its place says that the file has changed, not that a map differs.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;

use bytes::Bytes;
use clearway_lidar::calibration::Calibration;
use clearway_mapping::config::{ConfigValueError, VehicleConfig};
use clearway_mapping::event::Event;
use clearway_mapping::pipeline::{Handover, Pipeline};
use clearway_proto::v1;
use prost::Message;
use serde_json::{Value, json};

use crate::base::counted::counted;
use crate::config::RecordedMaps;
use crate::encode::{EncodedMap, as_served, as_served_with};
use crate::record::damage::Damage;
use crate::record::mcap_file::sha256;
use crate::record::reader::{Beginning, RecordedMessage, RecordingError, RecordingReader};

mod difference;
mod disorder;

use difference::first_difference;
pub use difference::{Difference, DifferenceKind};
pub use disorder::Disorder;

/// Greatest number of differences, and of places out of order, in a report; all are counted. Ours: the first ones
/// explain the others.
const DIFFERENCES_MAX: usize = 20;

/// The result of a verification.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Report {
    /// Number of events of all journals.
    pub events: u64,
    /// What the recording holds of the maps. Without any, only its events are checked.
    pub recorded: RecordedMaps,
    /// Number of recorded maps or digests, of one layer each, that equal those of the computed map byte for byte.
    pub equal: u64,
    /// Number of maps computed from the events.
    pub maps: u64,
    /// Number of cells of the recorded maps that have a computed map: those of their layers' grids.
    pub cells: u64,
    /// True if a crash cut the file; then the part before the cut is verified.
    pub cut: bool,
    /// Number of maps, of one layer each, that belong to the last event before the cut and are not recorded.
    pub beyond_cut: u64,
    /// Number of layers of maps that follow from events which the file lacks, and which do not equal the computed layer
    /// or are not recorded. They cannot be judged.
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
    /// What `clearway repair` could not read of the damaged file, if it wrote this one. The events and maps that are
    /// lost there are no differences.
    pub repaired: Vec<String>,
    /// The first differences.
    pub differences: Vec<Difference>,
    /// Number of all differences.
    pub different: u64,
    /// The first events and maps that do not stand in their place: behind a gap, behind a later one, or twice.
    pub disorder: Vec<Disorder>,
    /// Number of all of these.
    pub disordered: u64,
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
            "dropped": self.dropped, "dropped_because": self.dropped_because,
            "damage": self.damages.iter().map(Damage::to_json).collect::<Vec<_>>(), "repaired": self.repaired,
            "differences": self.differences.iter().map(Difference::to_json).collect::<Vec<_>>(),
            "disorder": self.disorder.iter().map(Disorder::to_json).collect::<Vec<_>>(), "disordered": self.disordered,
        })
    }

    fn add(&mut self, vehicle: &str, sequence: u64, layer: &str, kind: DifferenceKind) {
        self.different += 1;
        if self.differences.len() < DIFFERENCES_MAX {
            self.differences.push(Difference { vehicle: vehicle.into(), sequence, layer: layer.into(), kind });
        }
    }

    fn add_disorder(&mut self, disorder: Disorder) {
        self.disordered += 1;
        if self.disorder.len() < DIFFERENCES_MAX {
            self.disorder.push(disorder);
        }
    }

    /// How the file is incomplete by its order alone. What the recorder has dropped, or what a repair could not read,
    /// leaves a gap that is told already.
    fn why_disordered(&self) -> Option<String> {
        let first = self.disorder.first().filter(|_| self.dropped == 0 && self.repaired.is_empty())?;
        let places = counted(self.disordered, "place");
        Some(format!("its messages are not as they were written in {places}, the first: {first}"))
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
    /// Sequence of the next event of the maps; `None` before the first one.
    next_event: Option<u64>,
    /// Sequence of the event that follows the newest one of the file, which may be an earlier one.
    next_of_file: Option<u64>,
    /// True while a keyframe repeats the events that are in force.
    repeats: bool,
    /// Sequence of the newest map that was compared, by layer.
    newest_maps: BTreeMap<String, u64>,
    /// True if events are missing before this one, until the next keyframe; the maps need not equal the computed ones.
    lacks_events: bool,
    /// Computed maps that are not compared yet, by sequence and layer.
    computed: BTreeMap<(u64, String), Bytes>,
}

/// Verifies a recording. A map that differs and a damaged part are no errors; the [`Report`] contains them.
///
/// # Errors
/// [`VerifyError::Recording`] if the file is not a recording or cannot be read, [`VerifyError::Config`] if its
/// configuration is invalid.
pub fn verify(file: &Path) -> Result<Report, VerifyError> {
    let mut recording = RecordingReader::open(file)?;
    let beginning = if recording.maps() == RecordedMaps::None { Beginning::default() } else { Beginning::of(file)? };
    let stated_boot_id = recording.header().boot_id;
    let boot_id = beginning.boot_id.unwrap_or(stated_boot_id);
    let (config, tables) = recording.config()?;
    let mut replays = Vec::new();
    let is_first_part = recording.part().map_or(beginning.first_event == Some(0), |part| part == 1);
    for (vehicle, tables) in config.vehicles.iter().zip(tables) {
        let config = vehicle.core();
        let pipeline = Pipeline::new(&config, tables.clone())?;
        replays.push(VehicleReplay {
            name: vehicle.name.as_str().into(),
            config,
            tables,
            pipeline: is_first_part.then_some(pipeline),
            warm_up: None,
            valid_ms: vehicle.maps.valid_ms,
            records: recording.maps(),
            next_event: is_first_part.then_some(0),
            next_of_file: is_first_part.then_some(0),
            repeats: false,
            newest_maps: BTreeMap::new(),
            lacks_events: false,
            computed: BTreeMap::new(),
        });
    }
    let mut report = Report { recorded: recording.maps(), ..Report::default() };
    let mut losses = 0;
    while let Some(message) = recording.next() {
        let losses_before = std::mem::replace(&mut losses, recording.loss_count());
        if losses > losses_before {
            for replay in &mut replays {
                // The damaged part may have had the maps of the newest event.
                replay.lacks_events = true;
                report.unjudged += std::mem::take(&mut replay.computed).len() as u64;
            }
        }
        match message? {
            RecordedMessage::Event { vehicle, event } => {
                let Some(replay) = replays.iter_mut().find(|r| *r.name == *vehicle) else { continue };
                report.events += 1;
                replay.step(&event, boot_id, &mut report, recording.loss_count() > 0);
            }
            RecordedMessage::Keyframe { vehicle, keyframe } => {
                let Some(replay) = replays.iter_mut().find(|r| *r.name == *vehicle) else { continue };
                replay.apply(&keyframe)?;
            }
            RecordedMessage::Counts(counts) => {
                if let Some(topic) = counts.topics.iter().find(|topic| topic.dropped > 0) {
                    report.dropped = counts.topics.iter().map(|topic| topic.dropped).sum();
                    report.dropped_because = format!("{}: {}", topic.topic, counts.reason);
                }
                report.is_closed |= counts.closed;
            }
            RecordedMessage::Map { vehicle, layer, bytes } => {
                let Some(replay) = replays.iter_mut().find(|r| *r.name == *vehicle) else {
                    report.add(&vehicle, sequence_and_cells(&bytes).0, &layer, DifferenceKind::Extra);
                    continue;
                };
                replay.compare(&layer, &bytes, &mut report);
            }
            RecordedMessage::Digest { vehicle, layer, digest } => {
                let Some(replay) = replays.iter_mut().find(|r| *r.name == *vehicle) else {
                    let sequence = digest.header.map_or(u64::MAX, |header| header.sequence);
                    report.add(&vehicle, sequence, &layer, DifferenceKind::Extra);
                    continue;
                };
                replay.compare_digest(&layer, digest, &mut report);
            }
            RecordedMessage::Ros { .. } => {}
        }
    }
    report.cut = recording.is_cut();
    report.damages = recording.damages();
    report.incomplete = recording.incomplete();
    report.repaired = recording.repaired().to_vec();
    if boot_id != stated_boot_id && report.repaired.is_empty() {
        let differs = format!("its metadata has the boot id {stated_boot_id}, and its maps have {boot_id}");
        report.incomplete.get_or_insert(differs);
    }
    if let Some(disorder) = report.why_disordered() {
        report.incomplete.get_or_insert(disorder);
    }
    // Then the messages were written, and something else has changed the file later.
    let has_changed = recording.missing_messages() > 0 || recording.loss_count() > 0 || report.disordered > 0;
    for replay in &replays {
        // The recorder writes an event before its map, so a cut can remove only the map of the last event.
        let tail = replay.computed.last_key_value().map(|((sequence, _), _)| *sequence);
        for (sequence, layer) in replay.computed.keys() {
            if report.cut && Some(*sequence) == tail {
                report.beyond_cut += 1;
            } else if replay.lacks_events || has_changed {
                report.unjudged += 1;
            } else {
                report.add(&replay.name, *sequence, layer, DifferenceKind::Missing);
            }
        }
    }
    Ok(report)
}

impl VehicleReplay {
    /// Begins a pipeline for the keyframe, or lets it make the maps from here on.
    fn apply(&mut self, keyframe: &v1::Keyframe) -> Result<(), ConfigValueError> {
        match keyframe.phase() {
            v1::KeyframePhase::WarmUp => {
                self.warm_up = Some(Pipeline::new(&self.config, self.tables.clone())?);
                self.next_event.get_or_insert(keyframe.first_event);
                self.next_of_file.get_or_insert(keyframe.first_event);
                self.repeats = true;
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

    /// Steps the pipelines with an event and keeps the map that it completes. Events that are missing in a damaged file
    /// are no difference: the damage is reported.
    fn step(&mut self, event: &Event, boot_id: u64, report: &mut Report, is_damaged: bool) {
        if let Some(warm_up) = &mut self.warm_up {
            // Refused as it was in the recorded run.
            let _ = warm_up.step(event);
        }
        let expected = self.next_event.unwrap_or(event.sequence);
        self.repeats &= event.sequence < expected;
        if self.repeats {
            return;
        }
        let place = self.next_of_file.replace(event.sequence.saturating_add(1)).unwrap_or(event.sequence);
        if event.sequence != place && !(is_damaged && self.lacks_events) {
            let (vehicle, found) = (self.name.to_string(), event.sequence);
            report.add_disorder(Disorder::Event { vehicle, expected: place, found });
        }
        // One that was processed before.
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

    /// The computed layer of this sequence, if there is one; `None` for a map that is in the file again.
    fn computed_of(&mut self, layer: &str, sequence: u64, report: &mut Report) -> Option<Option<Bytes>> {
        let computed = self.computed.remove(&(sequence, layer.to_owned()));
        if computed.is_some() {
            self.newest_maps.insert(layer.to_owned(), sequence);
        } else if self.newest_maps.get(layer).is_some_and(|newest| sequence <= *newest) {
            let (vehicle, layer) = (self.name.to_string(), layer.to_owned());
            report.add_disorder(Disorder::Map { vehicle, layer, sequence });
            return None;
        }
        Some(computed)
    }

    /// Compares a recorded layer with the computed one.
    fn compare(&mut self, layer: &str, bytes: &Bytes, report: &mut Report) {
        let (sequence, cells) = sequence_and_cells(bytes);
        let Some(computed) = self.computed_of(layer, sequence, report) else { return };
        report.cells += if computed.is_some() { cells } else { 0 };
        match computed.map(|computed| as_served(computed, bytes)) {
            Some(computed) if computed == *bytes => report.equal += 1,
            _ if self.lacks_events || self.pipeline.is_none() => report.unjudged += 1,
            None => report.add(&self.name, sequence, layer, DifferenceKind::Extra),
            Some(computed) => report.add(&self.name, sequence, layer, first_difference(bytes, &computed)),
        }
    }

    /// Compares a recorded digest with that of the computed layer.
    fn compare_digest(&mut self, layer: &str, digest: v1::MapDigest, report: &mut Report) {
        let v1::MapDigest { header, sha256: recorded } = digest;
        let sequence = header.as_ref().map_or(u64::MAX, |header| header.sequence);
        let Some(computed) = self.computed_of(layer, sequence, report) else { return };
        report.cells += computed.as_ref().map_or(0, |computed| sequence_and_cells(computed).1);
        match computed.map(|computed| sha256(&as_served_with(computed, header))) {
            Some(computed) if computed == recorded => report.equal += 1,
            _ if self.lacks_events || self.pipeline.is_none() => report.unjudged += 1,
            None => report.add(&self.name, sequence, layer, DifferenceKind::Extra),
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
}

/// The sequence of a recorded map of one layer and the number of its cells; `u64::MAX` for an unreadable map, which
/// then counts as extra.
fn sequence_and_cells(bytes: &Bytes) -> (u64, u64) {
    let Ok(map) = v1::Map::decode(bytes.clone()) else { return (u64::MAX, 0) };
    let channels = map.layers.first().map(|layer| &layer.channels[..]).unwrap_or_default();
    let cells = channels.first().map_or(0, |channel| channel.cell_count.into());
    (map.header.map_or(u64::MAX, |header| header.sequence), cells)
}
