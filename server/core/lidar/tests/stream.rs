//! A small encoder: packets of any model inside a round wall.

use clearway_lidar::model::{AZIMUTHS_PER_REVOLUTION, BLOCK_FLAGS, BLOCKS_PER_PACKET, S1_FLAGS};
use clearway_lidar::{Model, ReturnMode, Revolution, Sensor};

/// Start of the streams, in ns since the Unix epoch: 3:33:20 UTC on 18 May 2033, and the same past the hour.
pub const START_NS: i64 = 2_000_000_000_000_000_000;

/// A sensor at 10 revolutions per second, with a wall at `distance` counts in all directions.
#[derive(Clone, Copy)]
pub struct Stream {
    pub model: Model,
    pub mode: ReturnMode,
    pub start_azimuth: u32,
    pub device_us: u32,
    pub distance: u16,
}

impl Stream {
    pub fn of(model: Model) -> Self {
        let past_hour_us = START_NS / 1_000 % 3_600_000_000;
        let mode = ReturnMode::Strongest;
        Self { model, mode, start_azimuth: 18_000, device_us: past_hour_us as u32, distance: 5_000 }
    }

    fn time_ns(&self, packet: usize, firing: usize) -> u64 {
        let spec = self.model.spec();
        (packet * spec.firings_per_packet(self.mode) + firing) as u64 * u64::from(spec.period_ns(self.mode))
    }

    /// Number of packets of so many revolutions, rounded up.
    pub fn packets(&self, revolutions: f64) -> usize {
        (revolutions * 1e8 / f64::from(self.model.spec().packet_period_ns(self.mode))).ceil() as usize
    }

    pub fn packet(&self, index: usize) -> Vec<u8> {
        let spec = self.model.spec();
        let mut bytes = Vec::with_capacity(1206);
        for block in 0..BLOCKS_PER_PACKET {
            if block >= spec.blocks_used(self.mode) {
                bytes.extend([0xFF; 100]);
                continue;
            }
            let place = spec.block_position(block, self.mode);
            let flag = if self.model == Model::Hdl64eS1 { S1_FLAGS[block % 4] } else { BLOCK_FLAGS[place.bank] };
            let turned = self.time_ns(index, place.firing) * 36_000 / 100_000_000;
            bytes.extend(flag.to_le_bytes());
            bytes.extend((((u64::from(self.start_azimuth) + turned) % 36_000) as u16).to_le_bytes());
            for laser in 0..32_u8 {
                bytes.extend((self.distance + 500 * place.echo as u16).to_le_bytes());
                bytes.push(laser);
            }
        }
        let device_us = (u64::from(self.device_us) + self.time_ns(index, 0) / 1_000) % 3_600_000_000;
        bytes.extend((device_us as u32).to_le_bytes());
        bytes.push(match self.mode {
            ReturnMode::Strongest => 0x37,
            ReturnMode::Last => 0x38,
            ReturnMode::Dual => 0x39,
        });
        bytes.push(spec.model_bytes.first().copied().unwrap_or(b'0'));
        bytes
    }

    /// `count` packets, with their arrivals, of a sensor that rotates at `rpm(seconds)`, begins at azimuth 180 degrees,
    /// and sends the columns of azimuths that are `visible`.
    pub fn rotating(
        &self,
        count: usize,
        rpm: impl Fn(f64) -> f64,
        visible: impl Fn(u32) -> bool,
    ) -> Vec<(Vec<u8>, i64)> {
        let spec = self.model.spec();
        let echoes = if self.mode == ReturnMode::Dual { 2 } else { 1 };
        let blocks = spec.blocks_per_firing * echoes;
        let columns = BLOCKS_PER_PACKET / blocks;
        let column_s = f64::from(spec.packet_period_ns(self.mode)) * 1e-9 / columns as f64;
        let (mut turned, mut seconds) = (18_000.0, 0.0);
        let mut packet = || {
            let mut bytes = self.packet(0);
            for column in 0..columns {
                while !visible(turned as u32 % AZIMUTHS_PER_REVOLUTION) {
                    turned += rpm(seconds) / 60.0 * f64::from(AZIMUTHS_PER_REVOLUTION) * column_s;
                    seconds += column_s;
                }
                if column == 0 {
                    let device_us = (f64::from(self.device_us) + seconds * 1e6) as u64 % 3_600_000_000;
                    bytes[1200..1204].copy_from_slice(&(device_us as u32).to_le_bytes());
                }
                for block in column * blocks..(column + 1) * blocks {
                    let azimuth = (turned as u32 % AZIMUTHS_PER_REVOLUTION) as u16;
                    bytes[100 * block + 2..100 * block + 4].copy_from_slice(&azimuth.to_le_bytes());
                }
                turned += rpm(seconds) / 60.0 * f64::from(AZIMUTHS_PER_REVOLUTION) * column_s;
                seconds += column_s;
            }
            (bytes, START_NS + (seconds * 1e9) as i64)
        };
        (0..count).map(|_| packet()).collect()
    }

    /// The packet with the device time of the packet at `index`.
    pub fn at_time_of(&self, index: usize, packet: &[u8]) -> Vec<u8> {
        let mut packet = packet.to_vec();
        packet[1200..1204].copy_from_slice(&self.packet(index)[1200..1204]);
        packet
    }

    pub fn arrival_ns(&self, index: usize) -> i64 {
        START_NS + self.time_ns(index + 1, 0) as i64
    }

    /// Pushes packets, and returns the revolutions that they complete.
    pub fn push(&self, sensor: &mut Sensor, packets: impl IntoIterator<Item = usize>) -> Vec<Revolution> {
        let push = |index| sensor.push(&self.packet(index), self.arrival_ns(index)).unwrap().cloned();
        packets.into_iter().filter_map(push).collect()
    }
}
