//! Properties of the codec: cells decode to themselves, each content has one encoding, and no input makes it panic.

use bytes::Bytes;
use clearway_proto::codec::{self, Cells, DecodeError, Limits};
use clearway_proto::{map, v1};
use proptest::collection::vec;
use proptest::prelude::*;

/// Cells of all types: runs of few values, and noise.
fn cells() -> impl Strategy<Value = Cells> {
    let spans = |length| vec((any::<u16>(), prop_oneof![Just(1_usize), 1..40_usize, 1..2000_usize]), 0..length);
    let spread = |spans: Vec<(u16, usize)>| spans.into_iter().flat_map(|(v, n)| std::iter::repeat_n(v, n)).collect();
    (spans(40).prop_map(spread), 0..3_u8).prop_map(|(values, kind): (Vec<u16>, u8)| match kind {
        0 => Cells::U8(values.into_iter().map(|v| v as u8).collect()),
        1 => Cells::I8(values.into_iter().map(|v| v as i8).collect()),
        _ => Cells::U16(values),
    })
}

/// Norms of a quaternion, and whether a pose may have them.
fn norms() -> impl Strategy<Value = (f64, bool)> {
    prop_oneof![
        (0.9995..1.0005_f64).prop_map(|norm| (norm, true)),
        prop_oneof![0.0..0.998_f64, 1.002..3.0_f64].prop_map(|norm| (norm, false)),
    ]
}

proptest! {
    #[test]
    fn cells_decode_to_themselves_and_never_exceed_the_raw_size(cells in cells(), columns in 1..3000_usize) {
        let encoded = codec::encode_grid(cells.as_ref(), columns);
        prop_assert!(encoded.payload.len() <= cells.as_ref().to_le_bytes().len());
        let channel = encoded.into_channel("c", "", 1.0, 0);
        prop_assert_eq!(codec::decode(&channel, columns, &Limits::default()), Ok(cells));
    }

    #[test]
    fn only_canonical_rows_decode(
        columns in 1..6_usize, bytes in vec(any::<u8>(), 0..12), cell_count in 5..60_u32,
    ) {
        let (cell_type, encoding) = (v1::CellType::U8 as i32, v1::Encoding::Rows as i32);
        let mut channel = v1::Channel { cell_type, encoding, cell_count, payload: bytes.into(), ..Default::default() };
        // The CRC is corrected if it alone is wrong, so that only the canonical form decides.
        if let Err(DecodeError::Crc { computed, .. }) = codec::decode(&channel, columns, &Limits::default()) {
            channel.crc32 = computed;
        }
        if let Ok(cells) = codec::decode(&channel, columns, &Limits::default()) {
            prop_assert_eq!(codec::encode_grid(cells.as_ref(), columns).payload, channel.payload);
        }
    }

    #[test]
    fn a_pose_decodes_exactly_if_its_quaternion_has_norm_1(
        [qx, qy, qz, qw] in [-1.0..1.0_f64, -1.0..1.0, -1.0..1.0, -1.0..1.0], (norm, allowed) in norms(),
    ) {
        let scale = norm / (qx * qx + qy * qy + qz * qz + qw * qw).sqrt().max(1e-9);
        let [qx, qy, qz, qw] = [qx, qy, qz, qw].map(|part| part * scale);
        let pose = v1::Pose { x: 1.0, y: -2.0, z: 0.5, qx, qy, qz, qw };
        let header = v1::Header { map_from_ego: Some(pose), ..Default::default() };
        let decoded = map::decode_map(map::encode_header(&header), &Limits::default());
        prop_assert_eq!(decoded.is_ok(), allowed, "{:?}", decoded);
    }

    #[test]
    fn any_bytes_decode_or_are_refused(bytes in vec(any::<u8>(), 0..400)) {
        let _ = map::decode_map(Bytes::from(bytes), &Limits::default());
    }

    #[test]
    fn a_golden_map_with_changed_bytes_decodes_or_is_refused(
        changes in vec((any::<prop::sample::Index>(), any::<u8>()), 1..6),
    ) {
        let mut bytes = include_bytes!("../golden/map.bin").to_vec();
        for (at, byte) in changes {
            let at = at.index(bytes.len());
            bytes[at] = byte;
        }
        if let Ok(map) = map::decode_map(Bytes::from(bytes), &Limits::default()) {
            for layer in &map.layers {
                layer.class_at(3.0, 4.0);
                for channel in &layer.channels {
                    prop_assert_eq!(channel.cells.len() as u64, layer.grid.cell_count());
                }
            }
        }
    }

    #[test]
    fn the_centre_of_a_cell_lies_in_that_cell(
        widths in vec(0.01_f32..3.0, 1..60), columns in 1..720_u32, at in any::<prop::sample::Index>(),
    ) {
        let row_radius_m = widths.iter().scan(0.0, |r, step| { *r += step; Some(*r) }).collect();
        let grid = clearway_proto::grid::Grid::Radial { centre_m: [0.0; 2], row_radius_m, columns };
        let index = at.index(grid.cell_count() as usize);
        let (x, y) = grid.centre_of(index).unwrap();
        prop_assert_eq!(grid.cell_at(x, y), Some(index));
    }
}

#[test]
fn a_map_over_the_limit_of_cells_is_refused_before_they_are_decoded() {
    // Each channel is within the limit of one channel; together they would need 80 MiB for 120 bytes.
    let channel = |name: usize| v1::Channel {
        name: name.to_string(),
        cell_type: v1::CellType::U16.into(),
        encoding: v1::Encoding::Rows.into(),
        cell_count: 4 << 20,
        payload: Bytes::from_static(&[0, 0, 2, 0, 0, 8]),
        ..Default::default()
    };
    let layer = v1::Layer { channels: (0..10).map(channel).collect(), ..Default::default() };
    let bytes = [map::encode_header(&v1::Header::default()), map::encode_layer(&layer)].concat();
    let refused = map::decode_map(bytes.into(), &Limits::default()).unwrap_err();
    assert_eq!(refused, map::MapError::TooManyCells { cells: 40 << 20, allowed: 16 << 20 });
}

#[test]
fn a_map_of_a_million_empty_layers_is_refused_before_it_is_decoded() {
    // Field 2 of `Map`, a layer, of no bytes.
    let hostile = Bytes::from([0x12, 0x00].repeat(1 << 20));
    let allowed = Limits::default().map_parts;
    let refused = map::decode_map(hostile, &Limits::default());
    assert_eq!(refused, Err(map::MapError::TooManyParts { parts: 1 << 20, allowed }));
}
