//! How much the roughness of the ground (Neuhaus 2009, section 2.4) lowers the speed of each cell.
//!
//! In: the sums of a cell's deviations. Out: a factor. Ground whose heights are even can still be gravel or a field,
//! which the distances show (section 2.4 of that paper) and the heights do not.

use crate::layer::roughness::RoughnessSums;

use super::config::{ROUGHNESS_ROUGH, ROUGHNESS_SMOOTH, SpeedConfig};

/// Least number of points with a deviation in a cell with a roughness. Ours: the number of the layer `terrain`.
const POINTS_MIN: u16 = 4;

/// Factor of the speed above `crawl_mps` of a cell: 1 on smooth ground and without a known roughness, `rough_share` on
/// rough ground, linear between.
pub fn factor(cell: &RoughnessSums, config: &SpeedConfig) -> f32 {
    let share =
        |roughness: f32| ((roughness - ROUGHNESS_SMOOTH) / (ROUGHNESS_ROUGH - ROUGHNESS_SMOOTH)).clamp(0.0, 1.0);
    1.0 - (1.0 - config.rough_share) * cell.roughness(POINTS_MIN).map_or(0.0, share)
}
