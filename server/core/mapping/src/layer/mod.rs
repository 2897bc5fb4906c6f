//! The six maps side by side, and the registry that makes them.

pub mod drivability;
pub mod height_difference;
pub mod occupancy;
pub mod radial_grid;
pub(crate) mod registry;
pub mod safe_path;
pub mod speed;
pub mod terrain;
