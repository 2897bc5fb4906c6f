//! The table `[vehicle.maps.speed]`.

use serde::{Deserialize, Serialize};

use crate::config::check::{ConfigValueError, check_each, check_fits};

/// Parameters of [`crate::layer::speed`]; the paper states no figures but the 30 m.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SpeedConfig {
    /// Whether the map is made.
    pub enabled: bool,
    /// The grid reaches this far to each side of the vehicle.
    pub extent_m: f32,
    /// Side of a cell.
    pub cell_m: f32,
    /// Points higher than this over the ground are dropped: the vehicle passes under them.
    pub overhang_m: f32,
    /// A cell that rises more than this over its surroundings, beyond what `grade_max` explains, is an obstacle.
    pub step_m_max: f32,
    /// Rise over distance that is a slope, not a step.
    pub grade_max: f32,
    /// Up to this bumpiness the ground allows the full off-road speed; the sensor's own noise lies below.
    pub smooth_m: f32,
    /// From this bumpiness on it allows a crawl.
    pub rough_m: f32,
    /// Speed in cells nothing is known of; less than a crawl, so that the two cannot be taken for one another.
    pub unknown_mps: f32,
    /// Speed over the roughest passable ground.
    pub crawl_mps: f32,
    /// Speed over smooth ground off the road.
    pub off_road_mps: f32,
    /// Greatest speed bonus of the road.
    pub bonus_mps: f32,
    /// How the bonus falls towards the road's edge.
    pub bonus: Bonus,
    /// With `bonus = "absolute"`: distance from the centre line at which it reaches 0.
    pub bonus_reach_m: f32,
    /// A road detected longer ago than this is not painted; lanes of a file, in the map frame, do not age.
    pub road_age_ms_max: u32,
    /// No road under this Kullback-Leibler divergence of the detector's orientations from even ones, nats.
    pub divergence_min: f32,
    /// The route ahead is looked at this far.
    pub route_ahead_m: f32,
    /// Largest curvature of the route the road detector follows; 0.05 is a radius of 20 m.
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
            unknown_mps: 1.0,
            crawl_mps: 2.0,
            off_road_mps: 10.0,
            bonus_mps: 8.0,
            bonus: Bonus::Relative,
            bonus_reach_m: 4.0,
            road_age_ms_max: 500,
            divergence_min: 0.1,
            route_ahead_m: 30.0,
            curvature_per_m_max: 0.05,
        }
    }
}

/// How the road's bonus falls towards its edge (§3.2.2): the paper's three ways, in its order.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Bonus {
    /// Not at all.
    Uniform,
    /// With the square of the distance from the centre line.
    Absolute,
    /// With the square of that distance relative to the road's half width there.
    Relative,
}

impl SpeedConfig {
    pub(crate) fn validate(&self, at: &str) -> Result<(), ConfigValueError> {
        let values = [
            ("extent_m", self.extent_m, (5.0..=200.0, "5 to 200")),
            ("cell_m", self.cell_m, (0.1..=2.0, "0.1 to 2")),
            ("overhang_m", self.overhang_m, (0.5..=20.0, "0.5 to 20")),
            ("step_m_max", self.step_m_max, (0.01..=10.0, "0.01 to 10")),
            ("grade_max", self.grade_max, (0.0..=1.0, "0 to 1")),
            ("smooth_m", self.smooth_m, (0.0..=1.0, "0 to 1")),
            ("rough_m", self.rough_m, (0.01..=2.0, "0.01 to 2")),
            // A speed is a cell of 8 bits in steps of 0.25 m/s, and 0 is an obstacle.
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
        crate::config::check::check_cells(at, self.extent_m, self.cell_m)?;
        check_fits(at, "rough_m", self.rough_m, self.rough_m > self.smooth_m, "more than smooth_m")?;
        let above_unknown = self.crawl_mps >= self.unknown_mps + 0.25;
        check_fits(at, "crawl_mps", self.crawl_mps, above_unknown, "at least 0.25 more than unknown_mps")?;
        check_fits(at, "off_road_mps", self.off_road_mps, self.off_road_mps >= self.crawl_mps, "at least crawl_mps")
    }
}
