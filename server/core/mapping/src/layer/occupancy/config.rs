//! The table `[vehicle.maps.occupancy]`.

use serde::{Deserialize, Serialize};

use crate::config::check::{ConfigValueError, check_each, check_fits};

/// Parameters of [`crate::layer::occupancy`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct OccupancyConfig {
    /// Whether the map is made.
    pub enabled: bool,
    /// The grid reaches this far to each side of the vehicle.
    pub extent_m: f32,
    /// Side of a cell.
    pub cell_m: f32,
    /// Returns lower than this over the ground are the ground's: the vehicle passes over them.
    pub clearance_m: f32,
    /// Returns from here on up are not counted: the vehicle passes under them.
    pub overhang_m: f32,
    /// A ray proves a cell clear where it is at least as high as this over it: it could be under a car's body, if
    /// lower.
    pub clear_height_m_min: f32,
    /// And no higher than this: what is lower than the ray stays unnoticed.
    pub clear_height_m_max: f32,
    /// Reliable range of the sensors (§2: 150 m); farther cells are out of range.
    pub range_m_max: f32,
    /// Rays that came back with nothing clear as far as this; 0: they prove nothing.
    pub no_return_m: f32,
    /// Up to this speed it takes `hits_slow` returns to make a cell occupied (figure 5).
    pub speed_mps_slow: f32,
    /// From this speed on it takes `hits_fast`; between the two, in proportion.
    pub speed_mps_fast: f32,
    /// Returns at low speed.
    pub hits_slow: u8,
    /// Returns at high speed, and where the speed is not known.
    pub hits_fast: u8,
    /// Maps for which a cell stays occupied that nobody sees.
    pub hold_maps: u8,
}

impl Default for OccupancyConfig {
    /// The paper's 10 and 60 mph with 20 and 2 returns. Three maps after a thing has gone nothing is left of it.
    fn default() -> Self {
        Self {
            enabled: true,
            extent_m: 50.0,
            cell_m: 0.25,
            clearance_m: 0.3,
            overhang_m: 5.0,
            clear_height_m_min: 0.2,
            clear_height_m_max: 0.5,
            range_m_max: 150.0,
            no_return_m: 0.0,
            speed_mps_slow: 4.4,
            speed_mps_fast: 26.8,
            hits_slow: 20,
            hits_fast: 2,
            hold_maps: 2,
        }
    }
}

impl OccupancyConfig {
    pub(crate) fn validate(&self, at: &str) -> Result<(), ConfigValueError> {
        let values = [
            ("extent_m", self.extent_m, (5.0..=100.0, "5 to 100")),
            ("cell_m", self.cell_m, (0.1..=2.0, "0.1 to 2")),
            ("clearance_m", self.clearance_m, (0.05..=2.0, "0.05 to 2")),
            ("overhang_m", self.overhang_m, (0.5..=20.0, "0.5 to 20")),
            ("clear_height_m_min", self.clear_height_m_min, (-1.0..=2.0, "-1 to 2")),
            ("clear_height_m_max", self.clear_height_m_max, (0.05..=5.0, "0.05 to 5")),
            ("range_m_max", self.range_m_max, (5.0..=300.0, "5 to 300")),
            ("no_return_m", self.no_return_m, (0.0..=300.0, "0 to 300")),
            ("speed_mps_slow", self.speed_mps_slow, (0.0..=100.0, "0 to 100")),
            ("speed_mps_fast", self.speed_mps_fast, (0.1..=100.0, "0.1 to 100")),
            // A cell no return can make occupied would be a cell no return can keep from being clear.
            ("hits_slow", self.hits_slow.into(), (1.0..=255.0, "1 to 255")),
            ("hits_fast", self.hits_fast.into(), (1.0..=255.0, "1 to 255")),
            ("hold_maps", self.hold_maps.into(), (0.0..=100.0, "0 to 100")),
        ];
        check_each(at, values)?;
        check_fits(at, "overhang_m", self.overhang_m, self.overhang_m > self.clearance_m, "more than clearance_m")?;
        let band = self.clear_height_m_max > self.clear_height_m_min;
        check_fits(at, "clear_height_m_max", self.clear_height_m_max, band, "more than clear_height_m_min")?;
        let lower = self.clear_height_m_min < self.clearance_m;
        check_fits(at, "clear_height_m_min", self.clear_height_m_min, lower, "less than clearance_m")?;
        let faster = self.speed_mps_fast > self.speed_mps_slow;
        check_fits(at, "speed_mps_fast", self.speed_mps_fast, faster, "more than speed_mps_slow")?;
        crate::config::check::check_cells(at, self.extent_m, self.cell_m)
    }
}
