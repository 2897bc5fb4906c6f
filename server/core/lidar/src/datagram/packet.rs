//! One data packet: 1206 bytes, read in place.
//!
//! In: a UDP payload. Out: a [`Packet`] with valid length, block flags and azimuths, or a [`DatagramError`]. The layout
//! is the same for all models, little endian: 12 blocks of 100 bytes (flag u16, azimuth u16 in hundredths of a degree,
//! 32 returns of distance u16 and intensity u8), microseconds past the hour u32, and two bytes. These are return mode
//! and model, or status type and value of an HDL-64E.

use super::error::DatagramError;
use crate::model::{AZIMUTHS_PER_REVOLUTION, BLOCK_FLAGS, BLOCKS_PER_PACKET, Model, RETURNS_PER_BLOCK, ReturnMode};

/// Length of a data packet, in bytes.
pub const PACKET_LENGTH: usize = 1206;
/// Length of a block, in bytes.
pub const BLOCK_LENGTH: usize = 100;
/// Length of the returns of a block, in bytes.
pub const RETURNS_LENGTH: usize = 3 * RETURNS_PER_BLOCK;
/// Least raw distance that is no return: sensors send 65534 and 65535, with full intensity, as filler.
pub const BOGUS_DISTANCE: u16 = 65_534;

/// A data packet that is read in place.
#[derive(Clone, Copy, Debug)]
pub struct Packet<'a> {
    bytes: &'a [u8; PACKET_LENGTH],
}

impl<'a> Packet<'a> {
    /// Checks length, flags and azimuths. The four blocks that a VLS-128 leaves unused in dual-return mode are not
    /// checked.
    ///
    /// # Errors
    /// - [`DatagramError::Length`] if the payload has not 1206 bytes.
    /// - [`DatagramError::BlockFlag`] if a block has a flag that no sensor sends.
    /// - [`DatagramError::Azimuth`] if a block has an azimuth of more than 360 degrees.
    pub fn new(payload: &'a [u8]) -> Result<Self, DatagramError> {
        let bytes = payload.try_into().map_err(|_| DatagramError::Length { length: payload.len() })?;
        let packet = Self { bytes };
        let used = if packet.looks_like_vls128_dual() { 8 } else { BLOCKS_PER_PACKET };
        for block in 0..used {
            let flag = packet.flag(block);
            if !BLOCK_FLAGS.contains(&flag) {
                return Err(DatagramError::BlockFlag { block, flag, allowed: BLOCK_FLAGS.to_vec() });
            }
            let azimuth = packet.raw_azimuth(block);
            if u32::from(azimuth) > AZIMUTHS_PER_REVOLUTION {
                return Err(DatagramError::Azimuth { block, azimuth });
            }
        }
        Ok(packet)
    }

    /// A packet from bytes that [`Packet::new`] accepted before.
    pub(crate) fn from_checked(bytes: &'a [u8; PACKET_LENGTH]) -> Self {
        Self { bytes }
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

    /// Flag of a block, one of [`BLOCK_FLAGS`].
    pub fn flag(&self, block: usize) -> u16 {
        self.u16_at(block * BLOCK_LENGTH)
    }

    fn raw_azimuth(&self, block: usize) -> u16 {
        self.u16_at(block * BLOCK_LENGTH + 2)
    }

    /// Azimuth of a block, in hundredths of a degree, in `0..36000`. The value 36000, which real sensors send, is 0.
    pub fn azimuth(&self, block: usize) -> u32 {
        u32::from(self.raw_azimuth(block)) % AZIMUTHS_PER_REVOLUTION
    }

    /// The 32 returns of a block, three bytes each: distance u16, intensity u8.
    pub fn returns(&self, block: usize) -> &'a [u8; RETURNS_LENGTH] {
        let at = block * BLOCK_LENGTH + 4;
        self.bytes[at..at + RETURNS_LENGTH].try_into().expect("a slice of that length")
    }

    /// Device time, in microseconds past the hour; without meaning in a packet of an HDL-64E S1.
    pub fn device_us(&self) -> u32 {
        u32::from_le_bytes(self.bytes[1200..1204].try_into().expect("four bytes"))
    }

    /// Return mode from byte 1204; `None` for other values (HDL-64E, early firmware).
    pub fn return_mode(&self) -> Option<ReturnMode> {
        match self.bytes[1204] {
            0x37 => Some(ReturnMode::Strongest),
            0x38 => Some(ReturnMode::Last),
            0x39 => Some(ReturnMode::Dual),
            _ => None,
        }
    }

    /// Byte 1205: the model, or the status value in a packet of an HDL-64E.
    pub fn model_byte(&self) -> u8 {
        self.bytes[1205]
    }

    /// Status type and value, the last two bytes of a packet of an HDL-64E.
    pub fn status(&self) -> (u8, u8) {
        (self.bytes[1204], self.bytes[1205])
    }
}
