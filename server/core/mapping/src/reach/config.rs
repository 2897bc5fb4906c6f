//! The table `[vehicle.maps.reach]`.

use serde::{Deserialize, Serialize};

use crate::value_check::{ConfigValueError, check_each, check_fits};
use crate::vehicle_outline::Outline;

/// Least rise over run of a step; less is a slope. 0.5 is ours; tuned on the even seeds of the random worlds.
pub(super) const STEP_SLOPE_MIN: f32 = 0.5;

/// The vehicle's outline, and what it cannot drive over or under.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ReachConfig {
    /// Width of the vehicle, metres. Ground counts as reached only where a disc of this width passes. 2 is ours, a car.
    pub vehicle_width_m: f32,
    /// Distance from the ego origin to the vehicle's front, metres. Returns from within the vehicle's outline are no
    /// obstacles. 3 is ours, a car.
    pub vehicle_front_m: f32,
    /// Distance from the ego origin to the vehicle's rear, metres. 2 is ours, a car.
    pub vehicle_rear_m: f32,
    /// Least height of an obstacle over the local ground, metres; the vehicle drives over lower ones. 0.25 is ours: one
    /// unit of the layer `drivability`.
    pub obstacle_m_min: f32,
    /// Ground clearance of the vehicle, metres: the layer `freespace` calls a thing between it and `obstacle_m_min`
    /// low. At most `obstacle_m_min`. 0.15 is ours, a car.
    pub clearance_m: f32,
    /// Greatest height of an obstacle over the local ground, metres; the vehicle passes under higher ones. 2.5: UT
    /// Austin thesis, section IV.2.
    pub overhang_m: f32,
    /// Range up to which ground that the sensors do not show is taken as free, metres: in the directions in which
    /// ground was seen within this range, and nothing stands nearer. For a sensor that looks ahead only, whose first
    /// ring lies far away. 0, never, is ours: unknown is never free.
    pub assumed_ground_m: f32,
    /// Highest step of the ground that the vehicle drives over, metres. 0.3 is ours: a step between two cells, each
    /// with the noise of its returns, looks a little higher than it is.
    pub step_m_max: f32,
}

impl Default for ReachConfig {
    fn default() -> Self {
        Self {
            vehicle_width_m: 2.0,
            vehicle_front_m: 3.0,
            vehicle_rear_m: 2.0,
            obstacle_m_min: 0.25,
            clearance_m: 0.15,
            overhang_m: 2.5,
            assumed_ground_m: 0.0,
            step_m_max: 0.3,
        }
    }
}

impl ReachConfig {
    /// Checks the values of the table `at`.
    ///
    /// # Errors
    /// [`ConfigValueError`] for the first value that is not allowed.
    pub(crate) fn validate(&self, at: &str) -> Result<(), ConfigValueError> {
        let values = [
            ("vehicle_width_m", self.vehicle_width_m, (0.1..=10.0, "0.1 to 10")),
            ("vehicle_front_m", self.vehicle_front_m, (0.0..=20.0, "0 to 20")),
            ("vehicle_rear_m", self.vehicle_rear_m, (0.0..=20.0, "0 to 20")),
            ("obstacle_m_min", self.obstacle_m_min, (0.05..=2.0, "0.05 to 2")),
            ("clearance_m", self.clearance_m, (0.05..=2.0, "0.05 to 2")),
            ("overhang_m", self.overhang_m, (0.5..=20.0, "0.5 to 20")),
            ("assumed_ground_m", self.assumed_ground_m, (0.0..=30.0, "0 to 30")),
            ("step_m_max", self.step_m_max, (0.05..=2.0, "0.05 to 2")),
        ];
        check_each(at, values)?;
        let lower = self.clearance_m <= self.obstacle_m_min;
        check_fits(at, "clearance_m", self.clearance_m, lower, "at most obstacle_m_min")?;
        let higher = self.overhang_m > self.obstacle_m_min;
        check_fits(at, "overhang_m", self.overhang_m, higher, "more than obstacle_m_min")
    }

    /// The vehicle's outline.
    pub fn outline(&self) -> Outline {
        Outline { width_m: self.vehicle_width_m, front_m: self.vehicle_front_m, rear_m: self.vehicle_rear_m }
    }
}
