//! The table `[vehicle.maps.terrain]`.
//!
//! Neuhaus 2009 gives no value for any parameter of the algorithm.

use serde::{Deserialize, Serialize};

use crate::value_check::{ConfigValueError, check_each};

use super::division::Division;

/// Largest local height disturbance of a flat region, m² (eq. 1: a variance). 0.005 is ours, because the paper
/// gives no threshold (section 2.3); not tuned.
pub(super) const FLATNESS_M2_MAX: f32 = 0.005;

/// With `variant = "grounded"`: largest distance between a point of a flat region and its plane, metres. 0.15 is
/// ours; chosen on the labelled frame of BENCHMARKS.md.
pub(super) const RESIDUAL_M_MAX: f32 = 0.15;

/// With `variant = "grounded"`: largest rise over run of a flat region. 0.2 is ours; chosen on the labelled frame
/// of BENCHMARKS.md.
pub(super) const GRADE_MAX: f32 = 0.2;

/// With `variant = "grounded"`: largest height of a flat cell's points over the local ground, metres. 0.25 is ours:
/// one unit of the layer `drivability`.
pub(super) const STEP_M_MAX: f32 = 0.25;

/// Standard deviation of the positions of points, metres: a flat region's plane has no slope in a direction in
/// which its points lie this close together. 0.02 is ours: the range noise of an HDL-64E. The noise that is
/// subtracted from the roughness (section 2.5) is a property of each sensor: `range_noise_m` of its table.
pub(super) const NOISE_M: f32 = 0.02;

/// Parameters of the layer `terrain`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TerrainConfig {
    /// True if the layer is made.
    pub enabled: bool,
    /// Variant of the algorithm. `grounded` is ours, because `paper` calls car roofs flat and infers cells far beyond
    /// the last point (BENCHMARKS.md compares the three).
    pub variant: Variant,
    /// Distance from the vehicle to each edge of the grid, metres. 50 is ours; not tuned.
    pub range_m_max: f32,
    /// Side of a cell, metres. 0.25 is ours, because the paper only says "relatively small" (section 2.3); not tuned.
    pub cell_m: f32,
    /// Largest height of a point over the ground under the vehicle, metres; the vehicle passes under higher ones. 2.5
    /// is ours: the value of the layer `drivability` (UT Austin thesis, section IV.2).
    #[serde(skip)]
    pub overhang_m: f32,
    /// Least number of points of a region that is judged. 3 is ours: as many as define a plane.
    #[serde(skip)]
    pub points_min: u16,
    /// With `variant = "grounded"`: widest hole in seen ground that is inferred to be flat, metres. 3 is ours; not
    /// tuned.
    #[serde(skip)]
    pub inference_m_max: f32,
    /// Least number of points with a range deviation in a cell with a roughness. 4 is ours; not tuned.
    #[serde(skip)]
    pub roughness_points_min: u16,
    /// True if the layer has channels for the plane of each flat cell (height and slopes). `false` is ours, because the
    /// channels cost bytes. The variant `paper` always has them (Neuhaus 2009, figure 4).
    pub planes: bool,
}

impl Default for TerrainConfig {
    fn default() -> Self {
        Self {
            enabled: true,
            variant: Variant::Grounded,
            range_m_max: 50.0,
            cell_m: 0.25,
            overhang_m: 2.5,
            points_min: 3,
            inference_m_max: 3.0,
            roughness_points_min: 4,
            planes: false,
        }
    }
}

/// How the layer `terrain` finds flat cells.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Variant {
    /// Hierarchical division into quarters; flat regions must lie on the local ground, where the vehicle can reach
    /// them; inference only within seen ground.
    Grounded,
    /// Hierarchical division alone (Neuhaus 2009, section 2.3).
    Paper,
    /// Each cell by itself, with the shape of its points (Neuhaus 2009, section 2.2).
    Grid,
}

impl Variant {
    /// How the variant divides the grid.
    pub(crate) fn division(self) -> Division {
        match self {
            Self::Grounded => Division::Quarters,
            Self::Paper | Self::Grid => Division::Halves,
        }
    }
}

impl TerrainConfig {
    /// The parameters with the values of the variant.
    pub(crate) fn of_variant(&self) -> Self {
        Self { planes: self.planes || self.variant == Variant::Paper, ..self.clone() }
    }

    /// Checks the values of the table `at`.
    ///
    /// # Errors
    /// [`ConfigValueError`] for the first value that is not allowed.
    pub(crate) fn validate(&self, at: &str) -> Result<(), ConfigValueError> {
        let values = [
            // At most 2000 cells a side.
            ("range_m_max", self.range_m_max, (5.0..=100.0, "5 to 100")),
            ("cell_m", self.cell_m, (0.1..=2.0, "0.1 to 2")),
            // Without noise the plane through a piece of one ring is not defined.
        ];
        check_each(at, values)
    }
}
