//! The distance series of each laser, and how far every measurement lies from its neighbours' (Neuhaus 2009 §2.5).
//!
//! In: one echo of a [`Revolution`]. Out: by slot, smoothed minus measured range, metres. A laser's series is its ranges of
//! the revolution in time order; a missing return takes the last valid one's place, as the paper has it; smoothed is the mean of
//! nine. Firings in which a laser had no turn (HDL-64E S1) are not part of its series. At the turn's two ends the mean is
//! over what there is.

use clearway_lidar::revolution::Revolution;

/// Measurements to each side of the one that is smoothed: the paper's mean of nine.
const REACH: usize = 4;

/// Series of one revolution after the other, reusing its buffers.
#[derive(Clone, Debug, Default)]
pub struct Series {
    ranges: Vec<f32>,
    slots: Vec<u32>,
    deviation_m: Vec<f32>,
}

impl Series {
    /// Deviation of every slot of the first echo, `firing * lasers + laser`; NaN where there was no return, or where the
    /// laser had none in the whole turn.
    pub fn take(&mut self, revolution: &Revolution) -> &[f32] {
        let range_m = revolution.echoes.first().map_or(&[][..], |echo| &echo.range_m[..]);
        self.deviation_m.clear();
        self.deviation_m.resize(range_m.len(), f32::NAN);
        for laser in 0..revolution.lasers {
            self.gather(range_m, laser, revolution.lasers);
            let ends = self.ranges.len();
            for (k, &slot) in self.slots.iter().enumerate() {
                if range_m[slot as usize] > 0.0 {
                    let around = &self.ranges[k.saturating_sub(REACH)..(k + REACH + 1).min(ends)];
                    let mean = around.iter().sum::<f32>() / around.len() as f32;
                    self.deviation_m[slot as usize] = mean - self.ranges[k];
                }
            }
        }
        &self.deviation_m
    }

    /// One laser's series, without a hole, and the slots it comes from.
    fn gather(&mut self, range_m: &[f32], laser: usize, lasers: usize) {
        self.ranges.clear();
        self.slots.clear();
        let own = || range_m.iter().enumerate().skip(laser).step_by(lasers);
        // Before the first valid measurement there is no last one.
        let Some(mut last) = own().map(|(_, range)| *range).find(|range| *range > 0.0) else { return };
        for (slot, &range) in own().filter(|(_, range)| !range.is_nan()) {
            last = if range > 0.0 { range } else { last };
            self.ranges.push(last);
            self.slots.push(slot as u32);
        }
    }
}
