//! Two sets of maps of one drive -> what changed: cells by layer and class, gained and lost free space, the maps that
//! changed most.
//!
//! The maps before come from a recording. The maps after are computed from its events with another configuration, or
//! come from another recording. Maps with the same stamp are compared; maps that only one side has are counted.

use std::path::Path;

use clearway_mapping::pipeline::Pipeline;

use computing::Computing;
use pairs::{AFTER, BEFORE, Pairs};

use super::reader::{RecordedMessage, RecordingReader};
use crate::{RecordedMaps, RecordedVehicle};

pub mod change;
mod computing;
mod outcome;
mod pairs;

pub use outcome::{CellChange, CompareError, Comparison, LayerChange, MapChange};

/// Where the maps after the change come from.
pub enum After<'a> {
    /// Maps computed from the recorded events with another configuration.
    Config {
        /// Configuration of each recorded vehicle, in any order; without tables, a vehicle uses the recorded tables.
        given: &'a [RecordedVehicle],
        /// The configuration of each vehicle as recorded, in the recording's order.
        recorded: &'a [RecordedVehicle],
    },
    /// The maps of this recording.
    Recording(&'a Path),
}

/// Compares the maps of the recording `before` with the maps of `after`; keeps the `worst` maps that changed most.
///
/// # Errors
/// [`CompareError::Recording`] if a file cannot be read, [`CompareError::Misfit`] if the configuration names other
/// vehicles or sensors than the recording, [`CompareError::NoMaps`] if two recordings are compared and one has no maps,
/// [`CompareError::Config`] if a configuration is invalid, [`CompareError::Map`] if a map cannot be decoded.
pub fn compare(before: &Path, after: &After<'_>, worst: usize) -> Result<Comparison, CompareError> {
    let mut pairs = Pairs::new(worst);
    let mut recording = RecordingReader::open(before)?;
    match after {
        After::Config { given, recorded } => {
            let boot_id = recording.header().boot_id;
            let vehicles = pipelines(before, boot_id, given, recorded)?;
            // Without recorded maps, the maps of the recorded configuration are computed too.
            let recorded = match recording.maps() {
                RecordedMaps::Full => Vec::new(),
                RecordedMaps::Digest | RecordedMaps::None => pipelines(before, boot_id, recorded, recorded)?,
            };
            push_computed(&mut pairs, before, &mut recording, [recorded, vehicles])?;
            pairs.comparison.incomplete = incomplete(before, &recording);
        }
        After::Recording(after) => {
            let mut sides = [recording, RecordingReader::open(after)?];
            let files = [before, *after];
            push_recorded(&mut pairs, files, &mut sides)?;
            pairs.comparison.incomplete = files.into_iter().zip(&sides).find_map(|(file, side)| incomplete(file, side));
        }
    }
    Ok(pairs.finish())
}

/// The recorded maps, and the maps that the pipelines of both sides make of the events, up to the first missing event.
fn push_computed(
    pairs: &mut Pairs,
    file: &Path,
    recording: &mut RecordingReader,
    mut sides: [Vec<Computing>; 2],
) -> Result<(), CompareError> {
    let losses = recording.loss_count();
    while let Some(message) = recording.next() {
        let message = message?;
        let is_after_gap = matches!(&message, RecordedMessage::Event { vehicle, event }
            if sides[AFTER].iter().any(|of| *of.name == **vehicle && of.lacks_events_before(event)));
        if recording.loss_count() > losses || is_after_gap {
            pairs.comparison.is_ended_by_loss = true;
            break;
        }
        match message {
            RecordedMessage::Event { vehicle, event } => {
                for (side, vehicles) in sides.iter_mut().enumerate() {
                    let Some(computing) = vehicles.iter_mut().find(|v| *v.name == *vehicle) else { continue };
                    for (layer, bytes) in computing.step(&event) {
                        pairs.push(side, file, vehicle.clone(), layer, bytes)?;
                    }
                }
            }
            RecordedMessage::Map { vehicle, layer, bytes } => _ = pairs.push(BEFORE, file, vehicle, layer, bytes)?,
            RecordedMessage::Digest { .. }
            | RecordedMessage::Keyframe { .. }
            | RecordedMessage::Counts(_)
            | RecordedMessage::Ros { .. } => {}
        }
    }
    // How the file ends is known at its end.
    Ok(recording.by_ref().try_for_each(|message| message.map(|_| ()))?)
}

/// The maps of two recordings.
fn push_recorded(pairs: &mut Pairs, files: [&Path; 2], sides: &mut [RecordingReader; 2]) -> Result<(), CompareError> {
    for (file, side) in files.iter().zip(&*sides) {
        if side.maps() != RecordedMaps::Full {
            return Err(CompareError::NoMaps { file: file.to_path_buf(), maps: side.maps() });
        }
    }
    let mut newest_ns = [Some(i64::MIN); 2];
    // The side that is behind is read next, so that few maps wait for their counterpart.
    while let Some(side) = (0..2).filter(|&side| newest_ns[side].is_some()).min_by_key(|&s| newest_ns[s]) {
        newest_ns[side] = loop {
            match sides[side].next().transpose()? {
                None => break None,
                Some(RecordedMessage::Map { vehicle, layer, bytes }) => {
                    break Some(pairs.push(side, files[side], vehicle, layer, bytes)?);
                }
                Some(_) => {}
            }
        };
    }
    Ok(())
}

/// How a recording that was read to its end is incomplete, with its name.
fn incomplete(file: &Path, recording: &RecordingReader) -> Option<String> {
    recording.incomplete().map(|how| format!("{} is not whole: {how}", file.display()))
}

/// The pipelines of a configuration, for the vehicles of a recording.
fn pipelines(
    file: &Path,
    boot_id: u64,
    given: &[RecordedVehicle],
    recorded: &[RecordedVehicle],
) -> Result<Vec<Computing>, CompareError> {
    let names = |vehicles: &[RecordedVehicle]| vehicles.iter().map(|vehicle| vehicle.config.name.clone()).collect();
    let misfit = |what: String, given: Vec<String>, recorded: Vec<String>| {
        let [given, recorded] = [given, recorded].map(|names| names.join(", "));
        CompareError::Misfit { file: file.to_owned(), what, given, recorded }
    };
    let mut vehicles = Vec::new();
    for was in recorded {
        let is = given.iter().find(|vehicle| vehicle.config.name == was.config.name);
        let is = is.ok_or_else(|| misfit("its vehicles are".into(), names(given), names(recorded)))?;
        let [given, known] = [is, was]
            .map(|vehicle| vehicle.config.sensors.iter().map(|sensor| sensor.name.clone()).collect::<Vec<_>>());
        if given != known {
            return Err(misfit(format!("the sensors of vehicle {} are", is.config.name), given, known));
        }
        let tables = if is.tables.is_empty() { &was.tables } else { &is.tables };
        vehicles.push(Computing {
            name: is.config.name.as_str().into(),
            boot_id,
            valid_ms: is.config.maps.valid_ms,
            next_event: 0,
            pipeline: Pipeline::new(&is.config, tables.clone())?,
        });
    }
    Ok(vehicles)
}
