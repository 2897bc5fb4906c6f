//! Which model sent a packet, and whether a packet can be of a model already known.
//!
//! In: a [`Packet`]. Out: a [`Finding`], or the [`ReturnMode`] of a packet that fits. Block flags tell an HDL-64E and a
//! VLS-128; the model byte tells the others, but VLP-16s of 2014 carry the HDL-32E's, so that 0x21 needs two packets:
//! an HDL-32E sends one every 553 µs of its own time, a VLP-16 every 1,327 µs.

use crate::model::{BLOCKS_PER_PACKET, FLAG_LASERS_0, FLAG_LASERS_64, FLAG_LASERS_96, Model, ReturnMode};
use crate::packet::{Packet, Refusal};

/// Packets that are kept while their rate decides between two models; then the byte is believed.
pub(crate) const PACKETS_HELD: usize = 16;

const MODEL_BYTE_OF_TWO: u8 = 0x21;

/// What one packet shows of its sensor.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Finding {
    /// This model.
    Model(Model),
    /// An HDL-32E or an early VLP-16.
    Hdl32eOrVlp16,
}

/// Tells the model from one packet.
///
/// # Errors
/// [`Refusal::BlockFlag`] for a mixture of flags no model sends, [`Refusal::Model`] for an unknown byte.
pub(crate) fn find(packet: &Packet<'_>) -> Result<Finding, Refusal> {
    let flags: [u16; BLOCKS_PER_PACKET] = std::array::from_fn(|block| packet.flag(block));
    let model = if flags[..8].iter().any(|flag| matches!(*flag, FLAG_LASERS_64 | FLAG_LASERS_96)) {
        Model::Vls128
    } else if flags.iter().all(|flag| *flag == FLAG_LASERS_0) {
        match packet.model_byte() {
            MODEL_BYTE_OF_TWO => return Ok(Finding::Hdl32eOrVlp16),
            byte => by_byte(byte)?,
        }
    } else if blocks_come_in_pairs(packet) {
        if hdl64e_dual(packet) { Model::Hdl64eS3 } else { Model::Hdl64eS2 }
    } else {
        Model::Hdl64eS1
    };
    check(packet, model).map(|_| Finding::Model(model))
}

/// Whether the model is one of those that [`Finding::Hdl32eOrVlp16`] leaves open.
pub(crate) fn is_of_two(model: Model) -> bool {
    matches!(model, Model::Hdl32e | Model::Vlp16)
}

/// The model of a packet with byte 0x21, from the device time that passed since the packet before.
pub(crate) fn by_rate(before: &Packet<'_>, packet: &Packet<'_>) -> Option<Model> {
    let passed_us = packet.device_us().wrapping_sub(before.device_us());
    let mode = packet.return_mode().unwrap_or(ReturnMode::Strongest);
    [Model::Hdl32e, Model::Vlp16].into_iter().find(|model| {
        let period_us = model.spec().packet_period_ns(mode) / 1_000;
        passed_us.abs_diff(period_us) <= period_us / 20
    })
}

/// Whether a packet can be of `model`: flags, and a byte the model is known to send.
///
/// # Errors
/// [`Refusal::BlockFlag`], [`Refusal::Model`].
pub(crate) fn check(packet: &Packet<'_>, model: Model) -> Result<ReturnMode, Refusal> {
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
        return Err(Refusal::BlockFlag { block, flag, allowed });
    }
    let byte = packet.model_byte();
    if !spec.model_bytes.is_empty() && !spec.model_bytes.contains(&byte) {
        let allowed = spec.model_bytes.iter().map(|byte| u16::from(*byte)).collect();
        return Err(Refusal::Model { byte, model: Some(model), allowed });
    }
    Ok(mode)
}

fn by_byte(byte: u8) -> Result<Model, Refusal> {
    let with_byte = |model: &Model| model.spec().model_bytes.first() == Some(&byte);
    Model::ALL.into_iter().find(with_byte).ok_or_else(|| {
        let bytes = Model::ALL.iter().filter_map(|model| model.spec().model_bytes.first());
        Refusal::Model { byte, model: None, allowed: bytes.map(|byte| u16::from(*byte)).collect() }
    })
}

/// HDL-64E S2 and S3: upper and lower block of one azimuth, in turns.
fn blocks_come_in_pairs(packet: &Packet<'_>) -> bool {
    (0..BLOCKS_PER_PACKET).step_by(2).all(|block| {
        packet.flag(block) == FLAG_LASERS_0
            && packet.flag(block + 1) != FLAG_LASERS_0
            && packet.azimuth(block) == packet.azimuth(block + 1)
    })
}

/// An HDL-64E has no byte for it: in dual-return mode each azimuth comes in four blocks, three times a packet.
fn hdl64e_dual(packet: &Packet<'_>) -> bool {
    (0..BLOCKS_PER_PACKET).step_by(4).all(|block| packet.azimuth(block) == packet.azimuth(block + 2))
        && packet.azimuth(0) != packet.azimuth(4)
        && packet.azimuth(4) != packet.azimuth(8)
}
