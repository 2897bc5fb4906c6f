//! The published message types: their names, their names in rmw_zenoh, and their definitions for MCAP files.
//!
//! Hashes are RIHS01 (REP-2016), equal from Iron to Jazzy. Definitions come from `common_interfaces` and `geometry2`,
//! without comments, each followed by the definitions of its members (MCAP's `ros2msg`).
//!
//! | file | in -> out |
//! |---|---|
//! | [`occupancy_grid`] | cells -> `nav_msgs/OccupancyGrid` |
//! | [`markers`] | lines -> `visualization_msgs/MarkerArray` |
//! | [`diagnostics`] | states of components -> `diagnostic_msgs/DiagnosticArray` |

pub mod diagnostics;
pub mod markers;
pub mod occupancy_grid;

/// A message type that this server publishes: its names, its hash and its definition.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Published {
    package: &'static str,
    message: &'static str,
    /// Type hash: `RIHS01_` and 64 hexadecimal digits.
    pub hash: &'static str,
    /// Definition in the format `ros2msg`.
    pub definition: &'static str,
}

impl Published {
    const fn new(package: &'static str, message: &'static str, hash: &'static str, definition: &'static str) -> Self {
        Self { package, message, hash, definition }
    }

    /// Name in ROS 2, such as `nav_msgs/msg/OccupancyGrid`.
    pub fn name(&self) -> String {
        format!("{}/msg/{}", self.package, self.message)
    }

    /// Name in DDS and rmw_zenoh, such as `nav_msgs::msg::dds_::OccupancyGrid_`.
    pub fn dds_name(&self) -> String {
        format!("{}::msg::dds_::{}_", self.package, self.message)
    }
}

/// `nav_msgs/msg/OccupancyGrid`: a layer as cells from 0 to 100.
pub const OCCUPANCY_GRID: Published = Published::new(
    "nav_msgs",
    "OccupancyGrid",
    "RIHS01_8d348150c12913a31ee0ec170fbf25089e4745d17035792a1ba94d6f0bc0cfc7",
    include_str!("definitions/OccupancyGrid.msg"),
);

/// `tf2_msgs/msg/TFMessage`: the ego pose as a transform.
pub const TF_MESSAGE: Published = Published::new(
    "tf2_msgs",
    "TFMessage",
    "RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087",
    include_str!("definitions/TFMessage.msg"),
);

/// `nav_msgs/msg/Odometry`: the ego pose with velocities.
pub const ODOMETRY: Published = Published::new(
    "nav_msgs",
    "Odometry",
    "RIHS01_3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0",
    include_str!("definitions/Odometry.msg"),
);

/// `sensor_msgs/msg/PointCloud2`: points with named fields.
pub const POINT_CLOUD2: Published = Published::new(
    "sensor_msgs",
    "PointCloud2",
    "RIHS01_9198cabf7da3796ae6fe19c4cb3bdd3525492988c70522628af5daa124bae2b5",
    include_str!("definitions/PointCloud2.msg"),
);

/// `geometry_msgs/msg/PoseArray`: a list of poses in one frame.
pub const POSE_ARRAY: Published = Published::new(
    "geometry_msgs",
    "PoseArray",
    "RIHS01_af0cc36d190e104d546d168d6b39df04fa4b4ccecf59cb4c9ed328d3d5004aa0",
    include_str!("definitions/PoseArray.msg"),
);

/// `nav_msgs/msg/Path`: a list of stamped poses in driving order.
pub const PATH: Published = Published::new(
    "nav_msgs",
    "Path",
    "RIHS01_1957a5bb3cee5da65c4e52e52b65a93df227efce4c20f8458b36e73066ca334b",
    include_str!("definitions/Path.msg"),
);

/// `visualization_msgs/msg/MarkerArray`: lines and texts to draw.
pub const MARKER_ARRAY: Published = Published::new(
    "visualization_msgs",
    "MarkerArray",
    "RIHS01_86cb8800b6fb05b5eff1abd7a56f62a5641d3ae9a1c29e78e67e704f1d067dcf",
    include_str!("definitions/MarkerArray.msg"),
);

/// `std_msgs/msg/Bool`: one truth value.
pub const BOOL: Published = Published::new(
    "std_msgs",
    "Bool",
    "RIHS01_feb91e995ff9ebd09c0cb3d2aed18b11077585839fb5db80193b62d74528f6c9",
    include_str!("definitions/Bool.msg"),
);

/// `diagnostic_msgs/msg/DiagnosticArray`: states of components, with keys and values.
pub const DIAGNOSTIC_ARRAY: Published = Published::new(
    "diagnostic_msgs",
    "DiagnosticArray",
    "RIHS01_5a8a36efb05fb25070fa0fb3810290c0e6cd4862b54a8fb975a1ee8dc55a333e",
    include_str!("definitions/DiagnosticArray.msg"),
);
