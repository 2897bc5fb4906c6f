//! One telemetry datagram: 512 bytes.
//!
//! In: a UDP payload (port 8308). Out: [`Telemetry`]: device time, state of the pulse per second, and the GPRMC
//! sentence. Layout (HDL-32E application note 63-9277, VLP-16 manual 63-9243, section 9.3.3): microseconds past the
//! hour u32 at byte 198, state of the pulse at byte 202, NMEA text from byte 206 to the first end of a line.

use super::error::DatagramError;
use super::nmea::Gprmc;

/// Length of a telemetry datagram, in bytes.
pub const TELEMETRY_LENGTH: usize = 512;
const DEVICE_US: usize = 198;
const PPS: usize = 202;
/// Device time from which on none is possible, in microseconds: in a leap second the counter passes the hour.
const DEVICE_US_MAX: u32 = 3_601_000_000;
const NMEA: std::ops::Range<usize> = 206..334;

/// The content of a telemetry datagram.
#[derive(Clone, Debug, PartialEq)]
pub struct Telemetry {
    /// Device time, in microseconds past the hour, on the clock of the data packets.
    pub device_us: u32,
    /// State of the pulse per second.
    pub pps: Pps,
    /// Newest GPRMC sentence; `None` if no GPS receiver is connected.
    pub gprmc: Option<Gprmc>,
}

/// State of the pulse per second (VLP-16 manual 63-9243, section 9.3.3).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Pps {
    /// The sensor detects no pulse. An HDL-32E always sends this state.
    Absent,
    /// The sensor synchronises to the pulse.
    Attempting,
    /// The sensor is locked to the pulse.
    Locked,
    /// The sensor has lost the pulse.
    Error,
    /// A value without a meaning in the manual.
    Unknown(u8),
}

impl Telemetry {
    /// Parses a telemetry datagram.
    ///
    /// # Errors
    /// - [`DatagramError::Length`] if the payload has not 512 bytes.
    /// - [`DatagramError::Nmea`] if there is a sentence and it is damaged.
    /// - [`DatagramError::Telemetry`] if there is no sentence and the other fields are not as sensors send them.
    pub fn new(payload: &[u8]) -> Result<Self, DatagramError> {
        if payload.len() != TELEMETRY_LENGTH {
            return Err(DatagramError::Length { length: payload.len() });
        }
        let device_us = u32::from_le_bytes(payload[DEVICE_US..DEVICE_US + 4].try_into().expect("four bytes"));
        let pps = match payload[PPS] {
            0 => Pps::Absent,
            1 => Pps::Attempting,
            2 => Pps::Locked,
            3 => Pps::Error,
            other => Pps::Unknown(other),
        };
        let text = payload[NMEA].split(|byte| matches!(byte, 0 | b'\r' | b'\n')).next().unwrap_or_default();
        let gprmc = if text.is_empty() { None } else { Some(Gprmc::parse(text).map_err(DatagramError::Nmea)?) };
        let is_text = |byte: &u8| matches!(byte, 0 | b'\r' | b'\n' | b' '..=b'~');
        let is_telemetry = device_us < DEVICE_US_MAX && payload[NMEA].iter().all(is_text);
        if gprmc.is_none() && !is_telemetry {
            return Err(DatagramError::Telemetry { device_us });
        }
        Ok(Self { device_us, pps, gprmc })
    }
}
