//! Highest point and unit height of each cell (UT Austin thesis, sections IV.1 and IV.2).
//!
//! In: a sweep, ego frame, and the heights of its points over the ground, metres. Out: for each cell the highest point
//! under the overhang cut-off, and `unit_height = floor((height + offset) / unit)`.

use crate::layer::maker::Context;
use crate::layer::radial_grid::RadialGrid;
use crate::layer::radial_points::RadialPoints;
use crate::sensor::sweep::Sweep;
use crate::vehicle_outline::Outline;

use super::class::UNIT_HEIGHT_UNKNOWN;
use super::config::{BLIND_ZONE_M, DrivabilityConfig, DrivabilityVariant, UNIT_HEIGHT_M};

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
        // The thesis has no memory.
        let is_paper = config.variant == DrivabilityVariant::Paper;
        let used = sweep.x.len() - if is_paper { sweep.remembered } else { 0 };
        for (point, (cell, &height)) in points.cells().iter().zip(heights_m).take(used).enumerate() {
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

    /// Makes the vehicle's own cells, and the empty cells before the first return of each column, level ground: the
    /// thesis takes the vehicle's own cell as the start, and no return from the ground falls near it.
    pub fn fill_blind_zone(&mut self, grid: &RadialGrid, outline: &Outline, config: &DrivabilityConfig) {
        let [x, y] = grid.centre_m();
        for column in 0..grid.columns() {
            let [cos, sin] = RadialGrid::direction(column, grid.columns());
            let at = |range_m: f32| [x + range_m * cos, y + range_m * sin];
            for row in 0..grid.blind_rows(BLIND_ZONE_M) {
                let cell = row * grid.columns() + column;
                let (inner_m, outer_m) = grid.row_span_m(row);
                let [middle_x, middle_y] = at((inner_m + outer_m) / 2.0);
                let is_own = row == 0 || outline.contains(middle_x, middle_y);
                if self.is_seen(cell) && !is_own {
                    break;
                }
                let [far_x, far_y] = at(outer_m);
                self.units[cell] = unit_height(0.0, config);
                self.points[cell] = [far_x, far_y, 0.0];
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

/// Keeps the higher point (UT Austin thesis, function `adjustHeight`), of equally high points the point with the larger
/// x, then y, so that the order of the points does not matter.
#[inline(always)]
fn adjust_height(cell: &mut Highest, height: f32, point: usize, sweep: &Sweep) {
    let held = *cell;
    // Which point is higher cannot be predicted; two are hardly ever equally high.
    let new = Highest { height, point: point as u32 };
    *cell = if height > held.height { new } else { held };
    if height == held.height {
        let [one, other] = [point, held.point as usize].map(|point| (sweep.x[point], sweep.y[point]));
        cell.point = if one > other { new.point } else { held.point };
    }
}

/// Height in whole units, clamped to the range of the channel.
pub fn unit_height(height_m: f32, config: &DrivabilityConfig) -> i8 {
    let units = ((height_m + config.offset_m) / UNIT_HEIGHT_M).floor();
    units.clamp(f32::from(UNIT_HEIGHT_UNKNOWN + 1), f32::from(i8::MAX)) as i8
}
