//! Maps with the layer `safe_path` -> the next move: the vehicle follows the safe points (UT Austin thesis, section
//! VI).
//!
//! In: maps, a goal. Out: the next [`Move`]. It uses the newest map alone, and of the map nothing but the safe points:
//! their radii and links. As in the thesis, the vehicle stays within the radius of a safe point, drives to the next
//! safe point, and chooses at a branch by the length that is left to the goal. Three rules are ours:
//!
//! - It aims at the place nearest to the goal, which lies in its own lane, and not at the middle of the street.
//! - It leaves its lane to the left only if it sees free ground far ahead; else it waits. A car that comes towards it
//!   is nearer in the next map, but the radii of one map do not show that it moves.
//! - It is never faster than it can stop on the arc that is known to be free.
//!
//! The server should remember ground (`[vehicle.maps.memory] enabled = true`): a sensor on the roof does not see the
//! ground beside a parked car that the vehicle passes, and without it the vehicle has no room there.

use std::cmp::Reverse;
use std::collections::BinaryHeap;

use clearway_client::{ClientError, MapView};

use super::motion::{BRAKE_MPS2, CURVATURE_MAX, MPS_MAX, Move, Point, distance, ego_pose, in_ego};

/// Centres of five discs that cover the vehicle, in metres ahead of its centre; each has a radius of 1 m, so that the
/// vehicle passes where `safe_path` says that it fits.
const DISCS_M: [f64; 5] = [-1.76, -0.88, 0.0, 0.88, 1.76];
/// Distance that the centre of each disc keeps from obstacles, in metres, and greatest speed in m/s. The first is the
/// disc's radius and 0.25 m more; the last is for passages about as wide as the configured vehicle.
const CLEARANCES_M: [(f64, f64); 3] = [(1.25, MPS_MAX), (1.1, 4.0), (LINK_CLEARANCE_M, 1.0)];
/// Half the length and half the width of the vehicle, in metres. The ground under it is free.
const HALF_M: [f64; 2] = [2.2, 0.9];
/// Least distance to obstacles along a link, in metres: half the vehicle's width in the configuration of the server.
const LINK_CLEARANCE_M: f64 = 1.0;
/// Distance between two points of a path, in metres: the width of a cell of the layer.
const STEP_M: f64 = 0.25;
/// A metre between the path's end and the goal counts as much as three metres along the path. Ours: the map does not
/// show how the path goes on there, and a straight line is the least that it can be.
const REST_WEIGHT: f64 = 3.0;
/// Least and greatest distance of the point to aim at, in metres.
const AIM_M: std::ops::Range<f64> = 2.0..12.0;
/// Places to aim at within the radius of a safe point, as shares of the way from the point towards the goal.
const SHARES: [f64; 3] = [1.0, 0.5, 0.0];
/// Distance to the left of the line to the goal within which the vehicle counts as in its lane, in metres.
const LEFT_M: f64 = 0.5;
/// Length of free ground ahead that the vehicle has to see before it leaves its lane to the left, in metres.
const SIGHT_M: f64 = 20.0;
/// Time from a return to the brakes, in seconds: one revolution, and the move until the next map.
const REACTION_S: f64 = 0.2;

/// The safe points of the newest map.
#[derive(Debug, Default)]
pub struct Follower {
    /// Points in the ego frame; the first is the vehicle's position.
    points: Vec<SafePoint>,
    /// Pose of the newest map: x, y, heading; 0 if the map has none.
    ego: [f64; 3],
}

#[derive(Clone, Debug)]
struct SafePoint {
    at: Point,
    /// Distance to the nearest obstacle, in metres.
    radius_m: f64,
    /// Indices of the points that the vehicle can drive straight to.
    links: Vec<usize>,
}

impl Follower {
    /// Replaces the safe points by the points of a map with the layer `safe_path`.
    pub fn update(&mut self, map: &MapView) -> Result<(), ClientError> {
        let layer = map.layer("safe_path")?;
        self.ego = ego_pose(map).unwrap_or_default();
        let point = |point: &clearway_client::SafePoint| SafePoint {
            at: [point.x_m.into(), point.y_m.into()],
            radius_m: point.radius_m.into(),
            links: Vec::new(),
        };
        self.points = layer.points.iter().map(point).collect();
        for (from, point) in layer.points.iter().enumerate() {
            point.links.iter().for_each(|to| self.link(from, *to as usize));
        }
        Ok(())
    }

    /// Links two points. On a long link it adds points, each with the radius that is sure to be free there.
    fn link(&mut self, from: usize, to: usize) {
        let [(a, radius_a), (b, radius_b)] =
            [from, to].map(|index| (self.points[index].at, self.points[index].radius_m));
        let length_m = distance(a, b);
        let steps = (length_m / (2.0 * STEP_M)).ceil().max(1.0);
        let mut last = from;
        for step in 1..steps as u32 {
            let share = f64::from(step) / steps;
            let at = [0, 1].map(|axis| a[axis] + share * (b[axis] - a[axis]));
            let of_ends = (radius_a - share * length_m).max(radius_b - (1.0 - share) * length_m);
            let radius_m = of_ends.max(LINK_CLEARANCE_M.min(radius_a).min(radius_b));
            self.points.push(SafePoint { at, radius_m, links: Vec::new() });
            self.link_directly(last, self.points.len() - 1);
            last = self.points.len() - 1;
        }
        self.link_directly(last, to);
    }

    fn link_directly(&mut self, a: usize, b: usize) {
        self.points[a].links.push(b);
        self.points[b].links.push(a);
    }

    /// The point `metres` straight ahead, in the frame of the goal.
    pub fn ahead(&self, metres: f64) -> Point {
        let (sin, cos) = self.ego[2].sin_cos();
        [self.ego[0] + metres * cos, self.ego[1] + metres * sin]
    }

    /// The next move towards a goal, in the frame of the ego poses, or in the ego frame without poses.
    pub fn next_move(&self, goal: Point) -> Move {
        let goal = self.in_ego(goal);
        let path = self.find_path(goal);
        let path_m = path.array_windows().map(|[a, b]| distance(self.points[*a].at, self.points[*b].at)).sum();
        let own_m = self.points.first().map_or(0.0, |own| own.radius_m);
        for (clearance_m, mps) in CLEARANCES_M {
            // A vehicle that stands nearer to an obstacle may drive on, but not nearer to it: so are its links made.
            let clearance_m = if clearance_m > LINK_CLEARANCE_M { clearance_m } else { clearance_m.min(own_m) };
            let Some([x, y]) = self.find_aim(&path, goal, clearance_m) else { continue };
            let curvature_per_m = curvature([x, y]);
            let in_bend = (BRAKE_MPS2 / curvature_per_m.abs()).sqrt();
            let mps = mps.min(in_bend).min(stoppable_mps(x.hypot(y)));
            return Move { curvature_per_m, mps, path_m };
        }
        Move { curvature_per_m: 0.0, mps: 0.0, path_m }
    }

    /// The point to aim at: the place nearest to the goal, within the radii of the path's safe points, that the vehicle
    /// can drive to on an arc.
    fn find_aim(&self, path: &[usize], goal: Point, clearance_m: f64) -> Option<Point> {
        let places = path.iter().flat_map(|index| {
            let SafePoint { at, radius_m, .. } = self.points[*index];
            let within_m = (radius_m - clearance_m).max(0.0).min(distance(at, goal));
            SHARES.map(|share| towards(at, goal, share * within_m))
        });
        let is_ahead = |aim: &Point| aim[0] > 0.0 && AIM_M.contains(&aim[0].hypot(aim[1]));
        let mut aims: Vec<Point> = places.filter(is_ahead).collect();
        aims.sort_by(|a, b| distance(*a, goal).total_cmp(&distance(*b, goal)));
        aims.into_iter().find(|aim| self.keeps_right(*aim, goal) && self.is_safe(*aim, clearance_m))
    }

    /// True if the aim is in the vehicle's lane or to the right of it, or if the ground beyond the aim is free as far
    /// as [`SIGHT_M`].
    fn keeps_right(&self, aim: Point, goal: Point) -> bool {
        let ahead = goal.map(|metres| metres / distance(goal, [0.0; 2]));
        let left_m = ahead[0] * aim[1] - ahead[1] * aim[0];
        let steps = (SIGHT_M / STEP_M) as u32;
        left_m <= LEFT_M
            || (1..=steps).map(|step| f64::from(step) * STEP_M).all(|metres| {
                let place = [0, 1].map(|axis| aim[axis] + metres * ahead[axis]);
                self.is_within(place, LINK_CLEARANCE_M)
            })
    }

    /// True if a place keeps this distance from obstacles: if it is so far within the radius of a safe point.
    fn is_within(&self, place: Point, clearance_m: f64) -> bool {
        self.points.iter().any(|point| distance(point.at, place) + clearance_m <= point.radius_m)
    }

    /// True if the vehicle stays within the radii of safe points on the arc to a point ahead.
    fn is_safe(&self, aim: Point, clearance_m: f64) -> bool {
        let (bend, length_m) = (curvature(aim), aim[0].hypot(aim[1]));
        let steps = (length_m / STEP_M).ceil();
        let is_free = |[x, y]: Point| {
            let is_under_vehicle = x.abs() <= HALF_M[0] && y.abs() <= HALF_M[1];
            is_under_vehicle || self.is_within([x, y], clearance_m)
        };
        let place = |step: f64, disc_m: f64| {
            let (chord_m, angle) = (length_m * step / steps, bend * length_m * step / steps);
            // The chord of an arc has half the angle of the arc.
            let ((half_sin, half_cos), (sin, cos)) = ((angle / 2.0).sin_cos(), angle.sin_cos());
            [chord_m * half_cos + disc_m * cos, chord_m * half_sin + disc_m * sin]
        };
        bend.abs() <= CURVATURE_MAX
            && (1..=steps as u32).map(f64::from).all(|step| DISCS_M.iter().all(|disc_m| is_free(place(step, *disc_m))))
    }

    /// Indices of the points of the path from the vehicle to the point with the least length to the goal: along the
    /// links, and from there straight to the goal, weighted by [`REST_WEIGHT`].
    fn find_path(&self, goal: Point) -> Vec<usize> {
        // Lengths in integer micrometres, because floats have no total order.
        let rank = |metres: f64| (metres * 1e6) as u64;
        let mut best = vec![(f64::INFINITY, 0); self.points.len()];
        let mut queue = BinaryHeap::new();
        if !best.is_empty() {
            best[0].0 = 0.0;
            queue.push((Reverse(0), 0));
        }
        while let Some((Reverse(length), index)) = queue.pop() {
            let length_m = best[index].0;
            if rank(length_m) < length {
                continue;
            }
            for &next in &self.points[index].links {
                let length_m = length_m + distance(self.points[index].at, self.points[next].at);
                if length_m < best[next].0 {
                    best[next] = (length_m, index);
                    queue.push((Reverse(rank(length_m)), next));
                }
            }
        }
        let total_m = |index: usize| best[index].0 + REST_WEIGHT * distance(self.points[index].at, goal);
        let Some(end) = (0..best.len()).min_by(|a, b| total_m(*a).total_cmp(&total_m(*b))) else { return Vec::new() };
        let back = std::iter::successors(Some(end), |index| (*index != 0).then(|| best[*index].1));
        let mut path: Vec<usize> = back.collect();
        path.reverse();
        path
    }

    fn in_ego(&self, point: Point) -> Point {
        in_ego(self.ego, point)
    }
}

/// Greatest speed in m/s from which the vehicle stops within a length, after the reaction time.
fn stoppable_mps(length_m: f64) -> f64 {
    let reaction_mps = BRAKE_MPS2 * REACTION_S;
    (reaction_mps * reaction_mps + 2.0 * BRAKE_MPS2 * length_m).sqrt() - reaction_mps
}

/// The point `metres` from one point towards another.
fn towards(from: Point, to: Point, metres: f64) -> Point {
    let share = metres / distance(from, to).max(f64::MIN_POSITIVE);
    [0, 1].map(|axis| from[axis] + share * (to[axis] - from[axis]))
}

/// Curvature in 1/m of the arc that starts straight ahead and leads through a point.
fn curvature([x, y]: Point) -> f64 {
    2.0 * y / (x * x + y * y)
}
