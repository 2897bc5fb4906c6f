//! Links between neighbouring safe points, and which points the vehicle can reach.
//!
//! In: the medial axis. Out: the points the vehicle can reach, its own position first, each linked with points before
//! it. The points come line by line, so that their order follows the lines.

use super::distance::Distances;
use super::free_space::State;
use super::medial_axis::{AROUND, MedialAxis, Point};

/// Points in the order in which they are reached.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Links {
    points: Vec<Point>,
    not_reached: usize,
    /// Memory of links that no point uses.
    spare: Vec<Vec<u32>>,
    /// Squared distance of each point of the axis from the vehicle, and its index.
    nearest: Vec<(i32, usize)>,
    /// By point of the axis: its index among the reached points.
    reached: Vec<Option<u32>>,
    /// Points whose lines are still to be followed.
    open: Vec<usize>,
}

impl Links {
    /// The reached points, the vehicle's own position first; empty if no safe point is reached.
    pub fn points(&self) -> &[Point] {
        &self.points
    }

    /// Number of safe points the vehicle cannot reach.
    pub fn not_reached(&self) -> usize {
        self.not_reached
    }

    /// Computes the links. The vehicle joins each line that it can drive straight to within `join_cells`, at the line's
    /// nearest point.
    pub fn link(
        &mut self,
        axis: &MedialAxis,
        states: &[State],
        distances: &Distances,
        width_cells: f64,
        join_cells: f64,
    ) {
        self.spare.extend(self.points.drain(..).map(|point| point.links));
        let found = axis.points();
        self.not_reached = found.len();
        // The vehicle's own position lies between the four middle cells.
        let own_position = [axis.side() as i32 - 1; 2];
        let Some(own_clearance) = distances.clearance_squared(own_position) else { return };
        if found.is_empty() {
            return;
        }
        let away_squared = |point: &Point| {
            let (dx, dy) = (point.position[0] - own_position[0], point.position[1] - own_position[1]);
            dx * dx + dy * dy
        };
        self.nearest.clear();
        self.nearest.extend(found.iter().enumerate().map(|(i, p)| (away_squared(p), i)));
        self.nearest.retain(|(away, _)| f64::from(*away) <= 4.0 * join_cells * join_cells);
        self.nearest.sort_unstable();
        // A vehicle nearer to a wall than a path would be may drive away from it, but not nearer to it.
        let clearance = width_cells.min(f64::from(own_clearance).sqrt());

        let own = Point { cell: 0, position: own_position, clearance_squared: own_clearance, links: Vec::new() };
        self.points.push(own);
        self.reached.clear();
        self.reached.resize(found.len(), None);
        for at in 0..self.nearest.len() {
            let first = self.nearest[at].1;
            if self.reached[first].is_none() && is_clear(&found[first], own_position, states, distances, clearance) {
                self.add_lines(axis, first);
            }
        }
        self.not_reached = found.len() + 1 - self.points.len();
        if self.points.len() == 1 {
            self.spare.extend(self.points.drain(..).map(|point| point.links));
        }
    }

    /// Adds the points of the lines that start at one point, depth first. That point is linked with the vehicle.
    fn add_lines(&mut self, axis: &MedialAxis, first: usize) {
        let found = axis.points();
        self.open.push(first);
        while let Some(index) = self.open.pop() {
            if self.reached[index].is_some() {
                continue;
            }
            let neighbours = neighbours(axis, &found[index]);
            let neighbours = neighbours.iter().flatten().copied();
            let mut links = self.spare.pop().unwrap_or_default();
            links.clear();
            links.extend(neighbours.clone().filter_map(|n| self.reached[n]));
            if index == first {
                links.push(0);
            }
            links.sort_unstable();
            self.reached[index] = Some(self.points.len() as u32);
            let Point { cell, position, clearance_squared, .. } = found[index];
            self.points.push(Point { cell, position, clearance_squared, links });
            self.open.extend(neighbours.rev().filter(|n| self.reached[*n].is_none()));
        }
    }
}

/// Indices of the points in the neighbouring cells, without corners that are reached across a side as well.
fn neighbours(axis: &MedialAxis, point: &Point) -> [Option<usize>; 8] {
    let (ix, iy) = ((point.cell % axis.side()) as i32, (point.cell / axis.side()) as i32);
    let points = AROUND.map(|[dx, dy]| axis.point_in(ix + dx, iy + dy));
    let is_side = |i: usize| i.is_multiple_of(2);
    let beside_a_side = |i: usize| points[(i + 7) % 8].is_some() || points[(i + 1) % 8].is_some();
    std::array::from_fn(|i| points[i].filter(|_| is_side(i) || !beside_a_side(i)))
}

/// True if the straight line from a position to a point is free, and each of its positions is at least `clearance_min`
/// half cells away from obstacles.
fn is_clear(point: &Point, from: [i32; 2], states: &[State], distances: &Distances, clearance_min: f64) -> bool {
    let (dx, dy) = (point.position[0] - from[0], point.position[1] - from[1]);
    // One sample for each half cell.
    let steps = dx.abs().max(dy.abs()).max(1);
    (0..=steps).all(|step| {
        let position = [from[0] + dx * step / steps, from[1] + dy * step / steps];
        let cell = (position[1] / 2) as usize * distances.side() + (position[0] / 2) as usize;
        let clearance = distances.clearance_squared(position);
        states[cell].is_free() && clearance.is_some_and(|squared| f64::from(squared).sqrt() >= clearance_min)
    })
}
