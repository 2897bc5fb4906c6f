//! A map -> Foxglove messages: `foxglove.Grid` for each layer, `foxglove.FrameTransforms`, and `foxglove.PointCloud` of
//! points.

use clearway_proto::map::Layer;
use foxglove::messages::packed_element_field::NumericType;
use foxglove::messages::{
    FrameTransform, FrameTransforms, Grid, PackedElementField, PointCloud, Pose, Quaternion, Timestamp, Vector2,
    Vector3,
};
use nalgebra::Isometry3;

use super::frame::{MAP_FRAME, base_frame, map_from_ego};
use super::raster::Raster;
use clearway_client::MapView;

/// Bytes of a cell: red, green, blue, alpha.
const CELL_BYTES: u32 = 4;
/// Bytes of a point: x, y, z.
const POINT_BYTES: u32 = 12;

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

/// Pose of the ego frame in `map`; `None` if no pose is known.
pub fn transforms(map: &MapView) -> Option<FrameTransforms> {
    let stamp_ns = map.header().capture_end_ns;
    let transform = transform(stamp_ns, MAP_FRAME, &base_frame(map.vehicle()), &map_from_ego(map)?);
    Some(FrameTransforms { transforms: vec![transform] })
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
