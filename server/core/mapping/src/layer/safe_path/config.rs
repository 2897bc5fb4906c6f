//! The table `[vehicle.maps.safe_path]`.
//!
//! The UT Austin thesis gives no value for any parameter of its safe points (section VI).

use serde::{Deserialize, Serialize};

use crate::value_check::{ConfigValueError, check_cells, check_each};

/// Range within which the sensor does not see the ground, metres; unknown cells before drivable ground are no
/// obstacles there. 7 is ours, as in the layer `drivability`; not tuned.
pub(super) const BLIND_ZONE_M: f32 = 7.0;

/// Widest unseen gap between drivable cells of one ring or azimuth that is no obstacle, metres; 0 closes no gap. 1
/// is ours; not tuned.
pub(super) const HOLE_M_MAX: f32 = 1.0;

/// Largest distance from the vehicle to a safe point that it drives to directly, metres. 15 is ours; not tuned.
pub(super) const JOIN_M_MAX: f32 = 15.0;

/// Parameters of the layer `safe_path`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SafePathConfig {
    /// True if the layer is made.
    pub enabled: bool,
    /// Distance from the vehicle to each edge of the grid, metres. 30 is ours; not tuned.
    pub extent_m: f32,
    /// Side of a cell, metres. 0.25 is ours; not tuned.
    pub cell_m: f32,
}

impl Default for SafePathConfig {
    fn default() -> Self {
        Self { enabled: true, extent_m: 30.0, cell_m: 0.25 }
    }
}

impl SafePathConfig {
    /// Checks the values of the table `at`.
    ///
    /// # Errors
    /// [`ConfigValueError`] for the first value that is not allowed.
    pub(crate) fn validate(&self, at: &str) -> Result<(), ConfigValueError> {
        let values =
            [("extent_m", self.extent_m, (5.0..=200.0, "5 to 200")), ("cell_m", self.cell_m, (0.1..=2.0, "0.1 to 2"))];
        check_each(at, values)?;
        check_cells(at, self.extent_m, self.cell_m)
    }
}
