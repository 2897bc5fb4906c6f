//! Azimuth bins around a sensor, a quarter of a degree each.
//!
//! In: positions relative to the sensor. Out: the bin of each, and the directions in which a bin is traced.

use std::ops::Range;

use crate::azimuth_columns::AzimuthColumns;

/// Number of azimuth bins around a sensor. Ours: a quarter of a degree each; not tuned.
pub const BINS: usize = 1440;
/// Number of bins to either side whose hits also end a traced ray. Ours; not tuned.
const BESIDE: isize = 2;

/// The azimuth bins around a sensor.
#[derive(Clone)]
pub struct AzimuthBins {
    /// Position -> bin.
    pub columns: AzimuthColumns,
    /// By bin: directions of its centre and of the centres of its halves. Far out a bin is so wide that a single ray
    /// would leave cells out.
    pub lines: Vec<[[f64; 2]; 3]>,
    /// Number of steps of a bin, a multiple of 64.
    pub steps: usize,
    /// Number of words with one bit for each step.
    pub words: usize,
}

impl AzimuthBins {
    /// Bins that reach `reach_m` from a sensor, in steps of a cell.
    pub fn new(reach_m: f32, cell_m: f32) -> Self {
        let steps = (reach_m / cell_m).ceil() as usize + 1;
        let words = steps.div_ceil(64);
        // The directions of the first quadrant are rotated by 90 degrees, so that a rotated world gives a rotated map
        // to the bit.
        let line = |bin: usize, within: f64| {
            let angle = ((bin % (BINS / 4)) as f64 + within) / BINS as f64 * std::f64::consts::TAU;
            let (y, x) = libm::sincos(angle);
            [[x, y], [-y, x], [-x, -y], [y, -x]][bin / (BINS / 4)]
        };
        let lines = (0..BINS).map(|bin| [0.5, 0.25, 0.75].map(|within| line(bin, within)));
        let columns = AzimuthColumns::new(BINS as u16);
        Self { columns, lines: lines.collect(), steps: words * 64, words }
    }

    /// Words of a bin's bits.
    #[inline]
    pub fn row(&self, bin: usize) -> Range<usize> {
        bin * self.words..(bin + 1) * self.words
    }
}

/// The bin `beside` bins to the left of a bin; to the right if `beside` is negative.
#[inline(always)]
pub fn neighbour(bin: usize, beside: isize) -> usize {
    (bin + BINS).wrapping_add_signed(beside) % BINS
}

/// A bin and the bins whose hits also end its traced rays.
#[inline(always)]
pub fn around(bin: usize) -> impl Iterator<Item = usize> {
    (-BESIDE..=BESIDE).map(move |beside| neighbour(bin, beside))
}
