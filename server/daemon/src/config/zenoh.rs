//! The table `[zenoh]`: the session in which maps are published; and `[zenoh.ros2]`: maps as ROS 2 topics.

use std::collections::BTreeSet;
use std::ops::RangeInclusive;
use std::path::PathBuf;
use std::time::Duration;

use serde::{Deserialize, Serialize};

use super::error::ValueError;
use super::ros::{DOMAIN_MAX, Ros, is_topic};
use super::vehicle::Vehicle;

/// The table `[zenoh]`: the zenoh session of the server.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Zenoh {
    /// True if the session is opened.
    pub enabled: bool,
    /// Role in the zenoh network.
    pub mode: ZenohMode,
    /// Endpoints to listen on, such as `tcp/127.0.0.1:7447`; see [`Self::listened`].
    pub listen: Vec<String>,
    /// Endpoints of routers or peers to connect to.
    pub connect: Vec<String>,
    /// Most maps of a vehicle that are sent in a second, of all layers together; 0: all.
    pub max_rate_hz: f64,
    /// True if peers are found by multicast.
    pub scouting: bool,
    /// The vehicles of other servers.
    pub fleet: Fleet,
    /// Maps as ROS 2 topics.
    pub ros2: Ros2,
    /// A zenoh configuration (JSON5) with TLS and access control; the keys above take precedence over it. A relative
    /// path starts at the configuration's folder. Empty: zenoh's defaults, with limits for what one peer may cost.
    pub file: PathBuf,
    /// Private key (Ed25519, PEM) with which maps are signed; a relative path starts at the configuration's folder.
    /// Empty: maps have no signature. A recording holds the path only.
    pub signing_key: PathBuf,
}

impl Default for Zenoh {
    fn default() -> Self {
        Self {
            enabled: true,
            mode: ZenohMode::Peer,
            listen: vec!["tcp/127.0.0.1:7447".into()],
            connect: Vec::new(),
            max_rate_hz: 0.0,
            scouting: false,
            fleet: Fleet::default(),
            ros2: Ros2::default(),
            file: PathBuf::new(),
            signing_key: PathBuf::new(),
        }
    }
}

impl Zenoh {
    pub(super) fn check(&self, vehicles: &[Vehicle]) -> Result<(), ValueError> {
        for (key, endpoints) in [("zenoh.listen", &self.listen), ("zenoh.connect", &self.connect)] {
            if let Some(endpoint) = endpoints.iter().find(|e| !e.starts_with("tcp/") && !e.starts_with("tls/")) {
                let allowed = "endpoints such as \"tcp/127.0.0.1:7447\" or \"tls/localhost:7447\"";
                return Err(ValueError::new(key, endpoint, allowed));
            }
        }
        if self.enabled && self.mode == ZenohMode::Client && self.connect.is_empty() && !self.scouting {
            let allowed = "with zenoh.mode = \"client\" the endpoint of a router, such as \"tcp/192.168.1.10:7447\"";
            return Err(ValueError::new("zenoh.connect", "[]", allowed));
        }
        if self.max_rate_hz != 0.0 && !RATE_HZ.contains(&self.max_rate_hz) {
            let allowed = format!("0 (all maps) or {} to {}", RATE_HZ.start(), RATE_HZ.end());
            return Err(ValueError::new("zenoh.max_rate_hz", self.max_rate_hz, allowed));
        }
        self.ros2.check(self.enabled, vehicles)
    }

    /// The endpoints that the session listens on: none in the mode `client`, whose router on the same host has the
    /// default one.
    pub fn listened(&self) -> &[String] {
        if self.mode == ZenohMode::Client { &[] } else { &self.listen }
    }

    /// Shortest time between two maps of a vehicle.
    pub fn period(&self) -> Duration {
        if self.max_rate_hz == 0.0 { Duration::ZERO } else { Duration::from_secs_f64(1.0 / self.max_rate_hz) }
    }
}

/// The rates to which maps may be limited. Ours: no sensor makes more revolutions.
const RATE_HZ: RangeInclusive<f64> = 0.01..=1000.0;

/// Role in the zenoh network.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ZenohMode {
    /// Exchanges data with the peers that connect, and with the endpoints of `connect`.
    Peer,
    /// Exchanges data through one router.
    Client,
    /// Routes the data of others.
    Router,
}

impl ZenohMode {
    /// The name in the zenoh configuration.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Peer => "peer",
            Self::Client => "client",
            Self::Router => "router",
        }
    }
}

/// The table `[zenoh.fleet]`: one list of vehicles for all servers of a zenoh network.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Fleet {
    /// True if the vehicles of this server are announced to others, some kilobytes a second for each.
    pub announce: bool,
    /// True if the vehicles of other servers are listed, and readers are led to them. A server on a vehicle with a thin
    /// uplink does without.
    pub list: bool,
}

impl Default for Fleet {
    fn default() -> Self {
        Self { announce: true, list: true }
    }
}

/// The table `[zenoh.ros2]`: maps as ROS 2 topics over zenoh.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Ros2 {
    /// True if maps are published as ROS 2 topics.
    pub enabled: bool,
    /// The `ROS_DOMAIN_ID` of the published topics, 0 to 232.
    pub domain: u32,
    /// Prefix of the topics `/<vehicle>/<layer>`; may be empty.
    pub namespace: String,
    /// True if the topics have the keys of zenoh-bridge-ros2dds, for ROS 2 over DDS; else the keys of rmw_zenoh.
    pub dds_bridge: bool,
    /// True if the vehicles' poses are published on `/tf`: only if nothing else does.
    pub tf: bool,
}

impl Default for Ros2 {
    fn default() -> Self {
        Self { enabled: false, domain: 0, namespace: "/clearway".into(), dds_bridge: false, tf: false }
    }
}

impl Ros2 {
    fn check(&self, zenoh_enabled: bool, vehicles: &[Vehicle]) -> Result<(), ValueError> {
        if self.domain > DOMAIN_MAX {
            return Err(ValueError::new("zenoh.ros2.domain", self.domain, format!("0 to {DOMAIN_MAX}")));
        }
        if !self.enabled {
            return Ok(());
        }
        if !zenoh_enabled {
            let allowed = "only with zenoh.enabled = true, because ROS topics go through zenoh";
            return Err(ValueError::new("zenoh.ros2.enabled", "true", allowed));
        }
        // ROS 2 allows no name that begins with a digit.
        let is_name = |topic: &str| {
            is_topic(topic) && !topic.split('/').any(|part| part.starts_with(|c: char| c.is_ascii_digit()))
        };
        if !self.namespace.is_empty() && !is_name(&self.namespace) {
            return Err(ValueError::new("zenoh.ros2.namespace", &self.namespace, "such as \"/clearway\", or empty"));
        }
        // Else what is seen around one vehicle would be drawn around another.
        let mut frames = BTreeSet::new();
        let mut tables = vehicles.iter().filter_map(|vehicle| vehicle.ros.as_ref());
        if let Some(Ros { ego_frame, .. }) = tables.find(|ros| !frames.insert(&ros.ego_frame)) {
            let allowed = "with zenoh.ros2.enabled: a different frame for each vehicle";
            return Err(ValueError::new("vehicle.ros.ego_frame", ego_frame, allowed));
        }
        match vehicles.iter().find(|vehicle| !is_name(&format!("/{}", vehicle.name))) {
            None => Ok(()),
            Some(vehicle) => {
                let allowed = "with zenoh.ros2.enabled: letters, digits and underscores, no digit first";
                Err(ValueError::new("vehicle.name", &vehicle.name, allowed))
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn two_vehicles_of_one_frame_are_refused_if_ros2_is_enabled() {
        let vehicle = |name: &str, ego_frame: &str| {
            let mut vehicle = crate::config::Config::of_one_vehicle(name, "top").vehicles.remove(0);
            vehicle.ros = Some(Ros { ego_frame: ego_frame.to_owned(), ..Ros::default() });
            vehicle
        };
        let ros2 = Ros2 { enabled: true, ..Ros2::default() };
        let check = |frame: &str| ros2.check(true, &[vehicle("car", "base_link"), vehicle("truck", frame)]);
        assert!(check("truck/base_link").is_ok());
        let refused = check("base_link").unwrap_err();
        assert_eq!((refused.key.as_str(), refused.value.as_str()), ("vehicle.ros.ego_frame", "base_link"));
    }
}
