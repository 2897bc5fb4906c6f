//! A recording -> the configuration of the recorded run; and with it, the verification of the recording.

use std::path::Path;

use clearway_journal::RecordedVehicle;
use clearway_journal::reader::{RecordingError, RecordingReader};
use clearway_journal::verify::{Report, VerifyError};
use clearway_mapping::config::TimeConfig;
use tracing::warn;

use crate::config::{Calibrations, Config};

/// The configuration of the recorded run, and its calibration tables as [`Config::calibrations`] returns them.
///
/// # Errors
/// [`RecordingError::NoConfig`] if the recording has no configuration, [`RecordingError::Config`] if it is invalid,
/// [`RecordingError::Calibration`] if a table that it names is missing or invalid.
pub fn run_config(recording: &RecordingReader) -> Result<(Config, Calibrations), RecordingError> {
    let mut config = recorded_config(recording, &[])?;
    use_rules_of_the_run(&mut config, recording.config_text()?);
    let tables = config
        .vehicles
        .iter()
        .map(|vehicle| vehicle.sensors.iter().map(|sensor| recording.table(&vehicle.name, sensor)).collect())
        .collect::<Result<_, _>>()?;
    Ok((config, tables))
}

/// The configuration of the recorded run with some of its keys set to other values. A key that is a constant of this
/// version is left out, and a warning names it if its recorded value is another value.
///
/// # Errors
/// [`RecordingError::NoConfig`] if the recording has no configuration, [`RecordingError::Config`] if it is invalid.
pub fn recorded_config(recording: &RecordingReader, set: &[String]) -> Result<Config, RecordingError> {
    let (text, changed) = without_removed_keys(recording.config_text()?);
    for key in changed {
        warn!("{}: {key}: its maps may differ", recording.file().display());
    }
    let file = recording.file().join("config.toml");
    Config::parse(&text, &file, set).map_err(|error| RecordingError::Config(error.into()))
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

/// Keys of `[vehicle.maps]` that earlier versions had and that are constants now: table, key, value.
const CONSTANTS: [(&str, &str, &str); 67] = [
    ("height_difference", "range_m_max", "60"),
    ("height_difference", "columns", "360"),
    ("height_difference", "difference_m_max", "0.25"),
    ("speed", "outside_corridor_mps", "0"),
    ("speed", "step_m_max", "0.2"),
    ("speed", "grade_max", "0.2"),
    ("speed", "smooth_m", "0.03"),
    ("speed", "rough_m", "0.15"),
    ("speed", "roughness_smooth", "0.002"),
    ("speed", "roughness_rough", "0.01"),
    ("speed", "rough_share", "0.5"),
    ("speed", "bonus_reach_m", "4"),
    ("speed", "road_age_ms_max", "500"),
    ("speed", "divergence_min", "0.1"),
    ("speed", "route_ahead_m", "30"),
    ("speed", "curvature_per_m_max", "0.05"),
    ("speed", "overhang_m", "2.5"),
    ("speed", "unknown_mps", "1"),
    ("speed", "crawl_mps", "2"),
    ("speed", "bonus_mps", "8"),
    ("speed", "corridor", "true"),
    ("speed", "speed_limits", "true"),
    ("occupancy", "clear_height_m_min", "0.2"),
    ("occupancy", "clear_height_m_max", "0.5"),
    ("occupancy", "speed_mps_slow", "4.4"),
    ("occupancy", "speed_mps_fast", "26.8"),
    ("occupancy", "hits_slow", "20"),
    ("occupancy", "hits_fast", "2"),
    ("occupancy", "hold_maps", "2"),
    ("occupancy", "calm_maps", "5"),
    ("occupancy", "hits", "reduced"),
    ("occupancy", "overhang_m", "5"),
    ("occupancy", "range_m_max", "150"),
    ("occupancy", "clearance_m", "0.3"),
    ("occupancy", "no_return_m", "0"),
    ("drivability", "overhang_m", "2.5"),
    ("drivability", "unit_height_m", "0.25"),
    ("drivability", "offset_m", "0.125"),
    ("drivability", "seed", "blind_zone"),
    ("drivability", "blind_zone_m", "7"),
    ("drivability", "bridge_rows", "2"),
    ("drivability", "close_gaps", "true"),
    ("drivability", "step_m_max", "0.15"),
    ("drivability", "grade_max", "0.2"),
    ("drivability", "plane_error_m_max", "0.25"),
    ("drivability", "plane_test", "each_side"),
    ("drivability", "passage_m_min", "3"),
    ("drivability", "passage", "to_drivable_ground"),
    ("terrain", "overhang_m", "2.5"),
    ("terrain", "flatness_m2_max", "0.005"),
    ("terrain", "points_min", "3"),
    ("terrain", "residual_m_max", "0.15"),
    ("terrain", "grade_max", "0.2"),
    ("terrain", "step_m_max", "0.25"),
    ("terrain", "inference_m_max", "3"),
    ("terrain", "noise_m", "0.02"),
    ("terrain", "roughness_points_min", "4"),
    ("safe_path", "blind_zone_m", "7"),
    ("safe_path", "hole_m_max", "1"),
    ("safe_path", "join_m_max", "15"),
    ("memory", "range_m_max", "25"),
    ("memory", "ground_s_max", "5"),
    ("memory", "obstacle_s_max", "0.3"),
    ("motion", "enabled", "true"),
    ("motion", "extrapolation_ms", "200"),
    ("motion", "speed_age_ms", "2000"),
    ("reach", "step_slope_min", "0.5"),
];

/// Keys of other tables that earlier versions had. They changed no map that is computed again.
const REMOVED: [(&str, &str); 11] = [
    ("recorder", "queue"),
    ("grpc", "connections_max"),
    ("page", "connections_max"),
    ("connections", "kept"),
    ("connections", "calls_max"),
    ("connections", "calls_per_address_max"),
    ("recorder", "chunk_kb"),
    ("recorder", "compression"),
    ("traces", "one_in"),
    ("connections", "idle_s"),
    ("connections", "stalled_s"),
];

/// Keys of the tables of a vehicle that earlier versions had. They decided which events came, and change none.
const REMOVED_OF_VEHICLE: [(&str, &str); 4] =
    [("udp", "receive_buffer_bytes"), ("ros", "tf_static"), ("ingest", "streams_max"), ("ingest", "ahead_ms_max")];

/// The text of a recorded configuration without the keys that this version does not have, and a sentence for each of
/// them whose recorded value is not the constant of this version.
fn without_removed_keys(text: &str) -> (String, Vec<String>) {
    let Ok(mut document) = text.parse::<toml::Table>() else { return (text.to_owned(), Vec::new()) };
    for (table, key) in REMOVED {
        remove(document.get_mut(table), key);
    }
    let mut changed = Vec::new();
    for vehicle in document.get_mut("vehicle").and_then(toml::Value::as_array_mut).into_iter().flatten() {
        for (table, key) in REMOVED_OF_VEHICLE {
            remove(vehicle.get_mut(table), key);
        }
        let Some(maps) = vehicle.get_mut("maps") else { continue };
        for (table, key, constant) in CONSTANTS {
            let Some(recorded) = remove(maps.get_mut(table), key) else { continue };
            if !is_same_value(&recorded, constant) {
                changed.push(format!("vehicle.maps.{table}.{key} = {recorded} is the constant {constant} now"));
            }
        }
    }
    (document.to_string(), changed)
}

/// Removes a key from a table that may not be there.
fn remove(table: Option<&mut toml::Value>, key: &str) -> Option<toml::Value> {
    table?.as_table_mut()?.remove(key)
}

/// True if a recorded value is a constant: numbers are compared as 32-bit ones, as the layers have them.
fn is_same_value(recorded: &toml::Value, constant: &str) -> bool {
    match recorded {
        toml::Value::Integer(number) => constant.parse() == Ok(*number as f32),
        toml::Value::Float(number) => constant.parse() == Ok(*number as f32),
        toml::Value::String(text) => text == constant,
        other => other.to_string() == constant,
    }
}

/// Sets the rules of a run that was recorded before they could be configured. A recorded configuration is complete, so
/// its program did not have a table that it lacks.
fn use_rules_of_the_run(config: &mut Config, text: &str) {
    let document: toml::Table = text.parse().unwrap_or_default();
    let recorded = document.get("vehicle").and_then(toml::Value::as_array).into_iter().flatten();
    for (vehicle, recorded) in config.vehicles.iter_mut().zip(recorded) {
        if recorded.get("time").is_none() {
            vehicle.time = TimeConfig::WITHOUT_EPOCHS;
        }
        if recorded.get("maps").is_some_and(|maps| maps.get("freespace").is_none()) {
            vehicle.maps.freespace.enabled = false;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_removed_key_is_read_and_named_if_its_value_is_not_the_constant() {
        let mut document: toml::Table = Config::of_one_vehicle("car", "top").to_toml().parse().unwrap();
        let speed = document["vehicle"][0]["maps"]["speed"].as_table_mut().unwrap();
        speed.insert("smooth_m".into(), 0.03.into());
        speed.insert("rough_m".into(), 0.25.into());
        document["recorder"].as_table_mut().unwrap().insert("chunk_kb".into(), 16.into());
        document["vehicle"][0]["ingest"].as_table_mut().unwrap().insert("streams_max".into(), 4.into());
        let (text, changed) = without_removed_keys(&document.to_string());
        assert_eq!(changed, ["vehicle.maps.speed.rough_m = 0.25 is the constant 0.15 now"]);
        Config::parse(&text, Path::new("config.toml"), &[]).unwrap();
    }

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
