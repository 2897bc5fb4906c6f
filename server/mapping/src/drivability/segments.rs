//! Segmenting (thesis §IV.3): sets of adjacent cells of one unit height, grown from the vehicle.
//!
//! In: unit heights. Out: the segment of every cell, counted from 0 (under the vehicle) in the order they were found;
//! the last is reserved for cells with points that were never reached. Written with a list instead of the thesis'
//! recursion.

use std::collections::VecDeque;

use crate::config::{DrivabilityConfig, Seed};
use crate::radial::RadialGrid;

use super::heights::{Heights, unit_height};
use super::{SEGMENT_UNKNOWN, UNIT_HEIGHT_UNKNOWN};

/// Cells with points that no segment has taken yet.
const UNREACHED: u16 = u16::MAX - 1;

/// The segment of every cell.
#[derive(Clone, Debug, Default)]
pub struct Segments {
    of_cell: Vec<u16>,
    unreachable: u16,
    neighbor_list: VecDeque<u32>,
    growing: Vec<u32>,
}

impl Segments {
    /// Grows segments from the seeds until the neighbour list is empty.
    pub fn grow(&mut self, grid: &RadialGrid, heights: &Heights, config: &DrivabilityConfig) {
        let units = heights.units();
        self.of_cell.clear();
        self.of_cell.extend(units.iter().map(|u| if *u == UNIT_HEIGHT_UNKNOWN { SEGMENT_UNKNOWN } else { UNREACHED }));
        self.neighbor_list.clear();
        self.growing.clear();

        let mut current_segment = 0;
        let seeds = seeds(grid, units, config);
        let ground = ground_unit(&seeds, units, config);
        for seed in seeds {
            if Some(units[seed]) == ground {
                self.of_cell[seed] = current_segment;
                self.growing.push(seed as u32);
            } else {
                self.neighbor_list.push_back(seed as u32);
            }
        }
        if ground.is_some() {
            self.grow_segment(grid, units, config.bridge_rows, current_segment);
            current_segment += 1;
        }
        while let Some(cell) = self.neighbor_list.pop_front() {
            // One id stays free for the unreachable segment; a grid of noise with more segments keeps the rest there.
            if self.of_cell[cell as usize] == UNREACHED && current_segment < UNREACHED - 1 {
                self.of_cell[cell as usize] = current_segment;
                self.growing.push(cell);
                self.grow_segment(grid, units, config.bridge_rows, current_segment);
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
    fn grow_segment(&mut self, grid: &RadialGrid, units: &[i8], bridge_rows: u8, current_segment: u16) {
        while let Some(cell) = self.growing.pop() {
            let cell = cell as usize;
            for adjacent in adjacent(grid, units, bridge_rows, cell).into_iter().flatten() {
                if self.of_cell[adjacent] != UNREACHED {
                    continue;
                }
                match units[adjacent].abs_diff(units[cell]) {
                    0 => {
                        self.of_cell[adjacent] = current_segment;
                        self.growing.push(adjacent as u32);
                    }
                    1 => self.neighbor_list.push_back(adjacent as u32),
                    _ => {}
                }
            }
        }
    }

    /// Segment of each cell; [`SEGMENT_UNKNOWN`] where it is empty.
    pub fn of_cell(&self) -> &[u16] {
        &self.of_cell
    }

    /// The last segment: cells with points that were never reached.
    pub fn unreachable(&self) -> u16 {
        self.unreachable
    }
}

/// Cells where segments start, in the order of the columns.
///
/// The thesis starts at cell (0, 0). On real scans row 0 holds points in few columns, often in none, so every column
/// offers its innermost cell within the blind zone: the ground between is hidden by the vehicle that stands on it.
fn seeds(grid: &RadialGrid, units: &[i8], config: &DrivabilityConfig) -> Vec<usize> {
    let under_the_vehicle = unit_height(0.0, config);
    let known = |cell: &usize| units[*cell] != UNIT_HEIGHT_UNKNOWN;
    let level = |cell: &usize| units[*cell].abs_diff(under_the_vehicle) <= 1;
    match config.seed {
        Seed::FirstCell => [0].into_iter().filter(|cell| *cell < units.len()).filter(known).collect(),
        Seed::BlindZone => {
            let rows = (0..grid.rows()).take_while(|row| grid.row_span_m(*row).0 < config.blind_zone_m).count();
            let innermost = |column| (0..rows).map(|row| row * grid.columns() + column).find(known);
            (0..grid.columns()).filter_map(innermost).filter(level).collect()
        }
    }
}

/// Unit height of segment 0: the one most seeds have; of equally frequent ones the nearest to the ground under the
/// vehicle, then the lower.
fn ground_unit(seeds: &[usize], units: &[i8], config: &DrivabilityConfig) -> Option<i8> {
    let under_the_vehicle = unit_height(0.0, config);
    let votes = |unit: i8| seeds.iter().filter(|seed| units[**seed] == unit).count();
    let rank = |unit: &i8| (votes(*unit), -i16::from(unit.abs_diff(under_the_vehicle)), -i16::from(*unit));
    seeds.iter().map(|seed| units[*seed]).max_by_key(rank)
}

/// The up to four cells that share a side with `cell` and hold points: inward, outward, clockwise, counter-clockwise.
///
/// Slopes stretch rings apart and leave rows empty, so inward and outward reach across up to `bridge_rows` of them.
/// Nothing is bridged between columns: a revolution leaves no gap there that is not a blocked view or a lost packet.
fn adjacent(grid: &RadialGrid, units: &[i8], bridge_rows: u8, cell: usize) -> [Option<usize>; 4] {
    let columns = grid.columns();
    let (row, column) = (cell / columns, cell % columns);
    let known = |cell: &usize| units[*cell] != UNIT_HEIGHT_UNKNOWN;
    let across = 1..=usize::from(bridge_rows) + 1;
    let inward = across.take_while(|step| *step <= row).map(|step| cell - step * columns).find(known);
    let clockwise = if column == 0 { cell + columns - 1 } else { cell - 1 };
    [inward, outward(grid, units, bridge_rows, cell), Some(clockwise), Some(counter_clockwise(columns, cell))]
        .map(|adjacent| adjacent.filter(known))
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
