//! The table `[vehicle.maps.freespace]`.

use serde::{Deserialize, Serialize};

/// Parameters of the layer `freespace`. The vehicle's outline and clearance are in `[vehicle.maps.reach]`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct FreespaceConfig {
    /// True if the layer is made.
    pub enabled: bool,
    /// True if the layer has the channel `height`.
    pub height: bool,
    /// True if the layer has the channel `why`.
    pub why: bool,
}

impl Default for FreespaceConfig {
    fn default() -> Self {
        Self { enabled: true, height: false, why: false }
    }
}

impl FreespaceConfig {
    /// Checks the values of the table `at`.
    ///
    /// # Errors
    /// [`ConfigValueError`](crate::value_check::ConfigValueError) for the first value that is not allowed.
    pub(crate) fn validate(&self, _at: &str) -> Result<(), crate::value_check::ConfigValueError> {
        Ok(())
    }
}
