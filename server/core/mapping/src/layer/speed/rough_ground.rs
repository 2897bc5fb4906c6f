//! How much the roughness of the ground (Neuhaus 2009, section 2.4) lowers the speed of each cell.
//!
//! In: the deviations of the sweep's points, with their cells. Out: a factor for each cell. Ground whose heights are
//! even can still be gravel or a field, which the distances show (section 2.4 of that paper) and the heights do not.

use crate::layer::roughness::Roughness;
use crate::sensor::deviation::Deviation;
use crate::sensor::sweep::Sweep;

use super::config::{ROUGHNESS_ROUGH, ROUGHNESS_SMOOTH, SpeedConfig};

/// Least number of points with a deviation in a cell with a roughness. Ours: that of the layer `terrain`.
const POINTS_MIN: u16 = 4;

/// The roughness of the cells of the layer.
#[derive(Clone, Debug, Default)]
pub struct RoughGround {
    roughness: Roughness,
    /// True if the newest sweep has deviations.
    is_known: bool,
}

impl RoughGround {
    /// Removes all points, and sets the number of cells. Without deviations in `sweep` no cell has a roughness.
    pub fn clear(&mut self, sweep: &Sweep, cells: usize) {
        self.is_known = !sweep.deviation.is_empty();
        if self.is_known {
            self.roughness.clear(cells);
        }
    }

    /// Adds points to their cells.
    pub fn add_points(&mut self, cells: &[u32], deviations: &[Deviation]) {
        self.roughness.add_points(cells, deviations);
    }

    /// Roughness of a cell, metres per metre; `None` if it is not known.
    pub fn roughness(&self, cell: usize) -> Option<f32> {
        if self.is_known { self.roughness.of_cell(cell, POINTS_MIN) } else { None }
    }

    /// Factor of the speed above `crawl_mps` of a cell: 1 on smooth ground and without a known roughness, `rough_share`
    /// on rough ground, linear between.
    pub fn factor(&self, cell: usize, config: &SpeedConfig) -> f32 {
        let share =
            |roughness: f32| ((roughness - ROUGHNESS_SMOOTH) / (ROUGHNESS_ROUGH - ROUGHNESS_SMOOTH)).clamp(0.0, 1.0);
        1.0 - (1.0 - config.rough_share) * self.roughness(cell).map_or(0.0, share)
    }
}
