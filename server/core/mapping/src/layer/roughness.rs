//! Roughness of the ground (Neuhaus 2009, sections 2.4 and 2.5, eq. 3 and 4), by cell of any grid.
//!
//! In: deviations of points ([`crate::sensor::sweep::Sweep::deviation`]) with their cells. Out: by cell the
//! square root of the paper's r: standard deviation of the ranges over the distance, without the sensor's own noise,
//! metres per metre. The root has the same resolution for smooth and for rough ground; a planner that sums r squares
//! it.
//!
//! The paper divides the variance of a cell by the squared distance of the cell from the laser. Here the deviation of
//! each point is divided by the point's own range, so that a cell may hold points of several sensors.

use crate::sensor::deviation::{Deviation, STEPS};

/// Cell of a point that lies in no cell.
pub const NOWHERE: u32 = u32::MAX;

/// Sums of the deviations of one cell.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RoughnessSums {
    points: i64,
    deviations: i64,
    /// Squares of the deviations.
    squares: i64,
    /// Squares of the noise.
    noise: i64,
}

impl RoughnessSums {
    /// No points.
    pub const EMPTY: Self = Self { points: 0, deviations: 0, squares: 0, noise: 0 };

    /// Adds a point, unless its deviation is not known.
    #[inline(always)]
    pub fn add(&mut self, deviation: Deviation) {
        if let Some([deviation, noise]) = deviation.steps() {
            self.points += 1;
            self.deviations += deviation;
            self.squares += deviation * deviation;
            self.noise += noise * noise;
        }
    }

    /// Roughness of the cell; `None` with fewer points than `points_min`.
    pub fn roughness(&self, points_min: u16) -> Option<f32> {
        let Self { points, deviations, squares, noise } = *self;
        if points == 0 || points < i64::from(points_min) {
            return None;
        }
        let n = i128::from(points);
        // With whole numbers n Σδ² - (Σδ)² is never negative (eq. 3).
        let variance = (n * i128::from(squares) - i128::from(deviations).pow(2)) as f64 / (n * n) as f64;
        let own = noise as f64 / points as f64;
        Some(((variance - own).max(0.0).sqrt() / f64::from(STEPS)) as f32)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_noise_of_the_sensor_is_no_roughness() {
        let mut cells = [RoughnessSums::EMPTY; 3];
        for number in 0..1000 {
            let sign = if number % 2 == 0 { 1.0 } else { -1.0 };
            cells[0].add(Deviation::new(0.001 * sign, 0.001));
            cells[1].add(Deviation::new(0.005 * sign, 0.003));
        }
        cells[2].add(Deviation::new(f32::NAN, f32::NAN));
        cells[2].add(Deviation::new(3.0, 0.001));
        assert_eq!(cells[0].roughness(4), Some(0.0));
        assert!((cells[1].roughness(4).unwrap() - 0.004).abs() < 1e-6);
        assert_eq!(cells[1].roughness(1001), None);
        assert_eq!(cells[2].roughness(0), None);
    }
}
