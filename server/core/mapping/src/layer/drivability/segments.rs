//! Segmenting (UT Austin thesis, section IV.3): sets of adjacent cells of one unit height, grown from the vehicle.
//!
//! In: unit heights. Out: the segment of each cell, counted from 0 (under the vehicle) in the order the segments were
//! found. The last segment is reserved for cells with points that were not reached. A list replaces the recursion of
//! the thesis.

use std::collections::VecDeque;

use crate::layer::radial_grid::RadialGrid;

use super::class::{SEGMENT, UNIT_HEIGHT_UNKNOWN};
use super::config::{BLIND_ZONE_M, DrivabilityConfig, Seed};
use super::heights::{Heights, unit_height};

/// Mark of a cell with points that belongs to no segment yet.
const UNREACHED: u16 = u16::MAX - 1;

/// The segment of each cell, in the order of the grid.
#[derive(Clone, Debug, Default)]
pub struct Segments {
    of_cell: Vec<u16>,
    unreachable: u16,
    seeds: Vec<u32>,
    /// Cells one unit higher or lower than a segment, from which further segments start.
    neighbor_list: VecDeque<u32>,
    /// Cells of the current segment whose neighbours are still to be visited.
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
            // One id stays free for the unreachable segment. If a grid of noise has more segments, the rest of its
            // cells become unreachable.
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

    /// Grows one segment from the cells in `growing` (UT Austin thesis, procedure "recursive segmenting").
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

    /// Segment of each cell; [`SEGMENT`]`.unknown` if the cell is empty.
    pub fn of_cell(&self) -> &[u16] {
        &self.of_cell
    }

    /// The last segment: cells with points that were not reached.
    pub fn unreachable(&self) -> u16 {
        self.unreachable
    }
}

/// True if two adjacent cells differ by at most one unit, or across empty rows by at most one unit for each row, if the
/// ground between them can be a slope of `grade_max`. On a hill the rings lie metres apart, and the cells with the unit
/// heights between them are empty.
pub fn is_step(grid: &RadialGrid, heights: &Heights, config: &DrivabilityConfig, cell: usize, other: usize) -> bool {
    let apart = usize::from(heights.units()[cell].abs_diff(heights.units()[other]));
    let rows = (cell / grid.columns()).abs_diff(other / grid.columns());
    let ([xa, ya, za], [xb, yb, zb]) = (heights.points()[cell], heights.points()[other]);
    let distance = ((xa - xb) * (xa - xb) + (ya - yb) * (ya - yb)).sqrt();
    apart <= 1 || (apart <= rows && (za - zb).abs() <= config.grade_max * distance)
}

/// Finds the cells where segments start, in the order of the columns.
///
/// The thesis starts at cell (0, 0). On real scans row 0 has points in few columns, often in none. Therefore each
/// column contributes its innermost cell within the blind zone: the vehicle itself hides the ground before it.
fn find_seeds(grid: &RadialGrid, units: &[i8], config: &DrivabilityConfig, seeds: &mut Vec<u32>) {
    let under_the_vehicle = unit_height(0.0, config);
    let known = |cell: &usize| units[*cell] != UNIT_HEIGHT_UNKNOWN;
    let level = |cell: &usize| units[*cell].abs_diff(under_the_vehicle) <= 1;
    match config.seed {
        Seed::FirstCell => seeds.extend((0..units.len().min(1)).filter(known).map(|cell| cell as u32)),
        Seed::BlindZone => {
            let rows = grid.blind_rows(BLIND_ZONE_M);
            let innermost = |column| (0..rows).map(|row| row * grid.columns() + column).find(known);
            seeds.extend((0..grid.columns()).filter_map(innermost).filter(level).map(|cell| cell as u32));
        }
    }
}

/// Unit height of segment 0: the unit height of most seeds. Of equally frequent ones, the nearest to the ground under
/// the vehicle, then the lower, is chosen.
fn ground_unit(seeds: &[u32], units: &[i8], config: &DrivabilityConfig) -> Option<i8> {
    if config.seed == Seed::FirstCell {
        return seeds.first().map(|seed| units[*seed as usize]);
    }
    let under_the_vehicle = unit_height(0.0, config);
    let votes = |unit: i8| seeds.iter().filter(|seed| units[**seed as usize] == unit).count();
    // `max_by_key` returns the last of equals, so the preferred unit is listed last.
    let units = [1, -1, 0].map(|step| under_the_vehicle.saturating_add(step));
    units.into_iter().filter(|unit| votes(*unit) > 0).max_by_key(|unit| votes(*unit))
}

/// The up to eight cells with points next to `cell`: inward, outward, clockwise, counter-clockwise, and across the
/// corners where a ring changes from one row to the next.
///
/// Slopes stretch rings apart and leave rows empty, so that the neighbours inward and outward may lie across up to
/// `bridge_rows` empty rows. A ring on a slope crosses from one row to the next between two columns: its two cells then
/// share only a corner, and the other two cells at the corner are empty. Gaps between columns are not bridged, because
/// there they are blocked views or lost packets.
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

/// True if a cell lies between two higher ones: opposite neighbours, corners included, that are both more than one unit
/// above it.
///
/// The sensor sees through the slats of a fence, and a thin wall can fall between two rays. So a barrier has holes one
/// cell wide, which would join the ground behind it to the ground before it. Within 60 m a column is narrower than a
/// vehicle, so that no gap a vehicle fits through is closed sideways. The ground between two objects one row apart is
/// lost; the nearer object hides most of it anyway.
fn is_gap(grid: &RadialGrid, units: &[i8], cell: usize) -> bool {
    let columns = grid.columns();
    let higher = |other: usize| units.get(other).is_some_and(|unit| i16::from(*unit) > i16::from(units[cell]) + 1);
    let (left, right) = (counter_clockwise(columns, cell), clockwise(columns, cell));
    if higher(left) && higher(right) {
        return true;
    }
    // Before the first row there is no cell; after the last row `get` finds none.
    cell >= columns
        && [(cell, cell), (left, right), (right, left)]
            .iter()
            .any(|(inner, outer)| higher(inner - columns) && higher(outer + columns))
}

/// The next cell outward with points, across up to `bridge_rows` empty rows.
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
