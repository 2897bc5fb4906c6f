//! The table `[vehicle.ros]`: which ROS 2 topics feed a vehicle, and the names of its frames.

use std::collections::BTreeMap;

use clearway_mapping::config::SensorConfig;
use serde::{Deserialize, Serialize};

use super::error::ValueError;

/// Greatest `ROS_DOMAIN_ID` that ROS 2 allows.
pub(super) const DOMAIN_MAX: u32 = 232;

/// The table `[vehicle.ros]`: subscriptions of ROS 2 topics over zenoh.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Ros {
    /// The `ROS_DOMAIN_ID` of the subscribed topics, 0 to 232.
    pub domain: u32,
    /// Topic of odometry or stamped poses; empty: poses come from tf.
    pub pose: String,
    /// Frame of the poses, of the topic `pose` or of tf, and of the grids that are published; empty: no poses.
    pub fixed_frame: String,
    /// The vehicle's own frame, with its origin on the ground, here and in what is published.
    pub ego_frame: String,
    /// Topic of moving transforms; empty: no subscription. Static ones are on the topic `<tf>_static`, as ROS 2 has it.
    pub tf: String,
    /// Topic of each sensor (PointCloud2 or VelodyneScan), by sensor name.
    pub sensors: BTreeMap<String, String>,
}

impl Default for Ros {
    fn default() -> Self {
        Self {
            domain: 0,
            pose: String::new(),
            fixed_frame: "odom".into(),
            ego_frame: "base_link".into(),
            tf: "/tf".into(),
            sensors: BTreeMap::new(),
        }
    }
}

impl Ros {
    /// The frames without the topics: for events from files.
    pub fn frames_alone(self) -> Self {
        let Self { fixed_frame, ego_frame, .. } = self;
        let (pose, tf, sensors) = Default::default();
        Self { domain: 0, pose, fixed_frame, ego_frame, tf, sensors }
    }

    /// Checks the values; the keys of errors start behind `vehicle.`.
    pub(super) fn check(&self, zenoh_enabled: bool, sensors: &[SensorConfig]) -> Result<(), ValueError> {
        let topics = self.sensors.values().chain([&self.pose, &self.tf]);
        let mut named: Vec<_> = topics.filter(|topic| !topic.is_empty()).collect();
        if !zenoh_enabled && !named.is_empty() {
            let allowed = "only with zenoh.enabled = true, because ROS topics come through zenoh";
            return Err(ValueError::new("ros", "(set)", allowed));
        }
        if self.domain > DOMAIN_MAX {
            return Err(ValueError::new("ros.domain", self.domain, format!("0 to {DOMAIN_MAX}")));
        }
        if let Some(unknown) = self.sensors.keys().find(|name| !sensors.iter().any(|sensor| sensor.name == **name)) {
            let known: Vec<_> = sensors.iter().map(|sensor| sensor.name.as_str()).collect();
            let allowed = format!("the vehicle's sensors: {}", known.join(", "));
            return Err(ValueError::new("ros.sensors", unknown, allowed));
        }
        if let Some(topic) = named.iter().find(|topic| !is_topic(topic)) {
            return Err(ValueError::new("ros", topic, "topics such as \"/sensing/top/points\""));
        }
        named.sort_unstable();
        match named.windows(2).find(|pair| pair[0] == pair[1]) {
            Some(pair) => Err(ValueError::new("ros", pair[0], "each topic once")),
            None => Ok(()),
        }
    }
}

/// True if ROS allows the topic: parts of letters, digits and underscores, each after a slash.
pub(super) fn is_topic(topic: &str) -> bool {
    let part = |part: &str| !part.is_empty() && part.bytes().all(|byte| byte == b'_' || byte.is_ascii_alphanumeric());
    topic.strip_prefix('/').is_some_and(|rest| rest.split('/').all(part))
}
