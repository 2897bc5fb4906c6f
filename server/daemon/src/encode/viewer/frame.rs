//! Frames of the messages for viewers, and the pose of a map.

use clearway_client::{MapView, v1};
use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion};

/// Name of the world frame of every vehicle.
pub const MAP_FRAME: &str = "map";

/// Name of a vehicle's ego frame.
pub fn base_frame(vehicle: &str) -> String {
    format!("{vehicle}/base_link")
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
