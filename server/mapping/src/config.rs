//! One vehicle's sensors and maps, as the configuration file spells them. Units in keys; unknown keys refused.

use serde::{Deserialize, Serialize};

use clearway_lidar::model::Model;

/// One vehicle: all the core needs to turn its events into maps.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct VehicleConfig {
    /// Names the vehicle in keys and topics: `[a-z0-9_-]+`.
    pub name: String,
    /// The sensors; the first one leads: its revolutions make the maps.
    #[serde(rename = "sensor")]
    pub sensors: Vec<SensorConfig>,
    /// Which maps are made, and how.
    #[serde(default)]
    pub maps: MapsConfig,
}

/// One sensor of a vehicle.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SensorConfig {
    /// Unique within the vehicle.
    pub name: String,
    /// Found from the data where absent; for scans: whose elevations the grid's rows come from.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub model: Option<Model>,
    /// Found from the data where absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rpm: Option<f32>,
    /// The sensor's own table: path of a ROS YAML or Velodyne XML file; the factory's where absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub calibration: Option<String>,
    /// Encoder angle at which turns are cut; 180 is behind the vehicle.
    #[serde(default = "behind")]
    pub cut_azimuth_deg: f32,
    /// `ego_from_sensor`: x, y, z in metres, roll, pitch, yaw in degrees.
    pub extrinsics: Extrinsics,
}

fn behind() -> f32 {
    180.0
}

/// `ego_from_sensor`, as people write it. Rotation = Rz(yaw) Ry(pitch) Rx(roll).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Extrinsics {
    /// Forward.
    pub x_m: f64,
    /// Left.
    pub y_m: f64,
    /// Up, over the ground.
    pub z_m: f64,
    /// About x.
    pub roll_deg: f64,
    /// About y; positive looks down.
    pub pitch_deg: f64,
    /// About z, counter-clockwise.
    pub yaw_deg: f64,
}

/// Which maps are made. A map that is absent is not made.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct MapsConfig {
    /// Age after capture at which a map is stale.
    pub valid_ms: u32,
}

impl Default for MapsConfig {
    fn default() -> Self {
        Self { valid_ms: 300 }
    }
}
