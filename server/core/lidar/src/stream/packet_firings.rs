//! The firings of a packet: the blocks of each pass of all lasers, and its azimuth.
//!
//! In: a [`Packet`] of a known model. Out: [`PacketFirings`], in time order.

use super::azimuth::forward;
use crate::datagram::packet::Packet;
use crate::model::{AZIMUTHS_PER_REVOLUTION, BLOCKS_PER_PACKET, ModelSpec, ReturnMode};

/// Greatest number of firings of a packet, reached by a VLP-16.
pub(super) const MAX_FIRINGS: usize = 2 * BLOCKS_PER_PACKET;

/// The azimuths of the firings of a packet.
#[derive(Clone, Copy, Debug)]
pub(super) struct PacketFirings {
    azimuths: [u32; MAX_FIRINGS],
    count: usize,
    /// Counts by which the sensor turns from block to block (VLS-128: from firing to firing): the median, as in
    /// VeloView.
    pub step: Option<u32>,
}

impl PacketFirings {
    /// Finds the firings of a packet. `step_before`: the step between packets, for packets of a single firing.
    pub fn from_packet(packet: &Packet<'_>, spec: &ModelSpec, mode: ReturnMode, step_before: Option<u32>) -> Self {
        let echoes = if mode == ReturnMode::Dual { 2 } else { 1 };
        let blocks_per_column = spec.blocks_per_firing * echoes;
        let mut columns = [0; BLOCKS_PER_PACKET];
        let columns = &mut columns[..spec.blocks_used(mode) / blocks_per_column];
        for (column, azimuth) in columns.iter_mut().enumerate() {
            *azimuth = packet.azimuth(column * blocks_per_column);
        }
        let step = median_step(columns).or(step_before);
        let mut firings = Self { azimuths: [0; MAX_FIRINGS], count: columns.len() * spec.firings_per_block, step };
        for (firing, azimuth) in firings.azimuths[..firings.count].iter_mut().enumerate() {
            let (column, later) = (firing / spec.firings_per_block, firing % spec.firings_per_block);
            let turned = spec.azimuth_offset(later * spec.lasers, step.unwrap_or(0) * u32::from(later > 0));
            *azimuth = (columns[column] + turned) % AZIMUTHS_PER_REVOLUTION;
        }
        firings
    }

    /// Azimuths in hundredths of a degree, in `0..36000`, in time order.
    pub fn azimuths(&self) -> &[u32] {
        &self.azimuths[..self.count]
    }
}

/// Counts between two blocks that no sensor reaches: 2 degrees. The largest step is 0.8 degrees (VLP-16 at 1,200 rpm).
const STEP_MAX: u32 = AZIMUTHS_PER_REVOLUTION / 180;

/// The median of the steps between columns; `None` for a single column, or if the median is not possible.
fn median_step(columns: &[u32]) -> Option<u32> {
    let mut steps = [0; BLOCKS_PER_PACKET];
    let count = columns.len() - 1;
    for (step, pair) in steps.iter_mut().zip(columns.windows(2)) {
        *step = forward(pair[0], pair[1]);
    }
    let steps = &mut steps[..count];
    steps.sort_unstable();
    steps.get(count.div_ceil(2).min(count.saturating_sub(1))).copied().filter(|step| *step < STEP_MAX)
}
