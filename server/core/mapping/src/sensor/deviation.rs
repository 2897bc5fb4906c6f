//! How far the range of a point deviates from its neighbours', as a whole number: sums of whole numbers do not depend
//! on the order of the points.

/// Number of steps in a deviation of 1 metre per metre: a step is a millionth.
pub const STEPS: f32 = 1e6;
/// Largest deviation of a point on the ground. Ours: a deviation of half the range is an edge; it bounds the sums.
const DEVIATION_MAX: f32 = 0.5;
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

    /// The deviation is unknown if it is NaN or that of an edge. It has no branch, so that the compiler vectorises it.
    #[inline(always)]
    pub fn new(deviation: f32, noise: f32) -> Self {
        // NaN fails the comparison. The casts saturate.
        let is_known = deviation.abs() <= DEVIATION_MAX;
        Self { steps: if is_known { (deviation * STEPS) as i32 } else { UNKNOWN }, noise: (noise * STEPS) as i32 }
    }

    /// Deviation and noise in steps; `None` if the deviation is unknown.
    #[inline(always)]
    pub fn steps(self) -> Option<[i64; 2]> {
        (self.steps != UNKNOWN).then_some([self.steps.into(), self.noise.into()])
    }
}
