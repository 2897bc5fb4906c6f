//! Fields of one line of a route or lane file.

/// Length of a foot in metres: both file formats state widths in feet.
pub const FOOT_M: f64 = 0.3048;

/// A line of a route or lane file that is left out.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("line {line}: {what} is {found:?}: allowed is {allowed}")]
pub struct LineError {
    /// Number of the line, counted from 1.
    pub line: usize,
    /// Name of the field.
    pub what: &'static str,
    /// Text of the field; empty if it is missing.
    pub found: String,
    /// What is allowed.
    pub allowed: &'static str,
}

/// Parses a number and checks that it is in `range`. `line` and `what` name it in the error.
///
/// # Errors
/// [`LineError`] if the field is missing, is not a number, or is out of range.
pub(crate) fn number(
    (line, what): (usize, &'static str),
    field: Option<&str>,
    range: std::ops::RangeInclusive<f64>,
    allowed: &'static str,
) -> Result<f64, LineError> {
    let found = field.unwrap_or("").trim();
    match found.parse::<f64>() {
        Ok(value) if range.contains(&value) => Ok(value),
        _ => Err(LineError { line, what, found: found.to_owned(), allowed }),
    }
}

/// Parses a latitude, degrees.
///
/// # Errors
/// As of [`number`].
pub(crate) fn latitude(line: usize, field: Option<&str>) -> Result<f64, LineError> {
    number((line, "latitude"), field, -90.0..=90.0, "-90 to 90 degrees")
}

/// Parses a longitude, degrees.
///
/// # Errors
/// As of [`number`].
pub(crate) fn longitude(line: usize, field: Option<&str>) -> Result<f64, LineError> {
    number((line, "longitude"), field, -180.0..=180.0, "-180 to 180 degrees")
}
