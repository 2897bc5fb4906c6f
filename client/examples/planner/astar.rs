//! Maps with the layer `speed` -> a path and the next move: A* by travel time over free ground.
//!
//! In: maps, a goal. Out: the next [`Move`]. With ego poses, the planner works in the world frame and keeps cells for a
//! while, because a sensor does not measure the ground near the vehicle. Without poses it uses each map alone, in the
//! ego frame. It never enters ground that is not measured, except around the vehicle's first position.

use std::cmp::Reverse;
use std::collections::{BinaryHeap, HashMap};

use clearway_client::v1::ClassMeaning;
use clearway_client::{ClientError, MapView};

use super::motion::{BRAKE_MPS2, CURVATURE_MAX, MPS_MAX, Move, Point, distance, ego_pose, in_ego};

/// Centres of three discs that cover a car, in metres ahead of its centre; each has a radius of 1.16 m.
const DISCS_M: [f64; 3] = [1.45, 0.0, -1.45];

/// Edge of a cell of the planner's grid, in metres.
const CELL_M: f64 = 0.5;
/// Radius of the planner's grid around the vehicle, in metres.
const RANGE_M: f64 = 16.0;
/// Distance from the centre of a disc to the centre of an obstacle's cell in metres (its radius and half a cell), and
/// greatest speed in m/s. The second is tried if there is no path with the first.
const CLEARANCES_M: [(f64, f64); 2] = [(1.5, MPS_MAX), (1.2, 1.0)];
/// Radius around the first position in which unknown ground is assumed free, in metres: the sensor cannot measure it.
const START_M: f64 = 5.0;
/// Speed on that ground, in m/s.
const START_MPS: f64 = 2.0;
/// Time after which an obstacle that is not measured again is removed, in ns; its cell is then unknown.
const MEMORY_NS: i64 = 2_000_000_000;
/// Least distance of the point to aim at, in metres.
const NEAREST_M: f64 = 2.0;

type Cell = [i32; 2];

/// A planner with a grid of recently measured cells.
#[derive(Debug, Default)]
pub struct Planner {
    seen: HashMap<Cell, Seen>,
    /// Pose of the newest map: x, y, heading.
    ego: [f64; 3],
}

#[derive(Clone, Copy, Debug)]
struct Seen {
    /// Speed in m/s; 0 for an obstacle.
    mps: f64,
    stamp_ns: i64,
}

impl Planner {
    /// Updates the grid from a map with the layer `speed`.
    pub fn update(&mut self, map: &MapView) -> Result<(), ClientError> {
        let (layer, stamp_ns) = (map.layer("speed")?, map.header().capture_end_ns);
        let ego = ego_pose(map);
        if ego.is_none() {
            self.seen.clear();
        }
        self.ego = ego.unwrap_or_default();
        let is_first = self.seen.is_empty();
        let here = [self.ego[0], self.ego[1]];
        self.seen.retain(|cell, seen| {
            let is_fresh = seen.mps > 0.0 || stamp_ns - seen.stamp_ns < MEMORY_NS;
            is_fresh && distance(centre(*cell), here) < 1.25 * RANGE_M
        });
        for cell in cells_within(self.cell_of_ego(), RANGE_M) {
            let [x, y] = self.in_ego(centre(cell));
            let mps = match layer.meaning_at(x, y) {
                ClassMeaning::Free => layer.value_at("speed", x, y).unwrap_or(0.0),
                ClassMeaning::Unknown if is_first && x.hypot(y) < START_M => START_MPS,
                _ => continue,
            };
            self.seen.insert(cell, Seen { mps, stamp_ns });
        }
        // Uses the cells of the obstacles, so that none lies between two cells of the planner.
        let occupied = |index: &usize| matches!(layer.meaning_of(*index), ClassMeaning::Occupied | ClassMeaning::Low);
        for index in (0..layer.grid.cell_count() as usize).filter(occupied) {
            let Some((x, y)) = layer.grid.centre_of(index).filter(|(x, y)| x.hypot(*y) < RANGE_M) else { continue };
            self.seen.insert(cell_of(self.in_map([x, y])), Seen { mps: 0.0, stamp_ns });
        }
        Ok(())
    }

    /// Text picture of the grid, with forward up: `.` free, `#` obstacle, blank unknown.
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

    /// The point `metres` straight ahead, in the planner's frame.
    pub fn ahead(&self, metres: f64) -> Point {
        self.in_map([metres, 0.0])
    }

    /// The next move towards a goal, or towards the reachable point nearest to it: the arc to the farthest point of the
    /// path that the vehicle can follow without touching an obstacle.
    pub fn next_move(&self, goal: Point) -> Move {
        let mut path_m = 0.0;
        for (clearance_m, mps) in CLEARANCES_M {
            let open = self.open(clearance_m);
            let path = self.find_path(goal, &open);
            path_m = path.array_windows().map(|[a, b]| distance(*a, *b)).sum();
            let ahead =
                path.iter().rev().map(|point| self.in_ego(*point)).filter(|[x, y]| *x > 0.0 && x.hypot(*y) > NEAREST_M);
            let mut arcs = ahead.map(|[x, y]| (2.0 * y / (x * x + y * y), x.hypot(y)));
            let Some((curvature_per_m, _)) = arcs.find(|(bend, length_m)| self.is_clear(*bend, *length_m, &open))
            else {
                continue;
            };
            let seen = path.iter().filter_map(|point| self.seen.get(&cell_of(*point)));
            let allowed = seen.take(6).map(|seen| seen.mps).fold(mps, f64::min);
            let in_bend = (BRAKE_MPS2 / curvature_per_m.abs()).sqrt();
            let to_stop = (2.0 * BRAKE_MPS2 * (path_m - 2.0).max(0.0)).sqrt();
            return Move { curvature_per_m, mps: allowed.min(in_bend).min(to_stop), path_m };
        }
        Move { curvature_per_m: 0.0, mps: 0.0, path_m }
    }

    /// True if the vehicle can follow an arc for a length without touching an obstacle. Curvatures are so small that
    /// the chord has about the length of the arc.
    fn is_clear(&self, curvature_per_m: f64, length_m: f64, open: &HashMap<Cell, f64>) -> bool {
        let steps = (length_m / (CELL_M / 2.0)).ceil();
        let is_open = |step: f64, disc_m: f64| {
            let angle = curvature_per_m * length_m * step / steps;
            // The chord of an arc has half the angle of the arc.
            let (chord_m, (half_sin, half_cos)) = (length_m * step / steps, (angle / 2.0).sin_cos());
            let (sin, cos) = angle.sin_cos();
            let point = [chord_m * half_cos + disc_m * cos, chord_m * half_sin + disc_m * sin];
            open.contains_key(&cell_of(self.in_map(point)))
        };
        // Discs behind the start are left out: the vehicle leaves that ground.
        let discs = |step: f64| DISCS_M.into_iter().filter(move |disc_m| length_m * step / steps + disc_m > 0.5);
        curvature_per_m.abs() <= CURVATURE_MAX
            && (0..=steps as u32).map(f64::from).all(|step| discs(step).all(|disc_m| is_open(step, disc_m)))
    }

    /// A* over the planner's cells, from the cell of the vehicle.
    fn find_path(&self, goal: Point, open: &HashMap<Cell, f64>) -> Vec<Point> {
        let start = self.cell_of_ego();
        let left_s = |cell: Cell| distance(centre(cell), goal) / MPS_MAX;
        let mut best: HashMap<Cell, (f64, Cell)> = HashMap::from([(start, (0.0, start))]);
        // Times in integer microseconds, because floats have no total order.
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
            if distance(centre(cell), goal) < CELL_M {
                break;
            }
            for next in cells_within(cell, 1.5 * CELL_M).filter(|next| *next != cell) {
                let Some(mps) = open.get(&next) else { continue };
                let spent = spent + distance(centre(cell), centre(next)) / mps.min(MPS_MAX);
                if best.get(&next).is_none_or(|(before, _)| spent < *before) {
                    best.insert(next, (spent, cell));
                    queue.push((rank(spent + left_s(next)), next));
                }
            }
        }
        let back = std::iter::successors(Some(nearest), |cell| (*cell != start).then(|| best[cell].1));
        let mut path: Vec<Point> = back.map(centre).collect();
        path.reverse();
        path
    }

    /// Speed of each cell that the centre of a disc may be in: free, with no obstacle within the clearance.
    fn open(&self, clearance_m: f64) -> HashMap<Cell, f64> {
        let near = |cell: &Cell| distance(centre(*cell), [self.ego[0], self.ego[1]]) < RANGE_M;
        let seen = self.seen.iter().filter(|(cell, _)| near(cell));
        let mut open: HashMap<Cell, f64> = seen.clone().map(|(cell, seen)| (*cell, seen.mps)).collect();
        for (obstacle, _) in seen.filter(|(_, seen)| seen.mps == 0.0) {
            for cell in cells_within(*obstacle, clearance_m) {
                open.remove(&cell);
            }
        }
        open
    }

    fn cell_of_ego(&self) -> Cell {
        cell_of([self.ego[0], self.ego[1]])
    }

    fn in_ego(&self, point: Point) -> Point {
        in_ego(self.ego, point)
    }

    fn in_map(&self, [x, y]: Point) -> Point {
        let (sin, cos) = self.ego[2].sin_cos();
        [self.ego[0] + x * cos - y * sin, self.ego[1] + x * sin + y * cos]
    }
}

fn cell_of(point: Point) -> Cell {
    point.map(|value| (value / CELL_M).floor() as i32)
}

fn centre(cell: Cell) -> Point {
    cell.map(|index| (f64::from(index) + 0.5) * CELL_M)
}

/// The cells whose centres lie within a distance in metres of the centre of a cell, including it.
fn cells_within([ix, iy]: Cell, range_m: f64) -> impl Iterator<Item = Cell> {
    let cells = range_m / CELL_M;
    let reach = cells as i32;
    let square = (-reach..=reach).flat_map(move |dx| (-reach..=reach).map(move |dy| [dx, dy]));
    let disc = square.filter(move |[dx, dy]| f64::from(dx * dx + dy * dy) <= cells * cells);
    disc.map(move |[dx, dy]| [ix + dx, iy + dy])
}
