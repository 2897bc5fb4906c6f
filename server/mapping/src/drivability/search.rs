//! Local drivability map construction (thesis §IV.5): the three criteria between segments, then breadth first from
//! segment 0.
//!
//! In: highest points, segments, planes. Out: which segments the vehicle can get to. Two segments are drivable from one
//! another when they share a contiguous boundary, at least `gate_m_min` wide, on which (1) their boundary cells are level
//! and (2) the plane of one, carried to the boundary cells of the other, is off by at most `plane_error_m_max`.
//!
//! The reading of (1): the thesis compares unit heights, and one unit apart may be 0.5 m apart. Cut into units, a low wall
//! at 20 m whose foot rises from grass became ground (14 of 9,886 drivable cells of the labelled frame held an obstacle,
//! 1 of 9,865 with this reading). So the highest points of boundary cells may differ by no more than a step the vehicle
//! takes, `step_m_max`, or by what a slope of `grade_max` makes of the distance between them, which matters where rings lie
//! metres apart. A step of two units is the thesis' own criterion.

use std::collections::VecDeque;

use crate::config::DrivabilityConfig;
use crate::radial::RadialGrid;

use super::heights::Heights;
use super::planes::Planes;
use super::segments::{Segments, counter_clockwise, is_step, outward};
use super::SEGMENT_UNKNOWN;

/// Which segments the vehicle can get to.
#[derive(Clone, Debug, Default)]
pub struct Search {
    sides: Vec<Side>,
    /// For each corner of the grid the last side that touched it.
    corners: Vec<u32>,
    /// For each side an earlier one of its group, or itself.
    group: Vec<u32>,
    /// Width of each group of sides of one boundary, metres, at its first side.
    widths: Vec<f32>,
    /// Segments drivable from one another, both ways, sorted.
    links: Vec<(u16, u16)>,
    drivable: Vec<bool>,
    queue: VecDeque<u16>,
}

/// A side shared by two cells of different segments, on which criteria 1 and 2 hold.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
struct Side {
    /// Smaller segment first.
    segments: (u16, u16),
    /// The cell nearer to the vehicle, or clockwise.
    cell: u32,
    /// The cell outward, or counter-clockwise.
    other: u32,
}

const NONE: u32 = u32::MAX;

impl Search {
    /// Applies the criteria to all boundaries and searches from segment 0.
    pub fn run(
        &mut self,
        grid: &RadialGrid,
        heights: &Heights,
        segments: &Segments,
        planes: &Planes,
        config: &DrivabilityConfig,
    ) {
        self.find_sides(grid, heights, segments, planes, config);
        self.find_links(grid, config);
        self.search(usize::from(segments.unreachable()));
    }

    /// By segment, the unreachable one included (never).
    pub fn drivable(&self) -> &[bool] {
        &self.drivable
    }

    fn find_sides(
        &mut self,
        grid: &RadialGrid,
        heights: &Heights,
        segments: &Segments,
        planes: &Planes,
        config: &DrivabilityConfig,
    ) {
        let units = heights.units();
        let of_cell = segments.of_cell();
        let reached = |cell: usize| of_cell[cell] != SEGMENT_UNKNOWN && of_cell[cell] != segments.unreachable();
        self.sides.clear();
        for cell in (0..units.len()).filter(|cell| reached(*cell)) {
            let counter_clockwise = counter_clockwise(grid.columns(), cell);
            let outward = outward(grid, units, config.bridge_rows, cell);
            for other in [Some(counter_clockwise), outward].into_iter().flatten().filter(|other| reached(*other)) {
                let (a, b) = (of_cell[cell], of_cell[other]);
                if a != b
                    && is_step(grid, heights, config, cell, other)
                    && is_taken(heights, config, cell, other)
                    && planes_agree(planes, heights, config, (a, cell), (b, other))
                {
                    let segments = (a.min(b), a.max(b));
                    self.sides.push(Side { segments, cell: cell as u32, other: other as u32 });
                }
            }
        }
        self.sides.sort_unstable();
    }

    /// Criterion 3: contiguous sides of two segments, at least a gate wide, link them.
    fn find_links(&mut self, grid: &RadialGrid, config: &DrivabilityConfig) {
        self.links.clear();
        self.corners.clear();
        self.corners.resize((grid.rows() + 1) * grid.columns(), NONE);
        self.group.clear();
        self.group.extend(0..self.sides.len() as u32);
        let mut first = 0;
        for boundary in self.sides.chunk_by(|a, b| a.segments == b.segments) {
            let mut widest = 0.0f32;
            for (index, side) in (first..).zip(boundary) {
                for corner in corners(grid, side) {
                    // A corner last touched by a side of an earlier boundary joins nothing.
                    let held = self.corners[corner];
                    if held != NONE && held >= first {
                        join(&mut self.group, held, index);
                    }
                    self.corners[corner] = index;
                }
            }
            self.widths.clear();
            self.widths.resize(boundary.len(), 0.0);
            for (index, side) in (first..).zip(boundary) {
                let root = find(&mut self.group, index);
                let width = &mut self.widths[(root - first) as usize];
                *width += width_m(grid, side);
                widest = widest.max(*width);
            }
            if widest >= config.gate_m_min {
                let (a, b) = boundary[0].segments;
                self.links.extend([(a, b), (b, a)]);
            }
            first += boundary.len() as u32;
        }
        self.links.sort_unstable();
    }

    /// Thesis, steps 1 and 2: breadth first from segment 0.
    fn search(&mut self, segments: usize) {
        self.drivable.clear();
        self.drivable.resize(segments + 1, false);
        if segments == 0 {
            return;
        }
        self.queue.clear();
        self.queue.push_back(0);
        self.drivable[0] = true;
        while let Some(segment) = self.queue.pop_front() {
            let start = self.links.partition_point(|link| link.0 < segment);
            for (_, other) in self.links[start..].iter().take_while(|link| link.0 == segment) {
                if !self.drivable[usize::from(*other)] {
                    self.drivable[usize::from(*other)] = true;
                    self.queue.push_back(*other);
                }
            }
        }
    }
}

/// Criterion 1, in metres: the highest points of boundary cells differ by a step or a slope the vehicle takes.
fn is_taken(heights: &Heights, config: &DrivabilityConfig, cell: usize, other: usize) -> bool {
    let ([xa, ya, za], [xb, yb, zb]) = (heights.points()[cell], heights.points()[other]);
    let distance = ((xa - xb) * (xa - xb) + (ya - yb) * (ya - yb)).sqrt();
    (za - zb).abs() <= config.step_m_max.max(config.grade_max * distance)
}

/// Criterion 2: the plane of the larger segment, carried to the boundary cell of the other, is off by little.
fn planes_agree(
    planes: &Planes,
    heights: &Heights,
    config: &DrivabilityConfig,
    a: (u16, usize),
    b: (u16, usize),
) -> bool {
    // The larger segment's plane is the better known one; a plane through a handful of cells says little beyond them.
    let ((segment, _), (_, cell)) = if planes.cells(a.0) >= planes.cells(b.0) { (a, b) } else { (b, a) };
    let [x, y, z] = heights.points()[cell].map(f64::from);
    let [pa, pb, pc] = planes.of_segment()[usize::from(segment)];
    (pa * x + pb * y + pc - z).abs() <= f64::from(config.plane_error_m_max)
}

/// Corners of the grid that a side touches; corner (row, column) is the inner clockwise one of cell (row, column). A side
/// across empty rows touches the corners of all of them.
fn corners(grid: &RadialGrid, side: &Side) -> impl Iterator<Item = usize> {
    let columns = grid.columns();
    let (cell, other) = (side.cell as usize, side.other as usize);
    let radial = cell / columns == other / columns;
    let (first, last) = if radial { (cell / columns, cell / columns + 1) } else { (cell / columns + 1, other / columns) };
    let left = counter_clockwise(columns, cell) % columns;
    let right = if radial { left } else { cell % columns };
    (first..=last).flat_map(move |row| [row * columns + left, row * columns + right])
}

/// Width of a side, metres: the arc between two rows, or the depth of a row between two columns.
fn width_m(grid: &RadialGrid, side: &Side) -> f32 {
    let columns = grid.columns();
    let (row, other_row) = (side.cell as usize / columns, side.other as usize / columns);
    let (inner, outer) = grid.row_span_m(row);
    if row == other_row { outer - inner } else { outer * std::f32::consts::TAU / columns as f32 }
}

fn find(group: &mut [u32], mut side: u32) -> u32 {
    while group[side as usize] != side {
        group[side as usize] = group[group[side as usize] as usize];
        side = group[side as usize];
    }
    side
}

fn join(group: &mut [u32], a: u32, b: u32) {
    let (a, b) = (find(group, a), find(group, b));
    // The earlier side leads, so that groups do not depend on the order of joining.
    group[a.max(b) as usize] = a.min(b);
}
