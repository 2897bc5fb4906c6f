//! A map -> Foxglove messages: `foxglove.Grid` a layer, `foxglove.FrameTransforms`, and `foxglove.PointCloud` of
//! points.

use clearway_proto::map::Layer;
use foxglove::messages::packed_element_field::NumericType;
use foxglove::messages::{
    FrameTransform, FrameTransforms, Grid, PackedElementField, PointCloud, Pose, Quaternion, Timestamp, Vector2,
    Vector3,
};
use nalgebra::Isometry3;

use super::{MAP_FRAME, Raster, base_frame, map_from_ego};
use clearway_client::MapView;

/// Red, green, blue, alpha.
const CELL_BYTES: u32 = 4;
/// x, y, z.
const POINT_BYTES: u32 = 12;

/// A layer as a coloured grid in the vehicle's frame; a grid that turns under the vehicle keeps its axes.
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

/// Where the vehicle is on the map; `None` where no pose is known.
pub fn transforms(map: &MapView) -> Option<FrameTransforms> {
    let stamp_ns = map.header().capture_end_ns;
    let transform = transform(stamp_ns, MAP_FRAME, &base_frame(map.vehicle()), &map_from_ego(map)?);
    Some(FrameTransforms { transforms: vec![transform] })
}

/// Where a frame lies in its parent.
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

/// Points of a frame, metres.
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

/// Seconds beyond what the message can say (before 1970, after 2106) are held at its limits.
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
