//! The reasons for which a sensor refuses a datagram.

use super::nmea::NmeaError;
use crate::calibration::CalibrationError;
use crate::model::Model;

/// The reason for which a datagram is refused, with the value that is wrong and what is allowed.
/// [`DatagramError::reason`] is the key under which the ledger counts it.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum DatagramError {
    /// The datagram has neither 1206 nor 512 bytes.
    #[error("length {length}: a data packet has 1206 bytes, a telemetry datagram 512")]
    Length {
        /// Length of the payload, in bytes.
        length: usize,
    },
    /// A block has a flag that no sensor, or not this sensor, sends in that block.
    #[error("block {block} has flag {flag:#06x}; allowed here: {}", Hex(.allowed))]
    BlockFlag {
        /// Index of the block in the packet, from 0.
        block: usize,
        /// Flag of the block, read as a little-endian number.
        flag: u16,
        /// Flags that the sensor sends in this block.
        allowed: Vec<u16>,
    },
    /// A block has an azimuth of more than 360 degrees.
    #[error("block {block} has azimuth {azimuth}; 0 to 36000 hundredths of a degree are allowed")]
    Azimuth {
        /// Index of the block in the packet, from 0.
        block: usize,
        /// Azimuth of the block, in hundredths of a degree.
        azimuth: u16,
    },
    /// The model byte belongs to no known model, or to another model than the sensor's.
    #[error("model byte {byte:#04x}{}; allowed: {}", sender(.model), Hex(.allowed))]
    Model {
        /// Byte 1205 of the packet.
        byte: u8,
        /// Model that is configured or was found before; `None` while the model is unknown.
        model: Option<Model>,
        /// Model bytes that the sensor may send.
        allowed: Vec<u16>,
    },
    /// The packet is a copy of an earlier one.
    #[error("a copy of the packet of {}, azimuth {azimuth}", device_time(.device_us))]
    Duplicate {
        /// Device time, in microseconds past the hour; `None` if the sensor sends no time.
        device_us: Option<u32>,
        /// Azimuth of block 0, in hundredths of a degree.
        azimuth: u32,
    },
    /// The packet arrives after later packets were decoded.
    #[error(
        "the packet of {}, azimuth {azimuth} is {packets} packets late; {packets_max} are allowed",
        device_time(.device_us)
    )]
    Late {
        /// Device time, in microseconds past the hour; `None` if the sensor sends no time.
        device_us: Option<u32>,
        /// Azimuth of block 0, in hundredths of a degree.
        azimuth: u32,
        /// Packet periods from this packet to the packet that was decoded last.
        packets: i64,
        /// Packet periods by which a packet may be late.
        packets_max: usize,
    },
    /// The device time does not follow the device time of the packet before, and no second packet has confirmed it yet.
    #[error(
        "the packet of {}, azimuth {azimuth} does not follow the one of {}: the next packet must confirm it",
        device_time(.device_us),
        device_time(.newest_us)
    )]
    DeviceTime {
        /// Device time, in microseconds past the hour; `None` if the sensor sends no time.
        device_us: Option<u32>,
        /// Azimuth of block 0, in hundredths of a degree.
        azimuth: u32,
        /// Device time of the newest packet, in microseconds past the hour; `None` if the sensor sends no time.
        newest_us: Option<u32>,
    },
    /// The configured calibration belongs to another sensor.
    #[error("calibration: {0}")]
    Calibration(CalibrationError),
    /// The NMEA sentence of a telemetry datagram is damaged.
    #[error("telemetry: {0}")]
    Nmea(NmeaError),
    /// A datagram of 512 bytes has no sentence and is no telemetry.
    #[error("telemetry without a sentence, device time {device_us} us: under 3601000000 us, and text, are allowed")]
    Telemetry {
        /// Bytes 198 to 201.
        device_us: u32,
    },
}

impl DatagramError {
    /// Name of the variant: `length`, `block_flag`, `azimuth`, `model`, `duplicate`, `late`, `device_time`,
    /// `calibration`, `nmea` or `telemetry`.
    pub fn reason(&self) -> &'static str {
        match self {
            Self::Length { .. } => "length",
            Self::BlockFlag { .. } => "block_flag",
            Self::Azimuth { .. } => "azimuth",
            Self::Model { .. } => "model",
            Self::Duplicate { .. } => "duplicate",
            Self::Late { .. } => "late",
            Self::DeviceTime { .. } => "device_time",
            Self::Calibration(_) => "calibration",
            Self::Nmea(_) => "nmea",
            Self::Telemetry { .. } => "telemetry",
        }
    }
}

/// Numbers that are shown as hexadecimal, separated by commas.
struct Hex<'a>(&'a [u16]);

impl std::fmt::Display for Hex<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        for (i, value) in self.0.iter().enumerate() {
            write!(f, "{}{value:#x}", if i == 0 { "" } else { ", " })?;
        }
        Ok(())
    }
}

fn device_time(device_us: &Option<u32>) -> String {
    device_us.map_or("no device time".to_owned(), |us| format!("device time {us} us"))
}

fn sender(model: &Option<Model>) -> String {
    model.map(|m| format!(" from a {}", m.spec().name)).unwrap_or_default()
}
