//! Roughness of flat ground (Neuhaus 2009, sections 2.4 and 2.5, eq. 3 and 4).
//!
//! In: the range deviations of the points ([`crate::sensor::distance_series`]) and their cells. Out: by slot the square
//! root of the paper's r: standard deviation of the ranges over the distance, without the sensor's own noise. The root
//! has the same resolution for smooth and for rough ground; a planner that sums r squares it.

use crate::sensor::sweep::Sweep;

use super::class::ROUGHNESS;
use super::config::TerrainConfig;
use super::moments::Cells;

/// Deviations are summed in whole tenths of a millimetre, so that the sums are exact in any order.
const STEPS_A_METRE: f32 = 1e4;
/// Largest deviation on the ground, metres. Ours: a larger one is an edge; it bounds the sums.
const DEVIATION_M_MAX: f32 = 10.0;

/// Roughness of each slot.
#[derive(Clone, Debug, Default)]
pub struct Roughness {
    /// By slot: number of points with a deviation, sum of the deviations, sum of their squares.
    sums: Vec<(i64, i64, i64)>,
}

impl Roughness {
    /// Sums the deviations of each slot's points.
    pub fn sum(&mut self, sweep: &Sweep, cells: &Cells) {
        self.sums.clear();
        self.sums.resize(cells.slots(), (0, 0, 0));
        for (slot, deviation) in cells.slot_of_points().zip(&sweep.deviation_m) {
            let (Some(slot), true) = (slot, deviation.abs() <= DEVIATION_M_MAX) else { continue };
            let steps = (deviation * STEPS_A_METRE) as i64;
            let (n, sum, squares) = &mut self.sums[slot];
            (*n, *sum, *squares) = (*n + 1, *sum + steps, *squares + steps * steps);
        }
    }

    /// Raw roughness of a slot whose centre is `distance_m` from the sensor; [`ROUGHNESS`]`.unknown` with too few
    /// points.
    pub fn raw(&self, slot: usize, distance_m: f32, config: &TerrainConfig) -> u8 {
        let (n, sum, squares) = self.sums[slot];
        if n < i64::from(config.roughness_points_min) {
            return ROUGHNESS.unknown;
        }
        // With whole numbers n Σδ² - (Σδ)² is never negative.
        let steps2 = (n * squares - sum * sum) as f64 / (n * n) as f64;
        let variance = steps2 / f64::from(STEPS_A_METRE).powi(2);
        let own = f64::from(config.noise_m).powi(2);
        let root = (variance - own).max(0.0).sqrt() / f64::from(distance_m);
        ((root / f64::from(ROUGHNESS.scale)).round() as u32).min(u32::from(ROUGHNESS.unknown) - 1) as u8
    }
}
