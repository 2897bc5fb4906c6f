//! A decoder refuses false claims before it allocates memory for them: it allocates at most the length of the payload
//! and 64 KiB, however many cells a channel or map claims.

use bytes::Bytes;
use clearway_proto::codec::{self, Limits};
use clearway_proto::legend::encode_legend;
use clearway_proto::{map, v1};
use peak_alloc::PeakAlloc;
use prost::Message;

#[global_allocator]
static ALLOCATED: PeakAlloc = PeakAlloc;

/// Bytes that may be allocated beside the payload.
const BYTES_MAX: usize = 64 << 10;

/// Runs a function; returns its result and by how many bytes the allocated memory grew at most.
fn peak<T>(run: impl FnOnce() -> T) -> (T, usize) {
    ALLOCATED.reset_peak_usage();
    let before = ALLOCATED.current_usage();
    let result = run();
    (result, ALLOCATED.peak_usage().saturating_sub(before))
}

/// Appends a number in exp-Golomb code, as text of bits.
fn number(bits: &mut String, number: u64) {
    let binary = format!("{:b}", number + 1);
    *bits += &"0".repeat(binary.len() - 1);
    *bits += &binary;
}

fn bytes(bits: &str) -> Vec<u8> {
    let byte = |bits: &[u8]| bits.iter().fold(0, |byte, bit| byte << 1 | (bit & 1)) << (8 - bits.len());
    bits.as_bytes().chunks(8).map(byte).collect()
}

/// Payloads of rows with another number of cells than `count`, and malformed payloads.
fn false_rows(count: u64) -> Vec<Vec<u8>> {
    let copy = |cells: u64| {
        let mut bits = String::new();
        number(&mut bits, cells);
        bits
    };
    let run = |copied: u64, value: u64, cells: u64| {
        let mut bits = copy(copied) + "0";
        number(&mut bits, value);
        number(&mut bits, cells - 1);
        bits
    };
    let most = u64::from(u32::MAX);
    [
        copy(count + 1),
        copy(most),
        copy(count - 1),
        copy(count - 1) + "00",
        copy(count) + "1",
        copy(count) + "00000000",
        copy(count - 1) + "0" + &"0".repeat(40),
        run(0, 1, count + 1),
        run(0, 1, most),
        run(0, 1, count - 1),
        run(1, 1, count),
        run(count - 1, 1, 2),
        run(0, 1 << 20, count),
        run(0, 1, count / 2) + &copy(count),
        run(0, 1, count / 2) + &run(1, 2, count),
    ]
    .iter()
    .map(|bits| bytes(bits))
    .collect()
}

fn channel(cell_type: v1::CellType, encoding: v1::Encoding, cell_count: u32, payload: Vec<u8>) -> v1::Channel {
    let (cell_type, encoding) = (cell_type.into(), encoding.into());
    v1::Channel { name: "class".into(), cell_type, encoding, cell_count, payload: payload.into(), ..Default::default() }
}

/// Channels that claim the greatest allowed number of cells, or more.
fn channels() -> Vec<v1::Channel> {
    let most = Limits::default().channel_cells;
    let mut channels = Vec::new();
    for cell_type in [v1::CellType::U8, v1::CellType::I8, v1::CellType::U16] {
        for payload in false_rows(most.into()) {
            channels.push(channel(cell_type, v1::Encoding::Rows, most, payload));
        }
        for encoding in [v1::Encoding::Raw, v1::Encoding::Rows, v1::Encoding::Changes] {
            for count in [most, most + 1, 1 << 31, u32::MAX] {
                channels.push(channel(cell_type, encoding, count, vec![0; 5]));
            }
        }
    }
    channels
}

/// The bytes of a map with one layer.
fn map_of(geometry: v1::layer::Geometry, channels: Vec<v1::Channel>) -> Vec<u8> {
    let header = v1::Header { vehicle: "car".into(), ..Default::default() };
    let mut layer = v1::Layer { name: "occupancy".into(), geometry: Some(geometry), channels, ..Default::default() };
    encode_legend(&mut layer, [("unknown", v1::ClassMeaning::Unknown, 0), ("clear", v1::ClassMeaning::Free, 0)]);
    v1::Map { header: Some(header), layers: vec![layer] }.encode_to_vec()
}

fn maps() -> Vec<Vec<u8>> {
    let most = Limits::default().channel_cells;
    let square = |width, height| {
        v1::layer::Geometry::Cartesian(v1::CartesianGrid { width, height, cell_m: 0.25, ..Default::default() })
    };
    let radial = |columns| {
        v1::layer::Geometry::Radial(v1::RadialGrid { row_radius_m: vec![1.0, 2.0], columns, ..Default::default() })
    };
    let rows = |count: u32, payload: Vec<u8>| channel(v1::CellType::U8, v1::Encoding::Rows, count, payload);
    let mut maps: Vec<_> = channels().into_iter().map(|channel| map_of(square(2048, 2048), vec![channel])).collect();
    for (width, height) in [(u32::MAX, u32::MAX), (u32::MAX, 1), (65_536, 65_536), (4096, 4096)] {
        maps.push(map_of(square(width, height), vec![rows(width.wrapping_mul(height), vec![0; 5])]));
    }
    for columns in [u32::MAX, 1 << 31, 1 << 23] {
        maps.push(map_of(radial(columns), vec![rows(columns.wrapping_mul(2), vec![0; 5])]));
    }
    // Each channel is within its limit, but all of them together exceed the limit of a map.
    let many = (0..64).map(|index| v1::Channel { name: format!("c{index}"), ..rows(most, vec![0; 5]) });
    maps.push(map_of(square(2048, 2048), many.collect()));
    maps
}

#[test]
fn false_claims_of_cells_are_refused_before_memory_is_allocated() {
    let limits = Limits::default();
    let (channels, maps) = (channels(), maps());
    assert!(channels.len() >= 40 && maps.len() >= 40);
    for channel in &channels {
        let (refused, peak) = peak(|| codec::decode(channel, 2048, &limits));
        let named = format!("{refused:?} for {} cells in {:02x?}", channel.cell_count, &channel.payload[..]);
        assert!(refused.is_err(), "{named}");
        assert!(peak <= channel.payload.len() + BYTES_MAX, "{named}: {peak} bytes");
    }
    for bytes in maps {
        let length = bytes.len();
        let (refused, peak) = peak(|| map::decode_map(Bytes::from(bytes), &limits).map(|_| ()));
        assert!(refused.is_err());
        assert!(peak <= length + BYTES_MAX, "{refused:?}: {peak} bytes");
    }
}
