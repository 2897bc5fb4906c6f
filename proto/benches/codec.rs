//! Cells to payload and back: 160,000 cells (400 x 400) of a drivability-like map, and of noise.

use clearway_proto::codec::{self, Cells, Limits};
use divan::{Bencher, counter::ItemsCount};

const SIDE: usize = 400;

/// Three classes in blobs, and `noise` per thousand of stray cells.
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
    bencher.counter(ItemsCount::new(cells.len())).bench(|| codec::encode(divan::black_box(cells.as_ref())));
}

#[divan::bench(args = [0, 20, 500])]
fn decode(bencher: Bencher, noise: u32) {
    let cells = scene(noise);
    let channel = codec::encode(cells.as_ref()).into_channel("class", "", 1.0, 0);
    println!("noise {noise} per thousand: {} bytes", channel.payload.len());
    bencher
        .counter(ItemsCount::new(cells.len()))
        .bench(|| codec::decode(divan::black_box(&channel), &Limits::default()));
}

fn main() {
    divan::main();
}
