//! How far the range of a point deviates from its neighbours', as a whole number: sums of whole numbers do not depend
//! on the order of the points.

use crate::azimuth_columns::floor_to_whole;
use crate::sensor::transform::{CHUNK, squared_range};
use crate::wide::WideLoop;

/// Number of steps in a deviation of 1 metre per metre: a step is a millionth.
pub const STEPS: f32 = 1e6;
/// Largest deviation of a point on the ground. Ours: a deviation of half the range is an edge; it bounds the sums.
const DEVIATION_MAX: f32 = 0.5;
/// Largest noise over the range. Ours: a return with more comes from within the sensor's own case.
const NOISE_MAX: f32 = 4.0;
/// A deviation that is not known, in steps.
const UNKNOWN: i32 = i32::MIN;

/// Deviation of a range from the mean of its laser's neighbouring ranges, and standard deviation of the sensor's range
/// noise, both over the range itself: metres per metre of distance from the sensor that measured the point.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Deviation {
    steps: i32,
    noise: i32,
}

impl Deviation {
    /// The deviation of a point without a series.
    pub const UNKNOWN: Self = Self { steps: UNKNOWN, noise: 0 };

    /// The deviation is unknown if it is NaN or an edge's. The noise is a number of at least 0 and ends at 4. It has no
    /// branch and no cast with range checks, so that the compiler vectorises it.
    #[inline(always)]
    pub fn new(deviation: f32, noise: f32) -> Self {
        // NaN fails the comparison.
        let is_known = deviation.abs() <= DEVIATION_MAX;
        let whole = |value: f32| floor_to_whole((value * STEPS).min(NOISE_MAX * STEPS)) as i32;
        let steps = whole(deviation.abs());
        let steps = if deviation < 0.0 { -steps } else { steps };
        Self { steps: if is_known { steps } else { UNKNOWN }, noise: whole(noise) }
    }

    /// Deviation and noise in steps; `None` if the deviation is unknown.
    #[inline(always)]
    pub fn steps(self) -> Option<[i64; 2]> {
        (self.steps != UNKNOWN).then_some([self.steps.into(), self.noise.into()])
    }
}

/// The deviations of the points that are kept, in their order.
#[inline(always)]
pub(crate) fn kept<'a>(found: &'a mut [Deviation; CHUNK], are_kept: &[bool]) -> &'a [Deviation] {
    let mut kept = 0;
    for (i, is_kept) in are_kept.iter().enumerate().take(CHUNK) {
        found[kept % CHUNK] = found[i];
        kept += usize::from(*is_kept);
    }
    &found[..kept]
}

/// Finds the deviations of slots of a revolution. `scale` is 1, or NaN if they are unknown.
pub(crate) struct ReturnDeviations<'a> {
    pub(crate) range_m: &'a [f32],
    pub(crate) deviation_m: &'a [f32],
    pub(crate) scale: f32,
    pub(crate) noise_m: f32,
    pub(crate) found: &'a mut [Deviation; CHUNK],
}

impl WideLoop for ReturnDeviations<'_> {
    #[inline(always)]
    fn run(self) {
        let Self { range_m, deviation_m, scale, noise_m, found } = self;
        for (found, (&range_m, &deviation_m)) in found.iter_mut().zip(range_m.iter().zip(deviation_m)) {
            let per_m = scale / range_m;
            *found = Deviation::new(deviation_m * per_m, noise_m * per_m);
        }
    }
}

/// Finds the deviations of points of a scan.
pub(crate) struct PointDeviations<'a> {
    pub(crate) points: [&'a [f32]; 3],
    pub(crate) deviation_m: &'a [f32],
    pub(crate) noise_m: f32,
    pub(crate) found: &'a mut [Deviation; CHUNK],
}

impl WideLoop for PointDeviations<'_> {
    #[inline(always)]
    fn run(self) {
        let Self { points: [xs, ys, zs], deviation_m, noise_m, found } = self;
        let n = xs.len().min(CHUNK);
        let (xs, ys, zs, deviation_m) = (&xs[..n], &ys[..n], &zs[..n], &deviation_m[..n]);
        for i in 0..n {
            let range_m = squared_range(xs[i], ys[i], zs[i]).sqrt();
            found[i] = Deviation::new(deviation_m[i] / range_m, noise_m / range_m);
        }
    }
}
