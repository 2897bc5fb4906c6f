//! Firings to data packets: the decoder's inverse.
//!
//! In: firings of raw returns, in time order. Out: packets of 1206 bytes (the layout is in `packet.rs` of
//! clearway-lidar). The content of each block follows from the model's [`ModelSpec`], which the decoder uses too.

use clearway_lidar::calibration::Calibration;
use clearway_lidar::calibration::status_table::status_bytes;
use clearway_lidar::model::{Model, ModelSpec, RETURNS_PER_BLOCK, ReturnMode, S1_FLAGS};
use clearway_lidar::packet::{BLOCK_LENGTH, PACKET_LENGTH};

use super::telemetry::{civil_time, device_us};

/// One echo as the packet holds it; distance 0 means no return.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct RawReturn {
    /// Distance, in counts of the model's distance unit.
    pub distance: u16,
    /// Intensity, 0 to 255.
    pub intensity: u8,
}

/// One firing of all lasers, before it is packed.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RawFiring {
    /// Time of the firing, ns since the Unix epoch.
    pub stamp_ns: i64,
    /// Encoder angle, hundredths of a degree, in `0..36000`.
    pub azimuth: u16,
    /// For each laser, the only echo or the strongest.
    pub strongest: Vec<RawReturn>,
    /// For each laser, the last echo in dual-return mode; else empty.
    pub last: Vec<RawReturn>,
}

/// Packs firings, one packet at a time.
#[derive(Clone, Debug)]
pub struct Encoder {
    spec: &'static ModelSpec,
    mode: ReturnMode,
    /// The status types and values of an HDL-64E's packets, which repeat.
    status: Vec<(u8, u8)>,
    firings: Vec<RawFiring>,
    packets: i64,
}

impl Encoder {
    /// An encoder of `model` in `mode`. An HDL-64E S2 or S3 sends `calibration` repeatedly, one byte a packet.
    pub fn new(model: Model, mode: ReturnMode, calibration: &Calibration) -> Self {
        let status = match model {
            Model::Hdl64eS2 | Model::Hdl64eS3 => status_bytes(model, calibration),
            _ => Vec::new(),
        };
        Self { spec: model.spec(), mode, status, firings: Vec::new(), packets: 0 }
    }

    /// Drops the firings of an unfinished packet; the next packet is packet `number`.
    pub fn begin_packet(&mut self, number: i64) {
        self.firings.clear();
        self.packets = number;
    }

    /// Adds the next firing; returns the packet that it completes, if any.
    pub fn push(&mut self, firing: RawFiring) -> Option<[u8; PACKET_LENGTH]> {
        self.firings.push(firing);
        (self.firings.len() == self.spec.firings_per_packet(self.mode)).then(|| {
            let bytes = self.packet();
            self.firings.clear();
            self.packets += 1;
            bytes
        })
    }

    fn packet(&self) -> [u8; PACKET_LENGTH] {
        let mut bytes = [0; PACKET_LENGTH];
        let used = self.spec.blocks_used(self.mode);
        for (block, bytes) in bytes.chunks_exact_mut(BLOCK_LENGTH).take(used).enumerate() {
            let place = self.spec.block_position(block, self.mode);
            let flag = self.spec.flag(block, self.mode).unwrap_or(S1_FLAGS[block % S1_FLAGS.len()]);
            bytes[..2].copy_from_slice(&flag.to_le_bytes());
            bytes[2..4].copy_from_slice(&self.firings[place.firing].azimuth.to_le_bytes());
            let first = self.spec.first_laser(flag).expect("a flag of the model's own");
            for (index, bytes) in bytes[4..].chunks_exact_mut(3).enumerate() {
                // A block of a 16-laser model holds two firings, one after the other.
                let (firing, laser) = if self.spec.lasers < RETURNS_PER_BLOCK {
                    (place.firing + index / self.spec.lasers, index % self.spec.lasers)
                } else {
                    (place.firing, first + index)
                };
                let firing = &self.firings[firing];
                let slots = if place.echo == 0 { &firing.strongest } else { &firing.last };
                let RawReturn { distance, intensity } = slots[laser];
                bytes[..2].copy_from_slice(&distance.to_le_bytes());
                bytes[2] = intensity;
            }
        }
        bytes[1200..].copy_from_slice(&self.tail());
        bytes
    }

    /// The status bytes by which an HDL-64E with GPS sends the time: binary, the second before the present one, as in
    /// its GPRMC (HDL-64E S3 manual, appendix E). All bytes of a cycle are of the time of its first packet.
    fn clock_value(&self, kind: u8) -> Option<u8> {
        const CYCLE: i64 = 16;
        if !b"HMSDNYG".contains(&kind) {
            return None;
        }
        let begun_ns = self.packets.rem_euclid(CYCLE) * i64::from(self.spec.packet_period_ns(self.mode));
        let ([year, month, day], [hour, minute, second]) =
            civil_time(self.firings[0].stamp_ns - begun_ns - 1_000_000_000);
        let value = match kind {
            b'H' => hour,
            b'M' => minute,
            b'S' => second,
            b'D' => day,
            b'N' => month,
            b'Y' => year % 100,
            // GPS time and pulse are both present.
            _ => b'A'.into(),
        };
        u8::try_from(value).ok()
    }

    /// The last six bytes: the time past the hour, then return mode and model, or status.
    fn tail(&self) -> [u8; 6] {
        let [a, b, c, d] = device_us(self.firings[0].stamp_ns).to_le_bytes();
        match (self.spec.model_bytes.first(), self.status.len() as i64) {
            (Some(&model), _) => [a, b, c, d, mode_byte(self.mode), model],
            // An S1 has no clock: firmware and spin count alternate with temperature and its unit.
            (None, 0) if self.packets % 2 == 0 => *b"\x58\x02v25c",
            (None, 0) => *b"\x00\x19DegC",
            (None, length) => {
                let (kind, value) = self.status[self.packets.rem_euclid(length) as usize];
                [a, b, c, d, kind, self.clock_value(kind).unwrap_or(value)]
            }
        }
    }
}

/// Byte 1204 of all but the HDL-64E (VLP-16 manual 63-9243, table 9-1).
fn mode_byte(mode: ReturnMode) -> u8 {
    match mode {
        ReturnMode::Strongest => 0x37,
        ReturnMode::Last => 0x38,
        ReturnMode::Dual => 0x39,
    }
}
