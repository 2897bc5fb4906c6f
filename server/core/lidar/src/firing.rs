//! Packet to firings: which blocks make one pass of all lasers, at which azimuth, at which time.
//!
//! In: a [`Packet`] of a known model. Out: [`PacketFirings`], in time order.

use crate::model::{AZIMUTHS_PER_TURN, BLOCKS_PER_PACKET, ModelSpec, ReturnMode};
use crate::packet::Packet;

/// Most firings a packet can hold: a VLP-16's.
pub const MAX_FIRINGS: usize = 2 * BLOCKS_PER_PACKET;

/// The azimuths of a packet's firings.
#[derive(Clone, Copy, Debug)]
pub(crate) struct PacketFirings {
    azimuths: [u32; MAX_FIRINGS],
    count: usize,
    /// Counts the sensor turns from block to block (a VLS-128: firing to firing); the median, as VeloView takes it.
    pub step: Option<u32>,
}

impl PacketFirings {
    /// `step_before`: the step of the packets before, for packets too short to have one of their own.
    pub fn new(packet: &Packet<'_>, spec: &ModelSpec, mode: ReturnMode, step_before: Option<u32>) -> Self {
        let echoes = if mode == ReturnMode::Dual { 2 } else { 1 };
        let blocks_a_step = spec.blocks_per_firing * echoes;
        let mut columns = [0; BLOCKS_PER_PACKET];
        let columns = &mut columns[..spec.blocks_used(mode) / blocks_a_step];
        for (column, azimuth) in columns.iter_mut().enumerate() {
            *azimuth = packet.azimuth(column * blocks_a_step);
        }
        let step = median_step(columns).or(step_before);
        let mut firings = Self { azimuths: [0; MAX_FIRINGS], count: columns.len() * spec.firings_per_block, step };
        for (firing, azimuth) in firings.azimuths[..firings.count].iter_mut().enumerate() {
            let (column, later) = (firing / spec.firings_per_block, firing % spec.firings_per_block);
            let turned = spec.azimuth_offset(later * spec.lasers, step.unwrap_or(0) * u32::from(later > 0));
            *azimuth = (columns[column] + turned) % AZIMUTHS_PER_TURN;
        }
        firings
    }

    /// Hundredths of a degree, in `0..36000`, in time order.
    pub fn azimuths(&self) -> &[u32] {
        &self.azimuths[..self.count]
    }
}

/// How far the sensor turns forward from one azimuth to the next, in counts.
pub(crate) fn forward(from: u32, to: u32) -> u32 {
    (to + AZIMUTHS_PER_TURN - from) % AZIMUTHS_PER_TURN
}

fn median_step(columns: &[u32]) -> Option<u32> {
    let mut steps = [0; BLOCKS_PER_PACKET];
    let count = columns.len() - 1;
    for (step, pair) in steps.iter_mut().zip(columns.windows(2)) {
        *step = forward(pair[0], pair[1]);
    }
    let steps = &mut steps[..count];
    steps.sort_unstable();
    // A sensor turns less than 2 degrees between blocks, even at 20 turns a second.
    steps.get(count.div_ceil(2).min(count.saturating_sub(1))).copied().filter(|step| *step < AZIMUTHS_PER_TURN / 180)
}
