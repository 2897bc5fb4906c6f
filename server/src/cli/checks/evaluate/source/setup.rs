//! The pipeline of a vehicle with one sensor, as evaluations use it.

use clearway_lidar::model::Model;
use clearway_mapping::config::{Extrinsics, MapsConfig};
use clearway_mapping::pipeline::Pipeline;
use clearway_mapping::sensor::sweep::Mount;

use super::super::error::EvaluateError;
use clearway_daemon::config::Config;

/// The sensor that sends the scans.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SensorSetup {
    /// Model whose elevations define the rows of radial maps.
    pub model: Option<Model>,
    /// Elevation of each laser, degrees, in place of a model.
    pub elevations_deg: Vec<f32>,
    /// Position and orientation in the ego frame.
    pub extrinsics: Option<Extrinsics>,
}

/// The pipeline of a vehicle with this sensor at these extrinsics, and the sensor's mount.
///
/// # Errors
/// [`EvaluateError::Maps`] if a value of the configuration is not allowed.
pub fn pipeline(
    maps: &MapsConfig,
    setup: &SensorSetup,
    extrinsics: Extrinsics,
) -> Result<(Pipeline, Mount), EvaluateError> {
    let mut config = Config::of_one_vehicle("car", "top").vehicles.remove(0).core();
    config.maps = maps.clone();
    let sensor = &mut config.sensors[0];
    (sensor.model, sensor.elevations_deg) = (setup.model, setup.elevations_deg.clone());
    sensor.extrinsics = extrinsics;
    let mount = Mount { ego_from_sensor: extrinsics.ego_from_sensor(), range_m_min: sensor.range_m_min };
    Ok((Pipeline::new(&config, vec![None])?, mount))
}
