//! The table `[vehicle.maps.speed]`.
//!
//! Lindström 2005 gives one value: the 30 m over which the route's curvature is measured.

use serde::{Deserialize, Serialize};

use crate::value_check::{ConfigValueError, check_cells, check_each, check_fits};

/// Largest rise of a passable cell over its surroundings, beyond what `grade_max` explains, metres. 0.2 is ours;
/// not tuned.
pub(super) const STEP_M_MAX: f32 = 0.2;

/// Largest rise over distance that counts as a slope, not a step. 0.2 is ours; not tuned.
pub(super) const GRADE_MAX: f32 = 0.2;

/// Bumpiness up to which the ground allows `off_road_mps`, metres. 0.03 is ours, because the sensor's range noise
/// stays below it; not tuned.
pub(super) const SMOOTH_M: f32 = 0.03;

/// Bumpiness from which the ground allows `crawl_mps`, metres. 0.15 is ours; not tuned.
pub(super) const ROUGH_M: f32 = 0.15;

/// Roughness (the square root of Neuhaus 2009, eq. 4) up to which the ground allows its full speed, metres per
/// metre. 0.002 is ours: nine tenths of the road of the labelled frame of BENCHMARKS.md are smoother up to 25 m.
pub(super) const ROUGHNESS_SMOOTH: f32 = 0.002;

/// Roughness from which the ground allows `rough_share` of its speed, metres per metre. 0.01 is ours: nine tenths
/// of the grass beside that road are smoother up to 15 m.
pub(super) const ROUGHNESS_ROUGH: f32 = 0.01;

/// With `bonus = "absolute"`: distance from the centre line at which the bonus is 0, metres. 4 is ours; not tuned.
pub(super) const BONUS_REACH_M: f32 = 4.0;

/// Largest age of a detected road that is painted, milliseconds; lanes of a file, in the map frame, do not age. 500
/// is ours; not tuned.
pub(super) const ROAD_AGE_MS_MAX: u32 = 500;

/// Least Kullback-Leibler divergence between the detector's orientations and even ones at which a road is painted,
/// nats. 0.1 is ours, because the paper derives its thresholds from data that it does not give (section 3.3); not
/// tuned.
pub(super) const DIVERGENCE_MIN: f32 = 0.1;

/// Length of the route ahead whose curvature is measured, metres. 30: Lindström 2005, section 3.3.
pub(super) const ROUTE_AHEAD_M: f32 = 30.0;

/// Largest curvature of the route at which a road is painted, 1/m. 0.05 (a radius of 20 m) is ours, because the
/// paper gives no value (section 3.3); not tuned.
pub(super) const CURVATURE_PER_M_MAX: f32 = 0.05;

/// Parameters of the layer `speed`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SpeedConfig {
    /// True if the layer is made.
    pub enabled: bool,
    /// Distance from the vehicle to each edge of the grid, metres. 40 is ours; not tuned.
    pub extent_m: f32,
    /// Side of a cell, metres. 0.5 is ours; not tuned.
    pub cell_m: f32,
    /// Largest height of a point over the ground, metres; the vehicle passes under higher ones. 2.5 is ours: the value
    /// of the layer `drivability` (UT Austin thesis, section IV.2).
    #[serde(skip)]
    pub overhang_m: f32,
    /// Share of its speed above `crawl_mps` that the roughest ground allows; 1: roughness changes nothing. 0.5 is ours;
    /// not tuned.
    #[serde(skip)]
    pub rough_share: f32,
    /// Speed of cells about which nothing is known, m/s; less than `crawl_mps`, so that the two differ. 1 is ours; not
    /// tuned.
    #[serde(skip)]
    pub unknown_mps: f32,
    /// Speed on the roughest passable ground, m/s. 2 is ours; not tuned.
    #[serde(skip)]
    pub crawl_mps: f32,
    /// Speed on smooth ground off the road, m/s. 10 is ours; not tuned.
    pub off_road_mps: f32,
    /// Largest speed bonus of the road, m/s. 8 is ours; not tuned.
    #[serde(skip)]
    pub bonus_mps: f32,
    /// How the bonus falls towards the road's edge. `relative`: Lindström 2005, section 3.2.2, the final variant.
    pub bonus: Bonus,
    /// True if the road ahead is measured in the sweep while no road is sent: its width and its lateral offset, from
    /// kerbs, berms and verges on both sides (Lindström 2005, section 3.1). `false` is ours, because the edges were
    /// measured in one town and one recorded street only.
    pub measure_road: bool,
    /// True if roads are painted only within the corridor of the route, if there is one. `true` follows the corridor of
    /// an RDDF (Lindström 2005, section 3.2.1).
    #[serde(skip)]
    pub corridor: bool,
    /// True if the speed limits of the route cap the speed in their part of its corridor. `true` is ours, because the
    /// rules of the race demand it; the paper reads the same file for its curvature alone.
    #[serde(skip)]
    pub speed_limits: bool,
}

impl Default for SpeedConfig {
    fn default() -> Self {
        Self {
            enabled: true,
            extent_m: 40.0,
            cell_m: 0.5,
            overhang_m: 2.5,
            rough_share: 0.5,
            unknown_mps: 1.0,
            crawl_mps: 2.0,
            off_road_mps: 10.0,
            bonus_mps: 8.0,
            bonus: Bonus::Relative,
            measure_road: false,
            corridor: true,
            speed_limits: true,
        }
    }
}

/// How the road's bonus falls towards its edge: the three variants of Lindström 2005, section 3.2.2, in its order.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Bonus {
    /// The bonus is the same over the whole width.
    Uniform,
    /// The bonus falls with the square of the distance from the centre line.
    Absolute,
    /// The bonus falls with the square of that distance over the road's half width at the same place.
    Relative,
}

impl SpeedConfig {
    /// Checks the values of the table `at`, and how they fit one another.
    ///
    /// # Errors
    /// [`ConfigValueError`] for the first value that is not allowed.
    pub(crate) fn validate(&self, at: &str) -> Result<(), ConfigValueError> {
        let values = [
            ("extent_m", self.extent_m, (5.0..=200.0, "5 to 200")),
            ("cell_m", self.cell_m, (0.1..=2.0, "0.1 to 2")),
            ("off_road_mps", self.off_road_mps, (0.5..=60.0, "0.5 to 60")),
        ];
        check_each(at, values)?;
        check_cells(at, self.extent_m, self.cell_m)?;
        let is_faster = self.off_road_mps >= self.crawl_mps;
        check_fits(at, "off_road_mps", self.off_road_mps, is_faster, "at least the 2 of the roughest ground")
    }
}
