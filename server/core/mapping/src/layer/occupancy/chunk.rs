//! What a polar scan computes of some points by arithmetic alone.
//!
//! In: points, ego frame, with their heights over the ground, metres. Out: the bin of each ray, and the steps along it.

use crate::azimuth_columns::{floor_to_whole, round_to_whole};
use crate::wide::WideLoop;

use super::azimuth_bins::AzimuthBins;
use super::config::{CLEAR_HEIGHT_M_MAX, CLEAR_HEIGHT_M_MIN, OccupancyConfig};

/// Largest step number. Ours: beyond each window, and within 16 bits.
const STEPS_MAX: f32 = 65_000.0;
/// Number of points that are processed together. Ours: their intermediate values fit into the first-level cache.
pub const CHUNK: usize = 256;

/// Values computed from points by arithmetic alone; ranges and steps are in cells from the sensor.
#[derive(Clone)]
pub struct Chunk {
    pub bin: [u32; CHUNK],
    pub range: [f32; CHUNK],
    pub step: [u32; CHUNK],
    /// First step at which the ray is at the height of a bumper.
    pub first: [u32; CHUNK],
    /// Step after the last such one.
    pub end: [u32; CHUNK],
    /// Step at which the ray comes below the clearance.
    pub under: [u32; CHUNK],
    /// Step at which the ray is too low to prove anything.
    pub low: [u32; CHUNK],
}

impl Default for Chunk {
    fn default() -> Self {
        let none = [0; CHUNK];
        Self { bin: none, range: [0.0; CHUNK], step: none, first: none, end: none, under: none, low: none }
    }
}

impl Chunk {
    /// Computes the values of up to [`CHUNK`] points. It has no branches and reads no tables, so that the compiler
    /// vectorises it.
    #[inline(always)]
    fn fill(
        &mut self,
        [xs, ys, zs]: [&[f32]; 3],
        origin_m: [f32; 3],
        config: &OccupancyConfig,
        azimuths: &AzimuthBins,
    ) {
        let [ox, oy, oz] = origin_m;
        let (per_m, steps) = (1.0 / config.cell_m, azimuths.steps as f32);
        let [lowest, highest, clearance] =
            [CLEAR_HEIGHT_M_MIN, CLEAR_HEIGHT_M_MAX, config.clearance_m].map(|height_m| height_m - oz);
        let reliable = config.range_m_max * per_m;
        let n = xs.len();
        let (xs, ys, zs) = (&xs[..n], &ys[..n], &zs[..n]);
        let (bin, range_of, step) = (&mut self.bin[..n], &mut self.range[..n], &mut self.step[..n]);
        let (first, end) = (&mut self.first[..n], &mut self.end[..n]);
        let (under_of, low_of) = (&mut self.under[..n], &mut self.low[..n]);
        for i in 0..n {
            let (dx, dy, z) = (xs[i] - ox, ys[i] - oy, zs[i]);
            let range = (dx * dx + dy * dy).sqrt() * per_m;
            // For a ray that returns from the ground, the ground is a straight line from under the sensor to the
            // return.
            let rise = if z < CLEAR_HEIGHT_M_MIN { -oz } else { z - oz };
            let steps_a_m = range / rise;
            let (from, to) = between(lowest * steps_a_m, highest * steps_a_m);
            let (under, low) = between(lowest * steps_a_m, clearance * steps_a_m);
            bin[i] = azimuths.columns.column(dx, dy);
            range_of[i] = range;
            step[i] = floor_to_whole(least(range, STEPS_MAX));
            first[i] = round_to_whole(least(from, steps));
            end[i] = round_to_whole(least(to, least(least(reliable, range), steps)));
            under_of[i] = round_to_whole(least(under, least(range, steps)));
            low_of[i] = round_to_whole(least(low, least(range, steps)));
        }
    }
}

/// [`Chunk::fill`] as a loop.
pub struct FillChunk<'a> {
    pub chunk: &'a mut Chunk,
    pub points: [&'a [f32]; 3],
    pub origin_m: [f32; 3],
    pub config: &'a OccupancyConfig,
    pub azimuths: &'a AzimuthBins,
}

impl WideLoop for FillChunk<'_> {
    #[inline(always)]
    fn run(self) {
        self.chunk.fill(self.points, self.origin_m, self.config, self.azimuths);
    }
}

/// Start and end of the part of a ray between two distances. Distances behind the sensor become 0.
#[inline(always)]
pub fn between(a: f32, b: f32) -> (f32, f32) {
    // Level rays give infinities of the right sign. NaN fails every comparison.
    let (from, to) = if a < b { (a, b) } else { (b, a) };
    (if from > 0.0 { from } else { 0.0 }, if to > 0.0 { to } else { 0.0 })
}

/// The lesser of two values; the second if the first is NaN.
#[inline(always)]
pub fn least(a: f32, b: f32) -> f32 {
    if a < b { a } else { b }
}
