//! Checks of single values of the configuration, and the error they give.

/// A value of the configuration that is not allowed.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("{key} = {value}: allowed is {allowed}")]
pub struct ConfigValueError {
    /// Full path of the key, such as `vehicle.maps.drivability.columns`.
    pub key: String,
    /// The value as it was given.
    pub value: String,
    /// Which values are allowed.
    pub allowed: &'static str,
}

impl ConfigValueError {
    /// An error for the value of a key.
    pub(crate) fn new(key: impl Into<String>, value: impl ToString, allowed: &'static str) -> Self {
        Self { key: key.into(), value: value.to_string(), allowed }
    }
}

/// A range of allowed values, and how an error states it.
pub(crate) type Allowed = (std::ops::RangeInclusive<f64>, &'static str);

/// Checks that a value is in a range.
///
/// # Errors
/// [`ConfigValueError`] if it is not. NaN is in no range.
pub(crate) fn check(
    value: f64,
    range: std::ops::RangeInclusive<f64>,
    key: impl FnOnce() -> String,
    allowed: &'static str,
) -> Result<(), ConfigValueError> {
    if range.contains(&value) { Ok(()) } else { Err(ConfigValueError::new(key(), value, allowed)) }
}

/// Checks the values of the table `at`.
///
/// # Errors
/// [`ConfigValueError`] for the first value that is not in its range.
pub(crate) fn check_each<const N: usize>(at: &str, values: [(&str, f32, Allowed); N]) -> Result<(), ConfigValueError> {
    values.into_iter().try_for_each(|(key, value, (range, allowed))| {
        check(f64::from(value), range, || format!("{at}.{key}"), allowed)
    })
}

/// Checks a condition between a value and another one of the table `at`.
///
/// # Errors
/// [`ConfigValueError`] if `fits` is false.
pub(crate) fn check_fits(
    at: &str,
    key: &str,
    value: f32,
    fits: bool,
    allowed: &'static str,
) -> Result<(), ConfigValueError> {
    if fits { Ok(()) } else { Err(ConfigValueError::new(format!("{at}.{key}"), value, allowed)) }
}

/// Checks that the grid of a layer has at most 1000 cells a side, which keeps a message of one-byte cells under 1 MB.
///
/// # Errors
/// [`ConfigValueError`] if `cell_m` is less than `extent_m / 500`.
pub(crate) fn check_cells(at: &str, extent_m: f32, cell_m: f32) -> Result<(), ConfigValueError> {
    if extent_m / cell_m <= 500.0 {
        return Ok(());
    }
    Err(ConfigValueError::new(format!("{at}.cell_m"), cell_m, "at least extent_m / 500"))
}

/// Checks the number of columns of a radial grid.
///
/// # Errors
/// [`ConfigValueError`] if it is not 8 to 1440.
pub(crate) fn check_columns(at: &str, columns: u16) -> Result<(), ConfigValueError> {
    if (8..=1440).contains(&columns) {
        Ok(())
    } else {
        Err(ConfigValueError::new(format!("{at}.columns"), columns, "8 to 1440"))
    }
}

/// Checks a name, which is part of keys and topics.
///
/// # Errors
/// [`ConfigValueError`] if it is not 1 to 64 of the characters a-z, 0-9, - and _.
pub fn check_name(key: &str, name: &str) -> Result<(), ConfigValueError> {
    let is_allowed = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '-' || c == '_';
    if !name.is_empty() && name.len() <= 64 && name.chars().all(is_allowed) {
        Ok(())
    } else {
        Err(ConfigValueError::new(key, format!("{name:?}"), "1 to 64 of the characters a-z, 0-9, - and _"))
    }
}
