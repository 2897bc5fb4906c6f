//! Channels with a class table: shorter, and with the same cells.

use bytes::Bytes;
use clearway_proto::by_class::encode_beside;
use clearway_proto::codec::{Cells, CellsRef, Limits, encode_grid};
use clearway_proto::delta::encode_delta;
use clearway_proto::map::{Map, decode_map, decode_map_on, encode_header, encode_layer};
use clearway_proto::v1::{self, ClassMeaning};
use proptest::collection::vec;
use proptest::prelude::*;
use prost::Message;

use crate::common::{assert_golden, with_legend};

const CLASSES: [(&str, ClassMeaning, u32); 4] = [
    ("unknown", ClassMeaning::Unknown, 0x3a3f46),
    ("clear", ClassMeaning::Free, 0x1c9e96),
    ("occupied", ClassMeaning::Occupied, 0xc42638),
    ("hidden", ClassMeaning::Hidden, 0x5c5c80),
];

/// The bytes of a map with one layer: these classes and channels, with class tables if `by_class`.
fn bytes(class: &[u8], columns: u32, channels: &[(&str, Cells)], by_class: bool) -> Bytes {
    let beside = |cells: CellsRef<'_>| match by_class {
        true => encode_beside(cells, class, CLASSES.len(), columns as usize),
        false => encode_grid(cells, columns as usize),
    };
    let others = channels.iter().map(|(name, cells)| beside(cells.as_ref()).into_channel(name, "", 1.0, 0));
    let of_class = encode_grid(CellsRef::U8(class), columns as usize).into_channel("class", "", 1.0, 0);
    let layer = v1::Layer {
        name: "occupancy".into(),
        geometry: Some(v1::layer::Geometry::Cartesian(v1::CartesianGrid {
            width: columns,
            height: class.len() as u32 / columns,
            cell_m: 0.25,
            ..Default::default()
        })),
        channels: std::iter::once(of_class).chain(others).collect(),
        ..Default::default()
    };
    let header = v1::Header { vehicle: "alpha".into(), boot_id: 7, sequence: 3, ..Default::default() };
    [encode_header(&header), encode_layer(&with_legend(layer, &CLASSES))].concat().into()
}

fn decode(bytes: &Bytes) -> Map {
    decode_map(bytes.clone(), &Limits::default()).unwrap()
}

/// Arcs of classes. Each channel has one value per class except in few cells.
fn golden_channels() -> (Vec<u8>, Vec<(&'static str, Cells)>) {
    let class: Vec<u8> = (0..1200).map(|cell| (((cell / 40) * (cell / 40) + (cell % 40) * 7) / 60 % 4) as u8).collect();
    let other = |cell: usize| cell.is_multiple_of(97);
    let of = |table: [i32; 4]| {
        let cell = move |(cell, class): (usize, &u8)| table[usize::from(*class)] + if other(cell) { 5 } else { 0 };
        class.iter().enumerate().map(cell).collect::<Vec<i32>>()
    };
    let channels = vec![
        ("hits", Cells::U8(of([0, 3, 250, 255]).iter().map(|value| *value as u8).collect())),
        ("unit_height", Cells::I8(of([-128, 2, -7, 125]).iter().map(|value| *value as i8).collect())),
        ("difference", Cells::U16(of([65_535, 0, 300, 40_000]).iter().map(|value| *value as u16).collect())),
    ];
    (class, channels)
}

#[test]
fn the_golden_map_with_class_tables_equals_the_one_without() {
    let (class, channels) = golden_channels();
    let [tables, plain] = [true, false].map(|by_class| bytes(&class, 40, &channels, by_class));
    assert_golden("by_class.bin", &tables);
    assert_golden("by_class_plain.bin", &plain);
    let map = decode(&tables);
    assert_eq!(map, decode(&plain));
    channels.iter().for_each(|(name, cells)| assert_eq!(&map.layers[0].channel(name).unwrap().cells, cells, "{name}"));
    let with_tables = v1::Map::decode(&tables[..]).unwrap().layers.remove(0).channels;
    let lengths: Vec<usize> = with_tables.iter().map(|channel| channel.by_class.len()).collect();
    assert_eq!(lengths, [0, 4, 4, 8]);
    assert!(tables.len() * 10 < plain.len() * 9, "{} bytes, and {} without tables", tables.len(), plain.len());
}

#[test]
fn a_channel_of_a_delta_has_a_class_table_if_that_is_shorter() {
    let (class, channels) = golden_channels();
    let before = bytes(&class, 40, &channels, true);
    // The new classes have nothing to do with the old classes; the values of each class stay.
    let later: Vec<u8> = (0..1200).map(|cell: u32| (cell / 40 / 7 + cell % 40 / 9) as u8 % 4).collect();
    let of = |table: [u8; 4]| Cells::U8(later.iter().map(|class| table[usize::from(*class)]).collect());
    let after = [("hits", of([0, 3, 250, 255])), channels[1].clone(), channels[2].clone()];
    let after = bytes(&later, 40, &after, true);
    let layer = |bytes: &Bytes| v1::Map::decode(&bytes[..]).unwrap().layers.remove(0);
    let delta =
        encode_delta(&layer(&before), 3, &layer(&after), &Limits::default()).expect("two channels have not changed");
    let lengths: Vec<usize> = delta.channels.iter().map(|channel| channel.by_class.len()).collect();
    assert_eq!(lengths, [0, 4, 0, 0]);
    let header = v1::Header { vehicle: "alpha".into(), boot_id: 7, sequence: 4, ..Default::default() };
    let bytes = [encode_header(&header), encode_layer(&delta)].concat().into();
    let decoded = decode_map_on(bytes, Some(&decode(&before)), &Limits::default()).unwrap();
    assert_eq!(decoded.layers, decode(&after).layers);
}

proptest! {
    #[test]
    fn class_tables_keep_the_cells_and_do_not_enlarge_the_map(
        columns in 1..20_u32,
        stretches in vec((0..4_u8, 1..60_usize), 1..30),
        values in vec(any::<u16>(), 4),
        noise in vec((any::<prop::sample::Index>(), any::<u16>()), 0..40),
    ) {
        let mut class: Vec<u8> = stretches.iter().flat_map(|&(class, length)| vec![class; length]).collect();
        class.resize(class.len().next_multiple_of(columns as usize), 0);
        let mut cells: Vec<u16> = class.iter().map(|&class| values[usize::from(class)]).collect();
        noise.iter().for_each(|(at, value)| *at.get_mut(&mut cells) = *value);
        let channels = [
            ("u16", Cells::U16(cells.clone())),
            ("u8", Cells::U8(cells.iter().map(|cell| *cell as u8).collect())),
            ("i8", Cells::I8(cells.iter().map(|cell| *cell as i8).collect())),
        ];
        let [tables, plain] = [true, false].map(|by_class| bytes(&class, columns, &channels, by_class));
        prop_assert_eq!(decode(&tables), decode(&plain));
        // The field of a class table needs two bytes beside the table.
        prop_assert!(tables.len() <= plain.len() + 2 * channels.len());
        prop_assert_eq!(&tables, &bytes(&class, columns, &channels, true));
    }
}
