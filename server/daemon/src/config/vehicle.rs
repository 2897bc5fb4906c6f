//! The table `[[vehicle]]`: its sensors and maps, and where its events come from.

use clearway_mapping::config::{BodyConfig, FusionConfig, MapsConfig, SensorConfig, TimeConfig, VehicleConfig};
use serde::{Deserialize, Serialize};

use super::error::ValueError;
use super::ros::Ros;
use super::udp::Udp;

/// One table `[[vehicle]]`: its sensors and maps, and where its events come from.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Vehicle {
    /// Name of the vehicle in keys and topics: `[a-z0-9_-]+`.
    pub name: String,
    /// Events that may wait for the engine; more are counted as lost.
    #[serde(default = "queue")]
    pub queue: usize,
    /// Datagrams over UDP; without it the vehicle listens on no socket.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub udp: Option<Udp>,
    /// ROS 2 topics, through rmw_zenoh's key space.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub ros: Option<Ros>,
    /// Observations over gRPC and zenoh.
    #[serde(default)]
    pub ingest: Ingest,
    /// How stamps follow the clocks.
    #[serde(default)]
    pub time: TimeConfig,
    /// How the scans of several sensors are merged.
    #[serde(default)]
    pub fusion: FusionConfig,
    /// Outline of the vehicle, for the self filter; without it no return is removed.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub body: Option<BodyConfig>,
    /// Which layers are made, and with which parameters.
    #[serde(default)]
    pub maps: MapsConfig,
    /// The sensors, in the order in which events name them.
    #[serde(rename = "sensor")]
    pub sensors: Vec<SensorConfig>,
}

fn queue() -> usize {
    8192
}

impl Vehicle {
    /// The part of the configuration that the core needs.
    pub fn core(&self) -> VehicleConfig {
        VehicleConfig {
            name: self.name.clone(),
            sensors: self.sensors.clone(),
            time: self.time,
            fusion: self.fusion.clone(),
            body: self.body,
            maps: self.maps.clone(),
        }
    }
}

/// The table `[vehicle.ingest]`: limits of observations over gRPC and zenoh.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Ingest {
    /// True if clients may send scans, poses, roads and packets.
    pub enabled: bool,
    /// Most points of one scan; the longest message follows from it.
    pub points_max: usize,
    /// Most streams at once; they share half the event queue. A constant but in tests.
    #[serde(skip)]
    pub streams_max: usize,
}

impl Default for Ingest {
    fn default() -> Self {
        Self { enabled: true, points_max: 500_000, streams_max: 8 }
    }
}

impl Ingest {
    /// Number of events of all streams together on a queue of this length: half of it, the other half is for UDP.
    pub fn events_max(&self, queue: usize) -> usize {
        if self.enabled { queue / 2 } else { 0 }
    }
}

impl Vehicle {
    pub(super) fn check(&self, zenoh_enabled: bool) -> Result<(), ValueError> {
        if let Err(error) = self.core().validate() {
            return Err(ValueError::new(format!("{} (of {})", error.key, self.name), &error.value, error.allowed));
        }
        let at = |key: &str| format!("vehicle.{key} (of {})", self.name);
        if !(16..=1 << 20).contains(&self.queue) {
            return Err(ValueError::new(at("queue"), self.queue, "16 to 1048576 events"));
        }
        if let Some(ros) = &self.ros {
            ros.check(zenoh_enabled, &self.sensors).map_err(|error| ValueError { key: at(&error.key), ..error })?;
        }
        let points_max = self.ingest.points_max;
        if !(1000..=20_000_000).contains(&points_max) {
            return Err(ValueError::new(at("ingest.points_max"), points_max, "1000 to 20000000 points"));
        }
        Ok(())
    }
}
