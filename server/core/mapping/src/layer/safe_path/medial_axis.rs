//! Medial axis: positions at equal distances from two obstacles.
//!
//! In: states and distances. Out: safe points on lines one cell wide. If the nearest sites of two neighbouring cells
//! are two different obstacles, the position at equal distances from both lies between the cells, and the cell nearer
//! to it is on the axis (the integer medial axis of Hesselink and Roerdink 2008). Sites nearer to one another than the
//! vehicle's width count as one obstacle: the vehicle does not fit between them, and without this rule each dent in a
//! wall would give a line. The point of a cell is its centre or the middle between it and that neighbour, whichever is
//! farther from obstacles, so that a passage an even number of cells wide gets its true width.

use crate::layer::maker::SafePoint;

use super::distance::Distances;
use super::free_space::State;

/// Steps to the eight neighbours: right, then counter-clockwise.
pub const AROUND: [[i32; 2]; 8] = [[1, 0], [1, 1], [0, 1], [-1, 1], [-1, 0], [-1, -1], [0, -1], [1, -1]];

/// A safe point on the grid.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Point {
    /// Index of its cell.
    pub cell: usize,
    /// Position in half cells; the centre of cell (ix, iy) is (2 ix, 2 iy).
    pub position: [i32; 2],
    /// Squared distance to the square of the nearest cell that is not free, in half cells.
    pub clearance_squared: i32,
    /// Indices of the points before this one with which it is linked.
    pub links: Vec<u32>,
}

impl Point {
    /// The point in metres, ego frame. `links` is memory for its links.
    pub fn in_metres(&self, side: usize, cell_m: f64, mut links: Vec<u32>) -> SafePoint {
        links.clone_from(&self.links);
        let metres = |half_cells: i32| (f64::from(half_cells + 1) - side as f64) / 2.0 * cell_m;
        SafePoint {
            x_m: metres(self.position[0]),
            y_m: metres(self.position[1]),
            radius_m: f64::from(self.clearance_squared).sqrt() / 2.0 * cell_m,
            links,
        }
    }
}

/// Medial axis of a grid of `side` cells along x and y.
#[derive(Clone, Debug, PartialEq)]
pub struct MedialAxis {
    side: usize,
    /// By cell: one bit for each of the neighbours in [`ACROSS`], set if its nearest obstacle is another one.
    across: Vec<u8>,
    /// By cell: 1 + index into `points`; 0 if the cell is not on the axis.
    point_of_cell: Vec<u32>,
    points: Vec<Point>,
    /// Indices of the cells with a bit in `across`.
    marked: Vec<u32>,
    /// Clearance and cell of the points that thinning may still remove.
    order: Vec<(i32, usize)>,
}

/// Bits of `across`, with the step to the neighbour in cells, which is the step to the position between in half cells.
const ACROSS: [(u8, [i32; 2]); 4] = [(1, [1, 0]), (2, [-1, 0]), (4, [0, 1]), (8, [0, -1])];

impl MedialAxis {
    /// An axis without points.
    pub fn new(side: usize) -> Self {
        let cells = side * side;
        let (points, marked, order) = Default::default();
        Self { side, across: vec![0; cells], point_of_cell: vec![0; cells], points, marked, order }
    }

    /// Number of cells along x, and along y.
    pub fn side(&self) -> usize {
        self.side
    }

    /// Points in the order of their cells, without links.
    pub fn points(&self) -> &[Point] {
        &self.points
    }

    /// Index of the point in a cell; `None` if the cell has none.
    pub fn point_in(&self, ix: i32, iy: i32) -> Option<usize> {
        let side = self.side as i32;
        let inside = (0..side).contains(&ix) && (0..side).contains(&iy);
        if !inside {
            return None;
        }
        (self.point_of_cell[(iy * side + ix) as usize] as usize).checked_sub(1)
    }

    /// Finds the points at which a vehicle `width_cells` wide fits.
    pub fn find(&mut self, states: &[State], distances: &Distances, width_cells: f64) {
        self.mark(states, distances, width_cells);
        self.make_points(states, distances, width_cells);
        self.thin();
        for (index, point) in self.points.iter().enumerate() {
            self.point_of_cell[point.cell] = index as u32 + 1;
        }
    }

    /// Marks the cells on the axis.
    fn mark(&mut self, states: &[State], distances: &Distances, width_cells: f64) {
        // Points of the last map lie only in marked cells.
        for &cell in &self.marked {
            (self.across[cell as usize], self.point_of_cell[cell as usize]) = (0, 0);
        }
        self.marked.clear();
        let side = self.side;
        let apart_min = (width_cells * width_cells).ceil() as i32;
        for iy in 0..side {
            for ix in 0..side {
                let p = iy * side + ix;
                if !states[p].is_free() {
                    continue;
                }
                let Some(site) = distances.site(ix, iy) else { return };
                // Each cell is compared with the next column and the next row.
                for (exists, [qx, qy], to, back) in
                    [(ix + 1 < side, [ix + 1, iy], 1, 2), (iy + 1 < side, [ix, iy + 1], 4, 8)]
                {
                    let q = qy * side + qx;
                    if !exists || !states[q].is_free() {
                        continue;
                    }
                    let Some(other) = distances.site(qx, qy) else { return };
                    let apart = [site[0] - other[0], site[1] - other[1]];
                    if apart[0] * apart[0] + apart[1] * apart[1] < apart_min {
                        continue;
                    }
                    // |site - m|² - |other - m|² with m between p and q is not negative if the position at equal
                    // distances lies on p's side.
                    let sum = [site[0] + other[0] - (ix + qx) as i32, site[1] + other[1] - (iy + qy) as i32];
                    let on_p = apart[0] * sum[0] + apart[1] * sum[1] >= 0;
                    let (cell, bit) = if on_p { (p, to) } else { (q, back) };
                    if self.across[cell] == 0 {
                        self.marked.push(cell as u32);
                    }
                    self.across[cell] |= bit;
                }
            }
        }
        self.marked.sort_unstable();
    }

    /// Makes points of the marked cells that are drivable and wide enough.
    fn make_points(&mut self, states: &[State], distances: &Distances, width_cells: f64) {
        self.points.clear();
        let side = self.side;
        for &cell in &self.marked {
            let cell = cell as usize;
            if states[cell] != State::Drivable {
                continue;
            }
            let centre = [2 * (cell % side) as i32, 2 * (cell / side) as i32];
            let Some(mut best) = distances.clearance_squared(centre).map(|clearance| (clearance, centre)) else {
                return;
            };
            for (bit, [dx, dy]) in ACROSS {
                let neighbour = cell as i32 + dx + dy * side as i32;
                if self.across[cell] & bit == 0 || states[neighbour as usize] != State::Drivable {
                    continue;
                }
                let position = [centre[0] + dx, centre[1] + dy];
                if let Some(clearance) = distances.clearance_squared(position)
                    && clearance > best.0
                {
                    best = (clearance, position);
                }
            }
            // Twice the radius in half cells is the free width in cells.
            if f64::from(best.0) >= width_cells * width_cells {
                self.points.push(Point { cell, position: best.1, clearance_squared: best.0, links: Vec::new() });
            }
        }
    }

    /// Removes points until lines are one cell wide, those nearest to obstacles first. A point is removed if its
    /// neighbours stay connected without it, unless it is the end of a line.
    fn thin(&mut self) {
        self.points.iter().for_each(|point| self.point_of_cell[point.cell] = 1);
        let mut order = std::mem::take(&mut self.order);
        order.clear();
        order.extend(self.points.iter().map(|p| (p.clearance_squared, p.cell)));
        order.sort_unstable();
        loop {
            let before = order.len();
            order.retain(|&(_, cell)| {
                let (ix, iy) = ((cell % self.side) as i32, (cell / self.side) as i32);
                let has_point = AROUND.map(|[dx, dy]| self.point_in(ix + dx, iy + dy).is_some());
                let removed = has_point.iter().filter(|has| **has).count() >= 2 && is_simple(has_point);
                if removed {
                    self.point_of_cell[cell] = 0;
                }
                !removed
            });
            if order.len() == before {
                break;
            }
        }
        self.order = order;
        self.points.retain(|point| self.point_of_cell[point.cell] != 0);
    }
}

/// True if the neighbours stay connected, by sides and corners, without the point in their middle: Yokoi's connectivity
/// number is 1.
fn is_simple(has_point: [bool; 8]) -> bool {
    let empty = |i: usize| u8::from(!has_point[i % 8]);
    let number: u8 = [0, 2, 4, 6].iter().map(|&i| empty(i) - empty(i) * empty(i + 1) * empty(i + 2)).sum();
    number == 1
}
