//! Far ground counts as reached only in the directions in which the vehicle gets to it near.
//!
//! In: by cell whether the middle of the vehicle's disc gets there. Out: reached cells without those that only a detour
//! over farther ground leads to, or a way around what closes their direction near. Rings lie metres apart far away, so
//! that no return shows a kerb, a ditch or a rail there; but near the vehicle the same edge was seen.

use std::f32::consts::TAU;

use super::cells::{SIDE, centre_m};
use super::flood::{Bits, Flood};

/// Number of directions. Ours: those of the ground's estimate.
const DIRECTIONS: usize = 180;
/// The edges of near ground. Ours; tuned on the even seeds of the random worlds.
const EDGES: [Edge; 2] = [Edge { range_m: 15.0, beside: 8 }, Edge { range_m: 25.0, beside: 5 }];
/// Depth of near ground at its edge in which a direction must be reached, metres. Ours; tuned as the edges.
const DEPTH_M: f32 = 6.0;

/// An edge of near ground.
struct Edge {
    /// Distance from the vehicle, metres.
    range_m: f32,
    /// Number of directions on each side of a reached one that are open too.
    beside: usize,
}

/// The cells by edge and direction.
#[derive(Clone)]
pub struct Directions {
    /// By edge: the cells nearer than it.
    near: Vec<Bits>,
    /// By edge and direction: the cells of near ground at the edge.
    inside: Vec<Vec<u32>>,
    /// By edge and direction: word of [`Bits`], and its bits of cells beyond the edge, up to the next one.
    beyond: Vec<Vec<(u32, u64)>>,
}

impl Directions {
    /// The directions of the reach stage's cells.
    pub fn new() -> Self {
        let mut near = EDGES.map(|_| Bits::square(SIDE)).to_vec();
        let mut inside = vec![Vec::new(); EDGES.len() * DIRECTIONS];
        let mut beyond: Vec<Vec<(u32, u64)>> = inside.iter().map(|_| Vec::new()).collect();
        for cell in 0..SIDE * SIDE {
            let [x, y] = centre_m(cell);
            let (range_m, direction) = (libm::hypotf(x, y), direction(x, y));
            for (edge, Edge { range_m: edge_m, .. }) in EDGES.iter().enumerate() {
                if range_m < *edge_m {
                    near[edge].set(cell % SIDE, cell / SIDE);
                    if range_m >= edge_m - DEPTH_M {
                        inside[edge * DIRECTIONS + direction].push(cell as u32);
                    }
                }
            }
            let passed = EDGES.iter().filter(|edge| range_m >= edge.range_m).count();
            if let Some(edge) = passed.checked_sub(1) {
                let (word, bit) = near[edge].place(cell % SIDE, cell / SIDE);
                let words = &mut beyond[edge * DIRECTIONS + direction];
                match words.last_mut() {
                    Some((last, bits)) if *last == word => *bits |= bit,
                    _ => words.push((word, bit)),
                }
            }
        }
        Self { near, inside, beyond }
    }

    /// By edge, from the nearest: the cells nearer than it.
    pub fn near(&self) -> &[Bits] {
        &self.near
    }

    /// Removes the reached cells beyond an edge in directions that are closed there.
    pub fn close(&self, flood: &mut Flood) {
        let mut is_open = [true; DIRECTIONS];
        for (edge, Edge { beside, .. }) in EDGES.iter().enumerate() {
            let of_edge = edge * DIRECTIONS..(edge + 1) * DIRECTIONS;
            let is_reached = |cell: &u32| flood.is_middle(*cell as usize % SIDE, *cell as usize / SIDE);
            let mut leads_on = [false; DIRECTIONS];
            for direction in (0..DIRECTIONS).filter(|at| self.inside[of_edge.start + at].iter().any(is_reached)) {
                for near in 0..=2 * beside {
                    leads_on[(direction + DIRECTIONS - beside + near) % DIRECTIONS] = true;
                }
            }
            for (direction, words) in self.beyond[of_edge].iter().enumerate() {
                is_open[direction] &= leads_on[direction];
                if !is_open[direction] {
                    words.iter().for_each(|(word, bits)| flood.remove(*word, *bits));
                }
            }
        }
    }
}

/// The direction of a position.
fn direction(x: f32, y: f32) -> usize {
    let turns = (libm::atan2f(y, x) / TAU).rem_euclid(1.0);
    (turns * DIRECTIONS as f32) as usize % DIRECTIONS
}

#[cfg(test)]
mod tests {
    use super::super::cells::cell;
    use super::*;

    #[test]
    fn ground_behind_a_long_wall_is_not_reached_around_its_far_end() {
        // A wall 6 m to the left, this long ahead and behind.
        let reached = |half_m: f32, [x, y]: [f32; 2]| {
            let [mut open, mut closed] = [Bits::square(SIDE), Bits::square(SIDE)];
            open.fill(|_| true);
            closed.fill(|cell| {
                let [x, y] = centre_m(cell);
                x.abs() < half_m && (6.0..6.5).contains(&y)
            });
            let (directions, mut flood) = (Directions::new(), Flood::new(SIDE));
            flood.run(&open, &closed, 3, directions.near());
            directions.close(&mut flood);
            let cell = cell(x, y) as usize;
            flood.is_reached(cell % SIDE, cell / SIDE)
        };
        for beside in [[0.0, 10.0], [10.0, 20.0], [0.0, 50.0]] {
            assert!(reached(10.0, beside), "the end of the wall is near: {beside:?}");
            assert!(!reached(40.0, beside), "the end of the wall is far: {beside:?}");
            assert!(reached(40.0, beside.map(|metres| -metres)), "no wall on that side: {beside:?}");
        }
        assert!(reached(40.0, [50.0, 4.0]), "beyond the end of the wall, ahead");
    }
}
