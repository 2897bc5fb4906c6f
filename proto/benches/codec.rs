//! Cells <-> payload: 160,000 cells (400 x 400) that resemble a drivability map, with noise; and a layer of them as a
//! delta to the layer before, from which it has scrolled by 3 cells.

use clearway_proto::by_class::encode_beside;
use clearway_proto::codec::{self, Cells, Limits};
use clearway_proto::delta;
use clearway_proto::legend::encode_legend;
use clearway_proto::map::{decode_map, decode_map_on, encode_header, encode_layer};
use clearway_proto::v1;
use divan::{Bencher, counter::ItemsCount};

const SIDE: usize = 400;

/// Three classes in patches, and `noise` stray cells per thousand.
fn scene(noise: u32) -> Cells {
    let mut state = 1_u32;
    let mut random = || {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        state >> 16
    };
    let class = |x: usize, y: usize| {
        let wave = ((x as f32 / 23.0).sin() * 40.0) as isize + 200;
        u8::from((y as isize) < wave) + u8::from((x / 50 + y / 70).is_multiple_of(4))
    };
    let cells = (0..SIDE * SIDE).map(|i| if random() % 1000 < noise { 3 } else { class(i % SIDE, i / SIDE) });
    Cells::U8(cells.collect())
}

#[divan::bench(args = [0, 20, 500])]
fn encode(bencher: Bencher, noise: u32) {
    let cells = scene(noise);
    bencher.counter(ItemsCount::new(cells.len())).bench(|| codec::encode_grid(divan::black_box(cells.as_ref()), SIDE));
}

#[divan::bench(args = [0, 20, 500])]
fn decode(bencher: Bencher, noise: u32) {
    let cells = scene(noise);
    let channel = codec::encode_grid(cells.as_ref(), SIDE).into_channel("class", "", 1.0, 0);
    println!("noise {noise} per thousand: {} bytes", channel.payload.len());
    bencher
        .counter(ItemsCount::new(cells.len()))
        .bench(|| codec::decode(divan::black_box(&channel), SIDE, &Limits::default()));
}

/// A channel with one value per class, except in `noise` cells per thousand.
#[divan::bench(args = [0, 20])]
fn encode_by_class(bencher: Bencher, noise: u32) {
    let (Cells::U8(class), Cells::U8(noisy)) = (scene(0), scene(noise)) else { unreachable!("scene() gives u8") };
    let hits: Vec<u8> = noisy.iter().map(|class| 40 * class).collect();
    let hits = codec::CellsRef::U8(&hits);
    println!("noise {noise} per thousand: {} bytes", encode_beside(hits, &class, 4, SIDE).payload.len());
    bencher.counter(ItemsCount::new(SIDE * SIDE)).bench(|| encode_beside(divan::black_box(hits), &class, 4, SIDE));
}

/// The scene as a layer whose cell (0, 0) has the number (`first_ix`, 0).
fn layer(first_ix: i64) -> v1::Layer {
    let Cells::U8(scene) = scene(0) else { unreachable!("scene() gives u8") };
    let shift = first_ix as usize;
    let class = |cell: usize| {
        let changed = cell.wrapping_mul(2_654_435_761) % 1000 < 5 * shift;
        if changed { 3 } else { scene[cell / SIDE * SIDE + (cell + shift) % SIDE] }
    };
    let cells: Vec<u8> = (0..SIDE * SIDE).map(class).collect();
    let side = SIDE as u32;
    let grid = v1::CartesianGrid { width: side, height: side, cell_m: 0.25, first_ix, ..Default::default() };
    let mut layer = v1::Layer {
        name: "occupancy".into(),
        geometry: Some(v1::layer::Geometry::Cartesian(grid)),
        channels: vec![codec::encode_grid(codec::CellsRef::U8(&cells), SIDE).into_channel("class", "", 1.0, 0)],
        ..Default::default()
    };
    let classes = [
        ("unknown", v1::ClassMeaning::Unknown, 0x3a3f46),
        ("clear", v1::ClassMeaning::Free, 0x1c9e96),
        ("occupied", v1::ClassMeaning::Occupied, 0xc42638),
        ("occluded", v1::ClassMeaning::Hidden, 0x5c5c80),
    ];
    encode_legend(&mut layer, classes);
    layer
}

#[divan::bench]
fn encode_delta(bencher: Bencher) {
    let (before, now) = (layer(0), layer(3));
    bencher
        .counter(ItemsCount::new(SIDE * SIDE))
        .bench(|| delta::encode_delta(divan::black_box(&before), 1, &now, &Limits::default()));
}

#[divan::bench]
fn decode_delta(bencher: Bencher) {
    let (before, now) = (layer(0), layer(3));
    let message = |sequence, layer: &v1::Layer| {
        [encode_header(&v1::Header { sequence, ..Default::default() }), encode_layer(layer)].concat().into()
    };
    let base = decode_map(message(1, &before), &Limits::default()).expect("a map");
    let delta = delta::encode_delta(&before, 1, &now, &Limits::default()).expect("a smaller delta");
    let message: bytes::Bytes = message(2, &delta);
    println!("delta: {} bytes, whole: {}", message.len(), encode_layer(&now).len());
    bencher
        .counter(ItemsCount::new(SIDE * SIDE))
        .bench(|| decode_map_on(divan::black_box(message.clone()), Some(&base), &Limits::default()));
}

fn main() {
    divan::main();
}
