//! Whether a vehicle's footprint is free, and where the nearest obstacle is.
//!
//! In: a layer with classes, and a rectangle or a point in the ego frame (x forward, y left, metres). Out: answers from
//! the meanings in the layer's legend. They consider every cell that the rectangle touches and the borders of cells,
//! not only their centres. Only the meaning free is free; a place outside the grid is not free.

use std::f64::consts::TAU;

use clearway_proto::grid::Grid;
use clearway_proto::map::Layer;
use clearway_proto::v1::ClassMeaning;

use crate::error::ClientError;
use crate::view::MapView;

/// Distance in metres below which a point touches a cell. Ours: far more than the rounding errors of a point on a map.
const TOUCH_M: f64 = 1e-9;

/// The rectangle of ground that a vehicle covers, including its border.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Footprint {
    /// Centre: distance forward, in metres.
    pub x_m: f64,
    /// Centre: distance to the left, in metres.
    pub y_m: f64,
    /// Heading in radians, counter-clockwise from the ego x axis.
    pub heading_rad: f64,
    /// Length along the heading, in metres.
    pub length_m: f64,
    /// Width across the heading, in metres.
    pub width_m: f64,
}

/// The nearest point of a cell that contains an obstacle.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Obstacle {
    /// Distance forward, in metres.
    pub x_m: f64,
    /// Distance to the left, in metres.
    pub y_m: f64,
    /// Distance from the given point, in metres; 0 if the point lies in such a cell. No obstacle of the layer is
    /// nearer. The obstacle itself can be farther away by up to the size of the cell, because a map does not state
    /// where in a cell it stands. The innermost cells of a radial grid start at the vehicle's origin, so an obstacle in
    /// one is 0 m from there.
    pub distance_m: f64,
    /// Direction from the given point in radians, counter-clockwise from the ego x axis, -π to π.
    pub bearing_rad: f64,
}

impl MapView {
    /// True if every cell that the footprint touches has a class that means free. False if a value of the footprint is
    /// not finite.
    ///
    /// # Errors
    /// [`ClientError::NoLayer`] if the map does not have the layer.
    pub fn is_free(&self, layer: &str, footprint: &Footprint) -> Result<bool, ClientError> {
        let layer = self.layer(layer)?;
        Ok(covers_only(&layer.grid, &footprint.corners(), &cells_that_mean(layer, ClassMeaning::Free)))
    }

    /// The obstacle of a layer that is nearest to a point; `None` if the layer has none. An obstacle can also stand in
    /// an unknown cell.
    ///
    /// # Errors
    /// [`ClientError::NoLayer`] if the map does not have the layer.
    pub fn nearest_obstacle(&self, layer: &str, x_m: f64, y_m: f64) -> Result<Option<Obstacle>, ClientError> {
        let layer = self.layer(layer)?;
        let obstacles = cells_that_mean(layer, ClassMeaning::Occupied);
        let found = (0..layer.grid.cell_count() as usize).filter(|&cell| obstacles(cell)).map(|cell| {
            let [x, y] = nearest_in(&layer.grid, cell, [x_m, y_m]);
            let (dx, dy) = (x - x_m, y - y_m);
            Obstacle { x_m: x, y_m: y, distance_m: dx.hypot(dy), bearing_rad: dy.atan2(dx) }
        });
        Ok(found.min_by(|a, b| a.distance_m.total_cmp(&b.distance_m)))
    }
}

impl Footprint {
    /// The corners (x, y) in metres, counter-clockwise, starting at the front right.
    pub fn corners(&self) -> [[f64; 2]; 4] {
        let (sin, cos) = self.heading_rad.sin_cos();
        let (ahead, left) = (self.length_m.abs() / 2.0, self.width_m.abs() / 2.0);
        [(ahead, -left), (ahead, left), (-ahead, left), (-ahead, -left)]
            .map(|(x, y)| [self.x_m + x * cos - y * sin, self.y_m + x * sin + y * cos])
    }
}

/// Returns a predicate on cell indices: true if the class of the cell has this meaning.
fn cells_that_mean(layer: &Layer, meaning: ClassMeaning) -> impl Fn(usize) -> bool {
    let has_meaning: Vec<bool> = layer.legend.iter().map(|class| class.meaning == meaning).collect();
    let classes = layer.channel("class").map(|channel| &channel.cells);
    move |cell| {
        let class = classes.and_then(|classes| classes.get(cell)).and_then(|raw| usize::try_from(raw).ok());
        class.and_then(|class| has_meaning.get(class).copied()).unwrap_or(false)
    }
}

/// True if every cell that a convex polygon touches satisfies `is_fit`, and the polygon lies inside the grid.
fn covers_only(grid: &Grid, corners: &[[f64; 2]], is_fit: &dyn Fn(usize) -> bool) -> bool {
    if corners.iter().flatten().any(|value| !value.is_finite()) {
        return false;
    }
    match grid {
        Grid::Radial { centre_m, row_radius_m, columns } => {
            let corners: Vec<_> = corners.iter().map(|corner| from_centre(*centre_m, *corner)).collect();
            (0..*columns).all(|column| column_fits(row_radius_m, (column, *columns), &corners, is_fit))
        }
        Grid::Cartesian { origin_x_m, origin_y_m, width, height, cell_m, yaw_rad, .. } => {
            let (sin, cos) = yaw_rad.sin_cos();
            let edge = f64::from(*cell_m);
            let in_cells =
                |[x, y]: &[f64; 2]| [(x * cos - y * sin - origin_x_m) / edge, (x * sin + y * cos - origin_y_m) / edge];
            let corners: Vec<_> = corners.iter().map(in_cells).collect();
            let slack = TOUCH_M / edge;
            let Some(rows) = touched(extent(&corners, 1), slack, *height) else { return false };
            rows.into_iter().all(|iy| {
                let above = clip(&corners, [0.0, 1.0], iy as f64 - slack);
                let strip = clip(&above, [0.0, -1.0], -(iy as f64 + 1.0 + slack));
                strip.is_empty()
                    || touched(extent(&strip, 0), slack, *width)
                        .is_some_and(|mut columns| columns.all(|ix| is_fit(iy * *width as usize + ix)))
            })
        }
    }
}

/// A position of the ego frame as seen from the centre of a radial grid.
fn from_centre(centre_m: [f32; 2], [x, y]: [f64; 2]) -> [f64; 2] {
    [x - f64::from(centre_m[0]), y - f64::from(centre_m[1])]
}

/// True if the part of a polygon in one column of a radial grid touches only cells that satisfy `is_fit`.
fn column_fits(
    row_radius_m: &[f32],
    (column, columns): (u32, u32),
    corners: &[[f64; 2]],
    is_fit: &dyn Fn(usize) -> bool,
) -> bool {
    let azimuth = |column: u32| (f64::from(column) / f64::from(columns) * TAU).sin_cos();
    let ((sin, cos), (end_sin, end_cos)) = (azimuth(column), azimuth(column + 1));
    // Left of the column's beginning and right of its end; a single column is all there is.
    let part = if columns == 1 {
        corners.to_vec()
    } else {
        clip(&clip(corners, [-sin, cos], -TOUCH_M), [end_sin, -end_cos], -TOUCH_M)
    };
    if part.is_empty() {
        return true;
    }
    let to_border = edges(&part).map(|edge| gap([0.0, 0.0], edge)).fold(f64::INFINITY, f64::min);
    let nearest = if contains(&part, [0.0, 0.0]) { 0.0 } else { to_border };
    let farthest = part.iter().map(|[x, y]| x.hypot(*y)).fold(0.0, f64::max);
    let row = |range_m: f64| row_radius_m.partition_point(|&outer| f64::from(outer) < range_m);
    let rows = row(nearest - TOUCH_M)..=row(farthest + TOUCH_M);
    *rows.end() < row_radius_m.len() && rows.into_iter().all(|row| is_fit(row * columns as usize + column as usize))
}

/// The part of a convex polygon where `normal · p >= offset`.
fn clip(polygon: &[[f64; 2]], normal: [f64; 2], offset: f64) -> Vec<[f64; 2]> {
    let over = |p: &[f64; 2]| normal[0] * p[0] + normal[1] * p[1] - offset;
    let mut part = Vec::with_capacity(polygon.len() + 1);
    for [from, to] in edges(polygon) {
        let (a, b) = (over(&from), over(&to));
        if a >= 0.0 {
            part.push(from);
        }
        if (a >= 0.0) != (b >= 0.0) {
            let share = a / (a - b);
            part.push([from[0] + share * (to[0] - from[0]), from[1] + share * (to[1] - from[1])]);
        }
    }
    part
}

fn edges(polygon: &[[f64; 2]]) -> impl Iterator<Item = [[f64; 2]; 2]> {
    (0..polygon.len()).map(|index| [polygon[index], polygon[(index + 1) % polygon.len()]])
}

/// Whether a point lies within a counter-clockwise convex polygon, its border left out.
fn contains(polygon: &[[f64; 2]], [x, y]: [f64; 2]) -> bool {
    edges(polygon).all(|[a, b]| (b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0]) > 0.0)
}

/// Distance from a point to a stretch.
fn gap(point: [f64; 2], stretch: [[f64; 2]; 2]) -> f64 {
    let [x, y] = nearest_on(stretch, point);
    (x - point[0]).hypot(y - point[1])
}

/// The place on a stretch that is nearest to a point.
fn nearest_on([a, b]: [[f64; 2]; 2], [x, y]: [f64; 2]) -> [f64; 2] {
    let (dx, dy) = (b[0] - a[0], b[1] - a[1]);
    let squared = dx * dx + dy * dy;
    let share = if squared > 0.0 { (((x - a[0]) * dx + (y - a[1]) * dy) / squared).clamp(0.0, 1.0) } else { 0.0 };
    [a[0] + share * dx, a[1] + share * dy]
}

/// Least and greatest of one coordinate.
fn extent(polygon: &[[f64; 2]], axis: usize) -> (f64, f64) {
    let values = polygon.iter().map(|point| point[axis]);
    values.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), value| (low.min(value), high.max(value)))
}

/// The cells of `count` in a row that a stretch touches, its ends in cells; `None` where it reaches outside.
fn touched((low, high): (f64, f64), slack: f64, count: u32) -> Option<std::ops::RangeInclusive<usize>> {
    let (low, high) = ((low - slack).floor(), (high + slack).floor());
    (low >= 0.0 && high < f64::from(count)).then_some(low as usize..=high as usize)
}

/// The place in a cell that is nearest to a point, ego frame.
fn nearest_in(grid: &Grid, cell: usize, [x, y]: [f64; 2]) -> [f64; 2] {
    match grid {
        // To the bit.
        _ if grid.cell_at(x, y) == Some(cell) => [x, y],
        Grid::Cartesian { origin_x_m, origin_y_m, width, cell_m, yaw_rad, .. } => {
            let (sin, cos) = yaw_rad.sin_cos();
            let edge = f64::from(*cell_m);
            let (ix, iy) = ((cell % *width as usize) as f64, (cell / *width as usize) as f64);
            let near_x = (x * cos - y * sin).clamp(origin_x_m + ix * edge, origin_x_m + (ix + 1.0) * edge);
            let near_y = (x * sin + y * cos).clamp(origin_y_m + iy * edge, origin_y_m + (iy + 1.0) * edge);
            [near_x * cos + near_y * sin, near_y * cos - near_x * sin]
        }
        Grid::Radial { centre_m, row_radius_m, columns } => {
            let [centre_x, centre_y] = centre_m.map(f64::from);
            let in_ego_frame = |[x, y]: [f64; 2]| [x + centre_x, y + centre_y];
            let [x, y] = from_centre(*centre_m, [x, y]);
            let (row, column) = (cell / *columns as usize, (cell % *columns as usize) as f64);
            let (inner, outer) =
                (if row == 0 { 0.0 } else { f64::from(row_radius_m[row - 1]) }, f64::from(row_radius_m[row]));
            let position = (y.atan2(x) / TAU).rem_euclid(1.0) * f64::from(*columns);
            if (column..=column + 1.0).contains(&position) {
                let range_m = x.hypot(y).clamp(inner, outer);
                let (sin, cos) = y.atan2(x).sin_cos();
                return in_ego_frame([range_m * cos, range_m * sin]);
            }
            // Beside the column, one of its two sides is nearest: an arc comes nearer towards its ends.
            let side = |column: f64| {
                let (sin, cos) = (column / f64::from(*columns) * TAU).sin_cos();
                nearest_on([[inner * cos, inner * sin], [outer * cos, outer * sin]], [x, y])
            };
            let distance = |[a, b]: [f64; 2]| (a - x).hypot(b - y);
            let (first, last) = (side(column), side(column + 1.0));
            in_ego_frame(if distance(first) <= distance(last) { first } else { last })
        }
    }
}
