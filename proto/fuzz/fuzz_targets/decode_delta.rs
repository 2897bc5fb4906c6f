//! On the golden base any bytes are a map or are refused; what is a map has the cells its grid promises.
#![no_main]

use bytes::Bytes;
use clearway_proto::codec::Limits;
use clearway_proto::map::{decode_map, decode_map_on};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    let limits = Limits::default();
    let base = decode_map(Bytes::from_static(include_bytes!("../../golden/delta_base.bin")), &limits).expect("a map");
    if let Ok(map) = decode_map_on(Bytes::copy_from_slice(bytes), Some(&base), &limits) {
        for layer in &map.layers {
            assert!(layer.channels.iter().all(|channel| channel.cells.len() as u64 == layer.grid.cell_count()));
        }
    }
});
