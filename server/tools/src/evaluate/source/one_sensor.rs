//! A pipeline of one sensor, as `evaluate` runs it.

use std::path::Path;

use anyhow::{Context, Result};
use clearway_daemon::config::Config;
use clearway_lidar::model::Model;
use clearway_mapping::config::{Extrinsics, MapsConfig};
use clearway_mapping::event::{Body, Event, Scan};
use clearway_mapping::pipeline::Pipeline;
use clearway_mapping::sensor::sweep::Mount;

/// The pipeline of a vehicle with one sensor at these extrinsics, and the sensor's mount. Without a model the scans say
/// the rings of their points.
///
/// # Errors
/// If a value of the configuration is not allowed.
pub(super) fn pipeline(maps: &MapsConfig, model: Option<Model>, extrinsics: Extrinsics) -> Result<(Pipeline, Mount)> {
    let mut config = Config::of_one_vehicle("car", "top").vehicles.remove(0).core();
    config.maps = maps.clone();
    let sensor = &mut config.sensors[0];
    (sensor.model, sensor.extrinsics) = (model, extrinsics);
    let mount = Mount { ego_from_sensor: extrinsics.ego_from_sensor(), range_m_min: sensor.range_m_min };
    Ok((Pipeline::new(&config, vec![None])?, mount))
}

/// Makes the map of a scan.
///
/// # Errors
/// If the scan is refused; the error names its file.
pub(super) fn step(pipeline: &mut Pipeline, scan: Scan, sequence: u64, file: &Path) -> Result<()> {
    let event = Event { sequence, arrival_ns: scan.stamp_ns, source: 0, body: Body::Scan(scan) };
    pipeline.step(&event).with_context(|| file.display().to_string())?;
    Ok(())
}
