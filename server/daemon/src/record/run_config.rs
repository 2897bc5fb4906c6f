//! A recording -> the configuration of the recorded run; and with it, the verification of the recording.

use std::path::Path;

use clearway_journal::RecordedVehicle;
use clearway_journal::reader::{RecordingError, RecordingReader};
use clearway_journal::verify::{Report, VerifyError};
use clearway_mapping::config::TimeConfig;

use crate::config::{Calibrations, Config};

/// The configuration of the recorded run, and its calibration tables as [`Config::calibrations`] returns them.
///
/// # Errors
/// [`RecordingError::NoConfig`] if the recording has no configuration, [`RecordingError::Config`] if it is invalid,
/// [`RecordingError::Calibration`] if a table that it names is missing or invalid.
pub fn run_config(recording: &RecordingReader) -> Result<(Config, Calibrations), RecordingError> {
    let text = recording.config_text()?;
    let mut config = Config::parse(text, &recording.file().join("config.toml"), &[])
        .map_err(|error| RecordingError::Config(error.into()))?;
    use_rules_of_the_run(&mut config, text);
    let tables = config
        .vehicles
        .iter()
        .map(|vehicle| vehicle.sensors.iter().map(|sensor| recording.table(&vehicle.name, sensor)).collect())
        .collect::<Result<_, _>>()?;
    Ok((config, tables))
}

/// The vehicles of a configuration with their calibration tables.
pub fn recorded_vehicles(config: &Config, tables: Calibrations) -> Vec<RecordedVehicle> {
    let configs = config.vehicles.iter().map(|vehicle| vehicle.core());
    configs.zip(tables).map(|(config, tables)| RecordedVehicle { config, tables }).collect()
}

/// Verifies a recording with its own configuration ([`clearway_journal::verify::verify`]).
///
/// # Errors
/// [`VerifyError`] if the file is not a recording or cannot be read, or if its configuration is invalid.
pub fn verify(file: &Path) -> Result<Report, VerifyError> {
    let recording = RecordingReader::open(file)?;
    let (config, tables) = run_config(&recording)?;
    clearway_journal::verify::verify(recording, recorded_vehicles(&config, tables))
}

/// Sets the rules of a run that was recorded before they could be configured. A recorded configuration is complete, so
/// a table that it lacks is one that its program did not have.
fn use_rules_of_the_run(config: &mut Config, text: &str) {
    let document: toml::Table = text.parse().unwrap_or_default();
    let recorded = document.get("vehicle").and_then(toml::Value::as_array).into_iter().flatten();
    for (vehicle, recorded) in config.vehicles.iter_mut().zip(recorded) {
        if recorded.get("time").is_none() {
            vehicle.time = TimeConfig::WITHOUT_EPOCHS;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_recording_of_a_program_without_epochs_is_replayed_without_epochs() {
        let mut config = Config::of_one_vehicle("car", "top");
        let text = config.to_toml();
        use_rules_of_the_run(&mut config, &text);
        assert_eq!(config.vehicles[0].time, TimeConfig::default());
        let mut document: toml::Table = text.parse().unwrap();
        let vehicle = document["vehicle"][0].as_table_mut().unwrap();
        assert!(vehicle.remove("time").is_some(), "a recorded configuration is complete");
        use_rules_of_the_run(&mut config, &document.to_string());
        assert_eq!(config.vehicles[0].time, TimeConfig::WITHOUT_EPOCHS);
    }
}
