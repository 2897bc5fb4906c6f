//! The table `[vehicle.maps.occupancy]`.

use serde::{Deserialize, Serialize};

use crate::value_check::{ConfigValueError, check_cells, check_each};

/// Least height at which a ray proves a cell clear, metres: a lower ray could pass under a car. 0.2 is ours; not
/// tuned.
pub(super) const CLEAR_HEIGHT_M_MIN: f32 = 0.2;

/// Largest height at which a ray proves a cell clear, metres: a higher ray misses low obstacles. 0.5 is ours, the
/// height of a bumper; not tuned.
pub(super) const CLEAR_HEIGHT_M_MAX: f32 = 0.5;

/// Speed up to which `hits_slow` returns make a cell occupied, m/s. 4.4 (10 mph): Seo 2014, figure 5.
pub(super) const SPEED_MPS_SLOW: f32 = 4.4;

/// Speed from which `hits_fast` returns do, m/s; the number is linear between the two speeds. 26.8 (60 mph): Seo
/// 2014, figure 5.
pub(super) const SPEED_MPS_FAST: f32 = 26.8;

/// Number of returns at low speed. 20: Seo 2014, figure 5.
pub(super) const HITS_SLOW: u8 = 20;

/// Number of returns at high speed, and if the speed is not known. 2: Seo 2014, figure 5.
pub(super) const HITS_FAST: u8 = 2;

/// With `variant = "polar"`: number of maps for which an occupied cell without new evidence stays occupied. 2 is ours,
/// so that an object that no sensor sees again leaves the third map; not tuned.
pub(super) const HOLD_MAPS: u8 = 2;

/// With `variant = "polar"` and ego poses: number of maps in which a cell that was clear, and then was neither
/// clear nor occupied, does not become clear again; and a hidden cell becomes clear only in the second map in a row
/// that shows it clear. 0: both do at once. 5 is ours: of the changes along the borders of shadows half are undone
/// within five maps; not tuned.
pub(super) const CALM_MAPS: u8 = 5;

/// Parameters of the layer `occupancy`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct OccupancyConfig {
    /// True if the layer is made.
    pub enabled: bool,
    /// Variant of the algorithm. `polar` is ours, because `paper` traces a line for every return, and so takes ten
    /// times as long; and because its lines clear the cells under the rays of a sensor on the roof (BENCHMARKS.md
    /// compares the two).
    pub variant: OccupancyVariant,
    /// Distance from the vehicle to each edge of the grid, metres. 50: Seo 2014, section 2 (a map of 100 m).
    pub extent_m: f32,
    /// Side of a cell, metres. 0.25: Seo 2014, section 2.
    pub cell_m: f32,
    /// Least height of an obstacle over the ground, metres; the vehicle drives over lower ones. 0.3 is ours, because
    /// the paper says "ego-vehicle's clearance" without a number; not tuned.
    #[serde(skip)]
    pub clearance_m: f32,
    /// With `variant = "paper"`: least height of a return that is not counted, metres; the vehicle passes under it. 5:
    /// Seo 2014, section 2. The other variant has the overhang of [`crate::reach`].
    #[serde(skip)]
    pub overhang_m: f32,
    /// Reliable range of the sensors, metres; cells beyond it are out of range. 150: Seo 2014, section 2.
    #[serde(skip)]
    pub range_m_max: f32,
    /// Range to which a ray without a return clears cells, metres; 0: such rays prove nothing. 0 is ours, because a
    /// ray may also be lost on a dark or wet surface.
    #[serde(skip)]
    pub no_return_m: f32,
    /// What the channel `hits` contains. `reduced` is ours, because it costs fewer bytes (BENCHMARKS.md has the sizes);
    /// `counted` is the paper's (section 2).
    #[serde(skip)]
    pub hits: Hits,
}

/// How the layer `occupancy` finds what rays pass through and what hides cells.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum OccupancyVariant {
    /// One traced ray for each azimuth; a ray clears a cell only where it is low over the ground.
    Polar,
    /// One line for each return from the sensor through the return to the reliable range (Seo 2014, algorithm 1).
    Paper,
}

/// The published number of hits of a cell.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Hits {
    /// 255 in an occupied cell, in an unknown one the power of two that its hits reach, 0 in any other.
    Reduced,
    /// 255 in an occupied cell, in any other the number of its hits, at most 254 (Seo 2014, section 2).
    Counted,
}

impl Default for OccupancyConfig {
    fn default() -> Self {
        Self {
            enabled: true,
            variant: OccupancyVariant::Polar,
            extent_m: 50.0,
            cell_m: 0.25,
            clearance_m: 0.3,
            overhang_m: 5.0,
            range_m_max: 150.0,
            no_return_m: 0.0,
            hits: Hits::Reduced,
        }
    }
}

impl OccupancyConfig {
    /// The parameters with the values of the variant: the paper counts hits, and keeps nothing that no return confirms.
    pub(crate) fn of_variant(&self) -> Self {
        match self.variant {
            OccupancyVariant::Polar => self.clone(),
            OccupancyVariant::Paper => Self { hits: Hits::Counted, ..self.clone() },
        }
    }

    /// With `variant = "polar"`: number of maps for which an occupied cell without new evidence stays occupied.
    pub(crate) fn hold_maps(&self) -> u8 {
        if self.variant == OccupancyVariant::Paper { 0 } else { HOLD_MAPS }
    }

    /// Checks the values of the table `at`, and how they fit one another.
    ///
    /// # Errors
    /// [`ConfigValueError`] for the first value that is not allowed.
    pub(crate) fn validate(&self, at: &str) -> Result<(), ConfigValueError> {
        let values =
            [("extent_m", self.extent_m, (5.0..=100.0, "5 to 100")), ("cell_m", self.cell_m, (0.1..=2.0, "0.1 to 2"))];
        check_each(at, values)?;
        check_cells(at, self.extent_m, self.cell_m)
    }
}
