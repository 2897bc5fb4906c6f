//! A small map with known classes.

// Each test uses a part of this.
#![allow(dead_code)]

use bytes::Bytes;
use clearway_client::codec::{CellsRef, encode_grid};
use clearway_client::v1;
use clearway_proto::legend::encode_legend;
use clearway_proto::map::{encode_header, encode_layer};
use clearway_proto::v1::ClassMeaning;

/// The legend of the layer `drivability`.
pub const LEGEND: [(&str, ClassMeaning, u32); 4] = [
    ("unknown", ClassMeaning::Unknown, 0x3a3f46),
    ("drivable", ClassMeaning::Free, 0x1c9e96),
    ("not_drivable", ClassMeaning::NotReached, 0xf4b842),
    ("obstacle", ClassMeaning::Occupied, 0xc42638),
];

pub const CAPTURE_END_NS: i64 = 1_700_000_000_100_000_000;

/// Classes of three rows of 10 m and four columns of 90 degrees: ahead and to the left drivable, behind and to the left
/// not, behind and to the right unknown, ahead and to the right drivable with an obstacle from 10 to 20 m.
#[rustfmt::skip]
pub const CLASSES: [u8; 12] = [
    1, 2, 0, 1,
    1, 2, 0, 3,
    1, 2, 0, 1,
];

pub fn map(sequence: u64, capture_end_ns: i64) -> Bytes {
    let header = v1::Header {
        vehicle: "alpha".into(),
        boot_id: 7,
        sequence,
        capture_start_ns: capture_end_ns - 100_000_000,
        capture_end_ns,
        completed_ns: capture_end_ns + 1_000_000,
        valid_until_ns: capture_end_ns + 300_000_000,
        ..Default::default()
    };
    let heights: Vec<i8> = (0..12).map(|i| if i == 2 { -128 } else { i }).collect();
    let mut layer = v1::Layer {
        name: "drivability".into(),
        geometry: Some(v1::layer::Geometry::Radial(v1::RadialGrid {
            row_radius_m: vec![10.0, 20.0, 30.0],
            columns: 4,
            ..Default::default()
        })),
        channels: vec![
            encode_grid(CellsRef::U8(&CLASSES), 4).into_channel("class", "", 1.0, 0),
            encode_grid(CellsRef::I8(&heights), 4).into_channel("unit_height", "m", 0.5, -128),
            encode_grid(CellsRef::U16(&[400; 12]), 4).into_channel("segment", "id", 1.0, 65_535),
        ],
        metrics: [("drivable_share".to_string(), 0.625)].into(),
        ..Default::default()
    };
    encode_legend(&mut layer, LEGEND);
    [encode_header(&header), encode_layer(&layer)].concat().into()
}
