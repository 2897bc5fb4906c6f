//! Maps for other people's planners and viewers: ROS 2 and Foxglove messages of one [`MapView`].
//!
//! Frames: grids and points in `<vehicle>/base_link`, the ego frame; where poses are known, that frame in `map`. Every
//! stamp is the end of the capture.

use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion};

use clearway_client::MapView;

pub mod foxglove;
pub mod raster;
pub mod ros;

pub use raster::Raster;

/// The world frame of every vehicle.
pub const MAP_FRAME: &str = "map";

/// A vehicle's own frame.
pub fn base_frame(vehicle: &str) -> String {
    format!("{vehicle}/base_link")
}

/// Where the vehicle was when the capture ended; `None` where no pose is known.
pub fn map_from_ego(map: &MapView) -> Option<Isometry3<f64>> {
    let pose = map.header().map_from_ego.as_ref()?;
    let rotation = UnitQuaternion::from_quaternion(Quaternion::new(pose.qw, pose.qx, pose.qy, pose.qz));
    Some(Isometry3::from_parts(Translation3::new(pose.x, pose.y, pose.z), rotation))
}
