//! Rigid transforms of points in single precision, and which points a sweep keeps.

use nalgebra::Isometry3;

use crate::sensor::observation::POSITION_M_MAX;
use crate::wide::WideLoop;

/// Number of points that are processed together. Ours: their intermediate values fit into the first-level cache.
pub const CHUNK: usize = 1024;

/// A rigid transform in single precision. It rounds by 8 µm at 120 m, where the sensor's own step is 2 mm.
#[derive(Clone, Copy)]
pub struct Transform {
    rotation: [[f32; 3]; 3],
    translation: [f32; 3],
}

impl Transform {
    pub fn new(ego_from_sensor: &Isometry3<f64>) -> Self {
        let rotation = ego_from_sensor.rotation.to_rotation_matrix();
        let translation = ego_from_sensor.translation;
        let row = |i: usize| [0, 1, 2].map(|j| rotation[(i, j)] as f32);
        Self {
            rotation: [row(0), row(1), row(2)],
            translation: [translation.x as f32, translation.y as f32, translation.z as f32],
        }
    }

    /// A transform between two that differ by the motion of a millisecond; linear, which is as good as the arc there.
    #[inline(always)]
    pub fn towards(&self, to: &Self, share: f32) -> Self {
        let mix = |a: f32, b: f32| a + share * (b - a);
        let row = |i: usize| [0, 1, 2].map(|j| mix(self.rotation[i][j], to.rotation[i][j]));
        Self {
            rotation: [row(0), row(1), row(2)],
            translation: [0, 1, 2].map(|i| mix(self.translation[i], to.translation[i])),
        }
    }

    #[inline(always)]
    pub fn apply(&self, x: f32, y: f32, z: f32) -> [f32; 3] {
        let axis = |i: usize| {
            let [a, b, c] = self.rotation[i];
            a * x + b * y + c * z + self.translation[i]
        };
        [axis(0), axis(1), axis(2)]
    }
}

/// Up to [`CHUNK`] points on their way into a sweep, ego frame, metres, and whether it keeps each.
pub(crate) struct MovedPoints {
    pub(crate) x: [f32; CHUNK],
    pub(crate) y: [f32; CHUNK],
    pub(crate) z: [f32; CHUNK],
    pub(crate) are_kept: [bool; CHUNK],
}

impl Default for MovedPoints {
    fn default() -> Self {
        Self { x: [0.0; CHUNK], y: [0.0; CHUNK], z: [0.0; CHUNK], are_kept: [false; CHUNK] }
    }
}

impl MovedPoints {
    /// Moves the kept ones of the first `points` to the front, and returns their number. Each point is written, and the
    /// place of the next one advances if it is kept, so that the loop has no branch.
    #[inline(always)]
    pub(crate) fn close_up(&mut self, points: usize) -> usize {
        let mut kept = 0;
        for i in 0..points.min(CHUNK) {
            let to = kept % CHUNK;
            (self.x[to], self.y[to], self.z[to]) = (self.x[i], self.y[i], self.z[i]);
            kept += usize::from(self.are_kept[i]);
        }
        kept
    }
}

/// Moves the slots of a revolution by one transform, finds the slots that a sweep keeps, and counts the returns. A slot
/// that has not fired is NaN, one without a return is 0: neither is kept.
pub(crate) struct MoveReturns<'a> {
    pub(crate) range_m: &'a [f32],
    pub(crate) points: [&'a [f32]; 3],
    pub(crate) range_m_min: f32,
    pub(crate) transform: Transform,
    pub(crate) moved: &'a mut MovedPoints,
    pub(crate) returns: &'a mut u32,
}

impl WideLoop for MoveReturns<'_> {
    #[inline(always)]
    fn run(self) {
        let Self { range_m, points: [xs, ys, zs], range_m_min, transform, moved, returns } = self;
        let n = range_m.len().min(CHUNK);
        let (range_m, xs, ys, zs) = (&range_m[..n], &xs[..n], &ys[..n], &zs[..n]);
        let mut found = 0;
        // Without a branch, so that the compiler vectorises it.
        for i in 0..n {
            found += u32::from(range_m[i] > 0.0);
            moved.are_kept[i] = (range_m[i] > 0.0) & (range_m[i] >= range_m_min);
            [moved.x[i], moved.y[i], moved.z[i]] = transform.apply(xs[i], ys[i], zs[i]);
        }
        *returns += found;
    }
}

/// Moves the points of a scan by one transform, finds the points that a sweep keeps, and counts the positions and the
/// returns.
pub(crate) struct MoveAtRest<'a> {
    pub(crate) points: [&'a [f32]; 3],
    pub(crate) range_m_min: f32,
    pub(crate) transform: Transform,
    pub(crate) moved: &'a mut MovedPoints,
    pub(crate) counts: [&'a mut u32; 2],
}

impl WideLoop for MoveAtRest<'_> {
    #[inline(always)]
    fn run(self) {
        let Self { points: [xs, ys, zs], range_m_min, transform, moved, counts } = self;
        let n = xs.len().min(CHUNK);
        let (xs, ys, zs) = (&xs[..n], &ys[..n], &zs[..n]);
        let [mut positions, mut returns] = [0; 2];
        // Without a branch, so that the compiler vectorises it.
        for i in 0..n {
            let (is_position, is_return) = classify(xs[i], ys[i], zs[i]);
            moved.are_kept[i] = is_return & is_far(range_m_min, [xs[i], ys[i], zs[i]]);
            (positions, returns) = (positions + u32::from(is_position), returns + u32::from(is_return));
            [moved.x[i], moved.y[i], moved.z[i]] = transform.apply(xs[i], ys[i], zs[i]);
        }
        let [all_positions, all_returns] = counts;
        (*all_positions, *all_returns) = (*all_positions + positions, *all_returns + returns);
    }
}

/// Whether a point of a scan is a position, and whether it is a return: a position other than the sensor's own.
#[inline(always)]
pub(crate) fn classify(x: f32, y: f32, z: f32) -> (bool, bool) {
    // NaN fails every comparison.
    let is_position = (x.abs() <= POSITION_M_MAX) & (y.abs() <= POSITION_M_MAX) & (z.abs() <= POSITION_M_MAX);
    (is_position, is_position & (squared_range(x, y, z) > 0.0))
}

/// True if a position, sensor frame, metres, is at least `range_m_min` away from the sensor.
#[inline(always)]
pub(crate) fn is_far(range_m_min: f32, [x, y, z]: [f32; 3]) -> bool {
    squared_range(x, y, z) >= range_m_min * range_m_min
}

#[inline(always)]
pub(crate) fn squared_range(x: f32, y: f32, z: f32) -> f32 {
    x * x + y * y + z * z
}
