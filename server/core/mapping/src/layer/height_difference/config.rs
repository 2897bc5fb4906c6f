//! The table `[vehicle.maps.height_difference]`.

use serde::{Deserialize, Serialize};

use crate::value_check::{ConfigValueError, check_columns};

/// Parameters of the layer `height_difference`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct HeightDifferenceConfig {
    /// True if the layer is made.
    pub enabled: bool,
    /// Largest horizontal range of a point, metres; the outermost row ends here. 60: UT Austin thesis, section IV.1.
    #[serde(skip)]
    pub range_m_max: f32,
    /// Largest height difference between the points of a drivable cell, metres. 0.25 is ours, one unit of the layer
    /// `drivability`, because the thesis gives no value (section V); not tuned.
    #[serde(skip)]
    pub difference_m_max: f32,
    /// Number of columns of the grid. 360 (one degree each): UT Austin thesis, section IV.1.
    #[serde(skip)]
    pub columns: u16,
}

impl Default for HeightDifferenceConfig {
    fn default() -> Self {
        Self { enabled: true, range_m_max: 60.0, difference_m_max: 0.25, columns: 360 }
    }
}

impl HeightDifferenceConfig {
    /// Checks the values of the table `at`.
    ///
    /// # Errors
    /// [`ConfigValueError`] for the first value that is not allowed.
    pub(crate) fn validate(&self, at: &str) -> Result<(), ConfigValueError> {
        check_columns(at, self.columns)
    }
}
