//! Name of a message type -> [`Kind`].

/// The message types that are read.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Kind {
    /// `velodyne_msgs/msg/VelodyneScan`: the data packets of a scan.
    VelodyneScan,
    /// `sensor_msgs/msg/PointCloud2`: points with named fields.
    PointCloud2,
    /// `nav_msgs/msg/Odometry`: a pose with velocities.
    Odometry,
    /// `geometry_msgs/msg/PoseStamped`: a pose with its frame and stamp.
    PoseStamped,
    /// `tf2_msgs/msg/TFMessage`: transforms between frames.
    TfMessage,
}

impl Kind {
    /// All kinds, in the order of the enum.
    pub const ALL: [Self; 5] =
        [Self::VelodyneScan, Self::PointCloud2, Self::Odometry, Self::PoseStamped, Self::TfMessage];

    /// The kind with this name: `sensor_msgs/msg/PointCloud2`, `sensor_msgs/PointCloud2`, or as DDS and rmw_zenoh spell
    /// it,
    /// `sensor_msgs::msg::dds_::PointCloud2_`.
    pub fn from_name(name: &str) -> Option<Self> {
        let (package, message) = match name.split_once("::msg::dds_::") {
            Some((package, message)) => (package, message.strip_suffix('_')?),
            None => {
                let (package, message) = name.split_once('/')?;
                (package, message.strip_prefix("msg/").unwrap_or(message))
            }
        };
        Self::ALL.into_iter().find(|kind| kind.parts() == (package, message))
    }

    /// Package and message.
    fn parts(self) -> (&'static str, &'static str) {
        match self {
            Self::VelodyneScan => ("velodyne_msgs", "VelodyneScan"),
            Self::PointCloud2 => ("sensor_msgs", "PointCloud2"),
            Self::Odometry => ("nav_msgs", "Odometry"),
            Self::PoseStamped => ("geometry_msgs", "PoseStamped"),
            Self::TfMessage => ("tf2_msgs", "TFMessage"),
        }
    }

    /// True if the message holds data of a sensor.
    pub fn is_sensor(self) -> bool {
        matches!(self, Self::VelodyneScan | Self::PointCloud2)
    }
}

impl std::fmt::Display for Kind {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let (package, message) = self.parts();
        write!(f, "{package}/msg/{message}")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_type_is_found_by_each_of_its_spellings_only() {
        for kind in Kind::ALL {
            let (package, message) = kind.parts();
            for name in [format!("{package}/msg/{message}"), format!("{package}/{message}")] {
                assert_eq!(Kind::from_name(&name), Some(kind), "{name}");
            }
            assert_eq!(Kind::from_name(&format!("{package}::msg::dds_::{message}_")), Some(kind));
            assert_eq!(Kind::from_name(&format!("{package}::msg::dds_::{message}")), None);
        }
        for other in ["", "/", "PointCloud2", "sensor_msgs/msg/PointCloud", "sensor_msgs/srv/PointCloud2"] {
            assert_eq!(Kind::from_name(other), None, "{other}");
        }
    }
}
