//! The golden vectors in `golden/`: the encoder writes exactly these files, and the decoder accepts or refuses their
//! contents by name. Clients in other languages read the same files. `CLEARWAY_BLESS=1` writes them again.

use bytes::Bytes;
use clearway_proto::codec::{self, Cells, Limits};
use clearway_proto::legend::encode_legend;
use clearway_proto::v1::ClassMeaning;
use clearway_proto::{limits, map, safe_points, v1};
use prost::Message;
use serde_json::{Value, json};

use crate::common::{assert_golden, bless, golden, hex, pretty, with_legend};

fn unhex(text: &str) -> Vec<u8> {
    (0..text.len()).step_by(2).map(|at| u8::from_str_radix(&text[at..at + 2], 16).unwrap()).collect()
}

/// Cells as [value, length] pairs, so that long lists stay readable.
fn spans(cells: &Cells) -> Vec<[i64; 2]> {
    let mut spans: Vec<[i64; 2]> = Vec::new();
    for value in (0..cells.len()).map(|index| i64::from(cells.get(index).unwrap())) {
        match spans.last_mut() {
            Some(last) if last[0] == value => last[1] += 1,
            _ => spans.push([value, 1]),
        }
    }
    spans
}

fn good_vectors() -> Vec<(&'static str, Cells)> {
    let boundary = |length: usize| [vec![3; length], vec![0; 2]].concat();
    vec![
        ("empty", Cells::U8(vec![])),
        ("single_cell", Cells::U8(vec![7])),
        ("single_run", Cells::U8(vec![1; 100_000])),
        ("two_cells_equal", Cells::U8(vec![1; 2])),
        ("three_cells_equal", Cells::U8(vec![1; 3])),
        ("alternating", Cells::U8((0..64).map(|i| i % 2).collect())),
        ("largest_value", Cells::U8(vec![255; 9])),
        ("run_of_128", Cells::U8(boundary(128))),
        ("run_of_129", Cells::U8(boundary(129))),
        ("run_of_16385", Cells::U8(boundary(16_385))),
        ("signed", Cells::I8([vec![-128; 20], vec![-1; 20], vec![0; 20], vec![1; 20], vec![127; 20]].concat())),
        ("signed_alternating", Cells::I8((0..40).map(|i| if i % 2 == 0 { -1 } else { 1 }).collect())),
        ("u16", Cells::U16([vec![0; 9], vec![255; 9], vec![256; 9], vec![65_535; 9]].concat())),
        ("u16_ascending", Cells::U16((0..300).collect())),
        ("u16_pairs", Cells::U16((0..200).map(|i| i / 2).collect())),
    ]
}

/// Name, cells and number of columns of grids whose rows resemble one another.
fn good_grids() -> Vec<(&'static str, Cells, usize)> {
    let patch = |cell: usize| u8::from((4..9).contains(&(cell / 20)) && (3..12).contains(&(cell % 20)));
    let arcs = |cell: usize| ((cell / 20).pow(2) + (cell % 20).pow(2)) / 40;
    vec![
        ("rows_of_zeros", Cells::U8(vec![0; 4000]), 40),
        ("rows_of_ones", Cells::U8(vec![1; 4000]), 40),
        ("rows_patch", Cells::U8((0..400).map(patch).collect()), 20),
        ("rows_arcs_signed", Cells::I8((0..400).map(|cell| 3 - arcs(cell) as i8).collect()), 20),
        ("rows_arcs_u16", Cells::U16((0..400).map(|cell| 300 * arcs(cell) as u16).collect()), 20),
        ("rows_one_column", Cells::U8((0..100).map(|cell| cell / 30).collect()), 1),
    ]
}

#[test]
fn the_encoder_writes_the_golden_channels() {
    let mut vectors = Vec::new();
    let rows_of_one = good_vectors().into_iter().map(|(name, cells)| (name, cells.clone(), cells.len().max(1)));
    for (name, cells, columns) in rows_of_one.chain(good_grids()) {
        let channel = codec::encode_grid(cells.as_ref(), columns).into_channel(name, "", 1.0, 0);
        assert_eq!(codec::decode(&channel, columns, &Limits::default()), Ok(cells.clone()), "{name}");
        vectors.push(json!({
            "name": name,
            "cell_type": channel.cell_type,
            "encoding": channel.encoding,
            "cell_count": channel.cell_count,
            "columns": columns,
            "crc32": channel.crc32,
            "payload_hex": hex(&channel.payload),
            "cells_value_length": spans(&cells),
        }));
    }
    assert_golden("channels.json", &pretty(&json!(vectors)));
}

/// (name, expected variant, cell type, encoding, cell count, payload) of a channel with 3 columns; the CRC is 0.
type Bad = (&'static str, &'static str, i32, i32, u32, Vec<u8>);

fn bad_vectors() -> Vec<Bad> {
    let (u8_, i8_, u16_) = (v1::CellType::U8 as i32, v1::CellType::I8 as i32, v1::CellType::U16 as i32);
    let raw = v1::Encoding::Raw as i32;
    let (rows, changes) = (v1::Encoding::Rows as i32, v1::Encoding::Changes as i32);
    let max = u32::MAX;
    vec![
        ("claims_2_32_cells_as_one_copy", "TooManyCells", u8_, rows, max, vec![0, 0, 0, 0, 0x80, 0, 0, 0, 0]),
        ("claims_2_32_cells_with_nothing", "TooManyCells", u16_, rows, max, vec![]),
        ("claims_2_32_changes", "TooManyCells", u8_, changes, max, vec![0; 4]),
        ("claims_2_32_raw_cells", "TooManyCells", u8_, raw, max, vec![0; 4]),
        ("one_cell_over_the_limit", "TooManyCells", u8_, rows, (4 << 20) + 1, vec![0, 0, 2, 0, 0, 4]),
        ("cell_type_unspecified", "CellType", 0, raw, 1, vec![0]),
        ("cell_type_undefined", "CellType", 9, raw, 1, vec![0]),
        ("cell_type_negative", "CellType", -1, raw, 1, vec![0]),
        ("encoding_unspecified", "Encoding", u8_, 0, 1, vec![0]),
        ("encoding_undefined", "Encoding", u8_, 7, 1, vec![0]),
        ("encoding_negative", "Encoding", u8_, i32::MIN, 1, vec![0]),
        ("raw_short", "RawLength", u8_, raw, 5, vec![0; 4]),
        ("raw_long", "RawLength", u8_, raw, 3, vec![0; 4]),
        ("raw_empty", "RawLength", u8_, raw, 3, vec![]),
        ("raw_of_zero_cells", "RawLength", u8_, raw, 0, vec![0]),
        ("raw_u16_odd", "RawLength", u16_, raw, 2, vec![0; 3]),
        ("raw_u16_in_single_bytes", "RawLength", u16_, raw, 4, vec![0; 4]),
        ("raw_with_a_wrong_crc", "Crc", u8_, raw, 3, vec![1, 2, 3]),
        ("rows_as_long_as_raw", "NotSmaller", u8_, rows, 2, vec![0x60, 0]),
        ("rows_longer_than_raw", "NotSmaller", u8_, rows, 2, vec![0x60, 0, 0]),
        ("rows_of_u16_as_long_as_raw", "NotSmaller", u16_, rows, 1, vec![0x40, 0]),
        ("rows_of_zero_cells", "NotSmaller", u8_, rows, 0, vec![]),
        ("changes_of_zero_cells", "NotSmaller", u8_, changes, 0, vec![0x80]),
        ("changes_without_a_base", "NothingToChange", u8_, changes, 9, vec![0b0000_1001]),
        ("rows_without_payload", "Truncated", u8_, rows, 9, vec![]),
        ("rows_end_inside_a_number", "Truncated", u8_, rows, 9, vec![0]),
        // Copy 3 (00100), value 1 (0 010), and nothing of the run.
        ("rows_end_before_a_run", "Truncated", u8_, rows, 9, vec![0b0010_0001]),
        ("rows_number_with_33_zeros", "Overlong", u8_, rows, 9, vec![0, 0, 0, 0, 0x40]),
        // Copy 0 (1), another value (0), which is 256 (00000000 100000001), a run of 9 (0001001).
        ("rows_u8_256", "ValueTooLarge", u8_, rows, 9, vec![0b1000_0000, 0b0010_0000, 0b0010_0010, 0b0100_0000]),
        ("rows_i8_zigzag_256", "ValueTooLarge", i8_, rows, 9, vec![0x80, 0x20, 0x22, 0x40]),
        // The same with 65536.
        ("rows_u16_65536", "ValueTooLarge", u16_, rows, 9, vec![0x80, 0, 0x20, 0, 0x60]),
        // Copy 0 (1), another value (0), which is 0 (1): the same as before the first row; a run of 9 (0001001).
        ("rows_run_with_the_value_of_the_row_before", "Repeated", u8_, rows, 9, vec![0b1010_0010, 0b0100_0000]),
        // Copy 0, value 1 (0 010), a run of 1 (1); copy 0, value 1, a run of 8 (0001000).
        ("rows_run_that_is_split", "Repeated", u8_, rows, 9, vec![0b1001_0110, 0b0100_0010, 0]),
        // Copy 0, as the cell before: there is none; a run of 9.
        ("rows_first_cell_repeats_the_cell_before", "NothingBefore", u8_, rows, 9, vec![0b1100_0100, 0b1000_0000]),
        // Copy 10 (0001011) of 9 cells.
        ("rows_copy_too_long", "RunTooLong", u8_, rows, 9, vec![0b0001_0110]),
        // Copy 0, value 1 (0 010), a run of 10 (0001010).
        ("rows_run_too_long", "RunTooLong", u8_, rows, 9, vec![0b1001_0000, 0b1010_0000]),
        // Copy 9 (0001010), then a 1 where zeros fill up.
        ("rows_padded_with_a_one", "TrailingBytes", u8_, rows, 9, vec![0b0001_0101]),
        ("rows_with_a_byte_after", "TrailingBytes", u8_, rows, 9, vec![0b0001_0100, 0]),
        ("rows_with_a_wrong_crc", "Crc", u8_, rows, 9, vec![0b0001_0100]),
        // Copy 0, value 1, a run of 4 Mi.
        ("largest_channel_with_a_wrong_crc", "Crc", u16_, rows, 4 << 20, vec![0x90, 0, 0, 0x10, 0, 0, 0]),
    ]
}

#[test]
fn the_limits_are_those_of_the_golden_file() {
    let table: serde_json::Map<_, _> =
        limits::TABLE.iter().map(|(name, value)| ((*name).into(), json!(value))).collect();
    assert_golden("limits.json", &pretty(&Value::Object(table)));
}

#[test]
fn the_examples_in_map_proto_are_what_the_encoder_writes() {
    let specification = include_str!("../clearway/v1/map.proto");
    let has_payload = |payload: &[u8]| {
        let bits: Vec<_> = payload.iter().map(|byte| format!("{byte:08b}")).collect();
        let bytes: Vec<_> = payload.iter().map(|byte| format!("{byte:02x}")).collect();
        let line = format!("Payload: {} = {}", bits.join(" "), bytes.join(" "));
        assert!(specification.contains(&line), "{line}");
    };
    let rows = codec::encode_grid(codec::CellsRef::U8(&[1, 1, 0, 0, 1, 1, 1, 0]), 4);
    assert_eq!(rows.encoding, v1::Encoding::Rows);
    has_payload(&rows.payload);

    // One class: its table makes a base of zeros.
    let cells = [0, 0, 5, 5, 0, 0, 0, 0];
    let payload = vec![0x29, 0xb5, 0x10];
    has_payload(&payload);
    let class = codec::encode_grid(codec::CellsRef::U8(&[0; 8]), 4).into_channel("class", "", 1.0, 0);
    let hits = v1::Channel {
        name: "hits".into(),
        cell_type: v1::CellType::U8.into(),
        encoding: v1::Encoding::Changes.into(),
        cell_count: 8,
        crc32: codec::encode_grid(codec::CellsRef::U8(&cells), 4).crc32,
        payload: payload.into(),
        by_class: vec![0].into(),
        ..Default::default()
    };
    let grid = v1::CartesianGrid { width: 4, height: 2, cell_m: 1.0, ..Default::default() };
    let geometry = Some(v1::layer::Geometry::Cartesian(grid));
    let layer = v1::Layer { geometry, channels: vec![class, hits], ..Default::default() };
    let layer = with_legend(layer, &CLASSES[..1]);
    let bytes = [map::encode_header(&v1::Header::default()), map::encode_layer(&layer)].concat();
    let map = map::decode_map(bytes.into(), &Limits::default()).unwrap();
    assert_eq!(map.layers[0].channels[1].cells, Cells::U8(cells.to_vec()));
}

#[test]
fn every_bad_channel_is_refused_with_its_error() {
    let bad = bad_vectors();
    assert!(bad.len() >= 40, "{}", bad.len());
    let mut vectors = Vec::new();
    for (name, variant, cell_type, encoding, cell_count, payload) in bad {
        let payload_hex = hex(&payload);
        let channel = v1::Channel { cell_type, encoding, cell_count, payload: payload.into(), ..Default::default() };
        let refused = codec::decode(&channel, 3, &Limits::default()).expect_err(name);
        assert!(format!("{refused:?}").starts_with(variant), "{name}: {refused:?}");
        vectors.push(json!({
            "name": name, "error": refused.name(),
            "cell_type": cell_type, "encoding": encoding, "cell_count": cell_count,
            "columns": 3, "crc32": 0, "payload_hex": payload_hex,
        }));
    }
    assert_golden("bad_channels.json", &pretty(&json!(vectors)));
}

#[test]
fn the_stored_channels_decode_to_their_stored_cells() {
    let stored: Vec<Value> = serde_json::from_slice(&std::fs::read(golden("channels.json")).unwrap()).unwrap();
    assert_eq!(stored.len(), good_vectors().len() + good_grids().len());
    for vector in stored {
        let number = |key: &str| vector[key].as_i64().unwrap();
        let channel = v1::Channel {
            cell_type: number("cell_type") as i32,
            encoding: number("encoding") as i32,
            cell_count: number("cell_count") as u32,
            crc32: number("crc32") as u32,
            payload: unhex(vector["payload_hex"].as_str().unwrap()).into(),
            ..Default::default()
        };
        let cells = codec::decode(&channel, number("columns") as usize, &Limits::default()).unwrap();
        assert_eq!(json!(spans(&cells)), vector["cells_value_length"], "{}", vector["name"]);
    }
}

const CLASSES: [(&str, ClassMeaning, u32); 4] = [
    ("unknown", ClassMeaning::Unknown, 0x3a3f46),
    ("drivable", ClassMeaning::Free, 0x1c9e96),
    ("not_drivable", ClassMeaning::NotReached, 0xf4b842),
    ("obstacle", ClassMeaning::Occupied, 0xc42638),
];

fn golden_map() -> (v1::Header, v1::Layer, v1::Layer) {
    let header = v1::Header {
        vehicle: "alpha".into(),
        boot_id: 0x0123_4567_89ab_cdef,
        sequence: 42,
        capture_start_ns: 1_700_000_000_000_000_000,
        capture_end_ns: 1_700_000_000_100_000_000,
        completed_ns: 1_700_000_000_101_000_000,
        valid_until_ns: 1_700_000_000_400_000_000,
        map_from_ego: Some(v1::Pose { x: 1.5, y: -2.0, z: 0.25, qx: 0.0, qy: 0.0, qz: 0.6, qw: 0.8 }),
        speed_mps: Some(15.0),
        sensors: vec![v1::SensorState {
            name: "top".into(),
            model: "hdl64e_s2".into(),
            packets: 348,
            refused: 2,
            returns: 110_000,
            rpm: 600.0,
            completeness: 1.0,
            partial: String::new(),
            ..Default::default()
        }],
        compensation: "poses".into(),
        ..Default::default()
    };
    let radial = v1::RadialGrid { row_radius_m: vec![4.0, 8.0, 12.0], columns: 8, ..Default::default() };
    let class: Vec<u8> = [[1; 8], [1, 1, 1, 1, 2, 2, 1, 1], [0, 0, 1, 1, 3, 3, 0, 0]].concat();
    let height: Vec<i8> = (0..24).map(|i| if i < 16 { -2 } else { i }).collect();
    let drivability = v1::Layer {
        name: "drivability".into(),
        geometry: Some(v1::layer::Geometry::Radial(radial)),
        channels: vec![
            codec::encode_grid(codec::CellsRef::U8(&class), 8).into_channel("class", "", 1.0, 0),
            codec::encode_grid(codec::CellsRef::I8(&height), 8).into_channel("unit_height", "m", 0.02, -128),
        ],
        planes: vec![v1::Plane { a: 0.01, b: -0.02, c: 0.0 }],
        metrics: [("drivable_share".to_string(), 0.8), ("judged_share".to_string(), 0.75)].into(),
        ..Default::default()
    };
    let drivability = with_legend(drivability, &CLASSES);
    let grid = v1::CartesianGrid {
        origin_x_m: -1.0,
        origin_y_m: -0.5,
        width: 4,
        height: 2,
        cell_m: 0.5,
        ..Default::default()
    };
    let hits: Vec<u16> = vec![0, 0, 0, 0, 0, 0, 300, 2];
    let flat = v1::Layer {
        name: "hits".into(),
        geometry: Some(v1::layer::Geometry::Cartesian(grid)),
        channels: vec![codec::encode_grid(codec::CellsRef::U16(&hits), 4).into_channel("hits", "", 1.0, 0)],
        safe_points: Some(safe_points::pack(&points_of_flat(), 0.125)),
        ..Default::default()
    };
    (header, drivability, flat)
}

fn points_of_flat() -> Vec<map::SafePoint> {
    [
        (0.0, 0.0, 0.5, vec![]),
        (0.25, 0.5, 1.5, vec![0]),
        (-0.5, 0.25, 0.75, vec![0, 1]),
        (1.0, -0.125, 0.25, vec![0, 1]),
    ]
    .map(|(x_m, y_m, radius_m, links)| map::SafePoint { x_m, y_m, radius_m, links })
    .to_vec()
}

#[test]
fn the_golden_map_is_its_header_and_its_layers_concatenated() {
    let (header, drivability, flat) = golden_map();
    let bytes = [map::encode_header(&header), map::encode_layer(&drivability), map::encode_layer(&flat)].concat();
    assert_golden("map.bin", &bytes);
    let whole = v1::Map { header: Some(header), layers: vec![drivability, flat] };
    assert_eq!(v1::Map::decode(&bytes[..]).unwrap(), whole);

    let map = map::decode_map(Bytes::from(bytes), &Limits::default()).unwrap();
    assert_eq!(map.layers[1].points, points_of_flat());
    let places =
        [(2.0, 0.1), (0.0, 0.0), (-6.0, -0.1), (-6.0, 0.1), (-10.0, -0.1), (10.0, 0.1), (13.0, 0.0), (0.1, 6.0)];
    let layers: Vec<_> = map
        .layers
        .iter()
        .map(|layer| {
            let channels = layer.channels.iter();
            let channels: Vec<_> = channels
                .map(|c| {
                    let cells = spans(&c.cells);
                    json!({
                        "name": c.name, "unit": c.unit, "scale": c.scale, "unknown": c.unknown,
                        "cells_value_length": cells,
                    })
                })
                .collect();
            let (rows, columns) = layer.grid.shape();
            let points: Vec<_> = layer
                .points
                .iter()
                .map(|p| json!({"x_m": p.x_m, "y_m": p.y_m, "radius_m": p.radius_m, "links": p.links}))
                .collect();
            let names: Vec<_> = layer.legend.iter().map(|class| &class.name).collect();
            let meanings: Vec<_> = layer.legend.iter().map(|class| class.meaning.as_str_name()).collect();
            let colours: Vec<_> = layer.legend.iter().map(|class| class.rgb).collect();
            json!({
                "name": layer.name, "shape": [rows, columns],
                "legend": names, "legend_meanings": meanings, "legend_rgb": colours,
                "channels": channels, "metrics": layer.metrics, "points": points,
            })
        })
        .collect();
    let layer = map.layer("drivability").unwrap();
    let classes: Vec<_> = places
        .iter()
        .map(|&(x, y)| {
            json!({
                "x_m": x, "y_m": y, "class": layer.class_at(x, y).1, "meaning": layer.meaning_at(x, y).as_str_name(),
            })
        })
        .collect();
    let description = json!({
        "vehicle": map.header.vehicle,
        "sequence": map.header.sequence,
        "capture_end_ns": map.header.capture_end_ns,
        "valid_until_ns": map.header.valid_until_ns,
        "layers": layers,
        "classes_of_drivability": classes,
    });
    assert_golden("map.json", &pretty(&description));
}

/// (name, expected error, fault to inject into the golden map).
type Fault = (&'static str, &'static str, fn(&mut v1::Map));

fn faults() -> [Fault; 43] {
    [
        ("class_table_too_short", "by_class", |map| map.layers[0].channels[1].by_class = vec![1; 3].into()),
        ("class_table_on_channel_class", "by_class", |map| map.layers[0].channels[0].by_class = vec![0; 4].into()),
        ("class_table_without_classes", "by_class", |map| map.layers[1].channels[0].by_class = vec![0; 2].into()),
        ("class_table_without_changes", "by_class", |map| map.layers[0].channels[1].by_class = vec![1; 4].into()),
        ("changes_of_other_cells", "cells", |map| {
            let channel = &mut map.layers[0].channels[1];
            (channel.encoding, channel.by_class) = (v1::Encoding::Changes.into(), vec![1; 4].into());
        }),
        ("changes_in_a_whole_layer", "cells", |map| map.layers[0].channels[1].encoding = v1::Encoding::Changes.into()),
        ("no_header", "header", |map| map.header = None),
        ("capture_ends_before_its_start", "header", |map| map.header.as_mut().unwrap().capture_end_ns = 0),
        ("pose_not_finite", "header", |map| pose(map).x = f64::NAN),
        ("quaternion_of_norm_0", "header", |map| *pose(map) = v1::Pose::default()),
        ("two_layers_with_one_name", "twice", |map| map.layers[1].name = "drivability".into()),
        ("two_channels_with_one_name", "twice", |map| map.layers[0].channels[1].name = "class".into()),
        ("no_geometry", "geometry", |map| map.layers[0].geometry = None),
        ("no_columns", "geometry", |map| radial(map).columns = 0),
        ("no_rows", "geometry", |map| radial(map).row_radius_m.clear()),
        ("row_radii_descending", "geometry", |map| radial(map).row_radius_m[2] = 7.0),
        ("row_radius_not_finite", "geometry", |map| radial(map).row_radius_m[2] = f32::INFINITY),
        ("row_radius_of_0", "geometry", |map| radial(map).row_radius_m[0] = 0.0),
        ("cell_edge_negative", "geometry", |map| cartesian(map).cell_m = -0.5),
        ("origin_not_finite", "geometry", |map| cartesian(map).origin_x_m = f64::NAN),
        ("more_columns_than_cells", "cell_count", |map| radial(map).columns = 0x2000_0000),
        ("legend_without_unknown", "legend", |map| map.layers[0].legend[0] = "free".into()),
        ("legend_without_meanings", "legend", |map| map.layers[0].legend_meanings.clear()),
        ("legend_of_fewer_meanings", "legend", |map| map.layers[0].legend_meanings.truncate(3)),
        ("legend_of_more_colours", "legend", |map| map.layers[0].legend_rgb.push(0)),
        ("legend_of_other_names", "legend", |map| map.layers[0].legend.truncate(3)),
        ("legend_whose_class_0_is_free", "legend", |map| {
            map.layers[0].legend_meanings[0] = ClassMeaning::Free.into();
        }),
        ("legend_colour_of_25_bits", "legend", |map| map.layers[0].legend_rgb[1] = 1 << 24),
        ("class_without_a_name", "class", |map| encode_legend(&mut map.layers[0], CLASSES[..3].iter().copied())),
        ("safe_points_of_infinite_steps", "safe_point", |map| points(map).step_m = f32::INFINITY),
        ("safe_points_in_steps_of_0", "safe_point", |map| points(map).step_m = 0.0),
        ("safe_point_too_far", "safe_point", |map| points(map).x[1] = i32::MIN),
        ("safe_points_of_two_lengths", "safe_point", |map| points(map).y.truncate(3)),
        ("safe_radius_negative", "safe_point", |map| points(map).radius_cm[1] = -51),
        ("safe_start_past_the_last_point", "safe_point", |map| points(map).starts[0] = 4),
        ("safe_start_that_occurs_twice", "safe_point", |map| points(map).starts.push(0)),
        ("safe_link_from_past_the_last_point", "safe_point", |map| points(map).link_from[0] = 4),
        ("safe_link_before_the_first", "safe_point", |map| points(map).link_back[0] = 3),
        ("safe_link_to_the_point_before", "safe_point", |map| points(map).link_back[0] = 1),
        ("safe_points_linked_twice", "safe_point", |map| points(map).link_back[2] = 3),
        ("safe_links_of_two_lengths", "safe_point", |map| points(map).link_back.truncate(2)),
        ("wrong_crc", "cells", |map| map.layers[0].channels[0].crc32 ^= 1),
        ("wire_of_version_2", "version", |map| map.header.as_mut().unwrap().wire_version = 2),
    ]
}

#[test]
fn a_map_with_one_fault_is_refused_with_its_error() {
    let (header, drivability, flat) = golden_map();
    let whole = v1::Map { header: Some(header), layers: vec![drivability, flat] };
    let mut vectors = Vec::new();
    for (name, error, inject) in faults() {
        let mut map = whole.clone();
        inject(&mut map);
        let bytes = map.encode_to_vec();
        let refused = map::decode_map(Bytes::from(bytes.clone()), &Limits::default()).expect_err(name);
        assert_eq!(refused.name(), error, "{name}: {refused}");
        vectors.push(json!({"name": name, "error": error, "map_hex": hex(&bytes)}));
    }
    assert_golden("bad_maps.json", &pretty(&json!(vectors)));
}

#[test]
fn the_fuzz_corpus_decodes_or_is_refused() {
    let corpus = concat!(env!("CARGO_MANIFEST_DIR"), "/fuzz/corpus/decode_map");
    let (header, drivability, flat) = golden_map();
    let golden = v1::Map { header: Some(header), layers: vec![drivability, flat] };
    let bad = faults().map(|(name, _, inject)| {
        let mut map = golden.clone();
        inject(&mut map);
        (name, map.encode_to_vec())
    });
    bless(corpus, bad.into_iter().chain([("golden", golden.encode_to_vec())]));
    let mut maps = Vec::new();
    for entry in std::fs::read_dir(corpus).unwrap() {
        let path = entry.unwrap().path();
        if map::decode_map(std::fs::read(&path).unwrap().into(), &Limits::default()).is_ok() {
            maps.push(path.file_name().unwrap().to_owned());
        }
    }
    maps.sort_unstable();
    assert_eq!(maps, ["golden", "header_alone"]);
}

fn pose(map: &mut v1::Map) -> &mut v1::Pose {
    map.header.as_mut().unwrap().map_from_ego.as_mut().unwrap()
}

fn points(map: &mut v1::Map) -> &mut v1::SafePoints {
    map.layers[1].safe_points.as_mut().unwrap()
}

fn radial(map: &mut v1::Map) -> &mut v1::RadialGrid {
    match &mut map.layers[0].geometry {
        Some(v1::layer::Geometry::Radial(grid)) => grid,
        other => panic!("{other:?}"),
    }
}

fn cartesian(map: &mut v1::Map) -> &mut v1::CartesianGrid {
    match &mut map.layers[1].geometry {
        Some(v1::layer::Geometry::Cartesian(grid)) => grid,
        other => panic!("{other:?}"),
    }
}
