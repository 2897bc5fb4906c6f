//! Local drivability map construction (UT Austin thesis, section IV.5): the three criteria between segments, then a
//! breadth-first search from segment 0.
//!
//! In: highest points, segments, planes. Out: which segments the vehicle can get to. Two segments are drivable from one
//! another if they share a contiguous boundary, at least `passage_m_min` wide, on which (1) their boundary cells are
//! level and (2) the plane of one misses the boundary cells of the other by at most `plane_error_m_max`.
//!
//! Where this differs from the thesis:
//! - Criterion 1: the thesis compares unit heights, and heights one unit apart may differ by almost 0.5 m. In unit
//!   heights, a low wall at 20 m whose foot rises from grass became ground (14 of 9,886 drivable cells of the labelled
//!   frame contained an obstacle; with this criterion 1 of 9,865). Therefore the highest points of boundary cells may
//!   differ by at most `step_m_max`, or by a slope of `grade_max` over the distance between them, which matters where
//!   rings lie metres apart. A step of two units is the criterion of the thesis.
//! - Criterion 2: the thesis judges all boundary cells of a pair of segments together, with the planes of both
//!   ([`PlaneTest::WholeBoundary`]). By default each side shared by two cells is judged by itself, with the plane of
//!   the larger segment.

use std::collections::VecDeque;

use crate::layer::radial_grid::RadialGrid;

use super::class::SEGMENT;
use super::config::{DrivabilityConfig, Passage, PlaneTest};
use super::heights::Heights;
use super::planes::Planes;
use super::segments::{Segments, counter_clockwise, is_step, outward};

/// Which segments the vehicle can get to.
#[derive(Clone, Debug, Default)]
pub struct Search {
    sides: Vec<Side>,
    /// By corner of the grid: number of the last boundary that touched it, and the side that touched it.
    corners: Vec<(u32, u32)>,
    /// Number of boundaries tested so far.
    boundaries: u32,
    /// By side of the boundary under test: an earlier side of the same contiguous group, or the side itself.
    group: Vec<u32>,
    /// By side of the boundary under test: width of its group, metres, if the side is the group's first.
    widths: Vec<f32>,
    drivable: Vec<bool>,
    queue: VecDeque<u16>,
}

/// A side shared by two cells of different segments that meets criteria 1 and 2; listed once for each segment.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
struct Side {
    segment: u16,
    neighbor: u16,
    /// The cell inward or clockwise of the side, of either segment.
    cell: u32,
    /// The cell outward or counter-clockwise of the side.
    other: u32,
}

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
        self.search(grid, usize::from(segments.unreachable()), config);
    }

    /// True by segment if the vehicle can get there; false for the unreachable segment.
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
        let reached = |cell: usize| of_cell[cell] != SEGMENT.unknown && of_cell[cell] != segments.unreachable();
        self.sides.clear();
        for cell in (0..units.len()).filter(|cell| reached(*cell)) {
            let counter_clockwise = counter_clockwise(grid.columns(), cell);
            let outward = outward(grid, units, config.bridge_rows, cell);
            for other in [Some(counter_clockwise), outward].into_iter().flatten().filter(|other| reached(*other)) {
                let (a, b) = (of_cell[cell], of_cell[other]);
                if a != b
                    && is_step(grid, heights, config, cell, other)
                    && is_level(heights, config, cell, other)
                    && (config.plane_test == PlaneTest::WholeBoundary
                        || planes_agree(planes, heights, config, (a, cell), (b, other)))
                {
                    let (cell, other) = (cell as u32, other as u32);
                    self.sides.push(Side { segment: a, neighbor: b, cell, other });
                    self.sides.push(Side { segment: b, neighbor: a, cell, other });
                }
            }
        }
        self.sides.sort_unstable();
        if config.plane_test == PlaneTest::WholeBoundary {
            self.remove_uneven_boundaries(of_cell, planes, heights, config);
        }
    }

    /// Criterion 2 of the thesis: removes all sides of two segments if the plane of one misses a boundary cell of the
    /// other.
    fn remove_uneven_boundaries(
        &mut self,
        of_cell: &[u16],
        planes: &Planes,
        heights: &Heights,
        config: &DrivabilityConfig,
    ) {
        let fits = |side: &Side| {
            let (cell, other) = (side.cell as usize, side.other as usize);
            is_near_plane(planes, heights, config, of_cell[other], cell)
                && is_near_plane(planes, heights, config, of_cell[cell], other)
        };
        let mut even = Vec::with_capacity(self.sides.len());
        for boundary in self.sides.chunk_by(|a, b| (a.segment, a.neighbor) == (b.segment, b.neighbor)) {
            if boundary.iter().all(fits) {
                even.extend_from_slice(boundary);
            }
        }
        self.sides = even;
    }

    /// Searches breadth first from segment 0 (UT Austin thesis, section IV.5, steps 1 and 2).
    fn search(&mut self, grid: &RadialGrid, segments: usize, config: &DrivabilityConfig) {
        self.corners.clear();
        self.corners.resize((grid.rows() + 1) * grid.columns(), (0, 0));
        self.boundaries = 0;
        self.drivable.clear();
        self.drivable.resize(segments + 1, false);
        self.queue.clear();
        if segments > 0 {
            self.drivable[0] = true;
            self.queue.push_back(0);
        }
        while let Some(segment) = self.queue.pop_front() {
            let mut sides = self.sides_of(segment);
            while let Some(side) = self.sides[sides.clone()].first() {
                let neighbor = side.neighbor;
                sides.start += self.sides[sides.clone()].partition_point(|side| side.neighbor == neighbor);
                if !self.drivable[usize::from(neighbor)] && self.is_passage(grid, config, segment, neighbor) {
                    self.drivable[usize::from(neighbor)] = true;
                    self.queue.push_back(neighbor);
                }
            }
        }
    }

    fn sides_of(&self, segment: u16) -> std::ops::Range<usize> {
        let start = self.sides.partition_point(|side| side.segment < segment);
        start..start + self.sides[start..].partition_point(|side| side.segment == segment)
    }

    /// Criterion 3: true if the sides between `segment`, which is drivable, and `neighbor`, which is not yet, contain a
    /// contiguous piece at least `passage_m_min` wide. With [`Passage::ToDrivableGround`] the sides between `neighbor`
    /// and all ground found drivable so far count: where the ground changes from one unit to the next along a ring,
    /// noise divides it into small segments, and none of their boundaries alone is wide enough.
    fn is_passage(&mut self, grid: &RadialGrid, config: &DrivabilityConfig, segment: u16, neighbor: u16) -> bool {
        let boundary = self.sides_of(neighbor);
        self.boundaries += 1;
        self.group.clear();
        self.group.extend(0..boundary.len() as u32);
        self.widths.clear();
        self.widths.resize(boundary.len(), 0.0);
        let drivable = &self.drivable;
        let counts = |side: &Side| match config.passage {
            Passage::BetweenSegments => side.neighbor == segment,
            Passage::ToDrivableGround => drivable[usize::from(side.neighbor)],
        };
        let sides = &self.sides[boundary];
        for (index, side) in (0..).zip(sides).filter(|(_, side)| counts(side)) {
            for corner in corners(grid, side) {
                let (boundary_of_corner, touched_by) = self.corners[corner];
                if boundary_of_corner == self.boundaries {
                    join(&mut self.group, touched_by, index);
                }
                self.corners[corner] = (self.boundaries, index);
            }
        }
        // A passage of width 0 still needs a side.
        let mut widest = f32::NEG_INFINITY;
        for (index, side) in (0..).zip(sides).filter(|(_, side)| counts(side)) {
            let width = &mut self.widths[find(&mut self.group, index) as usize];
            *width += width_m(grid, side);
            widest = widest.max(*width);
        }
        widest >= config.passage_m_min
    }
}

/// Criterion 1: true if the highest points of two boundary cells differ by a step or a slope that the vehicle can drive
/// over.
fn is_level(heights: &Heights, config: &DrivabilityConfig, cell: usize, other: usize) -> bool {
    let ([xa, ya, za], [xb, yb, zb]) = (heights.points()[cell], heights.points()[other]);
    let distance = ((xa - xb) * (xa - xb) + (ya - yb) * (ya - yb)).sqrt();
    (za - zb).abs() <= config.step_m_max.max(config.grade_max * distance)
}

/// Criterion 2: true if the plane of the larger segment misses the boundary cell of the other one by little.
fn planes_agree(
    planes: &Planes,
    heights: &Heights,
    config: &DrivabilityConfig,
    a: (u16, usize),
    b: (u16, usize),
) -> bool {
    // The plane of the larger segment is better determined; a plane through a few cells says little beyond them.
    let ((segment, _), (_, cell)) = if planes.cells(a.0) >= planes.cells(b.0) { (a, b) } else { (b, a) };
    is_near_plane(planes, heights, config, segment, cell)
}

/// True if the plane of a segment misses the highest point of a cell by little.
fn is_near_plane(planes: &Planes, heights: &Heights, config: &DrivabilityConfig, segment: u16, cell: usize) -> bool {
    let [x, y, z] = heights.points()[cell].map(f64::from);
    let [pa, pb, pc] = planes.of_segment()[usize::from(segment)];
    (pa * x + pb * y + pc - z).abs() <= f64::from(config.plane_error_m_max)
}

/// Corners of the grid that a side touches. Corner (row, column) is the inner clockwise corner of cell (row, column). A
/// side across empty rows touches the corners of all those rows.
fn corners(grid: &RadialGrid, side: &Side) -> impl Iterator<Item = usize> {
    let columns = grid.columns();
    let (cell, other) = (side.cell as usize, side.other as usize);
    let radial = cell / columns == other / columns;
    let (first, last) =
        if radial { (cell / columns, cell / columns + 1) } else { (cell / columns + 1, other / columns) };
    let left = counter_clockwise(columns, cell) % columns;
    let right = if radial { left } else { cell % columns };
    (first..=last).flat_map(move |row| [row * columns + left, row * columns + right])
}

/// Width of a side, metres: the length of the arc between two rows, or the depth of the row between two columns.
fn width_m(grid: &RadialGrid, side: &Side) -> f32 {
    let columns = grid.columns();
    let (row, other_row) = (side.cell as usize / columns, side.other as usize / columns);
    let (inner, outer) = grid.row_span_m(row);
    if row == other_row { outer - inner } else { outer * std::f32::consts::TAU / columns as f32 }
}

/// The first side of a side's group.
fn find(group: &mut [u32], mut side: u32) -> u32 {
    while group[side as usize] != side {
        group[side as usize] = group[group[side as usize] as usize];
        side = group[side as usize];
    }
    side
}

/// Joins the groups of two sides.
fn join(group: &mut [u32], a: u32, b: u32) {
    let (a, b) = (find(group, a), find(group, b));
    // The earlier side is the first one, so that groups do not depend on the order of joining.
    group[a.max(b) as usize] = a.min(b);
}
