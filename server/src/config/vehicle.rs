//! `[[vehicle]]`: its sensors and maps, and the doors its events come through.

use clearway_mapping::config::{BodyConfig, FusionConfig, MapsConfig, SensorConfig, VehicleConfig};
use serde::{Deserialize, Serialize};

use super::{Ros, Udp, Wrong};

/// One `[[vehicle]]`: its sensors and maps, and the doors its events come through.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Vehicle {
    /// Names the vehicle in keys and topics: `[a-z0-9_-]+`.
    pub name: String,
    /// Events that may wait for the engine; more are counted as lost.
    #[serde(default = "queue")]
    pub queue: usize,
    /// The UDP door; a vehicle without one is fed by other doors.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub udp: Option<Udp>,
    /// The ROS 2 door, through rmw_zenoh's key space.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub ros: Option<Ros>,
    /// Observations over gRPC and zenoh.
    #[serde(default)]
    pub ingest: Ingest,
    /// How one map is made of several sensors.
    #[serde(default)]
    pub fusion: FusionConfig,
    /// Where the vehicle itself is; nothing is taken for it where absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub body: Option<BodyConfig>,
    /// Which maps are made, and how.
    #[serde(default)]
    pub maps: MapsConfig,
    /// The sensors.
    #[serde(rename = "sensor")]
    pub sensors: Vec<SensorConfig>,
}

fn queue() -> usize {
    8192
}

impl Vehicle {
    /// What the core needs of it.
    pub fn core(&self) -> VehicleConfig {
        VehicleConfig {
            name: self.name.clone(),
            sensors: self.sensors.clone(),
            fusion: self.fusion.clone(),
            body: self.body,
            maps: self.maps.clone(),
        }
    }
}

/// `[vehicle.ingest]`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Ingest {
    /// Whether anybody may send scans, poses, roads and packets.
    pub enabled: bool,
    /// Points of one scan; the longest message follows from it.
    pub points_max: usize,
    /// Streams at once; each may have its share of half the queue on the way.
    pub streams_max: usize,
}

impl Default for Ingest {
    fn default() -> Self {
        Self { enabled: true, points_max: 2_000_000, streams_max: 8 }
    }
}

impl Vehicle {
    pub(super) fn check(&self, zenoh_enabled: bool) -> Result<(), Wrong> {
        if let Err(error) = self.core().validate() {
            return Err(Wrong::new(format!("{} (of {})", error.key, self.name), &error.value, error.allowed));
        }
        let at = |key: &str| format!("vehicle.{key} (of {})", self.name);
        if !(16..=1 << 20).contains(&self.queue) {
            return Err(Wrong::new(at("queue"), self.queue, "16 to 1048576 events"));
        }
        if let Some(ros) = &self.ros {
            ros.check(zenoh_enabled, &self.sensors).map_err(|wrong| Wrong { key: at(&wrong.key), ..wrong })?;
        }
        let Ingest { points_max, streams_max, .. } = self.ingest;
        if !(1000..=20_000_000).contains(&points_max) {
            return Err(Wrong::new(at("ingest.points_max"), points_max, "1000 to 20000000 points"));
        }
        if !(1..=64).contains(&streams_max) {
            return Err(Wrong::new(at("ingest.streams_max"), streams_max, "1 to 64 streams"));
        }
        Ok(())
    }
}
