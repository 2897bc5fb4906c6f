//! Highest point and unit height of each cell (UT Austin thesis, sections IV.1 and IV.2).
//!
//! In: a sweep, ego frame, and the heights of its points over the ground, metres. Out: for each cell the highest point
//! under the overhang cut-off, and `unit_height = floor((height + offset) / unit)`.

use crate::layer::maker::Context;
use crate::layer::radial_grid::RadialGrid;
use crate::layer::radial_points::RadialPoints;
use crate::sensor::sweep::Sweep;

use super::class::UNIT_HEIGHT_UNKNOWN;
use super::config::{BLIND_ZONE_M, DrivabilityConfig, UNIT_HEIGHT_M};

/// Highest point of a cell so far: its height over the ground and its index in the sweep.
#[derive(Clone, Copy, Debug)]
struct Highest {
    height: f32,
    point: u32,
}

const EMPTY: Highest = Highest { height: f32::NEG_INFINITY, point: u32::MAX };

/// Highest point and unit height of each cell, in the order of the grid.
#[derive(Clone, Debug, Default)]
pub struct Heights {
    highest: Vec<Highest>,
    points: Vec<[f32; 3]>,
    z_m: Vec<f32>,
    units: Vec<i8>,
}

impl Heights {
    /// Finds the highest point of each cell; points too far or too high are dropped (UT Austin thesis, procedure
    /// "Setting up the radial grid").
    pub fn compute(&mut self, points: &RadialPoints, sweep: &Sweep, context: &Context<'_>, config: &DrivabilityConfig) {
        let (grid, heights_m) = (points.grid(), context.heights_m(sweep));
        self.highest.clear();
        // One more row holds the points beyond the grid.
        self.highest.resize(grid.cells() + grid.columns(), EMPTY);
        for (point, (cell, &height)) in points.cells().iter().zip(heights_m).enumerate() {
            if height <= config.overhang_m {
                adjust_height(&mut self.highest[*cell as usize], height, point, sweep);
            }
        }

        self.points.clear();
        self.z_m.clear();
        self.units.clear();
        for highest in &self.highest[..grid.cells()] {
            if highest.point == EMPTY.point {
                self.points.push([0.0; 3]);
                self.z_m.push(0.0);
                self.units.push(UNIT_HEIGHT_UNKNOWN);
            } else {
                let point = highest.point as usize;
                self.points.push([sweep.x[point], sweep.y[point], highest.height]);
                self.z_m.push(sweep.z[point]);
                self.units.push(unit_height(highest.height, config));
            }
        }
    }

    /// Makes the empty cells before the first return of each column level ground, as under the vehicle: the thesis
    /// takes the vehicle's own cell as the start, and no return falls near it.
    pub fn fill_blind_zone(&mut self, grid: &RadialGrid, config: &DrivabilityConfig) {
        let [x, y] = grid.centre_m();
        for column in 0..grid.columns() {
            let [cos, sin] = RadialGrid::direction(column, grid.columns());
            let rows = (0..grid.rows()).take_while(|row| grid.row_span_m(*row).0 < BLIND_ZONE_M);
            let empty =
                rows.map(|row| (row, row * grid.columns() + column)).take_while(|(_, cell)| !self.is_seen(*cell));
            for (row, cell) in empty.collect::<Vec<_>>() {
                let radius_m = grid.row_span_m(row).1;
                self.units[cell] = unit_height(0.0, config);
                self.points[cell] = [x + radius_m * cos, y + radius_m * sin, 0.0];
            }
        }
    }

    /// True if a return fell into the cell.
    pub fn is_seen(&self, cell: usize) -> bool {
        self.highest[cell].point != EMPTY.point
    }

    /// Unit height of each cell; [`UNIT_HEIGHT_UNKNOWN`] if the cell is empty.
    pub fn units(&self) -> &[i8] {
        &self.units
    }

    /// Highest point of each cell: x, y, and height over the ground, metres; unspecified if the cell is empty.
    pub fn points(&self) -> &[[f32; 3]] {
        &self.points
    }

    /// z of the highest point of each cell, ego frame, metres; unspecified if the cell is empty.
    pub fn z_m(&self) -> &[f32] {
        &self.z_m
    }
}

/// Keeps the higher point (UT Austin thesis, function `adjustHeight`), of equally high points the one with the larger
/// x, then y, so that the order of the points does not matter.
#[inline(always)]
fn adjust_height(cell: &mut Highest, height: f32, point: usize, sweep: &Sweep) {
    if height > cell.height {
        *cell = Highest { height, point: point as u32 };
    } else if height == cell.height {
        let held = cell.point as usize;
        if (sweep.x[point], sweep.y[point]) > (sweep.x[held], sweep.y[held]) {
            cell.point = point as u32;
        }
    }
}

/// Height in whole units, clamped to the range of the channel.
pub fn unit_height(height_m: f32, config: &DrivabilityConfig) -> i8 {
    let units = ((height_m + config.offset_m) / UNIT_HEIGHT_M).floor();
    units.clamp(f32::from(UNIT_HEIGHT_UNKNOWN + 1), f32::from(i8::MAX)) as i8
}
