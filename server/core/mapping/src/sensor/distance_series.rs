//! The distance series of each laser, and how far each range deviates from its neighbours (Neuhaus 2009, section 2.5).
//!
//! In: one echo of a [`Revolution`]. Out: by slot, smoothed range minus measured range, metres. The series of a laser
//! holds its ranges of the revolution in time order. A missing return is replaced by the last valid one, as in the
//! paper. The smoothed range is the mean of nine ranges; at the two ends of the revolution it is the mean of the ranges
//! that exist. Firings in which a laser does not fire (HDL-64E S1) are not part of its series.

use clearway_lidar::revolution::Revolution;

/// Number of ranges on each side of the smoothed one: Neuhaus 2009, section 2.5, takes the mean of nine.
pub(crate) const REACH: usize = 4;
/// Number of lasers that fire together: a block of a data packet has 32 returns.
const BANK: usize = 32;

/// Computes the distance series of one revolution after the other and reuses its buffers.
#[derive(Clone, Debug, Default)]
pub struct DistanceSeries {
    /// First slots of the firings of one bank of lasers.
    firings: Vec<u32>,
    /// Ranges of these firings with missing returns replaced, firing by firing, metres.
    ranges: Vec<f32>,
    /// Deviation by slot, metres.
    deviation_m: Vec<f32>,
}

impl DistanceSeries {
    /// Deviation of every slot of the first echo, metres, by `firing * lasers + laser`; NaN for a slot without a
    /// return.
    pub fn deviations(&mut self, revolution: &Revolution) -> &[f32] {
        let range_m = revolution.echoes.first().map_or(&[][..], |echo| &echo.range_m[..]);
        self.compute(range_m, revolution.lasers);
        &self.deviation_m
    }

    fn compute(&mut self, range_m: &[f32], lasers: usize) {
        self.deviation_m.clear();
        self.deviation_m.resize(range_m.len(), f32::NAN);
        for first in (0..lasers).step_by(BANK) {
            let width = BANK.min(lasers - first);
            self.fill_holes(range_m, lasers, first, width);
            self.subtract(range_m, width);
        }
    }

    /// Replaces each missing return by the last valid one of its laser; those before the first valid one by that one.
    fn fill_holes(&mut self, range_m: &[f32], lasers: usize, first: usize, width: usize) {
        self.firings.clear();
        self.ranges.clear();
        let fired = |slot: &usize| range_m[*slot..slot + width].iter().any(|range| !range.is_nan());
        self.firings.extend((first..range_m.len()).step_by(lasers).filter(fired).map(|slot| slot as u32));
        let mut last = [0.0f32; BANK];
        for (lane, last) in last[..width].iter_mut().enumerate() {
            let own = self.firings.iter().map(|slot| range_m[*slot as usize + lane]);
            *last = own.into_iter().find(|range| *range > 0.0).unwrap_or(0.0);
        }
        for &slot in &self.firings {
            for (last, &range) in last[..width].iter_mut().zip(&range_m[slot as usize..]) {
                *last = if range > 0.0 { range } else { *last };
            }
            self.ranges.extend_from_slice(&last[..width]);
        }
    }

    fn subtract(&mut self, range_m: &[f32], width: usize) {
        let firings = self.firings.len();
        for (k, &slot) in self.firings.iter().enumerate() {
            let window = k.saturating_sub(REACH)..(k + REACH + 1).min(firings);
            let share = 1.0 / window.len() as f32;
            let mut sum = [0.0f32; BANK];
            for ranges in self.ranges[window.start * width..window.end * width].chunks_exact(width) {
                sum[..width].iter_mut().zip(ranges).for_each(|(sum, range)| *sum += range);
            }
            let slots = slot as usize..slot as usize + width;
            let own = self.deviation_m[slots.clone()].iter_mut().zip(&range_m[slots]);
            for ((deviation, &range), sum) in own.zip(&sum) {
                *deviation = if range > 0.0 { sum * share - range } else { f32::NAN };
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn deviations(range_m: &[f32], lasers: usize) -> Vec<f32> {
        let mut series = DistanceSeries::default();
        series.compute(range_m, lasers);
        series.deviation_m
    }

    #[test]
    fn a_bump_deviates_from_the_mean_and_a_missing_return_repeats_the_last() {
        let mut ranges = vec![10.0f32; 20];
        ranges[10] = 9.1;
        ranges[14] = 0.0;
        let found = deviations(&ranges, 1);
        assert!((found[10] - 0.8).abs() < 1e-5, "{found:?}");
        assert!((found[6] - -0.1).abs() < 1e-5 && found[5].abs() < 1e-5, "{found:?}");
        assert!(found[14].is_nan() && found[15].abs() < 1e-5, "{found:?}");
        // At the end it is the mean of five ranges: 9.5 and four times 10.
        ranges[19] = 9.5;
        assert!((deviations(&ranges, 1)[19] - 0.4).abs() < 1e-5);
    }

    #[test]
    fn each_laser_has_a_series_of_the_firings_in_which_it_fires() {
        // 64 lasers; the upper bank fires only in every third firing, as in an HDL-64E S1.
        let (lasers, firings) = (64, 30);
        let range = |firing: usize, laser: usize| 5.0 + laser as f32 + 0.01 * ((firing * 7 + laser * 3) % 11) as f32;
        let ranges: Vec<f32> = (0..lasers * firings)
            .map(|slot| (slot / lasers, slot % lasers))
            .map(|(firing, laser)| if laser >= 32 && firing % 3 != 0 { f32::NAN } else { range(firing, laser) })
            .collect();
        let found = deviations(&ranges, lasers);
        for laser in [0, 31, 32, 63] {
            let own: Vec<f32> = ranges.iter().skip(laser).step_by(lasers).copied().filter(|r| !r.is_nan()).collect();
            let alone = deviations(&own, 1);
            let together: Vec<f32> =
                found.iter().skip(laser).step_by(lasers).copied().filter(|d| !d.is_nan()).collect();
            assert_eq!(alone, together, "laser {laser}");
        }
        assert_eq!(deviations(&[], 64), []);
        assert!(deviations(&[0.0; 9], 1).iter().all(|deviation| deviation.is_nan()));
    }
}
