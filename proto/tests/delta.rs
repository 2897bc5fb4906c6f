//! Deltas and regions. A delta applied to its base gives the whole layer; applied to anything else it is refused.

use bytes::Bytes;
use clearway_proto::codec::{Cells, CellsRef, Limits, encode_grid};
use clearway_proto::delta::encode_delta;
use clearway_proto::grid::Grid;
use clearway_proto::map::{self, Channel, Map, MapError, decode_map, decode_map_on};
use clearway_proto::region::{self, RegionError};
use clearway_proto::v1::layer::Geometry;
use clearway_proto::v1::{self, ClassMeaning};
use proptest::prelude::*;
use prost::Message;
use serde_json::json;

use crate::common::{assert_golden, bless, hex, pretty, with_legend};

const LIMITS: fn() -> Limits = Limits::default;

fn header(sequence: u64) -> v1::Header {
    v1::Header { vehicle: "alpha".into(), boot_id: 7, sequence, ..Default::default() }
}

/// The decoded map `sequence` of one layer.
fn decode(sequence: u64, layer: &v1::Layer, base: Option<&Map>) -> Result<Map, MapError> {
    decode_map_on(bytes(&header(sequence), layer), base, &LIMITS())
}

fn bytes(header: &v1::Header, layer: &v1::Layer) -> Bytes {
    [map::encode_header(header), map::encode_layer(layer)].concat().into()
}

/// Raw value of a cell of an endless grid at a time: patches; few change from one time to the next.
fn world(seed: u64, time: u64, ix: i64, iy: i64) -> u16 {
    let hash = |a: i64, b: i64, c: u64| {
        let mut h =
            seed ^ (a as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15) ^ (b as u64).wrapping_mul(0xc2b2_ae3d_27d4_eb4f);
        h ^= c.wrapping_mul(0x1656_67b1_9e37_79f9);
        (h ^ h >> 29).wrapping_mul(0xbf58_476d_1ce4_e5b9) >> 40
    };
    let changed = hash(ix, iy, time).is_multiple_of(300);
    let patch = hash(ix >> 2, iy >> 2, if changed { time } else { 0 });
    // The class of the cell, and a difference within the class.
    (patch % 5 * 13_007 + hash(ix, iy, 0) % 90) as u16
}

/// A layer with three channels, one of each cell type, whose cell (0, 0) is cell `first` of the endless grid.
fn layer(seed: u64, time: u64, first: [i64; 2], [width, height]: [u32; 2]) -> v1::Layer {
    let at = |cell: u32| {
        let (ix, iy) = (i64::from(cell % width), i64::from(cell / width));
        world(seed, time, first[0].wrapping_add(ix), first[1].wrapping_add(iy))
    };
    let cells: Vec<u16> = (0..width * height).map(at).collect();
    let class: Vec<u8> = cells.iter().map(|cell| (cell / 13_007) as u8).collect();
    let height_raw: Vec<i8> = cells.iter().map(|cell| (cell >> 6) as i8).collect();
    let encode = |cells: CellsRef<'_>| encode_grid(cells, width as usize);
    let layer = v1::Layer {
        name: "occupancy".into(),
        geometry: Some(Geometry::Cartesian(v1::CartesianGrid {
            origin_x_m: -1.5,
            origin_y_m: -2.5,
            width,
            height,
            cell_m: 0.5,
            yaw_rad: 0.1 * time as f64,
            first_ix: first[0],
            first_iy: first[1],
        })),
        channels: vec![
            encode(CellsRef::U8(&class)).into_channel("class", "", 1.0, 0),
            encode(CellsRef::I8(&height_raw)).into_channel("unit_height", "m", 0.02, -128),
            encode(CellsRef::U16(&cells)).into_channel("hits", "", 1.0, 65_535),
        ],
        planes: vec![v1::Plane { a: 0.5, b: time as f64, c: 0.0 }],
        metrics: [("share".to_owned(), time as f64)].into(),
        ..Default::default()
    };
    with_legend(
        layer,
        &[
            ("unknown", ClassMeaning::Unknown, 0x3a3f46),
            ("flat", ClassMeaning::Inferred, 0x166e6a),
            ("clear", ClassMeaning::Free, 0x1c9e96),
            ("occupied", ClassMeaning::Occupied, 0xc42638),
            ("hidden", ClassMeaning::Hidden, 0x5c5c80),
        ],
    )
}

fn cartesian(layer: &mut v1::Layer) -> &mut v1::CartesianGrid {
    match &mut layer.geometry {
        Some(Geometry::Cartesian(grid)) => grid,
        other => panic!("{other:?}"),
    }
}

prop_compose! {
    fn place()(at in prop_oneof![-3..3_i64, -60..60_i64, Just(i64::MIN + 100), Just(i64::MAX - 200)]) -> i64 { at }
}

proptest! {
    #[test]
    fn a_delta_on_its_base_gives_the_whole_layer_of_a_scrolled_grid(
        seed in any::<u64>(), size in [1..50_u32, 1..50_u32], grown in [-3..4_i64, -3..4_i64],
        first in [place(), place()], scroll in [place(), place()],
    ) {
        let sizes = [0, 1].map(|i| (i64::from(size[i]) + grown[i]).max(1) as u32);
        let before = layer(seed, 1, first, size);
        let now = layer(seed, 2, [0, 1].map(|i| first[i].wrapping_add(scroll[i])), sizes);
        let base = decode(41, &before, None).unwrap();
        let whole = decode(42, &now, None).unwrap();
        if let Some(delta) = encode_delta(&before, 41, &now, &LIMITS()) {
            prop_assert_eq!(encode_delta(&before, 41, &now, &LIMITS()), Some(delta.clone()));
            prop_assert!(map::encode_layer(&delta).len() < map::encode_layer(&now).len());
            prop_assert_eq!(decode(42, &delta, Some(&base)), Ok(whole));
        }
    }

    #[test]
    fn a_delta_on_another_map_is_refused_and_gives_no_wrong_cell(
        seed in any::<u64>(), base_of_delta in 0..6_u64, scroll in [-2..3_i64, -2..3_i64],
    ) {
        let at = |time: u64| layer(seed, time, scroll.map(|step| step * time as i64), [40, 30]);
        let delta = encode_delta(&at(base_of_delta), base_of_delta, &at(6), &LIMITS());
        let delta = delta.expect("40 x 30 cells of which few change");
        let whole = decode(6, &at(6), None).unwrap();
        for given in 0..6 {
            let base = decode(given, &at(given), None).unwrap();
            match decode(6, &delta, Some(&base)) {
                Ok(map) => prop_assert!(given == base_of_delta && map == whole),
                Err(refused) => prop_assert!(given != base_of_delta && refused.name() == "other_base", "{refused}"),
            }
            // The wrong base with the right identity: the CRC of the cells refuses it.
            let foreign = decode(base_of_delta, &at(given), None).unwrap();
            match decode(6, &delta, Some(&foreign)) {
                Ok(map) => prop_assert_eq!(&map, &whole),
                Err(refused) => {
                    prop_assert!(given != base_of_delta && ["cells", "class"].contains(&refused.name()), "{refused}");
                }
            }
        }
    }

    #[test]
    fn a_delta_with_changed_bytes_decodes_or_is_refused(
        changes in proptest::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..5),
    ) {
        let base = decode(41, &layer(3, 1, [5, 5], [20, 20]), None).unwrap();
        let [before, now] = [layer(3, 1, [5, 5], [20, 20]), layer(3, 2, [6, 3], [20, 20])];
        let delta = encode_delta(&before, 41, &now, &LIMITS()).unwrap();
        let mut bytes = bytes(&header(42), &delta).to_vec();
        for (at, byte) in changes {
            let at = at.index(bytes.len());
            bytes[at] = byte;
        }
        if let Ok(map) = decode_map_on(bytes.into(), Some(&base), &LIMITS()) {
            for layer in &map.layers {
                layer.class_at(3.0, 4.0);
                let has_all_cells = |channel: &Channel| channel.cells.len() as u64 == layer.grid.cell_count();
                prop_assert!(layer.channels.iter().all(has_all_cells));
            }
        }
    }

    #[test]
    fn a_part_has_the_cells_of_the_whole_and_all_cells_of_the_region(
        seed in any::<u64>(), yaw_rad in -4.0..4.0_f64,
        from in [-9.0..9.0_f64, -9.0..9.0_f64], size in [0.1..12.0_f64, 0.1..12.0_f64],
    ) {
        let mut whole = layer(seed, 1, [-17, 4], [30, 20]);
        let grid = cartesian(&mut whole);
        (grid.yaw_rad, grid.origin_x_m, grid.origin_y_m) = (yaw_rad, -7.3, -4.9);
        let wanted = rectangle(from, size);
        let all = decode(1, &whole, None).unwrap();
        let v1::Region { x_from_m, x_to_m, y_from_m, y_to_m } = wanted;
        let inside = |x: f64, y: f64| x_from_m <= x && x <= x_to_m && y_from_m <= y && y <= y_to_m;
        let middles = (0..600).filter_map(|cell| all.layers[0].grid.centre_of(cell)).filter(|&(x, y)| inside(x, y));
        match region::crop(&whole, &wanted, &LIMITS()) {
            Err(refused) => {
                prop_assert!(matches!(refused, RegionError::Outside { .. }), "{refused}");
                prop_assert_eq!(middles.count(), 0);
            }
            Ok(part) => {
                let part = decode(1, &part, None).unwrap();
                for (x, y) in middles {
                    prop_assert!(part.layers[0].grid.cell_at(x, y).is_some());
                }
                let (part, all) = (&part.layers[0], &all.layers[0]);
                for cell in 0..part.grid.cell_count() as usize {
                    let (x, y) = part.grid.centre_of(cell).unwrap();
                    prop_assert_eq!(part.class_at(x, y), all.class_at(x, y));
                    prop_assert_eq!(part.value_at("unit_height", x, y), all.value_at("unit_height", x, y));
                }
            }
        }
    }

    #[test]
    fn a_radial_part_equals_the_whole_in_the_region_and_is_unknown_elsewhere(
        seed in any::<u64>(), columns in 1..40_u32, on_axis in 0..4,
        from in [-12.0..9.0_f64, -12.0..9.0_f64], size in [0.1..14.0_f64, 0.1..14.0_f64],
    ) {
        // Some regions have an edge or a corner at the vehicle.
        let from = [0, 1].map(|axis| if on_axis & (1 << axis) == 0 { from[axis] } else { 0.0 });
        let whole = radial(layer(seed, 1, [0, 0], [columns, 5]), vec![2.0, 5.0, 6.0, 9.0, 11.0]);
        let wanted = rectangle(from, size);
        let Ok(part) = region::crop(&whole, &wanted, &LIMITS()) else { return Ok(()) };
        let (part, all) = (decode(1, &part, None).unwrap(), decode(1, &whole, None).unwrap());
        let (part, all) = (&part.layers[0], &all.layers[0]);
        for step in 0..1000 {
            let along = |axis: usize, by: i32| from[axis] + size[axis] * f64::from(by) / 39.0;
            let (x, y) = (along(0, step % 40), along(1, step / 40 * 39 / 24));
            prop_assert_eq!(part.class_at(x, y), all.class_at(x, y), "at ({}, {})", x, y);
            prop_assert_eq!(part.value_at("unit_height", x, y), all.value_at("unit_height", x, y));
        }
        for (cut, whole) in part.channels.iter().zip(&all.channels) {
            for cell in 0..cut.cells.len() {
                prop_assert!(cut.value(cell).is_none() || cut.value(cell) == whole.value(cell), "cell {}", cell);
            }
        }
    }
}

fn rectangle(from: [f64; 2], size: [f64; 2]) -> v1::Region {
    v1::Region { x_from_m: from[0], x_to_m: from[0] + size[0], y_from_m: from[1], y_to_m: from[1] + size[1] }
}

/// `layer` with a radial grid.
fn radial(mut layer: v1::Layer, row_radius_m: Vec<f32>) -> v1::Layer {
    let columns = layer.channels[0].cell_count / row_radius_m.len() as u32;
    layer.geometry = Some(Geometry::Radial(v1::RadialGrid { row_radius_m, columns, ..Default::default() }));
    layer
}

/// The layers of the golden maps at a time: a Cartesian grid that scrolls, and a radial grid.
fn golden_layers(time: u64) -> [v1::Layer; 2] {
    let scrolled = layer(5, time, [5 + time as i64, -9 - 2 * time as i64], [24, 20]);
    let rings = radial(layer(6, time, [0, 0], [24, 5]), vec![2.0, 5.0, 6.0, 9.0, 11.0]);
    [scrolled, v1::Layer { name: "drivability".into(), ..rings }]
}

fn golden_map(sequence: u64, layers: &[v1::Layer]) -> Vec<u8> {
    let chunks = layers.iter().flat_map(map::encode_layer);
    map::encode_header(&header(sequence)).into_iter().chain(chunks).collect()
}

fn golden_delta() -> [v1::Layer; 2] {
    let (before, now) = (golden_layers(1), golden_layers(2));
    [0, 1].map(|i| encode_delta(&before[i], 41, &now[i], &LIMITS()).expect("a smaller delta"))
}

#[test]
fn the_golden_delta_on_its_base_gives_the_golden_whole_map() {
    let [base, delta, whole] =
        [golden_map(41, &golden_layers(1)), golden_map(42, &golden_delta()), golden_map(42, &golden_layers(2))];
    assert_golden("delta_base.bin", &base);
    assert_golden("delta.bin", &delta);
    assert_golden("delta_whole.bin", &whole);
    let base = decode_map(base.into(), &LIMITS()).unwrap();
    let decoded = decode_map_on(delta.into(), Some(&base), &LIMITS()).unwrap();
    assert_eq!(decoded, decode_map(whole.into(), &LIMITS()).unwrap());
}

/// (name, expected error, bytes): the golden delta with one fault.
fn faulty_deltas() -> [(&'static str, &'static str, Vec<u8>); 4] {
    type Fault = fn(&mut v1::Layer);
    let faults: [(&str, &str, Fault); 4] = [
        ("more_cells_than_the_grid", "cell_count", |layer| layer.channels[0].cell_count += 1),
        ("of_2_32_cells", "too_many_cells", |layer| {
            (cartesian(layer).width, cartesian(layer).height) = (u32::MAX, 1);
            layer.channels.iter_mut().for_each(|channel| channel.cell_count = u32::MAX);
        }),
        ("payload_cut", "cells", |layer| layer.channels[1].payload.truncate(9)),
        ("crc_of_something_else", "cells", |layer| layer.channels[2].crc32 ^= 1),
    ];
    faults.map(|(name, error, inject)| {
        let mut layers = golden_delta();
        inject(&mut layers[0]);
        (name, error, golden_map(42, &layers))
    })
}

#[test]
fn a_delta_without_its_base_or_on_a_wrong_one_is_refused() {
    type Fault = fn(&mut v1::Header, &mut [v1::Layer; 2]);
    let faults: [(&str, &str, Fault); 13] = [
        ("base_of_another_sequence", "other_base", |header, _| header.sequence = 40),
        ("base_of_another_boot", "other_base", |header, _| header.boot_id = 8),
        ("base_of_another_vehicle", "other_base", |header, _| header.vehicle = "beta".into()),
        ("base_without_the_layer", "no_base", |_, [layer, _]| layer.name = "terrain".into()),
        ("base_of_smaller_cells", "base_shape", |_, [layer, _]| cartesian(layer).cell_m = 0.25),
        ("base_of_another_kind", "base_shape", |_, [layer, _]| {
            let row_radius_m = (1..21).map(|row| row as f32).collect();
            layer.geometry = radial(layer.clone(), row_radius_m).geometry
        }),
        ("base_of_other_row_radii", "base_shape", |_, [_, rings]| {
            *rings = radial(rings.clone(), vec![1.0, 5.0, 6.0, 9.0, 11.0])
        }),
        ("base_of_other_columns", "base_shape", |_, [_, rings]| {
            let wider = layer(6, 1, [0, 0], [30, 5]);
            *rings = v1::Layer { name: "drivability".into(), ..radial(wider, row_radii(rings)) };
        }),
        ("base_without_the_channel", "base_shape", |_, [layer, _]| layer.channels.truncate(1)),
        ("base_of_another_type", "base_shape", |_, [layer, _]| {
            layer.channels[2] = v1::Channel { name: "hits".into(), ..layer.channels[0].clone() };
        }),
        ("base_scrolled", "cells", |_, [layer, _]| cartesian(layer).first_ix += 1),
        ("base_far_away", "cells", |_, [layer, _]| cartesian(layer).first_iy = i64::MIN),
        ("base_of_other_cells", "cells", |_, [layer, _]| layer.channels[1] = golden_layers(4)[0].channels[1].clone()),
    ];
    let delta = golden_map(42, &golden_delta());
    let mut vectors = Vec::new();
    let mut refuse = |name: &str, error: &str, base: Option<&[u8]>, delta: &[u8]| {
        let decoded = base.map(|base| decode_map(base.to_vec().into(), &LIMITS()).expect(name));
        let refused = decode_map_on(delta.to_vec().into(), decoded.as_ref(), &LIMITS()).expect_err(name);
        assert_eq!(refused.name(), error, "{name}: {refused}");
        vectors.push(json!({"name": name, "error": error, "base_hex": base.map(hex), "map_hex": hex(delta)}));
    };
    refuse("no_base", "no_base", None, &delta);
    for (name, error, inject) in faults {
        let (mut header, mut layers) = (header(41), golden_layers(1));
        inject(&mut header, &mut layers);
        let base = v1::Map { header: Some(header), layers: layers.to_vec() };
        refuse(name, error, Some(&base.encode_to_vec()), &delta);
    }
    let base = golden_map(41, &golden_layers(1));
    for (name, error, delta) in faulty_deltas() {
        refuse(name, error, Some(&base), &delta);
    }
    assert_eq!(decode_map(delta.into(), &LIMITS()).unwrap_err().name(), "no_base");
    assert_golden("bad_deltas.json", &pretty(&json!(vectors)));
}

fn row_radii(layer: &v1::Layer) -> Vec<f32> {
    match &layer.geometry {
        Some(Geometry::Radial(grid)) => grid.row_radius_m.clone(),
        other => panic!("{other:?}"),
    }
}

#[test]
fn a_delta_over_the_limit_of_cells_is_refused_before_it_is_decoded() {
    let base = decode_map(golden_map(41, &golden_layers(1)).into(), &LIMITS()).unwrap();
    let limits = Limits { channel_cells: 479, ..LIMITS() };
    let refused = decode_map_on(golden_map(42, &golden_delta()).into(), Some(&base), &limits).unwrap_err();
    assert_eq!(refused.name(), "too_many_cells");
}

#[test]
fn a_layer_without_a_smaller_or_comparable_delta_is_sent_whole() {
    let at = |time| layer(9, time, [0, 0], [30, 20]);
    let delta = |before: &v1::Layer, now: &v1::Layer| encode_delta(before, 1, now, &LIMITS());
    let delta_of_two = delta(&at(1), &at(2)).unwrap();
    assert_eq!(delta(&at(1), &layer(9, 2, [0, 1000], [30, 20])), None, "no cell of the base is shared");
    assert_eq!(delta(&delta_of_two, &at(3)), None, "the base must be whole");
    let mut corrupt = at(1);
    corrupt.channels[0].crc32 ^= 1;
    assert_eq!(delta(&corrupt, &at(2)), None);
    let mut finer = at(1);
    finer.channels[1].scale *= 0.5;
    assert_eq!(delta(&finer, &at(2)), None, "the values of another scale are not comparable");
    let rings = |time, last| radial(layer(9, time, [0, 0], [120, 5]), vec![2.0, 5.0, 6.0, 9.0, last]);
    assert!(delta(&rings(1, 11.0), &rings(2, 11.0)).is_some());
    assert_eq!(delta(&rings(1, 11.0), &rings(2, 12.0)), None);
}

#[test]
fn a_radial_part_has_rows_to_the_farthest_corner_and_all_columns() {
    let rings = radial(layer(2, 1, [0, 0], [24, 5]), vec![2.0, 5.0, 6.0, 9.0, 11.0]);
    let corner = |x_to_m, y_to_m| v1::Region { x_from_m: -1.0, x_to_m, y_from_m: -1.0, y_to_m };
    let part = decode(1, &region::crop(&rings, &corner(3.0, 4.0), &LIMITS()).unwrap(), None).unwrap();
    assert_eq!(part.layers[0].grid, Grid::Radial { centre_m: [0.0; 2], row_radius_m: vec![2.0, 5.0], columns: 24 });
    let (whole, Cells::U8(class)) = (decode(1, &rings, None).unwrap(), &part.layers[0].channels[0].cells) else {
        panic!("class of u8")
    };
    assert_eq!(whole.layers[0].channels[0].cells, Cells::U8([&class[..], &rest(&whole, 48)].concat()));
    assert_eq!((&part.layers[0].planes, &part.layers[0].metrics), (&whole.layers[0].planes, &whole.layers[0].metrics));
    // To the left, from the third row on: the columns from 45 to 135 degrees. The first two rows are unknown.
    let left = v1::Region { x_from_m: -5.4, x_to_m: 5.4, y_from_m: 5.5, y_to_m: 7.0 };
    let part = decode(1, &region::crop(&rings, &left, &LIMITS()).unwrap(), None).unwrap();
    let Cells::U8(cut) = &part.layers[0].channels[0].cells else { panic!("class of u8") };
    let all = rest(&whole, 0);
    let expected = (0..96).map(|cell| if cell / 24 >= 2 && (3..9).contains(&(cell % 24)) { all[cell] } else { 0 });
    assert_eq!(*cut, expected.collect::<Vec<u8>>());
    // The region contains the whole layer, which is returned as it is.
    assert_eq!(region::crop(&rings, &corner(99.0, 1.0), &LIMITS()), Ok(rings.clone()));
    let beyond = v1::Region { x_from_m: 8.0, x_to_m: 9.0, y_from_m: -12.0, y_to_m: -8.0 };
    assert!(matches!(region::crop(&rings, &beyond, &LIMITS()), Err(RegionError::Outside { range_m_max: 11.0, .. })));
    for bad in [corner(-1.0, 1.0), corner(f64::NAN, 1.0), corner(1.0, f64::INFINITY)] {
        assert!(matches!(region::crop(&rings, &bad, &LIMITS()), Err(RegionError::Bounds { .. })), "{bad:?}");
    }
}

fn rest(map: &Map, from: usize) -> Vec<u8> {
    match &map.layers[0].channels[0].cells {
        Cells::U8(cells) => cells[from..].to_vec(),
        other => panic!("{other:?}"),
    }
}

#[test]
fn a_part_is_the_base_for_the_same_part_of_the_next_map() {
    // The vehicle rotates, so the part grows, shrinks and scrolls by cells.
    let ahead = v1::Region { x_from_m: 0.0, x_to_m: 6.0, y_from_m: -3.0, y_to_m: 3.0 };
    let scrolling = |time: u64| {
        let mut whole = layer(4, time, [time as i64, -3], [60, 60]);
        (cartesian(&mut whole).origin_x_m, cartesian(&mut whole).origin_y_m) = (-15.1, -15.2);
        whole
    };
    let rings = |time: u64| radial(layer(4, time, [0, 0], [60, 20]), (1..=20).map(|row| row as f32).collect());
    for whole in [&scrolling as &dyn Fn(u64) -> v1::Layer, &rings] {
        let mut parts = (0..8).map(|time| region::crop(&whole(time), &ahead, &LIMITS()).unwrap());
        let mut before = parts.next().unwrap();
        let mut base = decode(0, &before, None).unwrap();
        for (sequence, now) in (1..).zip(parts) {
            let delta = encode_delta(&before, sequence - 1, &now, &LIMITS()).expect("a smaller delta");
            let decoded = decode(sequence, &delta, Some(&base)).unwrap();
            assert_eq!(decoded, decode(sequence, &now, None).unwrap());
            (before, base) = (now, decoded);
        }
    }
}

#[test]
fn the_fuzz_corpus_of_deltas_decodes_or_is_refused() {
    let corpus = concat!(env!("CARGO_MANIFEST_DIR"), "/fuzz/corpus/decode_delta");
    let delta = golden_map(42, &golden_delta());
    let cut = delta[..delta.len() / 2].to_vec();
    let seeds = [("cut", cut), ("whole", golden_map(42, &golden_layers(2))), ("golden", delta)];
    bless(corpus, seeds.into_iter().chain(faulty_deltas().map(|(name, _, delta)| (name, delta))));
    let base = golden_map(41, &golden_layers(1)).into();
    let base = decode_map(base, &LIMITS()).unwrap();
    let mut maps = Vec::new();
    for entry in std::fs::read_dir(corpus).unwrap() {
        let path = entry.unwrap().path();
        if decode_map_on(std::fs::read(&path).unwrap().into(), Some(&base), &LIMITS()).is_ok() {
            maps.push(path.file_name().unwrap().to_owned());
        }
    }
    maps.sort_unstable();
    assert_eq!(maps, ["golden", "whole"]);
}
