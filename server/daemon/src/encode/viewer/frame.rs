//! Frames of the messages for viewers, and the pose of a map.

use clearway_client::MapView;
use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion};

/// Name of the world frame of every vehicle.
pub const MAP_FRAME: &str = "map";

/// Name of a vehicle's ego frame.
pub fn base_frame(vehicle: &str) -> String {
    format!("{vehicle}/base_link")
}

/// Ego pose at the end of the capture; `None` if no pose is known.
pub fn map_from_ego(map: &MapView) -> Option<Isometry3<f64>> {
    let pose = map.header().map_from_ego.as_ref()?;
    let rotation = UnitQuaternion::from_quaternion(Quaternion::new(pose.qw, pose.qx, pose.qy, pose.qz));
    Some(Isometry3::from_parts(Translation3::new(pose.x, pose.y, pose.z), rotation))
}
