//! `speed` maps to a way and a move: A* by travel time over ground that was seen to be passable.
//!
//! In: maps, a goal. Out: the next [`Move`]. Frame: the maps' world ("map") where the vehicle tells its ego poses; what was
//! seen is then remembered for a while, since a sensor sees nothing close by. Without poses each map stands alone, in the
//! ego frame. Ground that nobody saw is never entered, but for where the vehicle stands at first.

use std::cmp::Reverse;
use std::collections::{BinaryHeap, HashMap};

use clearway_client::{ClientError, MapView};

/// Edge of a cell of the planner's own grid, metres.
const CELL_M: f64 = 0.5;
/// It looks this far, metres.
const REACH_M: f64 = 16.0;
/// From the vehicle's middle to anything: half its width, its corners in bends, half a cell of the map and of its own.
const CLEARANCE_M: f64 = 1.5;
/// Where it begins, the ground about it that its sensor cannot see is taken on trust, metres.
const STAND_M: f64 = 5.0;
/// What was seen is forgotten after this, ns.
const MEMORY_NS: i64 = 8_000_000_000;
/// Never faster, m/s.
const MPS_MAX: f64 = 8.0;
/// Braking, and to the side, m/s².
const BRAKE_MPS2: f64 = 3.0;
/// Tightest turn, 1/m.
const CURVATURE_MAX: f64 = 0.2;

/// A place, metres.
pub type Place = [f64; 2];
type Cell = [i32; 2];

/// What the vehicle should do until the next map.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Move {
    /// Of the arc to follow, left positive, 1/m.
    pub curvature_per_m: f64,
    /// 0 where there is no way.
    pub mps: f64,
    /// Length of the way found towards the goal.
    pub way_m: f64,
}

/// Remembers what it was shown.
#[derive(Debug, Default)]
pub struct Planner {
    seen: HashMap<Cell, Seen>,
    /// Of the newest map: x, y, heading.
    ego: [f64; 3],
}

#[derive(Clone, Copy, Debug)]
struct Seen {
    /// 0: an obstacle.
    mps: f64,
    stamp_ns: i64,
}

impl Planner {
    /// Takes a map with the layer `speed`.
    pub fn take(&mut self, map: &MapView) -> Result<(), ClientError> {
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
        self.seen.retain(|_, seen| stamp_ns - seen.stamp_ns < MEMORY_NS);
        for cell in about(self.cell_of_ego(), REACH_M) {
            let [x, y] = self.in_ego(middle(cell));
            let mps = match layer.class_at(x, y).1 {
                "passable" | "road" => layer.value_at("speed", x, y).unwrap_or(0.0),
                "unknown" if begins && x.hypot(y) < STAND_M => 1.0,
                _ => continue,
            };
            self.seen.insert(cell, Seen { mps, stamp_ns });
        }
        // By the obstacles' own cells: none falls between two of the planner's.
        let Some(classes) = layer.channel("class").map(|channel| &channel.cells) else { return Ok(()) };
        let obstacle = layer.legend.iter().position(|name| name == "obstacle").map(|class| class as i32);
        for index in (0..layer.grid.cell_count() as usize).filter(|&index| classes.get(index) == obstacle) {
            let Some((x, y)) = layer.grid.centre_of(index).filter(|(x, y)| x.hypot(*y) < REACH_M) else { continue };
            self.seen.insert(cell_of(self.in_map([x, y])), Seen { mps: 0.0, stamp_ns });
        }
        Ok(())
    }

    /// The place so many metres straight ahead, in the planner's frame.
    pub fn ahead(&self, metres: f64) -> Place {
        self.in_map([metres, 0.0])
    }

    /// The next move towards a goal, or to where the way ends nearest to it.
    pub fn next_move(&self, goal: Place) -> Move {
        let open = self.open();
        let way = self.way(goal, &open);
        let way_m: f64 = way.array_windows().map(|[a, b]| distance(*a, *b)).sum();
        let [x, y] =
            self.in_ego(*way.iter().rev().find(|place| self.is_straight_to(**place, &open)).unwrap_or(&way[0]));
        let range_m = x.hypot(y);
        if range_m < 1.0 || x < 0.0 {
            return Move { curvature_per_m: 0.0, mps: 0.0, way_m };
        }
        let curvature_per_m = (2.0 * y / (range_m * range_m)).clamp(-CURVATURE_MAX, CURVATURE_MAX);
        let seen = way.iter().filter_map(|place| self.seen.get(&cell_of(*place)));
        let allowed = seen.take(6).map(|seen| seen.mps).fold(MPS_MAX, f64::min);
        let in_bend = (BRAKE_MPS2 / curvature_per_m.abs()).sqrt();
        let to_stop = (2.0 * BRAKE_MPS2 * (way_m - 2.0).max(0.0)).sqrt();
        Move { curvature_per_m, mps: allowed.min(in_bend).min(to_stop), way_m }
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
            for next in about(cell, CELL_M).filter(|next| *next != cell) {
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

    /// Speeds of the cells the vehicle's middle may be in: seen, passable, and nothing within the clearance.
    fn open(&self) -> HashMap<Cell, f64> {
        let near = |cell: &Cell| distance(middle(*cell), [self.ego[0], self.ego[1]]) < REACH_M;
        let seen = self.seen.iter().filter(|(cell, _)| near(cell));
        let mut open: HashMap<Cell, f64> = seen.clone().map(|(cell, seen)| (*cell, seen.mps)).collect();
        for (obstacle, _) in seen.filter(|(_, seen)| seen.mps == 0.0) {
            for cell in about(*obstacle, CLEARANCE_M) {
                open.remove(&cell);
            }
        }
        open
    }

    /// Whether the vehicle may go straight to a place.
    fn is_straight_to(&self, place: Place, open: &HashMap<Cell, f64>) -> bool {
        let from = [self.ego[0], self.ego[1]];
        let steps = (distance(from, place) / (CELL_M / 2.0)).ceil().max(1.0);
        let at = |step: f64| [0, 1].map(|axis| from[axis] + (place[axis] - from[axis]) * step / steps);
        (1..=steps as u32).all(|step| open.contains_key(&cell_of(at(f64::from(step)))))
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

/// The cells whose middles lie within so many metres of a cell's to each side, cut to a disc beyond its neighbours.
fn about([ix, iy]: Cell, reach_m: f64) -> impl Iterator<Item = Cell> {
    let reach = (reach_m / CELL_M).round() as i32;
    let square = (-reach..=reach).flat_map(move |dx| (-reach..=reach).map(move |dy| [dx, dy]));
    let disc = square.filter(move |[dx, dy]| reach < 2 || dx * dx + dy * dy <= reach * reach);
    disc.map(move |[dx, dy]| [ix + dx, iy + dy])
}
