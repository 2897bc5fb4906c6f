//! The table `[vehicle.time]`.

use serde::{Deserialize, Serialize};

use clearway_lidar::clock::AHEAD_NS_MAX;

use crate::config::check::ConfigValueError;

const NS_PER_MS: i64 = 1_000_000;
/// Greatest value of `ahead_ms_max`. Ours: a minute ahead, no map is of use to a planner.
const AHEAD_MS_MAX: u32 = 60_000;

/// How the stamps of sensors follow the clocks.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TimeConfig {
    /// Greatest time by which stamps may be ahead of the clock that they follow, milliseconds. If they are ahead by
    /// more, they go back to it and a new epoch begins, which the map states. 0: stamps never go back, and epochs are
    /// not counted.
    pub ahead_ms_max: u32,
}

impl Default for TimeConfig {
    fn default() -> Self {
        Self { ahead_ms_max: (AHEAD_NS_MAX / NS_PER_MS) as u32 }
    }
}

impl TimeConfig {
    /// The rules of recordings that were made before there was this table.
    pub const WITHOUT_EPOCHS: Self = Self { ahead_ms_max: 0 };

    /// [`TimeConfig::ahead_ms_max`] in ns.
    pub fn ahead_ns_max(&self) -> i64 {
        i64::from(self.ahead_ms_max) * NS_PER_MS
    }

    pub(crate) fn validate(&self) -> Result<(), ConfigValueError> {
        let allowed = "0 (stamps never go back), or 20 to 60000";
        match self.ahead_ms_max {
            0 | 20..=AHEAD_MS_MAX => Ok(()),
            other => Err(ConfigValueError::new("vehicle.time.ahead_ms_max", other, allowed)),
        }
    }
}
