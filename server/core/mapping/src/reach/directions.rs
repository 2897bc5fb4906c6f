//! Far ground counts as reached only in the directions in which the vehicle gets to it near.
//!
//! In: by cell whether it is open, and whether the middle of the vehicle's disc gets there. Out: reached cells without
//! the cells that only a detour over farther ground leads to, or a way around what closes their direction near. Rings
//! lie metres apart far away, so that no return shows a kerb, a ditch or a rail there; but near the vehicle the same
//! edge was seen. A direction is closed at an edge of near ground if the ground before the edge is open and none of it
//! is reached. Where an obstacle hides that ground, nothing is known of a kerb, and the direction stays as it was.

use std::f32::consts::TAU;

use super::bits::Bits;
use super::cells::{SIDE, centre_m};
use super::flood::Flood;

/// Number of directions. Ours: the directions of the ground's estimate.
const DIRECTIONS: usize = 180;
/// The edges of near ground. Ours; tuned on the even seeds of the random worlds.
const EDGES: [Edge; 2] = [Edge { range_m: 15.0, beside: 2 }, Edge { range_m: 25.0, beside: 1 }];
/// Depth of near ground at its edge, metres. Ours; tuned as the edges.
const DEPTH_M: f32 = 4.0;
/// Share of the near ground of a direction that must be open if none of it is reached, so that it is closed. Ours;
/// tuned as the edges.
const OPEN_SHARE_MIN: f32 = 0.5;

/// An edge of near ground.
struct Edge {
    /// Distance from the vehicle, metres.
    range_m: f32,
    /// Number of directions on each side of a reached direction that are open too.
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

    /// Removes the reached cells beyond an edge in directions that are closed there. `open` are the cells over which
    /// the disc's middle may move if nothing closes them.
    pub fn close(&self, open: &Bits, flood: &mut Flood) {
        let mut is_open = [true; DIRECTIONS];
        for (edge, Edge { beside, .. }) in EDGES.iter().enumerate() {
            let of_edge = edge * DIRECTIONS..(edge + 1) * DIRECTIONS;
            let mut leads_on = [false; DIRECTIONS];
            for (direction, cells) in self.inside[of_edge.clone()].iter().enumerate() {
                match View::of(cells, open, flood) {
                    View::Reached => {
                        for near in 0..=2 * beside {
                            leads_on[(direction + DIRECTIONS - beside + near) % DIRECTIONS] = true;
                        }
                    }
                    View::Hidden => leads_on[direction] = true,
                    View::Closed => {}
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

/// What is known of the near ground of a direction.
enum View {
    /// Some of it is reached.
    Reached,
    /// Most of it is not open: obstacles hide it.
    Hidden,
    /// It is open, and none of it is reached.
    Closed,
}

impl View {
    fn of(cells: &[u32], open: &Bits, flood: &Flood) -> Self {
        let place = |cell: &u32| (*cell as usize % SIDE, *cell as usize / SIDE);
        if cells.iter().map(place).any(|(ix, iy)| flood.is_middle(ix, iy)) {
            return Self::Reached;
        }
        let seen = cells.iter().map(place).filter(|(ix, iy)| open.get(*ix, *iy)).count();
        if seen as f32 >= OPEN_SHARE_MIN * cells.len() as f32 { Self::Closed } else { Self::Hidden }
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

    /// True if a place is reached with a wall 6 m to the left, this long ahead and behind. `hides` is true for the
    /// cells behind it that are not open.
    fn is_reached(half_m: f32, hides: impl Fn([f32; 2]) -> bool, [x, y]: [f32; 2]) -> bool {
        let [mut open, mut closed] = [Bits::square(SIDE), Bits::square(SIDE)];
        open.fill(|cell| !hides(centre_m(cell)));
        closed.fill(|cell| {
            let [x, y] = centre_m(cell);
            x.abs() < half_m && (6.0..6.5).contains(&y)
        });
        let (directions, mut flood) = (Directions::new(), Flood::new(SIDE));
        flood.run(&open, &closed, 3, directions.near());
        directions.close(&open, &mut flood);
        let cell = cell(x, y) as usize;
        flood.is_reached(cell % SIDE, cell / SIDE)
    }

    #[test]
    fn ground_behind_a_long_wall_is_not_reached_around_its_far_end() {
        let reached = |half_m: f32, place: [f32; 2]| is_reached(half_m, |_| false, place);
        for beside in [[0.0, 10.0], [10.0, 20.0], [0.0, 50.0]] {
            assert!(reached(10.0, beside), "the end of the wall is near: {beside:?}");
            assert!(!reached(40.0, beside), "the end of the wall is far: {beside:?}");
            assert!(reached(40.0, beside.map(|metres| -metres)), "no wall on that side: {beside:?}");
        }
        assert!(reached(40.0, [50.0, 4.0]), "beyond the end of the wall, ahead");
    }

    #[test]
    fn a_direction_whose_near_ground_is_hidden_is_not_closed() {
        // The wall hides all ground behind it up to 25 m.
        let is_hidden = |[x, y]: [f32; 2]| y > 6.5 && libm::hypotf(x, y) < 25.0;
        assert!(is_reached(40.0, is_hidden, [0.0, 50.0]), "around the far end of the wall");
        assert!(!is_reached(40.0, |place| is_hidden(place) && place[0] < 0.0, [5.0, 50.0]), "open ground before it");
    }
}
