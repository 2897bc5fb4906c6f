//! How much the roughness of the ground (Neuhaus 2009, section 2.4) lowers the speed of each cell.
//!
//! In: the deviations of the sweep's points. Out: a factor for each cell. Ground whose heights are even can still be
//! gravel or a field, which the distances show (section 2.4 of that paper) and the heights do not.

use crate::layer::radial_grid::floor_to_whole;
use crate::layer::roughness::{NOWHERE, Roughness};
use crate::sensor::sweep::Sweep;

use super::config::SpeedConfig;

/// Least number of points with a deviation in a cell with a roughness. Ours: that of the layer `terrain`.
const POINTS_MIN: u16 = 4;

/// The roughness of a grid of `side` cells along x and y with the vehicle in the middle.
#[derive(Clone, Debug, Default)]
pub struct RoughGround {
    roughness: Roughness,
    /// By point of the sweep.
    cell_of_point: Vec<u32>,
    /// True if the newest sweep has deviations.
    is_known: bool,
}

impl RoughGround {
    /// Replaces the points by those of a sweep; `heights_m` are their heights over the ground.
    pub fn update(&mut self, sweep: &Sweep, heights_m: &[f32], side: usize, config: &SpeedConfig) {
        self.is_known = !sweep.deviation.is_empty();
        if !self.is_known {
            return;
        }
        self.roughness.clear(side * side);
        let (middle, cells_a_m, end) = ((side / 2) as f32, 1.0 / config.cell_m, side as f32);
        let points = sweep.x.iter().zip(&sweep.y).zip(heights_m);
        self.cell_of_point.resize(sweep.x.len(), NOWHERE);
        // Without a branch, so that the compiler vectorises it.
        for (cell, ((&x, &y), &height)) in self.cell_of_point.iter_mut().zip(points) {
            let (ix, iy) = (x * cells_a_m + middle, y * cells_a_m + middle);
            // NaN fails every comparison.
            let inside = (ix >= 0.0) & (ix < end) & (iy >= 0.0) & (iy < end) & (height <= config.overhang_m);
            let [ix, iy] = [ix, iy].map(|index| floor_to_whole(if inside { index } else { 0.0 }));
            *cell = if inside { iy * side as u32 + ix } else { NOWHERE };
        }
        self.roughness.add_points(&self.cell_of_point, &sweep.deviation, &sweep.noise);
    }

    /// Roughness of a cell, metres per metre; `None` if it is not known.
    pub fn roughness(&self, cell: usize) -> Option<f32> {
        if self.is_known { self.roughness.of_cell(cell, POINTS_MIN) } else { None }
    }

    /// Factor of the speed above `crawl_mps` of a cell: 1 on smooth ground and without a known roughness, `rough_share`
    /// on rough ground, linear between.
    pub fn factor(&self, cell: usize, config: &SpeedConfig) -> f32 {
        let SpeedConfig { roughness_smooth, roughness_rough, rough_share, .. } = *config;
        let share =
            |roughness: f32| ((roughness - roughness_smooth) / (roughness_rough - roughness_smooth)).clamp(0.0, 1.0);
        1.0 - (1.0 - rough_share) * self.roughness(cell).map_or(0.0, share)
    }
}
