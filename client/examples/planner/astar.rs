//! Plans a path and a move on the layer `speed`: A* by travel time over ground that the maps have shown as passable.
//!
//! In: maps, a goal. Out: the next [`Move`]. Frame: "map" if the vehicle sends ego poses; the planner then remembers
//! earlier maps for a while, because a sensor does not see the ground near the vehicle. Without poses the planner uses
//! the newest map only, in the ego frame. The planner never enters ground that no map has shown, except the place where
//! the vehicle stands at first.

use std::cmp::Reverse;
use std::collections::{BinaryHeap, HashMap};

use clearway_client::v1::ClassMeaning;
use clearway_client::{ClientError, MapView};

/// Edge of a cell of the planner's own grid, in metres.
const CELL_M: f64 = 0.5;
/// Reach of the planner's grid around the vehicle, in metres.
const REACH_M: f64 = 16.0;
/// Centres of three discs that cover the vehicle, in metres ahead of its middle; each has a radius of 1.16 m.
const DISCS_M: [f64; 3] = [1.45, 0.0, -1.45];
/// Least distances from the centre of a disc to that of an obstacle's cell, each with the greatest speed, in metres and
/// m/s. The first is the disc's radius and half a cell; the second applies if the first leaves no path.
const CLEARANCES_M: [(f64, f64); 2] = [(1.5, MPS_MAX), (1.2, 1.0)];
/// Radius around the first place of the vehicle in which unseen ground counts as passable, in metres.
const STAND_M: f64 = 5.0;
/// Speed on that unseen ground, in m/s.
const STAND_MPS: f64 = 2.0;
/// Time after which an obstacle that is not seen again is forgotten, in ns; its cell is then unknown.
const MEMORY_NS: i64 = 2_000_000_000;
/// Greatest speed, in m/s.
const MPS_MAX: f64 = 8.0;
/// Least distance of the place that a move aims at, in metres.
const NEAREST_M: f64 = 2.0;
/// Greatest braking and lateral acceleration, in m/s².
const BRAKE_MPS2: f64 = 4.0;
/// Greatest curvature of a move, in 1/m.
const CURVATURE_MAX: f64 = 0.2;

/// A place in the planner's frame: x, y, in metres.
pub type Place = [f64; 2];
type Cell = [i32; 2];

/// What the vehicle should do until the next map.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Move {
    /// Curvature of the arc to follow, left positive, in 1/m.
    pub curvature_per_m: f64,
    /// Speed, in m/s; 0 if there is no path.
    pub mps: f64,
    /// Length of the path towards the goal, in metres.
    pub way_m: f64,
}

/// A planner that remembers the ground of earlier maps.
#[derive(Debug, Default)]
pub struct Planner {
    seen: HashMap<Cell, Seen>,
    /// Pose of the newest map: x and y in metres, heading in radians.
    ego: [f64; 3],
}

#[derive(Clone, Copy, Debug)]
struct Seen {
    /// Allowed speed, in m/s; 0 for an obstacle.
    mps: f64,
    stamp_ns: i64,
}

impl Planner {
    /// Updates the remembered ground with a map that has the layer `speed`.
    pub fn update(&mut self, map: &MapView) -> Result<(), ClientError> {
        let (layer, stamp_ns) = (map.layer("speed")?, map.header().capture_end_ns);
        self.ego = match &map.header().map_from_ego {
            Some(p) => {
                [p.x, p.y, f64::atan2(2.0 * (p.qw * p.qz + p.qx * p.qy), 1.0 - 2.0 * (p.qy * p.qy + p.qz * p.qz))]
            }
            None => {
                self.seen.clear();
                [0.0; 3]
            }
        };
        let begins = self.seen.is_empty();
        let here = [self.ego[0], self.ego[1]];
        self.seen.retain(|cell, seen| {
            let is_fresh = seen.mps > 0.0 || stamp_ns - seen.stamp_ns < MEMORY_NS;
            is_fresh && distance(middle(*cell), here) < 1.25 * REACH_M
        });
        for cell in about(self.cell_of_ego(), REACH_M) {
            let [x, y] = self.in_ego(middle(cell));
            let mps = match layer.meaning_at(x, y) {
                ClassMeaning::Free => layer.value_at("speed", x, y).unwrap_or(0.0),
                ClassMeaning::Unknown if begins && x.hypot(y) < STAND_M => STAND_MPS,
                _ => continue,
            };
            self.seen.insert(cell, Seen { mps, stamp_ns });
        }
        // Over the cells of the map, so that no obstacle falls between two cells of the planner.
        let occupied = |index: &usize| layer.meaning_of(*index) == ClassMeaning::Occupied;
        for index in (0..layer.grid.cell_count() as usize).filter(occupied) {
            let Some((x, y)) = layer.grid.centre_of(index).filter(|(x, y)| x.hypot(*y) < REACH_M) else { continue };
            self.seen.insert(cell_of(self.in_map([x, y])), Seen { mps: 0.0, stamp_ns });
        }
        Ok(())
    }

    /// Text picture of the ground around the vehicle, ahead up: `.` is passable, `#` an obstacle, a blank is unseen.
    pub fn picture(&self) -> String {
        let here = self.cell_of_ego();
        let mark = |ahead: i32, left: i32| {
            let cell = cell_of(self.in_map([f64::from(ahead) * CELL_M, f64::from(left) * CELL_M]));
            match self.seen.get(&cell) {
                _ if cell == here => '^',
                None => ' ',
                Some(seen) if seen.mps == 0.0 => '#',
                Some(_) => '.',
            }
        };
        let line = |ahead| (-24..=24).rev().map(|left| mark(ahead, left)).chain(['\n']).collect::<String>();
        (-8..=24).rev().map(line).collect()
    }

    /// The place this many metres straight ahead, in the planner's frame.
    pub fn ahead(&self, metres: f64) -> Place {
        self.in_map([metres, 0.0])
    }

    /// The next move towards a goal, or towards the reachable place nearest to it: the arc to the farthest place of the
    /// path that the vehicle can reach on a free arc.
    pub fn next_move(&self, goal: Place) -> Move {
        let mut way_m = 0.0;
        for (clearance_m, mps) in CLEARANCES_M {
            let open = self.open(clearance_m);
            let way = self.way(goal, &open);
            way_m = way.array_windows().map(|[a, b]| distance(*a, *b)).sum();
            let ahead =
                way.iter().rev().map(|place| self.in_ego(*place)).filter(|[x, y]| *x > 0.0 && x.hypot(*y) > NEAREST_M);
            let mut arcs = ahead.map(|[x, y]| (2.0 * y / (x * x + y * y), x.hypot(y)));
            let Some((curvature_per_m, _)) = arcs.find(|(bend, length_m)| self.is_clear(*bend, *length_m, &open))
            else {
                continue;
            };
            let seen = way.iter().filter_map(|place| self.seen.get(&cell_of(*place)));
            let allowed = seen.take(6).map(|seen| seen.mps).fold(mps, f64::min);
            let in_bend = (BRAKE_MPS2 / curvature_per_m.abs()).sqrt();
            let to_stop = (2.0 * BRAKE_MPS2 * (way_m - 2.0).max(0.0)).sqrt();
            return Move { curvature_per_m, mps: allowed.min(in_bend).min(to_stop), way_m };
        }
        Move { curvature_per_m: 0.0, mps: 0.0, way_m }
    }

    /// True if the vehicle may follow an arc for this length. Arcs are so slight that the chord has the same length.
    fn is_clear(&self, curvature_per_m: f64, length_m: f64, open: &HashMap<Cell, f64>) -> bool {
        let steps = (length_m / (CELL_M / 2.0)).ceil();
        let is_open = |step: f64, disc_m: f64| {
            let turned = curvature_per_m * length_m * step / steps;
            // The chord of an arc points half as far round as the arc turns.
            let (chord_m, (half_sin, half_cos)) = (length_m * step / steps, (turned / 2.0).sin_cos());
            let (sin, cos) = turned.sin_cos();
            let place = [chord_m * half_cos + disc_m * cos, chord_m * half_sin + disc_m * sin];
            open.contains_key(&cell_of(self.in_map(place)))
        };
        // Cells under the tail do not count, because the vehicle leaves them.
        let discs = |step: f64| DISCS_M.into_iter().filter(move |disc_m| length_m * step / steps + disc_m > 0.5);
        curvature_per_m.abs() <= CURVATURE_MAX
            && (0..=steps as u32).map(f64::from).all(|step| discs(step).all(|disc_m| is_open(step, disc_m)))
    }

    /// A* over the planner's cells; begins with the vehicle's place.
    fn way(&self, goal: Place, open: &HashMap<Cell, f64>) -> Vec<Place> {
        let start = self.cell_of_ego();
        let left_s = |cell: Cell| distance(middle(cell), goal) / MPS_MAX;
        let mut best: HashMap<Cell, (f64, Cell)> = HashMap::from([(start, (0.0, start))]);
        // Times in µs: whole numbers have an order.
        let rank = |seconds: f64| Reverse((seconds * 1e6) as u64);
        let mut queue = BinaryHeap::from([(rank(left_s(start)), start)]);
        let mut nearest = start;
        while let Some((Reverse(total), cell)) = queue.pop() {
            let spent = best[&cell].0;
            if rank(spent + left_s(cell)).0 < total {
                continue;
            }
            if left_s(cell) < left_s(nearest) {
                nearest = cell;
            }
            if distance(middle(cell), goal) < CELL_M {
                break;
            }
            for next in about(cell, 1.5 * CELL_M).filter(|next| *next != cell) {
                let Some(mps) = open.get(&next) else { continue };
                let spent = spent + distance(middle(cell), middle(next)) / mps.min(MPS_MAX);
                if best.get(&next).is_none_or(|(before, _)| spent < *before) {
                    best.insert(next, (spent, cell));
                    queue.push((rank(spent + left_s(next)), next));
                }
            }
        }
        let back = std::iter::successors(Some(nearest), |cell| (*cell != start).then(|| best[cell].1));
        let mut way: Vec<Place> = back.map(middle).collect();
        way.reverse();
        way
    }

    /// Speeds of the cells a disc's middle may be in: seen, passable, and no obstacle within the clearance.
    fn open(&self, clearance_m: f64) -> HashMap<Cell, f64> {
        let near = |cell: &Cell| distance(middle(*cell), [self.ego[0], self.ego[1]]) < REACH_M;
        let seen = self.seen.iter().filter(|(cell, _)| near(cell));
        let mut open: HashMap<Cell, f64> = seen.clone().map(|(cell, seen)| (*cell, seen.mps)).collect();
        for (obstacle, _) in seen.filter(|(_, seen)| seen.mps == 0.0) {
            for cell in about(*obstacle, clearance_m) {
                open.remove(&cell);
            }
        }
        open
    }

    fn cell_of_ego(&self) -> Cell {
        cell_of([self.ego[0], self.ego[1]])
    }

    fn in_ego(&self, [x, y]: Place) -> Place {
        let ([dx, dy], (sin, cos)) = ([x - self.ego[0], y - self.ego[1]], self.ego[2].sin_cos());
        [dx * cos + dy * sin, dy * cos - dx * sin]
    }

    fn in_map(&self, [x, y]: Place) -> Place {
        let (sin, cos) = self.ego[2].sin_cos();
        [self.ego[0] + x * cos - y * sin, self.ego[1] + x * sin + y * cos]
    }
}

fn cell_of(place: Place) -> Cell {
    place.map(|value| (value / CELL_M).floor() as i32)
}

fn middle(cell: Cell) -> Place {
    cell.map(|index| (f64::from(index) + 0.5) * CELL_M)
}

fn distance(a: Place, b: Place) -> f64 {
    (a[0] - b[0]).hypot(a[1] - b[1])
}

/// A cell and the cells whose centres lie within this many metres of its own.
fn about([ix, iy]: Cell, reach_m: f64) -> impl Iterator<Item = Cell> {
    let cells = reach_m / CELL_M;
    let reach = cells as i32;
    let square = (-reach..=reach).flat_map(move |dx| (-reach..=reach).map(move |dy| [dx, dy]));
    let disc = square.filter(move |[dx, dy]| f64::from(dx * dx + dy * dy) <= cells * cells);
    disc.map(move |[dx, dy]| [ix + dx, iy + dy])
}
