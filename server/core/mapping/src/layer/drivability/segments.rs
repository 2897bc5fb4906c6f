//! Segmenting (thesis §IV.3): sets of adjacent cells of one unit height, grown from the vehicle.
//!
//! In: unit heights. Out: the segment of every cell, counted from 0 (under the vehicle) in the order they were found;
//! the last is reserved for cells with points that were never reached. Written with a list instead of the thesis'
//! recursion.

use std::collections::VecDeque;

use crate::config::{DrivabilityConfig, Seed};
use crate::layer::radial_grid::RadialGrid;

use super::class::{SEGMENT, UNIT_HEIGHT_UNKNOWN};
use super::heights::{Heights, unit_height};

/// Cells with points that no segment has taken yet.
const UNREACHED: u16 = u16::MAX - 1;

/// The segment of every cell.
#[derive(Clone, Debug, Default)]
pub struct Segments {
    of_cell: Vec<u16>,
    unreachable: u16,
    seeds: Vec<u32>,
    neighbor_list: VecDeque<u32>,
    growing: Vec<u32>,
}

impl Segments {
    /// Grows segments from the seeds until the neighbour list is empty.
    pub fn grow(&mut self, grid: &RadialGrid, heights: &Heights, config: &DrivabilityConfig) {
        let units = heights.units();
        self.of_cell.clear();
        self.of_cell.extend(units.iter().map(|u| if *u == UNIT_HEIGHT_UNKNOWN { SEGMENT.unknown } else { UNREACHED }));
        self.neighbor_list.clear();
        self.growing.clear();

        let mut current_segment = 0;
        self.seeds.clear();
        find_seeds(grid, units, config, &mut self.seeds);
        let ground = ground_unit(&self.seeds, units, config);
        for seed in &self.seeds {
            if Some(units[*seed as usize]) == ground {
                self.of_cell[*seed as usize] = current_segment;
                self.growing.push(*seed);
            } else {
                self.neighbor_list.push_back(*seed);
            }
        }
        if ground.is_some() {
            self.grow_segment(grid, heights, config, current_segment);
            current_segment += 1;
        }
        while let Some(cell) = self.neighbor_list.pop_front() {
            // One id stays free for the unreachable segment; a grid of noise with more segments keeps the rest there.
            if self.of_cell[cell as usize] == UNREACHED && current_segment < UNREACHED - 1 {
                self.of_cell[cell as usize] = current_segment;
                self.growing.push(cell);
                self.grow_segment(grid, heights, config, current_segment);
                current_segment += 1;
            }
        }

        self.unreachable = current_segment;
        for segment in &mut self.of_cell {
            if *segment == UNREACHED {
                *segment = self.unreachable;
            }
        }
    }

    /// Thesis, procedure "recursive segmenting", from the cells in `growing`.
    fn grow_segment(&mut self, grid: &RadialGrid, heights: &Heights, config: &DrivabilityConfig, current_segment: u16) {
        let units = heights.units();
        while let Some(cell) = self.growing.pop() {
            let cell = cell as usize;
            for adjacent in adjacent(grid, units, config.bridge_rows, cell).into_iter().flatten() {
                if self.of_cell[adjacent] != UNREACHED || !is_step(grid, heights, config, cell, adjacent) {
                    continue;
                }
                if config.close_gaps && is_gap(grid, units, adjacent) {
                    continue;
                }
                if units[adjacent] == units[cell] {
                    self.of_cell[adjacent] = current_segment;
                    self.growing.push(adjacent as u32);
                } else {
                    self.neighbor_list.push_back(adjacent as u32);
                }
            }
        }
    }

    /// Segment of each cell; [`SEGMENT`]`.unknown` where it is empty.
    pub fn of_cell(&self) -> &[u16] {
        &self.of_cell
    }

    /// The last segment: cells with points that were never reached.
    pub fn unreachable(&self) -> u16 {
        self.unreachable
    }
}

/// Whether two adjacent cells differ by at most one unit; across empty rows by one for each row, if the ground between
/// them can be a slope of `grade_max`: on a hill the rings lie metres apart, and the cells that would have shown the
/// units between are the empty ones.
pub fn is_step(grid: &RadialGrid, heights: &Heights, config: &DrivabilityConfig, cell: usize, other: usize) -> bool {
    let apart = usize::from(heights.units()[cell].abs_diff(heights.units()[other]));
    let rows = (cell / grid.columns()).abs_diff(other / grid.columns());
    let ([xa, ya, za], [xb, yb, zb]) = (heights.points()[cell], heights.points()[other]);
    let distance = ((xa - xb) * (xa - xb) + (ya - yb) * (ya - yb)).sqrt();
    apart <= 1 || (apart <= rows && (za - zb).abs() <= config.grade_max * distance)
}

/// Cells where segments start, in the order of the columns.
///
/// The thesis starts at cell (0, 0). On real scans row 0 holds points in few columns, often in none, so every column
/// offers its innermost cell within the blind zone: the ground between is hidden by the vehicle that stands on it.
fn find_seeds(grid: &RadialGrid, units: &[i8], config: &DrivabilityConfig, seeds: &mut Vec<u32>) {
    let under_the_vehicle = unit_height(0.0, config);
    let known = |cell: &usize| units[*cell] != UNIT_HEIGHT_UNKNOWN;
    let level = |cell: &usize| units[*cell].abs_diff(under_the_vehicle) <= 1;
    match config.seed {
        Seed::FirstCell => seeds.extend((0..units.len().min(1)).filter(known).map(|cell| cell as u32)),
        Seed::BlindZone => {
            let rows = (0..grid.rows()).take_while(|row| grid.row_span_m(*row).0 < config.blind_zone_m).count();
            let innermost = |column| (0..rows).map(|row| row * grid.columns() + column).find(known);
            seeds.extend((0..grid.columns()).filter_map(innermost).filter(level).map(|cell| cell as u32));
        }
    }
}

/// Unit height of segment 0: the one most seeds have; of equally frequent ones the nearest to the ground under the
/// vehicle, then the lower.
fn ground_unit(seeds: &[u32], units: &[i8], config: &DrivabilityConfig) -> Option<i8> {
    if config.seed == Seed::FirstCell {
        return seeds.first().map(|seed| units[*seed as usize]);
    }
    let under_the_vehicle = unit_height(0.0, config);
    let votes = |unit: i8| seeds.iter().filter(|seed| units[**seed as usize] == unit).count();
    // The last of equals wins, so they are listed from the least wanted on.
    let units = [1, -1, 0].map(|step| under_the_vehicle.saturating_add(step));
    units.into_iter().filter(|unit| votes(*unit) > 0).max_by_key(|unit| votes(*unit))
}

/// The up to eight cells next to `cell` that hold points: inward, outward, clockwise, counter-clockwise, and across the
/// corners where a ring slips from row to row.
///
/// Slopes stretch rings apart and leave rows empty, so inward and outward reach across up to `bridge_rows` of them; and
/// a ring that climbs crosses from a row to the next between two columns, where it is the same ring although its cells
/// share a corner only. That is so when the other two cells at the corner are empty. Nothing else is bridged between
/// columns: a revolution leaves no gap there that is not a blocked view or a lost packet.
fn adjacent(grid: &RadialGrid, units: &[i8], bridge_rows: u8, cell: usize) -> [Option<usize>; 8] {
    let columns = grid.columns();
    let row = cell / columns;
    let known = |cell: &usize| units[*cell] != UNIT_HEIGHT_UNKNOWN;
    let across = 1..=usize::from(bridge_rows) + 1;
    let inward = across.take_while(|step| *step <= row).map(|step| cell - step * columns).find(known);
    let (right, left) = (clockwise(columns, cell), counter_clockwise(columns, cell));
    let mut adjacent =
        [inward, outward(grid, units, bridge_rows, cell), Some(right), Some(left), None, None, None, None];
    if bridge_rows > 0 {
        let inner = cell.checked_sub(columns).filter(|inner| !known(inner)).map(|_| columns);
        let outer = Some(cell + columns).filter(|outer| *outer < units.len() && !known(outer)).map(|_| columns);
        for (side, slips) in [(right, [4, 5]), (left, [6, 7])] {
            if !known(&side) {
                adjacent[slips[0]] = inner.map(|step| side - step);
                adjacent[slips[1]] = outer.map(|step| side + step);
            }
        }
    }
    adjacent.map(|adjacent| adjacent.filter(known))
}

/// Whether a cell lies between two higher ones: opposite neighbours, corners included, both more than a unit above it.
///
/// Fences are seen through their slats, and a wall seen edge-on falls between two rays; so a barrier has holes one cell
/// wide, and through one of them the ground behind would join the ground before. A column is never wider than a vehicle
/// within 60 m, so nothing that could be driven through is closed sideways; what is lost is the ground between two
/// things one row apart, most of which the nearer one hides anyway.
fn is_gap(grid: &RadialGrid, units: &[i8], cell: usize) -> bool {
    let columns = grid.columns();
    let higher = |other: usize| units.get(other).is_some_and(|unit| i16::from(*unit) > i16::from(units[cell]) + 1);
    let (left, right) = (counter_clockwise(columns, cell), clockwise(columns, cell));
    if higher(left) && higher(right) {
        return true;
    }
    // Before the first row there is no cell, and after the last none that `get` finds.
    cell >= columns
        && [(cell, cell), (left, right), (right, left)]
            .iter()
            .any(|(inner, outer)| higher(inner - columns) && higher(outer + columns))
}

/// The next cell outward that holds points, across up to `bridge_rows` empty ones.
pub fn outward(grid: &RadialGrid, units: &[i8], bridge_rows: u8, cell: usize) -> Option<usize> {
    let across = (1..=usize::from(bridge_rows) + 1).map(|step| cell + step * grid.columns());
    across.take_while(|cell| *cell < units.len()).find(|cell| units[*cell] != UNIT_HEIGHT_UNKNOWN)
}

/// The next cell of the same row, counter-clockwise.
pub fn counter_clockwise(columns: usize, cell: usize) -> usize {
    if cell % columns == columns - 1 { cell + 1 - columns } else { cell + 1 }
}

/// The next cell of the same row, clockwise.
fn clockwise(columns: usize, cell: usize) -> usize {
    if cell.is_multiple_of(columns) { cell + columns - 1 } else { cell - 1 }
}
