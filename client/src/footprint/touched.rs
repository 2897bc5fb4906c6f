//! The cells that a polygon touches.
//!
//! In: a grid and the corners of a simple polygon in the ego frame (metres). Out: every cell that the polygon, its
//! border included, touches, and whether it reaches outside the grid. A cell is touched by an edge, or lies wholly
//! inside; then the line through its centre crosses the polygon there. `client/python` has the same arithmetic.

use std::f64::consts::TAU;

use clearway_proto::grid::Grid;

/// Distance in metres below which a point touches a cell. Ours: far more than the rounding errors of a point on a map.
const TOUCH_M: f64 = 1e-9;

type Xy = [f64; 2];

/// The cells that a polygon touches.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Touched {
    /// Indices of the cells, each once, ascending.
    pub cells: Vec<usize>,
    /// The first corner outside the grid, on its border or infinitely far; the polygon is wholly inside if `None`.
    pub outside: Option<Xy>,
}

/// The cells of a grid that a polygon touches.
pub fn touched(grid: &Grid, corners: &[Xy]) -> Touched {
    // No comparison of a number that is none would find a cell.
    if let Some(corner) = corners.iter().find(|corner| !corner.iter().all(|value| value.is_finite())) {
        return Touched { cells: Vec::new(), outside: Some(*corner) };
    }
    let mut cells = Vec::new();
    let is_outside = match grid {
        Grid::Radial { centre_m, row_radius_m, columns } => {
            let corners: Vec<_> = corners.iter().map(|corner| from_centre(*centre_m, *corner)).collect();
            radial(&corners, row_radius_m, *columns, &mut cells)
        }
        Grid::Cartesian { origin_x_m, origin_y_m, width, height, cell_m, yaw_rad, .. } => {
            let ((sin, cos), edge) = (yaw_rad.sin_cos(), f64::from(*cell_m));
            let in_cells =
                |[x, y]: &Xy| [(x * cos - y * sin - origin_x_m) / edge, (x * sin + y * cos - origin_y_m) / edge];
            let corners: Vec<_> = corners.iter().map(in_cells).collect();
            cartesian(&corners, [*width, *height], TOUCH_M / edge, &mut cells)
        }
    };
    cells.sort_unstable();
    cells.dedup();
    let outside = is_outside.then(|| {
        let leaves = |corner: &&Xy| touched_by_point(grid, **corner);
        corners.iter().find(leaves).or(corners.first()).copied().unwrap_or_default()
    });
    Touched { cells, outside }
}

/// True if a point lies outside the grid or on its border.
fn touched_by_point(grid: &Grid, [x, y]: Xy) -> bool {
    let around = [[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]];
    around.into_iter().any(|[dx, dy]| grid.cell_at(x + 2.0 * TOUCH_M * dx, y + 2.0 * TOUCH_M * dy).is_none())
}

/// A position of the ego frame as seen from the centre of a radial grid.
pub fn from_centre(centre_m: [f32; 2], [x, y]: Xy) -> Xy {
    [x - f64::from(centre_m[0]), y - f64::from(centre_m[1])]
}

/// Adds the touched squares; corners in cells. True if the polygon reaches outside.
fn cartesian(corners: &[Xy], [width, height]: [u32; 2], slack: f64, cells: &mut Vec<usize>) -> bool {
    let (low, high) = extent(corners.iter().map(|corner| corner[1]));
    let (first, last) = ((low - slack).floor(), (high + slack).floor());
    let mut is_outside = first < 0.0 || last >= f64::from(height);
    let rows = first.max(0.0) as u64..(last + 1.0).clamp(0.0, f64::from(height)) as u64;
    for row in rows {
        let mut add = |from: f64, to: f64| {
            let (from, to) = (from.floor(), to.floor());
            is_outside |= from < 0.0 || to >= f64::from(width);
            let columns = from.max(0.0) as u64..(to + 1.0).clamp(0.0, f64::from(width)) as u64;
            cells.extend(columns.map(|column| (row * u64::from(width) + column) as usize));
        };
        let (bottom, middle) = (row as f64, row as f64 + 0.5);
        let mut crossings = Vec::new();
        for [a, b] in edges(corners) {
            if let Some(part) = clip([a, b], [0.0, 1.0], bottom - slack)
                && let Some(part) = clip(part, [0.0, -1.0], -(bottom + 1.0 + slack))
            {
                let (from, to) = extent(part.iter().map(|point| point[0]));
                add(from - slack, to + slack);
            }
            if (a[1] > middle) != (b[1] > middle) {
                crossings.push(a[0] + (middle - a[1]) / (b[1] - a[1]) * (b[0] - a[0]));
            }
        }
        crossings.sort_by(f64::total_cmp);
        crossings.chunks_exact(2).for_each(|pair| add(pair[0], pair[1]));
    }
    is_outside
}

/// Adds the touched cells of a radial grid; corners about its centre. True if the polygon reaches outside.
fn radial(corners: &[Xy], row_radius_m: &[f32], columns: u32, cells: &mut Vec<usize>) -> bool {
    let row = |range_m: f64| row_radius_m.partition_point(|&outer| f64::from(outer) < range_m);
    let direction = |column: f64| (column / f64::from(columns) * TAU).sin_cos();
    let mut is_outside = false;
    for column in 0..columns {
        let mut add = |from_m: f64, to_m: f64| {
            let (from, to) = (row(from_m), row(to_m));
            is_outside |= to >= row_radius_m.len();
            let rows = from..(to + 1).min(row_radius_m.len());
            cells.extend(rows.map(|row| row * columns as usize + column as usize));
        };
        let ((sin, cos), (end_sin, end_cos)) = (direction(column.into()), direction(f64::from(column) + 1.0));
        let (mid_sin, mid_cos) = direction(f64::from(column) + 0.5);
        let mut crossings = Vec::new();
        for [a, b] in edges(corners) {
            // Left of the column's beginning and right of its end; a single column is all there is.
            let part = if columns == 1 {
                Some([a, b])
            } else {
                clip([a, b], [-sin, cos], -TOUCH_M).and_then(|part| clip(part, [end_sin, -end_cos], -TOUCH_M))
            };
            if let Some(part) = part {
                let [x, y] = nearest_on(part, [0.0, 0.0]);
                let farthest = part.iter().map(|[x, y]| x.hypot(*y)).fold(0.0, f64::max);
                add(x.hypot(y) - TOUCH_M, farthest + TOUCH_M);
            }
            let across = |[x, y]: Xy| mid_cos * y - mid_sin * x;
            let (from, to) = (across(a), across(b));
            if (from > 0.0) != (to > 0.0) {
                let share = from / (from - to);
                let [x, y] = [a[0] + share * (b[0] - a[0]), a[1] + share * (b[1] - a[1])];
                crossings.push(x * mid_cos + y * mid_sin);
            }
        }
        crossings.retain(|range_m| *range_m > 0.0);
        // An odd number of borders lies ahead of a centre inside the polygon.
        if !crossings.len().is_multiple_of(2) {
            crossings.push(0.0);
        }
        crossings.sort_by(f64::total_cmp);
        crossings.chunks_exact(2).for_each(|pair| add(pair[0], pair[1]));
    }
    is_outside
}

/// The part of a stretch where `normal · p >= offset`; `None` if there is none.
fn clip([a, b]: [Xy; 2], normal: Xy, offset: f64) -> Option<[Xy; 2]> {
    let over = |p: Xy| normal[0] * p[0] + normal[1] * p[1] - offset;
    let (from, to) = (over(a), over(b));
    let border = || {
        let share = from / (from - to);
        [a[0] + share * (b[0] - a[0]), a[1] + share * (b[1] - a[1])]
    };
    match (from >= 0.0, to >= 0.0) {
        (true, true) => Some([a, b]),
        (true, false) => Some([a, border()]),
        (false, true) => Some([border(), b]),
        (false, false) => None,
    }
}

/// The edges of a polygon, the last one back to the first corner.
pub fn edges(polygon: &[Xy]) -> impl Iterator<Item = [Xy; 2]> {
    (0..polygon.len()).map(|index| [polygon[index], polygon[(index + 1) % polygon.len()]])
}

/// The place on a stretch that is nearest to a point.
pub fn nearest_on([a, b]: [Xy; 2], [x, y]: Xy) -> Xy {
    let (dx, dy) = (b[0] - a[0], b[1] - a[1]);
    let squared = dx * dx + dy * dy;
    let share = if squared > 0.0 { (((x - a[0]) * dx + (y - a[1]) * dy) / squared).clamp(0.0, 1.0) } else { 0.0 };
    [a[0] + share * dx, a[1] + share * dy]
}

/// Least and greatest of some values.
fn extent(values: impl Iterator<Item = f64>) -> (f64, f64) {
    values.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), value| (low.min(value), high.max(value)))
}
