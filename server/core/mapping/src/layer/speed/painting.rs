//! Scan conversion of a road into the grid, as a speed bonus (Lindström 2005, section 3.2).
//!
//! In: the road's points (ego frame, metres) and widths. Out: the bonus of each cell whose centre lies on the road. The
//! direction at a point is that from the point before to the point after. The edge points lie half the width to each
//! side. Each pair of points with its four edge points is one convex piece, which is painted row by row (section
//! 3.2.1). If pieces overlap, in bends, the larger bonus is kept, so that their order does not matter.

use super::config::{BONUS_REACH_M, Bonus, SpeedConfig};

/// Bonus of a cell that is not on the road.
pub const NO_ROAD: f32 = -1.0;

/// Painter of roads into a grid of `side` cells along x and y with the vehicle in the middle.
#[derive(Clone, Debug, PartialEq)]
pub struct Painter {
    side: usize,
    cell_m: f64,
    style: Bonus,
    bonus_max_mps: f32,
    reach_m: f32,
    bonus_mps: Vec<f32>,
    /// True if a road was painted since the grid was last cleared.
    painted: bool,
    /// By point of the road: its edge points left and right, ego frame, metres.
    edges: Vec<[[f64; 2]; 2]>,
}

impl Painter {
    /// A grid without a road.
    pub fn new(side: usize, config: &SpeedConfig) -> Self {
        Self {
            side,
            cell_m: f64::from(config.cell_m),
            style: config.bonus,
            bonus_max_mps: config.bonus_mps,
            reach_m: BONUS_REACH_M,
            bonus_mps: vec![NO_ROAD; side * side],
            painted: false,
            edges: Vec::new(),
        }
    }

    /// Bonus by cell, m/s: [`NO_ROAD`], or 0 or more.
    pub fn bonus_mps(&self) -> &[f32] {
        &self.bonus_mps
    }

    /// Removes all roads.
    pub fn clear(&mut self) {
        if self.painted {
            self.bonus_mps.fill(NO_ROAD);
            self.painted = false;
        }
    }

    /// Paints one road: points that [`crate::road::check`] accepted, and their widths, metres.
    pub fn paint(&mut self, points: &[[f64; 2]], widths_m: &[f64]) {
        self.painted = true;
        edge_points(points, widths_m, &mut self.edges);
        for i in 0..points.len().saturating_sub(1) {
            let ([left, right], [next_left, next_right]) = (self.edges[i], self.edges[i + 1]);
            let radii = [widths_m[i] / 2.0, widths_m[i + 1] / 2.0];
            if let Some(piece) = Piece::new([points[i], points[i + 1]], radii) {
                self.paint_piece(&[left, next_left, next_right, right], &piece);
            }
        }
    }

    fn paint_piece(&mut self, corners: &[[f64; 2]; 4], piece: &Piece) {
        let middle = self.side as f64 / 2.0;
        // Positions in cells: the centre of cell i is i.
        let in_cells = |m: f64| m / self.cell_m + middle - 0.5;
        let corners = corners.map(|[x, y]| [in_cells(x), in_cells(y)]);
        let lowest = corners.iter().map(|c| c[1]).fold(f64::INFINITY, f64::min);
        let highest = corners.iter().map(|c| c[1]).fold(f64::NEG_INFINITY, f64::max);
        for iy in cells_between(lowest, highest, self.side) {
            let Some((from, to)) = span(&corners, iy as f64) else { continue };
            let columns = cells_between(from, to, self.side);
            let in_metres = |cells: usize| (cells as f64 + 0.5 - middle) * self.cell_m;
            let start = piece.at([in_metres(columns.start), in_metres(iy)]);
            let row = &mut self.bonus_mps[iy * self.side..][columns];
            let step = piece.along_x(self.cell_m);
            match self.style {
                Bonus::Uniform => row.iter_mut().for_each(|cell| *cell = cell.max(self.bonus_max_mps)),
                Bonus::Absolute => {
                    let reach_squared = self.reach_m * self.reach_m;
                    paint_row(row, start, step, self.bonus_max_mps, |_| reach_squared);
                }
                Bonus::Relative => paint_row(row, start, step, self.bonus_max_mps, |radius| radius * radius),
            }
        }
    }
}

/// Paints one row of a piece. Distance and radius are linear along the row, so that a cell costs 2 multiplications for
/// them, 2 for the squares, and 1 division and 1 multiplication for the bonus; the paper states 8 multiplications and 1
/// division (section 3.2.2).
#[inline(always)]
fn paint_row(row: &mut [f32], start: Across, step: Across, bonus_max: f32, scale_squared: impl Fn(f32) -> f32) {
    for (k, cell) in row.iter_mut().enumerate() {
        let k = k as f32;
        let distance = start.distance_m + k * step.distance_m;
        let radius = start.radius_m + k * step.radius_m;
        let relative_squared = distance * distance / scale_squared(radius);
        let bonus = bonus_max * (1.0 - relative_squared);
        // The bonus is 0 at the edge, and beyond it on the outside of a bend. `max` returns 0 for NaN (0/0).
        *cell = cell.max(bonus.max(0.0));
    }
}

/// Position of a point across the road.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Across {
    /// Distance from the centre line, metres, positive to the left.
    distance_m: f32,
    /// Half the road's width at the same place along it, metres.
    radius_m: f32,
}

/// One pair of points: `d` and `r(t)` (Lindström 2005, section 3.2.2) as linear functions of the position.
struct Piece {
    from: [f64; 2],
    /// Unit vector along the piece.
    along: [f64; 2],
    /// Half widths at both ends, metres.
    radii_m: [f64; 2],
    /// Length of the piece, metres.
    length_m: f64,
}

impl Piece {
    /// The piece of two points; `None` if they are equal.
    fn new([from, to]: [[f64; 2]; 2], radii_m: [f64; 2]) -> Option<Self> {
        let (dx, dy) = (to[0] - from[0], to[1] - from[1]);
        let length_m = libm::hypot(dx, dy);
        (length_m > 0.0).then(|| Self { from, along: [dx / length_m, dy / length_m], radii_m, length_m })
    }

    /// Distance and radius at a position.
    fn at(&self, [x, y]: [f64; 2]) -> Across {
        let (qx, qy) = (x - self.from[0], y - self.from[1]);
        let [ax, ay] = self.along;
        let t = (ax * qx + ay * qy) / self.length_m;
        let [r0, r1] = self.radii_m;
        Across { distance_m: (ax * qy - ay * qx) as f32, radius_m: (r0 + t * (r1 - r0)) as f32 }
    }

    /// Change of distance and radius over `x_m` along x.
    fn along_x(&self, x_m: f64) -> Across {
        let [ax, ay] = self.along;
        let [r0, r1] = self.radii_m;
        Across { distance_m: (-ay * x_m) as f32, radius_m: (ax * x_m / self.length_m * (r1 - r0)) as f32 }
    }
}

/// Computes the edge points of each point: half the width to the left and to the right of the direction there.
pub fn edge_points(points: &[[f64; 2]], widths_m: &[f64], edges: &mut Vec<[[f64; 2]; 2]>) {
    edges.clear();
    let last = points.len().saturating_sub(1);
    for (i, (&[x, y], &width)) in points.iter().zip(widths_m).enumerate() {
        let direction = |from: usize, to: usize| {
            let (dx, dy) = (points[to][0] - points[from][0], points[to][1] - points[from][1]);
            (dx, dy, libm::hypot(dx, dy))
        };
        let (mut dx, mut dy, mut length) = direction(i.saturating_sub(1), (i + 1).min(last));
        if length == 0.0 {
            // The road turns back on itself: the direction from the point before counts.
            (dx, dy, length) = direction(i.saturating_sub(1), i);
        }
        let half = if length > 0.0 { width / 2.0 / length } else { 0.0 };
        edges.push([[x - dy * half, y + dx * half], [x + dy * half, y - dx * half]]);
    }
}

/// Range of x in which the line through the cell centres of row `y` crosses a polygon; `None` if it does not.
fn span(corners: &[[f64; 2]; 4], y: f64) -> Option<(f64, f64)> {
    let (mut from, mut to) = (f64::INFINITY, f64::NEG_INFINITY);
    for i in 0..4 {
        let ([ax, ay], [bx, by]) = (corners[i], corners[(i + 1) % 4]);
        if (ay <= y) != (by <= y) {
            let x = ax + (y - ay) / (by - ay) * (bx - ax);
            (from, to) = (from.min(x), to.max(x));
        }
    }
    (from <= to).then_some((from, to))
}

/// Indices of the cells whose centres lie between two positions, which are in cells.
fn cells_between(from: f64, to: f64, side: usize) -> std::ops::Range<usize> {
    // `as` saturates, so that positions far outside become the grid's border.
    let start = from.ceil().max(0.0) as usize;
    let end = ((to.floor() + 1.0).max(0.0) as usize).min(side);
    start.min(end)..end
}
