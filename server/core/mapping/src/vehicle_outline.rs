//! The outline of the vehicle, seen from above.

/// A rectangle around the vehicle, ego frame, metres. Returns from within it come from the vehicle itself.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Outline {
    /// Width of the vehicle, half of it to each side of the ego origin.
    pub width_m: f32,
    /// Distance from the ego origin to the vehicle's front.
    pub front_m: f32,
    /// Distance from the ego origin to the vehicle's rear.
    pub rear_m: f32,
}

impl Outline {
    /// The outline with a margin on all sides.
    pub fn grown_by(&self, margin_m: f32) -> Self {
        let Self { width_m, front_m, rear_m } = *self;
        Self { width_m: width_m + 2.0 * margin_m, front_m: front_m + margin_m, rear_m: rear_m + margin_m }
    }

    /// True if a position lies within the outline.
    #[inline(always)]
    pub fn contains(&self, x: f32, y: f32) -> bool {
        (x >= -self.rear_m) & (x <= self.front_m) & (y.abs() <= self.width_m / 2.0)
    }
}
