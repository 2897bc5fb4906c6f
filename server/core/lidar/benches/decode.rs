//! Time to decode a packet, from bytes to corrected points of a revolution.
//!
//! The streams are generated: packets of an HDL-64E S2 (with and without a table that uses all corrections) and of a
//! VLP-16. Targets: 2.6 µs per packet of an HDL-64E, 2.7 µs per packet of a VLP-16. A packet has 384 points.

use clearway_lidar::model::{BLOCK_FLAGS, BLOCKS_PER_PACKET};
use clearway_lidar::{Calibration, Model, ReturnMode, Sensor, SensorConfig};
use divan::Bencher;
use divan::counter::ItemsCount;

fn main() {
    divan::main();
}

/// Number of packets of a measurement, so that it contains as many cuts per packet as a real stream.
const PACKETS: usize = 2_000;

#[divan::bench(args = [false, true])]
fn hdl64e_packet(bencher: Bencher<'_, '_>, corrected: bool) {
    let mut calibration = Calibration::factory(Model::Hdl64eS2);
    for laser in calibration.lasers.iter_mut().filter(|_| corrected) {
        laser.dist_correction = 1.2;
        (laser.dist_correction_x, laser.dist_correction_y) = (Some(1.23), Some(1.24));
        (laser.vert_offset_correction, laser.horiz_offset_correction) = (0.2, 0.026);
    }
    let calibration = Some(calibration.with_two_point_corrections(true));
    decode(bencher, Model::Hdl64eS2, SensorConfig { calibration, ..SensorConfig::default() });
}

#[divan::bench]
fn vlp16_packet(bencher: Bencher<'_, '_>) {
    decode(bencher, Model::Vlp16, SensorConfig::default());
}

fn decode(bencher: Bencher<'_, '_>, model: Model, config: SensorConfig) {
    let packets: Vec<_> = (0..PACKETS).map(|index| packet(model, index)).collect();
    let mut sensor = Sensor::new(SensorConfig { model: Some(model), ..config });
    bencher.counter(ItemsCount::new(PACKETS)).bench_local(|| {
        for (index, packet) in packets.iter().enumerate() {
            // When the stream begins again, its device time jumps back, and the first packet is refused.
            divan::black_box(sensor.push(packet, index as i64).ok());
        }
    });
}

/// Packet `index` of a stream at 10 revolutions per second: returns at 3 to 60 m, one in eight without an echo.
fn packet(model: Model, index: usize) -> Vec<u8> {
    let spec = model.spec();
    let mut bytes = Vec::with_capacity(1206);
    let firing = index * spec.firings_per_packet(ReturnMode::Strongest);
    for block in 0..BLOCKS_PER_PACKET {
        let place = spec.block_position(block, ReturnMode::Strongest);
        let time_ns = (firing + place.firing) as u64 * u64::from(spec.firing_period_ns);
        let azimuth = time_ns * 36_000 / 100_000_000 % 36_000;
        bytes.extend(BLOCK_FLAGS[place.bank].to_le_bytes());
        bytes.extend((azimuth as u16).to_le_bytes());
        for laser in 0..32_usize {
            let hash = (index * 12 + block) * 32 + laser;
            let hash = hash.wrapping_mul(0x9E37_79B9_7F4A_7C15) >> 40;
            let distance = if hash.is_multiple_of(8) { 0 } else { 1_500 + hash % 28_500 };
            bytes.extend((distance as u16).to_le_bytes());
            bytes.push(hash as u8);
        }
    }
    let device_us = index as u32 * (spec.packet_period_ns(ReturnMode::Strongest) / 1_000);
    bytes.extend(device_us.to_le_bytes());
    bytes.extend([0x37, spec.model_bytes.first().copied().unwrap_or(0)]);
    bytes
}
