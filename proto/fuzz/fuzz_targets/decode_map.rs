//! Any bytes decode or are refused. A decoded map has the cells of its grids.
#![no_main]

use bytes::Bytes;
use clearway_proto::codec::{Limits, encode_grid};
use clearway_proto::map::decode_map;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    if let Ok(map) = decode_map(Bytes::copy_from_slice(bytes), &Limits::default()) {
        for layer in &map.layers {
            layer.class_at(3.0, -4.0);
            for channel in &layer.channels {
                let encoded = encode_grid(channel.cells.as_ref(), layer.grid.shape().1 as usize);
                assert_eq!(u64::from(encoded.cell_count), layer.grid.cell_count());
            }
        }
    }
});
