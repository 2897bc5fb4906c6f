//! ROS 2 messages <-> values. Pure: no I/O and no clock.
//!
//! In: the bytes of one message as ROS 2 writes them (CDR, XCDR1, either byte order), from an MCAP file or from
//! rmw_zenoh. Out: values in metres, radians and ns since the Unix epoch, in the frames that the message names. A
//! reader allocates only as much memory as the message has bytes for, and every error names the member that is wrong.
//! A fault of one point, packet, transform or optional field costs that part alone: it is a [`RefusedPart`].
//!
//! | file | in -> out |
//! |---|---|
//! | [`kind`] | name of a message type -> [`Kind`] |
//! | [`cdr`] | bytes -> numbers, texts, headers; and back |
//! | [`velodyne_scan`] | `velodyne_msgs/VelodyneScan` -> packets |
//! | [`point_cloud2`] | `sensor_msgs/PointCloud2` -> fields and bytes; and back |
//! | [`points`] | fields and bytes -> positions, intensities, rings and times, by the conventions of drivers |
//! | `point_layout` | fields -> readers of the numbers of a point |
//! | `point_times` | times as written -> unit, and ns after the header's stamp |
//! | [`pose`] | `Odometry`, `PoseStamped`, `TFMessage` -> poses; poses -> `Odometry`, `TFMessage`, `PoseArray` |
//! | [`frames`] | transforms -> pose of one frame in another |
//! | [`published`] | the published types: names, hashes, definitions; grids, markers and states -> messages |

pub mod cdr;
pub mod frames;
pub mod kind;
pub mod point_cloud2;
mod point_layout;
mod point_times;
pub mod points;
pub mod pose;
pub mod published;
pub mod velodyne_scan;

pub use cdr::{MessageError, RefusedPart};
pub use frames::Frames;
pub use kind::Kind;
pub use point_cloud2::PointCloud2;
pub use points::Points;
pub use published::occupancy_grid::OccupancyGrid;
