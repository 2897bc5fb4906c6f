//! One data packet: 1206 bytes read in place.
//!
//! In: a UDP payload. Out: a [`Packet`] whose length, block flags and azimuths are sound, or a [`Refusal`]. Layout (all
//! models, little endian): 12 blocks of 100 bytes (flag u16, azimuth u16 in hundredths of a degree, 32 returns of
//! distance u16 and intensity u8), microseconds past the hour u32, and two bytes that are return mode and model, or an
//! HDL-64E's status type and value.

use crate::model::{AZIMUTHS_PER_TURN, BLOCK_FLAGS, BLOCKS_PER_PACKET, Model, RETURNS_PER_BLOCK, ReturnMode};
use crate::order::REORDER_PACKETS;

/// Bytes of a data packet.
pub const PACKET_LENGTH: usize = 1206;
/// Bytes of a block.
pub const BLOCK_LENGTH: usize = 100;
/// Bytes of a block's returns.
pub const RETURNS_LENGTH: usize = 3 * RETURNS_PER_BLOCK;
/// Raw distances from here on are no echoes: sensors send 65534 (and 65535) with full intensity as filler.
pub const BOGUS_DISTANCE: u16 = 65_534;

/// A datagram that was not taken. [`Refusal::reason`] is the ledger's key.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum Refusal {
    /// Neither 1206 nor 512 bytes.
    #[error("length {length}: a data packet has 1206 bytes, a telemetry datagram 512")]
    Length {
        /// Bytes received.
        length: usize,
    },
    /// A block that no sensor, or not this one, sends there.
    #[error("block {block} has flag {flag:#06x}; allowed here: {}", Hex(.allowed))]
    BlockFlag {
        /// Counted from 0.
        block: usize,
        /// Read little endian.
        flag: u16,
        /// What the sensor sends there.
        allowed: Vec<u16>,
    },
    /// An azimuth beyond a whole turn.
    #[error("block {block} has azimuth {azimuth}; 0 to 36000 hundredths of a degree are allowed")]
    Azimuth {
        /// Counted from 0.
        block: usize,
        /// Hundredths of a degree.
        azimuth: u16,
    },
    /// A model byte nobody knows, or another model's.
    #[error("model byte {byte:#04x}{}; allowed: {}", of(.model), Hex(.allowed))]
    Model {
        /// Byte 1205.
        byte: u8,
        /// The model configured or found before.
        model: Option<Model>,
        /// The bytes it may send.
        allowed: Vec<u16>,
    },
    /// A copy of a packet that came before.
    #[error("a copy of the packet of {}, azimuth {azimuth}", at(.device_us))]
    Duplicate {
        /// Microseconds past the hour; `None`: the sensor sends none.
        device_us: Option<u32>,
        /// Of block 0, hundredths of a degree.
        azimuth: u32,
    },
    /// A packet that came when the ones after it had long been decoded.
    #[error(
        "the packet of {}, azimuth {azimuth} is {packets} packets late; {REORDER_PACKETS} are allowed",
        at(.device_us)
    )]
    Late {
        /// Microseconds past the hour; `None`: the sensor sends none.
        device_us: Option<u32>,
        /// Of block 0, hundredths of a degree.
        azimuth: u32,
        /// Packet periods from it to the packet decoded last.
        packets: i64,
    },
    /// A time far from the packet's before, which nothing confirms yet: the next packet may.
    #[error(
        "the packet of {}, azimuth {azimuth} does not follow the one of {}: the next packet must confirm it",
        at(.device_us), at(.newest_us)
    )]
    DeviceTime {
        /// Microseconds past the hour; `None`: the sensor sends none.
        device_us: Option<u32>,
        /// Of block 0, hundredths of a degree.
        azimuth: u32,
        /// The newest packet's time.
        newest_us: Option<u32>,
    },
    /// The table configured is another sensor's.
    #[error("calibration: {0}")]
    Calibration(crate::calibration::CalibrationError),
    /// A telemetry datagram whose NMEA sentence is damaged.
    #[error("telemetry: {0}")]
    Nmea(crate::telemetry::NmeaError),
}

impl Refusal {
    /// `length`, `block_flag`, `azimuth`, `model`, `duplicate`, `late`, `device_time`, `calibration` or `nmea`.
    pub fn reason(&self) -> &'static str {
        match self {
            Refusal::Length { .. } => "length",
            Refusal::BlockFlag { .. } => "block_flag",
            Refusal::Azimuth { .. } => "azimuth",
            Refusal::Model { .. } => "model",
            Refusal::Duplicate { .. } => "duplicate",
            Refusal::Late { .. } => "late",
            Refusal::DeviceTime { .. } => "device_time",
            Refusal::Calibration(_) => "calibration",
            Refusal::Nmea(_) => "nmea",
        }
    }
}

struct Hex<'a>(&'a [u16]);

impl std::fmt::Display for Hex<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        for (i, value) in self.0.iter().enumerate() {
            write!(f, "{}{value:#x}", if i == 0 { "" } else { ", " })?;
        }
        Ok(())
    }
}

fn at(device_us: &Option<u32>) -> String {
    device_us.map_or("no device time".to_owned(), |us| format!("device time {us} us"))
}

fn of(model: &Option<Model>) -> String {
    model.map(|m| format!(" from a {}", m.spec().name)).unwrap_or_default()
}

/// A data packet, read in place.
#[derive(Clone, Copy, Debug)]
pub struct Packet<'a> {
    bytes: &'a [u8; PACKET_LENGTH],
}

impl<'a> Packet<'a> {
    /// Checks length, flags and azimuths; a block that could only be a VLS-128's unused one is let through.
    ///
    /// # Errors
    /// [`Refusal::Length`], [`Refusal::BlockFlag`], [`Refusal::Azimuth`].
    pub fn new(payload: &'a [u8]) -> Result<Self, Refusal> {
        let bytes = payload.try_into().map_err(|_| Refusal::Length { length: payload.len() })?;
        let packet = Self { bytes };
        let used = if packet.looks_like_vls128_dual() { 8 } else { BLOCKS_PER_PACKET };
        for block in 0..used {
            let flag = packet.flag(block);
            if !BLOCK_FLAGS.contains(&flag) {
                return Err(Refusal::BlockFlag { block, flag, allowed: BLOCK_FLAGS.to_vec() });
            }
            let azimuth = packet.raw_azimuth(block);
            if u32::from(azimuth) > AZIMUTHS_PER_TURN {
                return Err(Refusal::Azimuth { block, azimuth });
            }
        }
        Ok(packet)
    }

    fn looks_like_vls128_dual(&self) -> bool {
        self.return_mode() == Some(ReturnMode::Dual)
            && (0..8).all(|block| self.flag(block) == BLOCK_FLAGS[block / 2])
            && Model::Vls128.spec().model_bytes.contains(&self.model_byte())
    }

    pub(crate) fn bytes(&self) -> &'a [u8; PACKET_LENGTH] {
        self.bytes
    }

    fn u16_at(&self, at: usize) -> u16 {
        u16::from_le_bytes([self.bytes[at], self.bytes[at + 1]])
    }

    /// The block's flag, one of [`BLOCK_FLAGS`].
    pub fn flag(&self, block: usize) -> u16 {
        self.u16_at(block * BLOCK_LENGTH)
    }

    fn raw_azimuth(&self, block: usize) -> u16 {
        self.u16_at(block * BLOCK_LENGTH + 2)
    }

    /// The block's azimuth, hundredths of a degree in `0..36000`; the 36000 that real sensors send is 0.
    pub fn azimuth(&self, block: usize) -> u32 {
        u32::from(self.raw_azimuth(block)) % AZIMUTHS_PER_TURN
    }

    /// The block's 32 returns, three bytes each: distance u16, intensity u8.
    pub fn returns(&self, block: usize) -> &'a [u8; RETURNS_LENGTH] {
        let at = block * BLOCK_LENGTH + 4;
        self.bytes[at..at + RETURNS_LENGTH].try_into().expect("a slice of that length")
    }

    /// Microseconds past the hour; garbage in an HDL-64E S1's packet.
    pub fn device_us(&self) -> u32 {
        u32::from_le_bytes(self.bytes[1200..1204].try_into().expect("four bytes"))
    }

    /// Byte 1204 as a return mode; `None` for other values (HDL-64E, early firmware).
    pub fn return_mode(&self) -> Option<ReturnMode> {
        match self.bytes[1204] {
            0x37 => Some(ReturnMode::Strongest),
            0x38 => Some(ReturnMode::Last),
            0x39 => Some(ReturnMode::Dual),
            _ => None,
        }
    }

    /// Byte 1205; status in an HDL-64E's packet.
    pub fn model_byte(&self) -> u8 {
        self.bytes[1205]
    }

    /// Status type and value, the last two bytes of an HDL-64E's packet.
    pub fn status(&self) -> (u8, u8) {
        (self.bytes[1204], self.bytes[1205])
    }
}
