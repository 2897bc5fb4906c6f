//! A map -> ROS 2 messages, CDR: `nav_msgs/msg/OccupancyGrid` for each layer, `sensor_msgs/msg/PointCloud2` of the
//! obstacles and the ground of the layer to plan on, `visualization_msgs/msg/MarkerArray` and
//! `geometry_msgs/msg/PoseArray` of safe points, `tf2_msgs/msg/TFMessage` and `nav_msgs/msg/Odometry`. A sensor's
//! points -> `sensor_msgs/msg/PointCloud2`.

use clearway_mapping::event::EgoPose;
use clearway_proto::map::Layer;
use clearway_proto::{plan, v1};
use clearway_ros::OccupancyGrid;
use clearway_ros::cdr::Header;
use clearway_ros::point_cloud2::{Datatype, Field, PointCloud2};
use clearway_ros::pose::{Odometry, StampedTransform, Twist, path_to_cdr, pose_array_to_cdr, tf_message_to_cdr};
use clearway_ros::published::markers::{Lines, marker_array_to_cdr};
use clearway_ros::published::{MARKER_ARRAY, OCCUPANCY_GRID, POINT_CLOUD2, POSE_ARRAY, Published};
use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};

use super::aligned::AlignedGrid;
use super::clouds;
use super::frame::{FrameNames, map_from_ego};
use super::raster::{FREE, Raster, UNKNOWN};
use super::safe_paths;
use clearway_client::MapView;

/// Name of the layer to plan on: its free cells are graded, and it has clouds.
const PLANNED_LAYER: &str = "freespace";
/// Clearance from which a free cell has the occupancy 0, in metres. Ours: half the width of a lane.
const CLEAR_M: f64 = 2.0;
/// Occupancy that a free cell would have without clearance. Ours: far from 99, which Nav2 takes for an obstacle.
const NARROW: f64 = 50.0;

/// A layer of a map, as its topics show it.
pub struct ShownLayer<'a> {
    /// The map that has the layer.
    pub map: &'a MapView,
    /// The layer to show.
    pub layer: &'a Layer,
    /// The raster of the layer.
    pub raster: &'a Raster,
    /// Names of the frames in the messages.
    pub frames: &'a FrameNames,
    /// True until the map is stale.
    pub is_fresh: bool,
}

/// A topic of a layer.
pub struct LayerTopic {
    /// End of the topic's name, behind the layer's.
    pub ending: &'static str,
    /// Message type of the topic.
    pub kind: Published,
    /// True if a later subscriber gets the newest message.
    pub is_latched: bool,
    /// The message of a layer; `None` if the topic has none.
    pub write: fn(&ShownLayer) -> Option<Vec<u8>>,
}

/// The topics of a layer.
pub fn topics_of(layer: &str) -> &'static [LayerTopic] {
    const fn topic(ending: &'static str, kind: Published, write: fn(&ShownLayer) -> Option<Vec<u8>>) -> LayerTopic {
        LayerTopic { ending, kind, is_latched: true, write }
    }
    const fn cloud(ending: &'static str, write: fn(&ShownLayer) -> Option<Vec<u8>>) -> LayerTopic {
        LayerTopic { ending, kind: POINT_CLOUD2, is_latched: false, write }
    }
    const GRID: LayerTopic = topic("", OCCUPANCY_GRID, occupancy_grid);
    const MARKERS: LayerTopic = topic("/markers", MARKER_ARRAY, safe_path_markers);
    const POSES: LayerTopic = topic("/poses", POSE_ARRAY, safe_point_poses);
    const OBSTACLES: LayerTopic = cloud("/obstacles", |shown| point_cloud(shown, clouds::obstacles));
    const GROUND: LayerTopic = cloud("/ground", |shown| point_cloud(shown, clouds::ray_ends));
    match layer {
        PLANNED_LAYER => &[GRID, OBSTACLES, GROUND],
        safe_paths::LAYER => &[GRID, MARKERS, POSES],
        _ => &[GRID],
    }
}

/// A layer as an occupancy grid, along the axes of the fixed frame if the pose is known, else of the ego frame. The
/// grid of a stale map is unknown, with the time at which the map became stale.
fn occupancy_grid(shown: &ShownLayer) -> Option<Vec<u8>> {
    let &ShownLayer { map, layer, raster, frames, is_fresh } = shown;
    let fixed_from_ego = map_from_ego(map);
    let frame_id = if fixed_from_ego.is_some() { &frames.fixed } else { &frames.ego };
    let frame_from_ego = fixed_from_ego.unwrap_or_default();
    let occupancies = if is_fresh { graded(map, layer, raster) } else { vec![UNKNOWN; raster.cells()] };
    let AlignedGrid { origin_m: [x_m, y_m], width, height, occupancies } =
        AlignedGrid::new(raster, &occupancies, &frame_from_ego);
    let header = map.header();
    let stamp_ns = if is_fresh { header.capture_end_ns } else { header.valid_until_ns };
    let message = OccupancyGrid {
        header: Header { stamp_ns, frame_id },
        resolution_m: raster.cell_m,
        width,
        height,
        origin: Isometry3::translation(x_m, y_m, frame_from_ego.translation.z),
        data: occupancies,
    };
    Some(message.to_cdr())
}

/// The occupancies of a layer's cells. Of the layer to plan on, free cells rise from 0 with the clearance that they
/// lack.
fn graded(map: &MapView, layer: &Layer, raster: &Raster) -> Vec<i8> {
    let mut occupancies = raster.occupancies(layer);
    if layer.name == PLANNED_LAYER
        && let Ok(clearance) = map.clearance(PLANNED_LAYER, CLEAR_M, false)
    {
        for (occupancy, clear_m) in occupancies.iter_mut().zip(clearance.cells_m) {
            if *occupancy == FREE {
                *occupancy = (NARROW * (1.0 - clear_m / CLEAR_M)).round() as i8;
            }
        }
    }
    occupancies
}

/// Points of a layer in the ego frame; `None` if the map is stale, so that Nav2 misses them.
fn point_cloud(shown: &ShownLayer, of: fn(&Layer, &Raster) -> Vec<[f32; 3]>) -> Option<Vec<u8>> {
    let write = || {
        let at = of(shown.layer, shown.raster);
        points(shown.map.header().capture_end_ns, &shown.frames.ego, &at, &[], &[])
    };
    shown.is_fresh.then(write)
}

/// Safe points of a layer as lines of the links and of circles with the radii; they disappear when the map is stale.
fn safe_path_markers(shown: &ShownLayer) -> Option<Vec<u8>> {
    let (header, points) = (shown.map.header(), &shown.layer.points);
    let lines = |name, points, rgba, width_m| Lines { name, width_m, rgba, points };
    let markers = [
        lines("links", safe_paths::links(points), safe_paths::LINK_RGBA, safe_paths::LINK_M),
        lines("radii", safe_paths::circles(points), safe_paths::CIRCLE_RGBA, safe_paths::CIRCLE_M),
    ];
    let valid_ns = header.valid_until_ns.saturating_sub(header.capture_end_ns).max(0);
    let stamp = Header { stamp_ns: header.capture_end_ns, frame_id: &shown.frames.ego };
    shown.is_fresh.then(|| marker_array_to_cdr(&stamp, valid_ns, &markers))
}

/// Safe points of a layer as poses, each along its link; none if the map is stale.
fn safe_point_poses(shown: &ShownLayer) -> Option<Vec<u8>> {
    let header = Header { stamp_ns: shown.map.header().capture_end_ns, frame_id: &shown.frames.ego };
    let points = if shown.is_fresh { shown.layer.points.as_slice() } else { &[] };
    Some(pose_array_to_cdr(&header, &safe_paths::poses(points)))
}

/// The pose of a map; `None` if none is known.
pub fn pose_of(map: &MapView) -> Option<EgoPose> {
    let header = map.header();
    let speed_mps = header.speed_mps.unwrap_or_default();
    Some(EgoPose { stamp_ns: header.capture_end_ns, map_from_ego: map_from_ego(map)?, speed_mps })
}

/// A vehicle's pose as a tf message.
pub fn tf_of(frames: &FrameNames, pose: &EgoPose) -> Vec<u8> {
    transform(pose.stamp_ns, &frames.fixed, &frames.ego, &pose.map_from_ego)
}

/// A vehicle's pose and forward speed as odometry.
pub fn odometry_of(frames: &FrameNames, pose: &EgoPose) -> Vec<u8> {
    let header = Header { stamp_ns: pose.stamp_ns, frame_id: &frames.fixed };
    let transform = StampedTransform { header, child_frame_id: &frames.ego, parent_from_child: pose.map_from_ego };
    let twist = Some(Twist { linear_mps: [pose.speed_mps, 0.0, 0.0], angular_rps: [0.0; 3] });
    Odometry { transform, twist }.to_cdr()
}

/// A plan in its own frame as a path, on the ground.
pub fn path_of(frames: &FrameNames, plan: &v1::Plan) -> Vec<u8> {
    let frame_id = if plan.frame() == v1::PlanFrame::Map { &frames.fixed } else { &frames.ego };
    let points = plan.x.iter().zip(&plan.y).zip(plan::headings(plan));
    let rotation = |heading_rad| UnitQuaternion::from_axis_angle(&Vector3::z_axis(), heading_rad);
    let pose = |((&x, &y), heading_rad)| Isometry3::from_parts(Translation3::new(x, y, 0.0), rotation(heading_rad));
    path_to_cdr(&Header { stamp_ns: plan.stamp_ns, frame_id }, &points.map(pose).collect::<Vec<_>>())
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
