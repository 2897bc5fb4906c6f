//! A map -> Foxglove messages: `foxglove.Grid` for each layer, `foxglove.SceneUpdate` of safe points and of plans,
//! `foxglove.FrameTransforms`, and `foxglove.PointCloud` of points.

use clearway_proto::limits::PLAN_DRAWN_NS_MAX;
use clearway_proto::map::Layer;
use clearway_proto::{plan, v1};
use foxglove::messages::line_primitive::Type;
use foxglove::messages::log::Level;
use foxglove::messages::packed_element_field::NumericType;
use foxglove::messages::{
    Color, Duration, FrameTransform, FrameTransforms, Grid, LinePrimitive, Log, PackedElementField, Point3, PointCloud,
    Pose, Quaternion, SceneEntity, SceneUpdate, TextPrimitive, Timestamp, Vector2, Vector3,
};
use nalgebra::Isometry3;

use super::frame::{MAP_FRAME, base_frame, map_from_ego};
use super::raster::Raster;
use super::safe_paths::{self, Place};
use clearway_client::MapView;

/// Bytes of a cell: red, green, blue, alpha.
const CELL_BYTES: u32 = 4;
/// Bytes of a point: x, y, z.
const POINT_BYTES: u32 = 12;
/// Red, green, blue and opacity of plans: the colour that the page draws them with.
const PLAN_RGBA: [f32; 4] = [1.0, 0.31, 0.85, 1.0];
/// Width of a plan's lines, their height over the ground, and the height of its letters, in metres.
const PLAN_LINE_M: f64 = 0.15;
const PLAN_LIFT_M: f64 = 0.1;
const PLAN_LETTER_M: f64 = 0.8;

/// A layer as a coloured grid in the ego frame; a grid along the world's axes keeps these axes.
pub fn grid(map: &MapView, layer: &Layer, raster: &Raster) -> Grid {
    let field = |(name, offset): (&str, u32)| field(name, offset, NumericType::Uint8);
    let edge = f64::from(raster.cell_m);
    Grid {
        timestamp: Some(timestamp(map.header().capture_end_ns)),
        frame_id: base_frame(map.vehicle()),
        pose: Some(pose(&raster.ego_from_raster)),
        column_count: raster.width,
        cell_size: Some(Vector2 { x: edge, y: edge }),
        row_stride: raster.width * CELL_BYTES,
        cell_stride: CELL_BYTES,
        fields: [("red", 0), ("green", 1), ("blue", 2), ("alpha", 3)].map(field).to_vec(),
        data: raster.rgba(layer).into(),
    }
}

/// Safe points of a layer: their links as lines, and circles with their radii. Each map replaces the scene of the map
/// before; the scene disappears when the map is stale.
pub fn safe_paths(map: &MapView, layer: &Layer) -> SceneUpdate {
    let header = map.header();
    let valid_ns = header.valid_until_ns.saturating_sub(header.capture_end_ns).max(0);
    let lines = |points: Vec<Place>, rgba: [f32; 4], thickness: f64| LinePrimitive {
        r#type: Type::LineList.into(),
        pose: Some(pose(&Isometry3::identity())),
        thickness,
        points: points.into_iter().map(|[x, y, z]| Point3 { x, y, z }).collect(),
        color: Some(color(rgba)),
        ..LinePrimitive::default()
    };
    let links = lines(safe_paths::links(&layer.points), safe_paths::LINK_RGBA, safe_paths::LINK_M);
    let circles = lines(safe_paths::circles(&layer.points), safe_paths::CIRCLE_RGBA, safe_paths::CIRCLE_M);
    let entity = SceneEntity {
        timestamp: Some(timestamp(header.capture_end_ns)),
        frame_id: base_frame(map.vehicle()),
        id: layer.name.clone(),
        lifetime: Some(Duration::new((valid_ns / 1_000_000_000) as i32, (valid_ns % 1_000_000_000) as u32)),
        frame_locked: true,
        lines: vec![links, circles],
        ..SceneEntity::default()
    };
    SceneUpdate { deletions: Vec::new(), entities: vec![entity] }
}

/// A plan in its own frame: lines, and its text at the end of the path. The next plan replaces it; it disappears 2 s
/// after its stamp.
pub fn plan(vehicle: &str, plan: &v1::Plan) -> SceneUpdate {
    let colour = || Some(color(PLAN_RGBA));
    let at = |[x, y]: [f64; 2]| Point3 { x, y, z: PLAN_LIFT_M };
    let lines = LinePrimitive {
        r#type: Type::LineList.into(),
        pose: Some(pose(&Isometry3::identity())),
        thickness: PLAN_LINE_M,
        points: plan::lines(plan).into_flattened().into_iter().map(at).collect(),
        color: colour(),
        ..LinePrimitive::default()
    };
    let (x, y) = (plan.x.last().copied().unwrap_or_default(), plan.y.last().copied().unwrap_or_default());
    let text = TextPrimitive {
        pose: Some(pose(&Isometry3::translation(x, y, 1.0))),
        billboard: true,
        font_size: PLAN_LETTER_M,
        color: colour(),
        text: plan.text.clone(),
        ..TextPrimitive::default()
    };
    let entity = SceneEntity {
        timestamp: Some(timestamp(plan.stamp_ns)),
        frame_id: if plan.frame() == v1::PlanFrame::Map { MAP_FRAME.into() } else { base_frame(vehicle) },
        id: "plan".into(),
        lifetime: Some(Duration::new((PLAN_DRAWN_NS_MAX / 1_000_000_000) as i32, 0)),
        lines: vec![lines],
        texts: if plan.text.is_empty() { Vec::new() } else { vec![text] },
        ..SceneEntity::default()
    };
    SceneUpdate { deletions: Vec::new(), entities: vec![entity] }
}

/// Pose of the ego frame in `map`; `None` if no pose is known.
pub fn transforms(map: &MapView) -> Option<FrameTransforms> {
    let stamp_ns = map.header().capture_end_ns;
    let transform = transform(stamp_ns, MAP_FRAME, &base_frame(map.vehicle()), &map_from_ego(map)?);
    Some(FrameTransforms { transforms: vec![transform] })
}

/// A line of the log of a vehicle.
pub fn log(stamp_ns: i64, vehicle: &str, text: &str) -> Log {
    Log {
        timestamp: Some(timestamp(stamp_ns)),
        level: Level::Info.into(),
        message: text.to_owned(),
        name: vehicle.to_owned(),
        file: String::new(),
        line: 0,
    }
}

/// Transform of a frame in its parent.
pub fn transform(stamp_ns: i64, parent: &str, child: &str, parent_from_child: &Isometry3<f64>) -> FrameTransform {
    let Pose { position, orientation } = pose(parent_from_child);
    FrameTransform {
        timestamp: Some(timestamp(stamp_ns)),
        parent_frame_id: parent.to_owned(),
        child_frame_id: child.to_owned(),
        translation: position,
        rotation: orientation,
    }
}

/// Points in a frame, in metres.
pub fn points(stamp_ns: i64, frame_id: &str, points: impl Iterator<Item = [f32; 3]>) -> PointCloud {
    let field = |(name, offset): (&str, u32)| field(name, offset, NumericType::Float32);
    PointCloud {
        timestamp: Some(timestamp(stamp_ns)),
        frame_id: frame_id.to_owned(),
        pose: Some(pose(&Isometry3::identity())),
        point_stride: POINT_BYTES,
        fields: [("x", 0), ("y", 4), ("z", 8)].map(field).to_vec(),
        data: points.flatten().flat_map(f32::to_le_bytes).collect::<Vec<u8>>().into(),
    }
}

fn field(name: &str, offset: u32, kind: NumericType) -> PackedElementField {
    PackedElementField { name: name.to_owned(), offset, r#type: kind.into() }
}

fn color([r, g, b, a]: [f32; 4]) -> Color {
    Color { r: r.into(), g: g.into(), b: b.into(), a: a.into() }
}

/// A stamp, limited to the range of the message (1970 to 2106).
fn timestamp(stamp_ns: i64) -> Timestamp {
    let seconds = stamp_ns.div_euclid(1_000_000_000).clamp(0, u32::MAX.into()) as u32;
    Timestamp::new(seconds, stamp_ns.rem_euclid(1_000_000_000) as u32)
}

fn pose(isometry: &Isometry3<f64>) -> Pose {
    let (t, q) = (isometry.translation.vector, isometry.rotation.coords);
    Pose {
        position: Some(Vector3 { x: t.x, y: t.y, z: t.z }),
        orientation: Some(Quaternion { x: q.x, y: q.y, z: q.z, w: q.w }),
    }
}
