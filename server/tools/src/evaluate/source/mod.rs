//! Where scans come from whose truth is known.
//!
//! | file | in -> out |
//! |---|---|
//! | [`pairs`] | paths -> scans with their labels |
//! | [`labels`] | labels -> the truth about the points of a scan |
//! | [`objects`] | labelled scans with objects cut into them -> counts |
//! | [`variation`] | a scan -> the same scan of a bent or rolled world, with fewer lasers, from another place |
//! | [`scans`] | labelled scans and their variations -> counts |
//! | [`written`] | a varied scan and its truth -> files for other programs |
//! | [`worlds`] | a simulated scene -> maps, and the truth about their points |
//! | [`random`] | seeds -> counts by type of world |

pub mod labels;
pub mod objects;
pub mod pairs;
pub mod random;
pub mod scans;
pub mod variation;
pub mod worlds;
pub mod written;

use anyhow::Result;
use clearway_daemon::config::Config;
use clearway_lidar::model::Model;
use clearway_mapping::config::{Extrinsics, MapsConfig};
use clearway_mapping::pipeline::Pipeline;
use clearway_mapping::sensor::sweep::Mount;

/// The pipeline of a vehicle with one sensor at these extrinsics, and the sensor's mount. Without a model the scans say
/// the rings of their points.
///
/// # Errors
/// If a value of the configuration is not allowed.
fn pipeline(maps: &MapsConfig, model: Option<Model>, extrinsics: Extrinsics) -> Result<(Pipeline, Mount)> {
    let mut config = Config::of_one_vehicle("car", "top").vehicles.remove(0).core();
    config.maps = maps.clone();
    let sensor = &mut config.sensors[0];
    (sensor.model, sensor.extrinsics) = (model, extrinsics);
    let mount = Mount { ego_from_sensor: extrinsics.ego_from_sensor(), range_m_min: sensor.range_m_min };
    Ok((Pipeline::new(&config, vec![None])?, mount))
}
