//! The model that sent a packet, and the check that a packet is of a known model.
//!
//! In: a [`Packet`]. Out: a [`Finding`], or the [`ReturnMode`] of a packet of the model. Block flags identify an
//! HDL-64E and a VLS-128, and the model byte identifies the others. But a VLP-16 of 2014 sends the model byte of the
//! HDL-32E, so that 0x21 needs two packets: an HDL-32E sends one every 553 µs of device time, a VLP-16 every 1,327 µs.

use crate::datagram::DatagramError;
use crate::datagram::packet::Packet;
use crate::model::{BLOCKS_PER_PACKET, FLAG_LASERS_0, FLAG_LASERS_64, FLAG_LASERS_96, Model, ReturnMode};

/// Number of packets that wait while their rate may decide between two models. After them the model byte decides. Ours:
/// at 1,327 µs a packet they are 21 ms, less than a revolution.
pub(crate) const PACKETS_WAITING_MAX: usize = 16;

/// Model byte of an HDL-32E and of a VLP-16 of 2014.
const MODEL_BYTE_OF_TWO: u8 = 0x21;

/// What one packet shows of its model.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Finding {
    /// The model is known.
    Model(Model),
    /// The model is an HDL-32E or an early VLP-16.
    Hdl32eOrVlp16,
}

/// Finds the model that sent a packet.
///
/// # Errors
/// - [`DatagramError::BlockFlag`] if no model sends such a sequence of flags.
/// - [`DatagramError::Model`] if the model byte is unknown.
pub(crate) fn find(packet: &Packet<'_>) -> Result<Finding, DatagramError> {
    let flags: [u16; BLOCKS_PER_PACKET] = std::array::from_fn(|block| packet.flag(block));
    let model = if flags[..8].iter().any(|flag| matches!(*flag, FLAG_LASERS_64 | FLAG_LASERS_96)) {
        Model::Vls128
    } else if flags.iter().all(|flag| *flag == FLAG_LASERS_0) {
        match packet.model_byte() {
            MODEL_BYTE_OF_TWO => return Ok(Finding::Hdl32eOrVlp16),
            byte => find_by_byte(byte)?,
        }
    } else if blocks_come_in_pairs(packet) {
        if hdl64e_dual(packet) { Model::Hdl64eS3 } else { Model::Hdl64eS2 }
    } else {
        Model::Hdl64eS1
    };
    check(packet, model, false).map(|_| Finding::Model(model))
}

/// True if the model is one of the two of [`Finding::Hdl32eOrVlp16`].
pub(crate) fn is_of_two(model: Model) -> bool {
    matches!(model, Model::Hdl32e | Model::Vlp16)
}

/// Tolerance of a packet period, as a fraction (5 %). The periods of the two models differ by a factor of 2.4, and lost
/// packets multiply them by whole numbers; 5 % covers the drift of an oscillator and jitter, and no such multiple.
const PERIOD_TOLERANCE: u32 = 20;

/// Finds the model of a packet with byte 0x21, from the device time since the packet before; `None` if it is the period
/// of neither model.
pub(crate) fn find_by_rate(before: &Packet<'_>, packet: &Packet<'_>) -> Option<Model> {
    let passed_us = packet.device_us().wrapping_sub(before.device_us());
    let mode = packet.return_mode().unwrap_or(ReturnMode::Strongest);
    [Model::Hdl32e, Model::Vlp16].into_iter().find(|model| {
        let period_us = model.spec().packet_period_ns(mode) / 1_000;
        passed_us.abs_diff(period_us) <= period_us / PERIOD_TOLERANCE
    })
}

/// Checks that a packet has the flags and a model byte of `model`, and returns its return mode. If the model `is_given`
/// by the user, a byte of no model passes as well.
///
/// # Errors
/// - [`DatagramError::BlockFlag`] if a block has another flag.
/// - [`DatagramError::Model`] if it has the byte of another model.
pub(crate) fn check(packet: &Packet<'_>, model: Model, is_given: bool) -> Result<ReturnMode, DatagramError> {
    let spec = model.spec();
    let mode = match packet.return_mode() {
        _ if model == Model::Hdl64eS1 => ReturnMode::Strongest,
        _ if model.is_hdl64e() => {
            if hdl64e_dual(packet) {
                ReturnMode::Dual
            } else {
                ReturnMode::Strongest
            }
        }
        mode => mode.unwrap_or(ReturnMode::Strongest),
    };
    for block in 0..spec.blocks_used(mode) {
        let flag = packet.flag(block);
        let allowed = match spec.flag(block, mode) {
            Some(expected) if flag == expected => continue,
            Some(expected) => vec![expected],
            None if spec.first_laser(flag).is_some() => continue,
            None => crate::model::BLOCK_FLAGS[..spec.lasers / 32].to_vec(),
        };
        return Err(DatagramError::BlockFlag { block, flag, allowed });
    }
    let byte = packet.model_byte();
    let is_unknown = || !Model::ALL.iter().any(|model| model.spec().model_bytes.contains(&byte));
    let is_allowed = spec.model_bytes.is_empty() || spec.model_bytes.contains(&byte) || is_given && is_unknown();
    if !is_allowed {
        let allowed = spec.model_bytes.iter().map(|byte| u16::from(*byte)).collect();
        return Err(DatagramError::Model { byte, model: Some(model), allowed });
    }
    Ok(mode)
}

fn find_by_byte(byte: u8) -> Result<Model, DatagramError> {
    let with_byte = |model: &Model| model.spec().model_bytes.first() == Some(&byte);
    Model::ALL.into_iter().find(with_byte).ok_or_else(|| {
        let bytes = Model::ALL.iter().filter_map(|model| model.spec().model_bytes.first());
        DatagramError::Model { byte, model: None, allowed: bytes.map(|byte| u16::from(*byte)).collect() }
    })
}

/// True if upper and lower blocks alternate and each pair has one azimuth, as in packets of an HDL-64E S2 or S3.
fn blocks_come_in_pairs(packet: &Packet<'_>) -> bool {
    (0..BLOCKS_PER_PACKET).step_by(2).all(|block| {
        packet.flag(block) == FLAG_LASERS_0
            && packet.flag(block + 1) != FLAG_LASERS_0
            && packet.azimuth(block) == packet.azimuth(block + 1)
    })
}

/// True if each azimuth has four blocks: an HDL-64E in dual-return mode, which has no byte for that mode.
fn hdl64e_dual(packet: &Packet<'_>) -> bool {
    (0..BLOCKS_PER_PACKET).step_by(4).all(|block| packet.azimuth(block) == packet.azimuth(block + 2))
        && packet.azimuth(0) != packet.azimuth(4)
        && packet.azimuth(4) != packet.azimuth(8)
}
