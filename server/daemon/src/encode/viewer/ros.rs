//! A map -> ROS 2 messages, CDR: `nav_msgs/msg/OccupancyGrid` for each layer, `visualization_msgs/msg/MarkerArray` and
//! `geometry_msgs/msg/PoseArray` of safe points, `tf2_msgs/msg/TFMessage` and `nav_msgs/msg/Odometry`. A sensor's
//! points -> `sensor_msgs/msg/PointCloud2`.

use clearway_mapping::event::EgoPose;
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
    pose_of(map).map(|pose| tf_of(map.vehicle(), &pose))
}

/// Pose of the ego frame in `map` and forward speed as odometry; `None` if no pose is known.
pub fn odometry(map: &MapView) -> Option<Vec<u8>> {
    pose_of(map).map(|pose| odometry_of(map.vehicle(), &pose))
}

/// A vehicle's pose as a tf message.
pub fn tf_of(vehicle: &str, pose: &EgoPose) -> Vec<u8> {
    transform(pose.stamp_ns, MAP_FRAME, &base_frame(vehicle), &pose.map_from_ego)
}

/// A vehicle's pose and forward speed as odometry.
pub fn odometry_of(vehicle: &str, pose: &EgoPose) -> Vec<u8> {
    let header = Header { stamp_ns: pose.stamp_ns, frame_id: MAP_FRAME };
    let child_frame_id = &base_frame(vehicle);
    let transform = StampedTransform { header, child_frame_id, parent_from_child: pose.map_from_ego };
    let twist = Some(Twist { linear_mps: [pose.speed_mps, 0.0, 0.0], angular_rps: [0.0; 3] });
    Odometry { transform, twist }.to_cdr()
}

/// Transform of a frame in its parent as a tf message.
pub fn transform(stamp_ns: i64, parent: &str, child: &str, parent_from_child: &Isometry3<f64>) -> Vec<u8> {
    let header = Header { stamp_ns, frame_id: parent };
    tf_message_to_cdr(&[StampedTransform { header, child_frame_id: child, parent_from_child: *parent_from_child }])
}

/// Points in a frame, in metres, in one row, each with its ring and with its time in seconds after the stamp, if these
/// lists are not empty.
pub fn points(stamp_ns: i64, frame_id: &str, points: &[[f32; 3]], rings: &[u16], offsets_ns: &[i32]) -> Vec<u8> {
    let mut fields = vec![("x", Datatype::Float32), ("y", Datatype::Float32), ("z", Datatype::Float32)];
    fields.extend((!offsets_ns.is_empty()).then_some(("time", Datatype::Float32)));
    fields.extend((!rings.is_empty()).then_some(("ring", Datatype::Uint16)));
    let mut data = Vec::new();
    for (index, point) in points.iter().enumerate() {
        data.extend(point.iter().flat_map(|metres| metres.to_le_bytes()));
        data.extend(offsets_ns.get(index).into_iter().flat_map(|ns| (*ns as f32 * 1e-9).to_le_bytes()));
        data.extend(rings.get(index).into_iter().flat_map(|ring| ring.to_le_bytes()));
    }
    let mut point_step = 0;
    let field = |(name, datatype): (&'static str, Datatype)| {
        let offset = point_step;
        point_step += datatype.size();
        Field { name, offset, datatype: datatype as u8, count: 1 }
    };
    PointCloud2 {
        header: Header { stamp_ns, frame_id },
        height: 1,
        width: points.len() as u32,
        fields: fields.into_iter().map(field).collect(),
        big_endian: false,
        point_step,
        row_step: data.len() as u32,
        data: &data,
        dense: true,
    }
    .to_cdr()
}

/// The pose of a map.
fn pose_of(map: &MapView) -> Option<EgoPose> {
    let header = map.header();
    let speed_mps = header.speed_mps.unwrap_or_default();
    Some(EgoPose { stamp_ns: header.capture_end_ns, map_from_ego: map_from_ego(map)?, speed_mps })
}
