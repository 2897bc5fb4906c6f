//! Setting up the grid (thesis §IV.1 and §IV.2): each cell's highest point and unit height.
//!
//! In: a sweep, ego frame, metres. Out: for each cell the highest point under the overhang cut-off and
//! `unit_height = floor((z + offset) / unit)`.

use crate::config::DrivabilityConfig;
use crate::layer::radial_grid::RadialGrid;
use crate::sensor::sweep::Sweep;

use super::class::UNIT_HEIGHT_UNKNOWN;

/// A cell as the points fall into it: height and index of its highest point.
#[derive(Clone, Copy, Debug)]
struct Highest {
    z: f32,
    point: u32,
}

const EMPTY: Highest = Highest { z: f32::NEG_INFINITY, point: u32::MAX };

/// Highest point and unit height of every cell.
#[derive(Clone, Debug, Default)]
pub struct Heights {
    highest: Vec<Highest>,
    points: Vec<[f32; 3]>,
    units: Vec<i8>,
}

impl Heights {
    /// Thesis, "Setting up the radial grid": every point into its cell, those too far or too high dropped.
    pub fn set_up(&mut self, grid: &RadialGrid, sweep: &Sweep, config: &DrivabilityConfig) {
        self.highest.clear();
        // One more row takes the points beyond the grid.
        self.highest.resize(grid.cells() + grid.columns(), EMPTY);
        let highest = &mut self.highest;
        grid.for_each_chunk(sweep, |first, cells| {
            for (i, (cell, &z)) in cells.iter().zip(&sweep.z[first..]).enumerate() {
                if z <= config.overhang_m {
                    adjust_height(&mut highest[*cell as usize], z, first + i, sweep);
                }
            }
        });

        self.points.clear();
        self.units.clear();
        for highest in &self.highest[..grid.cells()] {
            if highest.point == EMPTY.point {
                self.points.push([0.0; 3]);
                self.units.push(UNIT_HEIGHT_UNKNOWN);
            } else {
                let point = highest.point as usize;
                self.points.push([sweep.x[point], sweep.y[point], sweep.z[point]]);
                self.units.push(unit_height(highest.z, config));
            }
        }
    }

    /// Unit height of each cell; [`UNIT_HEIGHT_UNKNOWN`] where it is empty.
    pub fn units(&self) -> &[i8] {
        &self.units
    }

    /// Highest point of each cell, ego frame, metres; unspecified where it is empty.
    pub fn points(&self) -> &[[f32; 3]] {
        &self.points
    }
}

/// Thesis, function `adjustHeight`; a tie goes to the larger x, then y, whatever the order of the points.
#[inline(always)]
fn adjust_height(cell: &mut Highest, z: f32, point: usize, sweep: &Sweep) {
    if z > cell.z {
        *cell = Highest { z, point: point as u32 };
    } else if z == cell.z {
        let held = cell.point as usize;
        if (sweep.x[point], sweep.y[point]) > (sweep.x[held], sweep.y[held]) {
            cell.point = point as u32;
        }
    }
}

/// Height in whole units; what lies deeper or higher than the channel can say is clamped to its ends.
pub fn unit_height(z: f32, config: &DrivabilityConfig) -> i8 {
    let units = ((z + config.offset_m) / config.unit_height_m).floor();
    units.clamp(f32::from(UNIT_HEIGHT_UNKNOWN + 1), f32::from(i8::MAX)) as i8
}
