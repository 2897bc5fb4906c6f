//! The table `[vehicle.maps.memory]`.

use serde::{Deserialize, Serialize};

use crate::value_check::{ConfigValueError, check_each};

/// Parameters of the memory of ground ([`crate::memory`]).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct MemoryConfig {
    /// True if ground that was seen in earlier maps is carried into the newest one. It needs ego poses.
    /// `false` is ours: ground in a sector whose sensor is covered must be unknown at once, and remembered ground is
    /// not.
    pub enabled: bool,
    /// Distance from the vehicle within which ground is kept, metres. 25 is ours: half of the shortest grid of a layer.
    pub range_m_max: f32,
    /// Age from which ground is forgotten, seconds. 5 is ours: a drift of 1 % of the way is then 0.4 m at 8 m/s.
    pub ground_s_max: f32,
    /// Age from which an obstacle that is not seen again is forgotten, seconds. 0.3 is ours: three revolutions; the
    /// cell is then unknown, not free.
    pub obstacle_s_max: f32,
}

impl Default for MemoryConfig {
    fn default() -> Self {
        Self { enabled: false, range_m_max: 25.0, ground_s_max: 5.0, obstacle_s_max: 0.3 }
    }
}

impl MemoryConfig {
    /// Checks the values of the table `at`.
    ///
    /// # Errors
    /// [`ConfigValueError`] for the first value that is not allowed.
    pub(crate) fn validate(&self, at: &str) -> Result<(), ConfigValueError> {
        let values = [
            ("range_m_max", self.range_m_max, (1.0..=30.0, "1 to 30")),
            ("ground_s_max", self.ground_s_max, (0.0..=60.0, "0 to 60")),
            ("obstacle_s_max", self.obstacle_s_max, (0.0..=10.0, "0 to 10")),
        ];
        check_each(at, values)
    }
}
