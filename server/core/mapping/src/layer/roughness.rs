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

/// Sums of one cell.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct Sums {
    points: i64,
    deviations: i64,
    /// Squares of the deviations.
    squares: i64,
    /// Squares of the noise.
    noise: i64,
}

/// Sums of the deviations by cell.
#[derive(Clone, Debug, Default)]
pub struct Roughness {
    sums: Vec<Sums>,
}

impl Roughness {
    /// Removes all points, and sets the number of cells.
    pub fn clear(&mut self, cells: usize) {
        self.sums.clear();
        self.sums.resize(cells, Sums::default());
    }

    /// Adds one more cell without points.
    pub fn push_cell(&mut self) {
        self.sums.push(Sums::default());
    }

    /// Adds points to their cells. A point of no cell ([`NOWHERE`]) and a deviation that is not known are left out.
    pub fn add_points(&mut self, cells: &[u32], deviations: &[Deviation]) {
        for (&cell, &deviation) in cells.iter().zip(deviations) {
            if let Some([deviation, noise]) = deviation.steps()
                && let Some(sums) = self.sums.get_mut(cell as usize)
            {
                sums.points += 1;
                sums.deviations += deviation;
                sums.squares += deviation * deviation;
                sums.noise += noise * noise;
            }
        }
    }

    /// Roughness of a cell; `None` with fewer points than `points_min`.
    pub fn of_cell(&self, cell: usize, points_min: u16) -> Option<f32> {
        let Sums { points, deviations, squares, noise } = self.sums[cell];
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
        let mut roughness = Roughness::default();
        roughness.clear(3);
        for number in 0..1000 {
            let sign = if number % 2 == 0 { 1.0 } else { -1.0 };
            let points = [[0.001 * sign, 0.001], [0.005 * sign, 0.003], [0.1, 0.0]];
            roughness.add_points(&[0, 1, NOWHERE], &points.map(|[deviation, noise]| Deviation::new(deviation, noise)));
        }
        roughness.add_points(&[2, 2], &[Deviation::new(f32::NAN, f32::NAN), Deviation::new(3.0, 0.001)]);
        assert_eq!(roughness.of_cell(0, 4), Some(0.0));
        assert!((roughness.of_cell(1, 4).unwrap() - 0.004).abs() < 1e-6);
        assert_eq!(roughness.of_cell(1, 1001), None);
        assert_eq!(roughness.of_cell(2, 0), None);
    }
}
