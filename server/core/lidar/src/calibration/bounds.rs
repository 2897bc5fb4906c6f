//! The bounds of the numbers of a calibration text. They are wide: they find degrees that are read as radians, not
//! unusual sensors.

use super::error::CalibrationError;

/// Bounds of an angle, and their description.
pub(super) const ANGLE_RAD: ((f64, f64), &str) = ((-1.6, 1.6), "an angle in radians, -1.6 to 1.6");
/// Bounds of a length, and their description.
pub(super) const LENGTH_M: ((f64, f64), &str) = ((-10.0, 10.0), "a length in metres, -10 to 10");
/// Bounds of focal distance and slope, and their description.
pub(super) const FOCAL: ((f64, f64), &str) = ((-1e6, 1e6), "a finite number");
/// Bounds of the length of a distance count, and their description.
pub(super) const RESOLUTION_M: ((f64, f64), &str) = ((1e-4, 0.1), "metres a count, 0.0001 to 0.1");

/// Checks that a number is within the bounds of its key.
///
/// # Errors
/// [`CalibrationError::Value`] if it is not.
pub(super) fn bounded(
    key: impl Fn() -> String,
    value: f64,
    (low, high): (f64, f64),
    allowed: &'static str,
) -> Result<f64, CalibrationError> {
    if (low..=high).contains(&value) {
        Ok(value)
    } else {
        Err(CalibrationError::Value { key: key(), value: value.to_string(), allowed })
    }
}
