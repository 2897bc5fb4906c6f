//! The table `[vehicle.maps.speed]`.
//!
//! Lindström 2005 gives one value: the 30 m over which the route's curvature is measured.

use serde::{Deserialize, Serialize};

use crate::value_check::{ConfigValueError, check_cells, check_each, check_fits};

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
    pub overhang_m: f32,
    /// Largest rise of a passable cell over its surroundings, beyond what `grade_max` explains, metres. 0.2 is ours;
    /// not tuned.
    pub step_m_max: f32,
    /// Largest rise over distance that counts as a slope, not a step. 0.2 is ours; not tuned.
    pub grade_max: f32,
    /// Bumpiness up to which the ground allows `off_road_mps`, metres. 0.03 is ours, because the sensor's range noise
    /// stays below it; not tuned.
    pub smooth_m: f32,
    /// Bumpiness from which the ground allows `crawl_mps`, metres. 0.15 is ours; not tuned.
    pub rough_m: f32,
    /// Roughness (the square root of Neuhaus 2009, eq. 4) up to which the ground allows its full speed, metres per
    /// metre. 0.002 is ours: nine tenths of the road of the labelled frame of BENCHMARKS.md are smoother up to 25 m.
    pub roughness_smooth: f32,
    /// Roughness from which the ground allows `rough_share` of its speed, metres per metre. 0.01 is ours: nine tenths
    /// of the grass beside that road are smoother up to 15 m.
    pub roughness_rough: f32,
    /// Share of its speed above `crawl_mps` that the roughest ground allows; 1: roughness changes nothing. 0.5 is ours;
    /// not tuned.
    pub rough_share: f32,
    /// Speed of cells of which nothing is known, m/s; less than `crawl_mps`, so that the two differ. 1 is ours; not
    /// tuned.
    pub unknown_mps: f32,
    /// Speed on the roughest passable ground, m/s. 2 is ours; not tuned.
    pub crawl_mps: f32,
    /// Speed on smooth ground off the road, m/s. 10 is ours; not tuned.
    pub off_road_mps: f32,
    /// Largest speed bonus of the road, m/s. 8 is ours; not tuned.
    pub bonus_mps: f32,
    /// How the bonus falls towards the road's edge. `relative`: Lindström 2005, section 3.2.2, the final variant.
    pub bonus: Bonus,
    /// With `bonus = "absolute"`: distance from the centre line at which the bonus is 0, metres. 4 is ours; not tuned.
    pub bonus_reach_m: f32,
    /// True if the road ahead is measured in the sweep while no road is sent: its width and its lateral offset, from
    /// kerbs, berms and verges on both sides (Lindström 2005, section 3.1). `false` is ours, because the edges were
    /// measured in one town and one recorded street only.
    pub measure_road: bool,
    /// True if roads are painted only within the corridor of the route, if there is one. `true` follows the corridor of
    /// an RDDF (Lindström 2005, section 3.2.1).
    pub corridor: bool,
    /// Speed limit outside the corridor of the route, m/s; 0: no limit. 0 is ours, because a route may lie beside the
    /// road by the error of the positions.
    pub outside_corridor_mps: f32,
    /// True if the speed limits of the route cap the speed in their part of its corridor. `true` is ours, because the
    /// rules of the race demand it; the paper reads the same file for its curvature alone.
    pub speed_limits: bool,
    /// Largest age of a detected road that is painted, milliseconds; lanes of a file, in the map frame, do not age. 500
    /// is ours; not tuned.
    pub road_age_ms_max: u32,
    /// Least Kullback-Leibler divergence between the detector's orientations and even ones at which a road is painted,
    /// nats. 0.1 is ours, because the paper derives its thresholds from data that it does not give (section 3.3); not
    /// tuned.
    pub divergence_min: f32,
    /// Length of the route ahead whose curvature is measured, metres. 30: Lindström 2005, section 3.3.
    pub route_ahead_m: f32,
    /// Largest curvature of the route at which a road is painted, 1/m. 0.05 (a radius of 20 m) is ours, because the
    /// paper gives no value (section 3.3); not tuned.
    pub curvature_per_m_max: f32,
}

impl Default for SpeedConfig {
    fn default() -> Self {
        Self {
            enabled: true,
            extent_m: 40.0,
            cell_m: 0.5,
            overhang_m: 2.5,
            step_m_max: 0.2,
            grade_max: 0.2,
            smooth_m: 0.03,
            rough_m: 0.15,
            roughness_smooth: 0.002,
            roughness_rough: 0.01,
            rough_share: 0.5,
            unknown_mps: 1.0,
            crawl_mps: 2.0,
            off_road_mps: 10.0,
            bonus_mps: 8.0,
            bonus: Bonus::Relative,
            bonus_reach_m: 4.0,
            measure_road: false,
            corridor: true,
            outside_corridor_mps: 0.0,
            speed_limits: true,
            road_age_ms_max: 500,
            divergence_min: 0.1,
            route_ahead_m: 30.0,
            curvature_per_m_max: 0.05,
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
            ("overhang_m", self.overhang_m, (0.5..=20.0, "0.5 to 20")),
            ("step_m_max", self.step_m_max, (0.01..=10.0, "0.01 to 10")),
            ("grade_max", self.grade_max, (0.0..=1.0, "0 to 1")),
            ("smooth_m", self.smooth_m, (0.0..=1.0, "0 to 1")),
            ("rough_m", self.rough_m, (0.01..=2.0, "0.01 to 2")),
            ("roughness_smooth", self.roughness_smooth, (0.0..=1.0, "0 to 1")),
            ("roughness_rough", self.roughness_rough, (0.0001..=1.0, "0.0001 to 1")),
            ("rough_share", self.rough_share, (0.0..=1.0, "0 to 1")),
            ("outside_corridor_mps", self.outside_corridor_mps, (0.0..=60.0, "0 to 60")),
            // A cell has 8 bits in steps of 0.25 m/s, and 0 is an obstacle.
            ("unknown_mps", self.unknown_mps, (0.25..=10.0, "0.25 to 10")),
            ("crawl_mps", self.crawl_mps, (0.5..=20.0, "0.5 to 20")),
            ("off_road_mps", self.off_road_mps, (0.5..=60.0, "0.5 to 60")),
            ("bonus_mps", self.bonus_mps, (0.0..=60.0, "0 to 60")),
            ("bonus_reach_m", self.bonus_reach_m, (0.1..=100.0, "0.1 to 100")),
            ("road_age_ms_max", self.road_age_ms_max as f32, (1.0..=60_000.0, "1 to 60000")),
            ("divergence_min", self.divergence_min, (0.0..=10.0, "0 to 10")),
            ("route_ahead_m", self.route_ahead_m, (1.0..=500.0, "1 to 500")),
            ("curvature_per_m_max", self.curvature_per_m_max, (0.0..=10.0, "0 to 10")),
        ];
        check_each(at, values)?;
        check_cells(at, self.extent_m, self.cell_m)?;
        check_fits(at, "rough_m", self.rough_m, self.rough_m > self.smooth_m, "more than smooth_m")?;
        let rougher = self.roughness_rough > self.roughness_smooth;
        check_fits(at, "roughness_rough", self.roughness_rough, rougher, "more than roughness_smooth")?;
        let above_unknown = self.crawl_mps >= self.unknown_mps + 0.25;
        check_fits(at, "crawl_mps", self.crawl_mps, above_unknown, "at least 0.25 more than unknown_mps")?;
        check_fits(at, "off_road_mps", self.off_road_mps, self.off_road_mps >= self.crawl_mps, "at least crawl_mps")
    }
}
