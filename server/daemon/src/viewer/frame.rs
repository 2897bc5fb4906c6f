//! Frames of the messages for viewers, and the pose of a map.

use clearway_client::{MapView, v1};
use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion};

use crate::config::Ros;

/// Name of the world frame of a vehicle whose input names none.
pub const MAP_FRAME: &str = "map";

/// Name of the ego frame of a vehicle whose input names none.
pub fn base_frame(vehicle: &str) -> String {
    format!("{vehicle}/base_link")
}

/// Names of a vehicle's frames in ROS 2.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct FrameNames {
    /// The frame of the poses, which is fixed to the ground.
    pub fixed: String,
    /// The vehicle's own frame, with its origin on the ground.
    pub ego: String,
}

impl FrameNames {
    /// The names in `[vehicle.ros]`, which are the names of the input; without them `map` and `<vehicle>/base_link`.
    pub fn new(vehicle: &str, ros: Option<&Ros>) -> Self {
        let named = |name: fn(&Ros) -> &String| ros.map(name).filter(|name| !name.is_empty()).cloned();
        Self {
            fixed: named(|ros| &ros.fixed_frame).unwrap_or_else(|| MAP_FRAME.to_owned()),
            ego: named(|ros| &ros.ego_frame).unwrap_or_else(|| base_frame(vehicle)),
        }
    }
}

/// Ego pose at the end of the capture; `None` if no pose is known.
pub fn map_from_ego(map: &MapView) -> Option<Isometry3<f64>> {
    map.header().map_from_ego.as_ref().map(isometry)
}

/// The rigid transform of a pose on the wire.
pub fn isometry(pose: &v1::Pose) -> Isometry3<f64> {
    let rotation = UnitQuaternion::from_quaternion(Quaternion::new(pose.qw, pose.qx, pose.qy, pose.qz));
    Isometry3::from_parts(Translation3::new(pose.x, pose.y, pose.z), rotation)
}
