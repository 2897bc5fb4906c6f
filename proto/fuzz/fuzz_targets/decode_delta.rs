//! Any bytes decode on the golden base or are refused. A decoded map has the cells of its grids.
#![no_main]

use std::sync::LazyLock;

use bytes::Bytes;
use clearway_proto::codec::Limits;
use clearway_proto::map::{Map, decode_map, decode_map_on};
use libfuzzer_sys::fuzz_target;

static BASE: LazyLock<Map> = LazyLock::new(|| {
    decode_map(Bytes::from_static(include_bytes!("../../golden/delta_base.bin")), &Limits::default()).expect("a map")
});

fuzz_target!(|bytes: &[u8]| {
    if let Ok(map) = decode_map_on(Bytes::copy_from_slice(bytes), Some(&BASE), &Limits::default()) {
        for layer in &map.layers {
            assert!(layer.channels.iter().all(|channel| channel.cells.len() as u64 == layer.grid.cell_count()));
        }
    }
});
