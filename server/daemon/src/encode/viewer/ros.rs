//! A map -> ROS 2 messages, CDR: `nav_msgs/msg/OccupancyGrid` for each layer, `visualization_msgs/msg/MarkerArray` and
//! `geometry_msgs/msg/PoseArray` of safe points, `tf2_msgs/msg/TFMessage` and `nav_msgs/msg/Odometry`. A sensor's
//! points -> `sensor_msgs/msg/PointCloud2`.

use clearway_proto::map::Layer;
use clearway_ros::OccupancyGrid;
use clearway_ros::cdr::Header;
use clearway_ros::markers::{Lines, marker_array_to_cdr};
use clearway_ros::point_cloud2::{Datatype, Field, PointCloud2};
use clearway_ros::pose::{Odometry, StampedTransform, Twist, pose_array_to_cdr, tf_message_to_cdr};
use nalgebra::Isometry3;

use super::frame::{MAP_FRAME, base_frame, map_from_ego};
use super::raster::Raster;
use super::safe_paths;
use clearway_client::MapView;

/// A layer as an occupancy grid in the ego frame; a grid along the world's axes keeps these axes, in its origin.
pub fn occupancy_grid(map: &MapView, layer: &Layer, raster: &Raster) -> Vec<u8> {
    OccupancyGrid {
        header: Header { stamp_ns: map.header().capture_end_ns, frame_id: &base_frame(map.vehicle()) },
        resolution_m: raster.cell_m,
        width: raster.width,
        height: raster.height,
        origin: raster.ego_from_raster,
        data: raster.occupancies(layer),
    }
    .to_cdr()
}

/// Safe points of a layer as lines of the links and of circles with the radii; they disappear when the map is stale.
pub fn safe_path_markers(map: &MapView, layer: &Layer) -> Vec<u8> {
    let header = map.header();
    let lines = |name, points, rgba, width_m| Lines { name, width_m, rgba, points };
    let markers = [
        lines("links", safe_paths::links(&layer.points), safe_paths::LINK_RGBA, safe_paths::LINK_M),
        lines("radii", safe_paths::circles(&layer.points), safe_paths::CIRCLE_RGBA, safe_paths::CIRCLE_M),
    ];
    let valid_ns = header.valid_until_ns.saturating_sub(header.capture_end_ns).max(0);
    let frame = base_frame(map.vehicle());
    marker_array_to_cdr(&Header { stamp_ns: header.capture_end_ns, frame_id: &frame }, valid_ns, &markers)
}

/// Safe points of a layer as poses, each along its link.
pub fn safe_point_poses(map: &MapView, layer: &Layer) -> Vec<u8> {
    let header = Header { stamp_ns: map.header().capture_end_ns, frame_id: &base_frame(map.vehicle()) };
    pose_array_to_cdr(&header, &safe_paths::poses(&layer.points))
}

/// Pose of the ego frame in `map` as a tf message; `None` if no pose is known.
pub fn tf(map: &MapView) -> Option<Vec<u8>> {
    with_transform(map, |transform| tf_message_to_cdr(&[transform]))
}

/// Pose of the ego frame in `map` and forward speed as odometry; `None` if no pose is known.
pub fn odometry(map: &MapView) -> Option<Vec<u8>> {
    let forward_mps = map.header().speed_mps.unwrap_or_default();
    with_transform(map, |transform| {
        let twist = Some(Twist { linear_mps: [forward_mps, 0.0, 0.0], angular_rps: [0.0; 3] });
        Odometry { transform, twist }.to_cdr()
    })
}

/// Transform of a frame in its parent as a tf message.
pub fn transform(stamp_ns: i64, parent: &str, child: &str, parent_from_child: &Isometry3<f64>) -> Vec<u8> {
    let header = Header { stamp_ns, frame_id: parent };
    tf_message_to_cdr(&[StampedTransform { header, child_frame_id: child, parent_from_child: *parent_from_child }])
}

/// Points in a frame, in metres, in one row.
pub fn points(stamp_ns: i64, frame_id: &str, points: &[[f32; 3]]) -> Vec<u8> {
    let data: Vec<u8> = points.iter().flatten().flat_map(|metres| metres.to_le_bytes()).collect();
    let field = |(name, offset)| Field { name, offset, datatype: Datatype::Float32 as u8, count: 1 };
    PointCloud2 {
        header: Header { stamp_ns, frame_id },
        height: 1,
        width: points.len() as u32,
        fields: [("x", 0), ("y", 4), ("z", 8)].map(field).to_vec(),
        big_endian: false,
        point_step: 12,
        row_step: data.len() as u32,
        data: &data,
        dense: true,
    }
    .to_cdr()
}

fn with_transform(map: &MapView, write: impl FnOnce(StampedTransform) -> Vec<u8>) -> Option<Vec<u8>> {
    let parent_from_child = map_from_ego(map)?;
    let header = Header { stamp_ns: map.header().capture_end_ns, frame_id: MAP_FRAME };
    Some(write(StampedTransform { header, child_frame_id: &base_frame(map.vehicle()), parent_from_child }))
}
