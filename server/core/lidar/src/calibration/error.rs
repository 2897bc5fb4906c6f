//! The reasons for which a calibration cannot be read.

/// The reason for which a calibration cannot be read.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum CalibrationError {
    /// The text is not YAML.
    #[error("not YAML: {0}")]
    Yaml(String),
    /// The text is not XML.
    #[error("not XML: {0}")]
    Xml(String),
    /// The text is neither YAML nor XML.
    #[error("{0}; ROS YAML or Velodyne XML is allowed")]
    Format(String),
    /// A required key is missing.
    #[error("{key}: missing; it must be {allowed}")]
    Missing {
        /// Path of the key, such as `lasers[3].vert_correction`.
        key: String,
        /// Values that are allowed.
        allowed: &'static str,
    },
    /// A value is out of bounds or of the wrong type.
    #[error("{key}: {value} is not allowed; it must be {allowed}")]
    Value {
        /// Path of the key, such as `lasers[3].vert_correction`.
        key: String,
        /// Value in the text.
        value: String,
        /// Values that are allowed.
        allowed: &'static str,
    },
    /// A key occurs twice with different values.
    #[error("{key}: given twice, as {first} and {second}")]
    Duplicate {
        /// Path of the key.
        key: String,
        /// First value in the text.
        first: String,
        /// Second value in the text.
        second: String,
    },
    /// The table has another number of lasers than the sensor.
    #[error("lasers: {found} of them, but a {model} has {expected}")]
    Lasers {
        /// Number of lasers in the table.
        found: usize,
        /// Name of the sensor model.
        model: &'static str,
        /// Number of lasers of the sensor.
        expected: usize,
    },
}
