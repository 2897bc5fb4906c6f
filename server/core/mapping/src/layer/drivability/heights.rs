//! Highest point and unit height of each cell (UT Austin thesis, sections IV.1 and IV.2).
//!
//! In: a sweep, ego frame, metres. Out: for each cell the highest point under the overhang cut-off, and
//! `unit_height = floor((z + offset) / unit)`.

use crate::layer::radial_grid::RadialGrid;
use crate::sensor::sweep::Sweep;

use super::class::UNIT_HEIGHT_UNKNOWN;
use super::config::DrivabilityConfig;

/// Highest point of a cell so far: its height and its index in the sweep.
#[derive(Clone, Copy, Debug)]
struct Highest {
    z: f32,
    point: u32,
}

const EMPTY: Highest = Highest { z: f32::NEG_INFINITY, point: u32::MAX };

/// Highest point and unit height of each cell, in the order of the grid.
#[derive(Clone, Debug, Default)]
pub struct Heights {
    highest: Vec<Highest>,
    points: Vec<[f32; 3]>,
    units: Vec<i8>,
}

impl Heights {
    /// Finds the highest point of each cell; points too far or too high are dropped (UT Austin thesis, procedure
    /// "Setting up the radial grid").
    pub fn compute(&mut self, grid: &RadialGrid, sweep: &Sweep, config: &DrivabilityConfig) {
        self.highest.clear();
        // One more row holds the points beyond the grid.
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

    /// Unit height of each cell; [`UNIT_HEIGHT_UNKNOWN`] if the cell is empty.
    pub fn units(&self) -> &[i8] {
        &self.units
    }

    /// Highest point (x, y, z) of each cell, ego frame, metres; unspecified if the cell is empty.
    pub fn points(&self) -> &[[f32; 3]] {
        &self.points
    }
}

/// Keeps the higher point (UT Austin thesis, function `adjustHeight`), of equally high points the one with the larger
/// x, then y, so that the order of the points does not matter.
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

/// Height in whole units, clamped to the range of the channel.
pub fn unit_height(z: f32, config: &DrivabilityConfig) -> i8 {
    let units = ((z + config.offset_m) / config.unit_height_m).floor();
    units.clamp(f32::from(UNIT_HEIGHT_UNKNOWN + 1), f32::from(i8::MAX)) as i8
}
