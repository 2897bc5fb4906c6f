//! Links between neighbouring safe points, and which of them the vehicle gets to.
//!
//! In: the ridge. Out: the points the vehicle gets to, its own place first, each linked with points before it, one line
//! after the other: following the order of the points follows the lines.

use super::distance::Distances;
use super::free::State;
use super::ridge::{AROUND, Point, Ridge};

/// Points in the order they are reached.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Links {
    points: Vec<Point>,
    not_reached: usize,
}

impl Links {
    /// The vehicle's own place first; empty where no safe point was found.
    pub fn points(&self) -> &[Point] {
        &self.points
    }

    /// Safe points the vehicle has no way to.
    pub fn not_reached(&self) -> usize {
        self.not_reached
    }

    /// Links anew. The vehicle joins every line it can drive straight to within `join_cells`, at its nearest point.
    pub fn link(&mut self, ridge: &Ridge, states: &[State], distances: &Distances, width_cells: f64, join_cells: f64) {
        self.points.clear();
        let found = ridge.points();
        self.not_reached = found.len();
        // Between the four middle cells.
        let own_place = [ridge.side() as i32 - 1; 2];
        let Some(own_clearance) = distances.clearance_squared(own_place) else { return };
        if found.is_empty() {
            return;
        }
        let away_squared = |point: &Point| {
            let (dx, dy) = (point.place[0] - own_place[0], point.place[1] - own_place[1]);
            dx * dx + dy * dy
        };
        let mut nearest: Vec<(i32, usize)> = found.iter().enumerate().map(|(i, p)| (away_squared(p), i)).collect();
        nearest.retain(|(away, _)| f64::from(*away) <= 4.0 * join_cells * join_cells);
        nearest.sort_unstable();
        // A vehicle that stands nearer to a wall than a path would be may leave it, and need not come nearer.
        let room = width_cells.min(f64::from(own_clearance).sqrt());

        let own = Point { cell: 0, place: own_place, clearance_squared: own_clearance, links: Vec::new() };
        self.points.push(own);
        // By ridge point: its index among the points reached, less one.
        let mut reached = vec![None::<u32>; found.len()];
        for (_, first) in nearest {
            if reached[first].is_none() && is_clear(&found[first], own_place, states, distances, room) {
                self.follow(ridge, first, &mut reached);
            }
        }
        self.not_reached = found.len() + 1 - self.points.len();
        if self.points.len() == 1 {
            self.points.clear();
        }
    }

    /// Depth first along the lines from one point, which is linked with the vehicle.
    fn follow(&mut self, ridge: &Ridge, first: usize, reached: &mut [Option<u32>]) {
        let found = ridge.points();
        let mut open = vec![first];
        while let Some(index) = open.pop() {
            if reached[index].is_some() {
                continue;
            }
            let neighbours = neighbours(ridge, &found[index]);
            let mut links: Vec<u32> = neighbours.iter().filter_map(|&n| reached[n]).collect();
            if index == first {
                links.push(0);
            }
            links.sort_unstable();
            reached[index] = Some(self.points.len() as u32);
            self.points.push(Point { links, ..found[index].clone() });
            open.extend(neighbours.iter().rev().filter(|&&n| reached[n].is_none()));
        }
    }
}

/// Points in the cells around, but no corner that a side leads to as well.
fn neighbours(ridge: &Ridge, point: &Point) -> Vec<usize> {
    let (ix, iy) = ((point.cell % ridge.side()) as i32, (point.cell / ridge.side()) as i32);
    let held = AROUND.map(|[dx, dy]| ridge.point_in(ix + dx, iy + dy));
    let is_side = |i: usize| i.is_multiple_of(2);
    let led_to = |i: usize| held[(i + 7) % 8].is_some() || held[(i + 1) % 8].is_some();
    (0..8).filter(|&i| is_side(i) || !led_to(i)).filter_map(|i| held[i]).collect()
}

/// Whether the straight way from a place to a point is free and has that room on it, half cells.
fn is_clear(point: &Point, from: [i32; 2], states: &[State], distances: &Distances, room: f64) -> bool {
    let (dx, dy) = (point.place[0] - from[0], point.place[1] - from[1]);
    // A look every half cell.
    let steps = dx.abs().max(dy.abs()).max(1);
    (0..=steps).all(|step| {
        let place = [from[0] + dx * step / steps, from[1] + dy * step / steps];
        let cell = (place[1] / 2) as usize * distances.side() + (place[0] / 2) as usize;
        let clearance = distances.clearance_squared(place);
        states[cell].is_free() && clearance.is_some_and(|squared| f64::from(squared).sqrt() >= room)
    })
}
