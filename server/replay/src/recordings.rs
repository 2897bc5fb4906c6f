//! Files that are recordings of this server: their vehicles, and whether a configuration fits them.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use clearway_daemon::config::{Calibrations, Config, Vehicle};
use clearway_daemon::record::run_config;
use clearway_journal::reader::RecordingReader;

use super::error::ReplayError;
use super::options::ReplayOptions;
use crate::files::{Kind, Readings};

/// A recording of this server.
pub(super) struct Recorded {
    /// Path of the recording.
    pub file: PathBuf,
    /// The recorded configuration.
    pub config: Config,
    /// The recorded calibration tables, by vehicle and sensor.
    pub tables: Calibrations,
    /// Boot id of the recorded maps.
    pub boot_id: u64,
}

/// The recordings, if all files are recordings of this server and they have several vehicles.
pub(super) fn several_vehicles(files: &Readings) -> Result<Option<Vec<Recorded>>, ReplayError> {
    let (mut recordings, mut names) = (Vec::new(), BTreeSet::new());
    for (file, kind) in files.files() {
        if kind != Kind::Mcap {
            return Ok(None);
        }
        let recording = RecordingReader::open(file)?;
        if recording.header().config.is_none() {
            return Ok(None);
        }
        let (config, tables) = run_config(&recording)?;
        names.extend(config.vehicles.iter().map(|vehicle| vehicle.name.clone()));
        recordings.push(Recorded { file: file.to_owned(), config, tables, boot_id: recording.header().boot_id });
    }
    Ok((names.len() > 1).then_some(recordings))
}

/// The recordings of the vehicle that the options name, if some of the files are of other vehicles only; the log names
/// those.
pub(super) fn files_of_vehicle(options: &ReplayOptions, files: &Readings) -> Result<Option<Vec<PathBuf>>, ReplayError> {
    let Some(name) = options.vehicle.as_ref().filter(|_| options.config.is_none()) else { return Ok(None) };
    let recordings = several_vehicles(files)?.unwrap_or_default();
    let has_vehicle = |recording: &Recorded| recording.config.vehicles.iter().any(|vehicle| vehicle.name == *name);
    let (of_vehicle, of_others): (Vec<_>, Vec<_>) = recordings.into_iter().partition(has_vehicle);
    if of_vehicle.is_empty() || of_others.is_empty() {
        return Ok(None);
    }
    for other in of_others {
        tracing::info!(file = %other.file.display(), "left out: it has no vehicle {name}");
    }
    Ok(Some(of_vehicle.into_iter().map(|recording| recording.file).collect()))
}

/// Refuses a configuration whose vehicle or sensors differ from the recording's: events name a sensor by its place.
pub(super) fn check_sensors(file: &Path, config: &Config, recording: &Path) -> Result<(), ReplayError> {
    let recording = RecordingReader::open(recording)?;
    if recording.header().config.is_none() {
        return Ok(());
    }
    let (recorded, _) = run_config(&recording)?;
    let vehicle = &config.vehicles[0];
    let names =
        |vehicle: &Vehicle| vehicle.sensors.iter().map(|sensor| sensor.name.as_str()).collect::<Vec<_>>().join(", ");
    let Some(of_name) = recorded.vehicles.iter().find(|of| of.name == vehicle.name) else {
        let names: Vec<&str> = recorded.vehicles.iter().map(|of| of.name.as_str()).collect();
        let (configured, recorded) = (&vehicle.name, names.join(", "));
        let reason = format!("its vehicle is {configured}, but the recording has {recorded}; the same name is allowed");
        return Err(ReplayError::mismatch(file, reason));
    };
    match (names(vehicle), names(of_name)) {
        (configured, recorded) if configured != recorded => {
            let reason = format!(
                "vehicle {} has the sensors [{configured}], but the recording has [{recorded}]; the same names in the \
                 same order are allowed",
                vehicle.name
            );
            Err(ReplayError::mismatch(file, reason))
        }
        _ => Ok(()),
    }
}
