//! Roughness of the ground (Neuhaus 2009, sections 2.4 and 2.5, eq. 3 and 4), by cell of any grid.
//!
//! In: deviation and noise of points ([`crate::sensor::sweep::Sweep::deviation`]) with their cells. Out: by cell the
//! square root of the paper's r: standard deviation of the ranges over the distance, without the sensor's own noise,
//! metres per metre. The root has the same resolution for smooth and for rough ground; a planner that sums r squares
//! it.
//!
//! The paper divides the variance of a cell by the squared distance of the cell from the laser. Here the deviation of
//! each point is divided by the point's own range, so that a cell may hold points of several sensors.

/// Number of steps of 1: deviations are summed in whole millionths, so that the sums are exact in any order.
const STEPS: f32 = 1e6;
/// Largest deviation of a point on the ground. Ours: a deviation of half the range is an edge; it bounds the sums.
const DEVIATION_MAX: f32 = 0.5;

/// Cell of a point that lies in no cell.
pub const NOWHERE: u32 = u32::MAX;
/// A deviation that is not known, in steps.
const UNKNOWN: i32 = i32::MIN;
/// Number of points that are processed together. Ours: their intermediate values fit into the first-level cache.
const CHUNK: usize = 1024;

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

    /// Adds points to their cells. A point of no cell ([`NOWHERE`]) and a deviation that is not known are left out.
    pub fn add_points(&mut self, cells: &[u32], deviation: &[f32], noise: &[f32]) {
        let (mut deviations, mut noises) = ([0_i32; CHUNK], [0_i32; CHUNK]);
        for ((cells, deviation), noise) in cells.chunks(CHUNK).zip(deviation.chunks(CHUNK)).zip(noise.chunks(CHUNK)) {
            // Without a branch, so that the compiler vectorises it. The casts saturate.
            for ((steps, squared), (&deviation, &noise)) in
                deviations.iter_mut().zip(&mut noises).zip(deviation.iter().zip(noise))
            {
                // NaN fails the comparison.
                let is_known = deviation.abs() <= DEVIATION_MAX;
                *steps = if is_known { (deviation * STEPS) as i32 } else { UNKNOWN };
                *squared = (noise * STEPS) as i32;
            }
            for ((&cell, &deviation), &noise) in cells.iter().zip(&deviations).zip(&noises) {
                if deviation != UNKNOWN
                    && let Some(sums) = self.sums.get_mut(cell as usize)
                {
                    let [deviation, noise] = [deviation, noise].map(i64::from);
                    sums.points += 1;
                    sums.deviations += deviation;
                    sums.squares += deviation * deviation;
                    sums.noise += noise * noise;
                }
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
            roughness.add_points(&[0, 1, NOWHERE], &[0.001 * sign, 0.005 * sign, 0.1], &[0.001, 0.003, 0.0]);
        }
        roughness.add_points(&[2, 2], &[f32::NAN, 3.0], &[f32::NAN, 0.001]);
        assert_eq!(roughness.of_cell(0, 4), Some(0.0));
        assert!((roughness.of_cell(1, 4).unwrap() - 0.004).abs() < 1e-6);
        assert_eq!(roughness.of_cell(1, 1001), None);
        assert_eq!(roughness.of_cell(2, 0), None);
    }
}
