//! The table `[vehicle.maps.motion]`.

use serde::{Deserialize, Serialize};

use crate::config::check::{ConfigValueError, check};

/// Parameters of the motion compensation ([`crate::sensor::motion`]).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct MotionConfig {
    /// True if points are moved to the end of their scan. The pose in a map's header is interpolated in any case.
    pub enabled: bool,
    /// Time for which the motion is extrapolated after the newest pose (and before the oldest), milliseconds. 200 is
    /// ours: two revolutions at 10 Hz.
    pub extrapolation_ms: u32,
    /// Largest age of a speed that is used if no poses are near enough, milliseconds; 0 leaves such scans
    /// uncompensated. 2000 is ours: two sentences of a GPS receiver that sends one each second.
    pub speed_age_ms: u32,
}

impl Default for MotionConfig {
    fn default() -> Self {
        Self { enabled: true, extrapolation_ms: 200, speed_age_ms: 2000 }
    }
}

impl MotionConfig {
    /// Checks the values of the table `at`.
    ///
    /// # Errors
    /// [`ConfigValueError`] for the first value that is not allowed.
    pub(crate) fn validate(&self, at: &str) -> Result<(), ConfigValueError> {
        let extrapolation = f64::from(self.extrapolation_ms);
        check(extrapolation, 0.0..=1000.0, || format!("{at}.extrapolation_ms"), "0 to 1000")?;
        check(f64::from(self.speed_age_ms), 0.0..=10_000.0, || format!("{at}.speed_age_ms"), "0 to 10000")
    }
}
