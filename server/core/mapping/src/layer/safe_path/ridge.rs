//! The ridge of the distances: where two obstacles are equally far.
//!
//! In: states and distances. Out: safe points on lines one cell wide. Two neighbouring cells whose nearest sites are
//! two obstacles have the place that is equally far from both between them; the one nearer to that place is on the
//! ridge (the integer medial axis of Hesselink and Roerdink 2008). Sites nearer to one another than the vehicle is wide
//! count as one obstacle: nothing passes between them, and every dent of a wall would draw a line. A ridge cell's point
//! is its middle or the middle between it and that neighbour, whichever has more room, so that a gate an even number of
//! cells wide has its true width.

use super::distance::Distances;
use super::free::State;
use crate::layer::maker::SafePoint;

/// Neighbours in turning order: right, then counter-clockwise.
pub const AROUND: [[i32; 2]; 8] = [[1, 0], [1, 1], [0, 1], [-1, 1], [-1, 0], [-1, -1], [0, -1], [1, -1]];

/// A safe point on the grid.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Point {
    /// Its cell's index.
    pub cell: usize,
    /// Half cells, the middle of cell (ix, iy) at (2 ix, 2 iy).
    pub place: [i32; 2],
    /// To the nearest square of a cell that is not free, half cells, squared.
    pub clearance_squared: i32,
    /// Points before this one that it is linked with.
    pub links: Vec<u32>,
}

impl Point {
    /// As a map holds it.
    pub fn in_metres(&self, side: usize, cell_m: f64) -> SafePoint {
        let metres = |half_cells: i32| (f64::from(half_cells + 1) - side as f64) / 2.0 * cell_m;
        SafePoint {
            x_m: metres(self.place[0]),
            y_m: metres(self.place[1]),
            radius_m: f64::from(self.clearance_squared).sqrt() / 2.0 * cell_m,
            links: self.links.clone(),
        }
    }
}

/// Ridge cells of a grid of `side` cells along x and y.
#[derive(Clone, Debug, PartialEq)]
pub struct Ridge {
    side: usize,
    /// By cell: bit d where the neighbour across d, of right, left (x), left, right (y), has another obstacle.
    across: Vec<u8>,
    /// By cell: 1 + index into `points`; 0 off the ridge.
    point_of_cell: Vec<u32>,
    points: Vec<Point>,
    marked: Vec<u32>,
}

/// Bits of `across`, with the half-cell step to the place between.
const ACROSS: [(u8, [i32; 2]); 4] = [(1, [1, 0]), (2, [-1, 0]), (4, [0, 1]), (8, [0, -1])];

impl Ridge {
    /// Without points.
    pub fn new(side: usize) -> Self {
        let cells = side * side;
        Self { side, across: vec![0; cells], point_of_cell: vec![0; cells], points: Vec::new(), marked: Vec::new() }
    }

    /// Cells along x, and along y.
    pub fn side(&self) -> usize {
        self.side
    }

    /// In the order of their cells, without links.
    pub fn points(&self) -> &[Point] {
        &self.points
    }

    /// Index of the point in a cell.
    pub fn point_in(&self, ix: i32, iy: i32) -> Option<usize> {
        let side = self.side as i32;
        let inside = (0..side).contains(&ix) && (0..side).contains(&iy);
        if !inside {
            return None;
        }
        (self.point_of_cell[(iy * side + ix) as usize] as usize).checked_sub(1)
    }

    /// Finds the points where a vehicle `width_cells` wide fits.
    pub fn find(&mut self, states: &[State], distances: &Distances, width_cells: f64) {
        self.mark(states, distances, width_cells);
        self.keep(states, distances, width_cells);
        self.thin();
        for (index, point) in self.points.iter().enumerate() {
            self.point_of_cell[point.cell] = index as u32 + 1;
        }
    }

    fn mark(&mut self, states: &[State], distances: &Distances, width_cells: f64) {
        // No point lies in any other cell.
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
                // Towards the next column and the next row; the other two ways come from there.
                for (there, [qx, qy], to, back) in
                    [(ix + 1 < side, [ix + 1, iy], 1, 2), (iy + 1 < side, [ix, iy + 1], 4, 8)]
                {
                    let q = qy * side + qx;
                    if !there || !states[q].is_free() {
                        continue;
                    }
                    let Some(other) = distances.site(qx, qy) else { return };
                    let apart = [site[0] - other[0], site[1] - other[1]];
                    if apart[0] * apart[0] + apart[1] * apart[1] < apart_min {
                        continue;
                    }
                    // |site - m|² - |other - m|² with m between p and q: not negative where the place that is equally
                    // far lies on p's side.
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

    /// Makes points of the marked cells that are drivable and have room.
    fn keep(&mut self, states: &[State], distances: &Distances, width_cells: f64) {
        self.points.clear();
        let side = self.side;
        for &cell in &self.marked {
            let cell = cell as usize;
            if states[cell] != State::Drivable {
                continue;
            }
            let middle = [2 * (cell % side) as i32, 2 * (cell / side) as i32];
            let Some(mut best) = distances.clearance_squared(middle).map(|clearance| (clearance, middle)) else {
                return;
            };
            for (bit, [dx, dy]) in ACROSS {
                let neighbour = cell as i32 + dx + dy * side as i32;
                if self.across[cell] & bit == 0 || states[neighbour as usize] != State::Drivable {
                    continue;
                }
                let place = [middle[0] + dx, middle[1] + dy];
                if let Some(clearance) = distances.clearance_squared(place)
                    && clearance > best.0
                {
                    best = (clearance, place);
                }
            }
            // Twice the radius, half cells, is the free width in cells.
            if f64::from(best.0) >= width_cells * width_cells {
                self.points.push(Point { cell, place: best.1, clearance_squared: best.0, links: Vec::new() });
            }
        }
    }

    /// Takes points away, those with the least room first, until lines are one cell wide: a point whose neighbours hang
    /// together without it, unless it is the end of a line.
    fn thin(&mut self) {
        self.points.iter().for_each(|point| self.point_of_cell[point.cell] = 1);
        let mut order: Vec<(i32, usize)> = self.points.iter().map(|p| (p.clearance_squared, p.cell)).collect();
        order.sort_unstable();
        loop {
            let before = order.len();
            order.retain(|&(_, cell)| {
                let (ix, iy) = ((cell % self.side) as i32, (cell / self.side) as i32);
                let held = AROUND.map(|[dx, dy]| self.point_in(ix + dx, iy + dy).is_some());
                let removed = held.iter().filter(|held| **held).count() >= 2 && is_simple(held);
                if removed {
                    self.point_of_cell[cell] = 0;
                }
                !removed
            });
            if order.len() == before {
                break;
            }
        }
        self.points.retain(|point| self.point_of_cell[point.cell] != 0);
    }
}

/// Whether the points around hang together, by sides and corners, without the middle: Yokoi's number is 1.
fn is_simple(held: [bool; 8]) -> bool {
    let empty = |i: usize| u8::from(!held[i % 8]);
    let number: u8 = [0, 2, 4, 6].iter().map(|&i| empty(i) - empty(i) * empty(i + 1) * empty(i + 2)).sum();
    number == 1
}
