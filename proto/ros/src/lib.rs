//! ROS 2 messages to values, and back.
//!
//! In: the bytes of one message as ROS 2 writes them (CDR, XCDR1, either byte order), from an MCAP file or out of
//! rmw_zenoh's key space. Out: values, frames as the message names them, metres, radians, ns since the Unix epoch.
//! Nothing is allocated that the message has no bytes for, and whatever is wrong is named.
//!
//! | file | in -> out |
//! |---|---|
//! | [`kind`] | a type's name -> which of these messages it is |
//! | [`cdr`] | bytes -> numbers, texts, headers; and back |
//! | [`velodyne_scan`] | `velodyne_msgs/VelodyneScan` -> packets |
//! | [`point_cloud2`] | `sensor_msgs/PointCloud2` -> fields and bytes; and back |
//! | [`points`] | fields and bytes -> positions, intensities, rings, times, by the drivers' conventions |
//! | [`occupancy_grid`] | cells -> `nav_msgs/OccupancyGrid` |
//! | [`pose`] | `nav_msgs/Odometry`, `geometry_msgs/PoseStamped`, `tf2_msgs/TFMessage` -> poses |
//! | [`frames`] | transforms -> where one frame lies in another |
//! | [`published`] | the types that are published: names, hashes, definitions |

pub mod cdr;
pub mod frames;
pub mod kind;
pub mod occupancy_grid;
pub mod point_cloud2;
pub mod points;
pub mod pose;
pub mod published;
pub mod velodyne_scan;

pub use cdr::MessageError;
pub use frames::Frames;
pub use kind::Kind;
pub use occupancy_grid::OccupancyGrid;
pub use point_cloud2::PointCloud2;
pub use points::Points;
