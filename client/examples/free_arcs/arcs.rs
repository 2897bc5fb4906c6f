//! Maps with the layer `freespace` -> the next move, by the layer's answers alone.
//!
//! In: maps, a goal. Out: the next [`Move`]: the arc that comes nearest to the goal before anything forbids it. Low
//! things forbid it too. The map answers for the whole vehicle, so the planner keeps no grid of its own.

use clearway_client::{Along, ClientError, MapView, Outline, Path};

use super::motion::{BRAKE_MPS2, CURVATURE_MAX, MPS_MAX, Move, Point, distance, ego_pose, in_ego};

/// Outline of the vehicle, a car with its reference point in the middle.
const CAR: Outline = Outline { front_m: 2.2, rear_m: 2.2, width_m: 1.8 };
/// Distance to keep to the front and to each side in metres, and greatest speed in m/s. The next pair is tried if there
/// is no arc with the pair before.
const MARGINS: [(f64, f64); 3] = [(0.6, MPS_MAX), (0.4, 3.0), (0.2, 1.0)];
/// Number of arcs to each side of straight ahead.
const ARCS: i32 = 20;
/// Length of an arc, in metres.
const LENGTH_M: f64 = 14.0;
/// Distance before the first thing that forbids at which the vehicle must be able to stop, in metres: its front stands
/// there already, because a path is judged by the whole outline.
const STOP_M: f64 = 1.0;
/// Least length of an arc that is worth driving, in metres.
const WORTH_M: f64 = 2.0;

/// A planner that remembers nothing but the newest map.
#[derive(Debug, Default)]
pub struct ArcPlanner {
    map: Option<MapView>,
    /// Pose of the newest map: x, y, heading.
    ego: [f64; 3],
}

impl ArcPlanner {
    /// Takes the newest map.
    pub fn update(&mut self, map: &MapView) {
        self.ego = ego_pose(map).unwrap_or_default();
        self.map = Some(map.clone());
    }

    /// The point `metres` straight ahead, in the planner's frame.
    pub fn ahead(&self, metres: f64) -> Point {
        let (sin, cos) = self.ego[2].sin_cos();
        [self.ego[0] + metres * cos, self.ego[1] + metres * sin]
    }

    /// The next move towards a goal.
    ///
    /// # Errors
    /// [`ClientError::NoLayer`] if the map does not have the layer `freespace`.
    pub fn next_move(&self, goal: Point) -> Result<Move, ClientError> {
        let stop = Move { curvature_per_m: 0.0, mps: 0.0, path_m: 0.0 };
        let Some(map) = &self.map else { return Ok(stop) };
        let goal = in_ego(self.ego, goal);
        for (margin_m, mps_max) in MARGINS {
            let outline = Outline { front_m: CAR.front_m + margin_m, width_m: CAR.width_m + 2.0 * margin_m, ..CAR };
            let mut best: Option<(f64, Move)> = None;
            for arc in -ARCS..=ARCS {
                let curvature_per_m = CURVATURE_MAX * f64::from(arc) / f64::from(ARCS);
                let path = Path::Arc { curvature_per_m, length_m: LENGTH_M };
                let path_m = free_m(&map.along("freespace", &path, &outline)?);
                let off_m = nearest_m(curvature_per_m, path_m, goal);
                if path_m >= WORTH_M && best.is_none_or(|(before_m, _)| off_m < before_m) {
                    let in_bend = (BRAKE_MPS2 / 2.0 / curvature_per_m.abs()).sqrt();
                    let to_stop = (BRAKE_MPS2 * (path_m - STOP_M).max(0.0)).sqrt();
                    best = Some((off_m, Move { curvature_per_m, mps: mps_max.min(in_bend).min(to_stop), path_m }));
                }
            }
            if let Some((_, next)) = best {
                return Ok(next);
            }
        }
        Ok(stop)
    }
}

/// Length of a path before anything that forbids it, in metres.
fn free_m(met: &Along) -> f64 {
    let firsts = [&met.low, &met.blocked].into_iter().flatten().map(|(along_m, _)| *along_m);
    firsts.fold(met.length_m, f64::min)
}

/// Least distance from an arc of this length to a point in the ego frame, in metres.
fn nearest_m(curvature_per_m: f64, length_m: f64, point: Point) -> f64 {
    let at = |along_m: f64| {
        let half = curvature_per_m * along_m / 2.0;
        let chord_m = if half == 0.0 { along_m } else { along_m * half.sin() / half };
        [chord_m * half.cos(), chord_m * half.sin()]
    };
    (0..=20).map(|step| distance(at(length_m * f64::from(step) / 20.0), point)).fold(f64::INFINITY, f64::min)
}
