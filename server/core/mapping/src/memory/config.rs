//! The table `[vehicle.maps.memory]`.

use serde::{Deserialize, Serialize};

/// Distance from the vehicle within which ground is kept, metres. 25 is ours: half of the shortest grid of a layer.
pub(super) const RANGE_M_MAX: f32 = 25.0;

/// Age from which ground is forgotten, seconds. 5 is ours: a drift of 1 % of the way is then 0.4 m at 8 m/s.
pub const GROUND_S_MAX: f32 = 5.0;

/// Age from which an obstacle that is not seen again is forgotten, seconds. 0.3 is ours: three revolutions; the
/// cell is then unknown, not free.
pub(super) const OBSTACLE_S_MAX: f32 = 0.3;

/// Parameters of the memory of ground ([`crate::memory`]).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct MemoryConfig {
    /// True if ground that was seen in earlier maps is carried into the newest one. It needs ego poses; without them,
    /// and in directions without a return, where the sensor may be covered, nothing is carried. `true` is ours.
    pub enabled: bool,
}

impl Default for MemoryConfig {
    fn default() -> Self {
        Self { enabled: true }
    }
}
