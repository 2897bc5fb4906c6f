//! Whether a road may be painted now (Lindström 2005, section 3.3): each condition that is violated stops the painting
//! at once.
//!
//! In: the newest road and route with the newest ego pose, and, where no road is sent, the measured one. Out:
//! [`PaintingConditions`]: the road in the ego frame, its source, and which conditions are violated. Two conditions are
//! the paper's: (1) the dominant orientations in the detector's image are no better than random; (2) the route bends
//! more than the detector can follow. Two are ours, because the system has clocks and frames: (3) the road was detected
//! too long ago; (4) it lies in the map frame and no pose is known.

use crate::layer::maker::Context;
use crate::road::RoadFrame;

use super::config::{CURVATURE_PER_M_MAX, DIVERGENCE_MIN, ROAD_AGE_MS_MAX, ROUTE_AHEAD_M};

/// Half the length over which the route's curvature is measured, metres. Ours: RDDF rows are metres to hundreds of
/// metres apart, so the curvature at a corner is the curvature of the circle through the points this far before and
/// behind it.
const BASE_M: f64 = 5.0;
/// Distance between samples of the route ahead, metres. Ours; not tuned.
const STEP_M: f64 = 1.0;

/// A condition for painting; the docs say when it is violated.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Condition {
    /// The road was detected too long ago.
    Age,
    /// The road or the route lies in the map frame, and no pose is known.
    Pose,
    /// The orientations are as even as without a road.
    Divergence,
    /// The route ahead bends more than the detector can follow.
    Curvature,
}

/// Where a road comes from.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum RoadSource {
    /// There is no road.
    #[default]
    None,
    /// A road that was sent.
    Sent,
    /// The road that was measured in the sweep.
    Measured,
}

/// The conditions of one map.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PaintingConditions {
    /// Kullback-Leibler divergence between the road's orientations and even ones, nats; `None` without a histogram.
    pub divergence: Option<f64>,
    /// Largest curvature of the route ahead, 1/m; `None` without a route.
    pub curvature_per_m: Option<f64>,
    violated: Vec<Condition>,
    source: RoadSource,
    road_m: Vec<[f64; 2]>,
    widths_m: Vec<f64>,
    route_m: Vec<[f64; 2]>,
    is_route_placed: bool,
}

impl PaintingConditions {
    /// Checks all conditions of a map, and computes the road in the ego frame.
    pub fn check(&mut self, context: &Context<'_>) {
        self.violated.clear();
        self.road_m.clear();
        self.widths_m.clear();
        (self.divergence, self.curvature_per_m, self.source) = (None, None, RoadSource::None);
        let pose = context.map_from_ego.as_ref();
        self.is_route_placed = context.route.is_some_and(|route| route.points_in_ego(pose, &mut self.route_m));
        let Some(stored) = context.road else { return };
        self.source = RoadSource::Sent;

        let age_ns = context.stamp_ns.saturating_sub(stored.road.stamp_ns);
        let ages = stored.road.frame == RoadFrame::Ego;
        // A road with a stamp in the future is no more current than an old one.
        self.add(Condition::Age, ages && age_ns.unsigned_abs() > u64::from(ROAD_AGE_MS_MAX) * 1_000_000);

        let is_road_placed = stored.points_in_ego(pose, &mut self.road_m);
        self.add(Condition::Pose, !is_road_placed);
        self.widths_m.extend_from_slice(&stored.road.widths_m);
        self.divergence = divergence(&stored.road.orientations);
        self.add(Condition::Divergence, self.divergence.is_some_and(|found| found < f64::from(DIVERGENCE_MIN)));

        self.check_route(context);
    }

    /// True if no road was sent, or only a road that is too old.
    pub fn lacks_road(&self) -> bool {
        self.source == RoadSource::None || self.violated(Condition::Age)
    }

    /// Offers a measured road (ego frame, metres) in place of a road that was not sent or is too old.
    pub fn offer(&mut self, points_m: &[[f64; 2]], widths_m: &[f64], context: &Context<'_>) {
        self.violated.clear();
        self.divergence = None;
        self.source = RoadSource::Measured;
        self.road_m.clear();
        self.road_m.extend_from_slice(points_m);
        self.widths_m.clear();
        self.widths_m.extend_from_slice(widths_m);
        self.check_route(context);
    }

    /// Checks the conditions of the route.
    fn check_route(&mut self, context: &Context<'_>) {
        self.add(Condition::Pose, context.route.is_some() && !self.is_route_placed);
        if self.is_route_placed {
            let curvature = curvature_ahead_per_m(&self.route_m, f64::from(ROUTE_AHEAD_M));
            self.curvature_per_m = Some(curvature);
            self.add(Condition::Curvature, curvature > f64::from(CURVATURE_PER_M_MAX));
        }
    }

    fn add(&mut self, condition: Condition, is_violated: bool) {
        if is_violated {
            self.violated.push(condition);
        }
    }

    /// True if there is a road and no condition is violated.
    pub fn painting(&self) -> bool {
        self.source != RoadSource::None && self.violated.is_empty()
    }

    /// Source of the road that is painted; [`RoadSource::None`] if none is.
    pub fn painted_source(&self) -> RoadSource {
        if self.painting() { self.source } else { RoadSource::None }
    }

    /// True if this condition is violated.
    pub fn violated(&self, condition: Condition) -> bool {
        self.violated.contains(&condition)
    }

    /// The road's points (x, y), ego frame, metres.
    pub fn road_m(&self) -> &[[f64; 2]] {
        &self.road_m
    }

    /// Width of the road at each point, metres.
    pub fn widths_m(&self) -> &[f64] {
        &self.widths_m
    }

    /// The route's points (x, y), ego frame, metres; `None` without a route, or if its place is not known.
    pub fn route_m(&self) -> Option<&[[f64; 2]]> {
        self.is_route_placed.then_some(&self.route_m[..])
    }
}

/// Kullback-Leibler divergence between a histogram and the even one, nats: 0 if all orientations are equally frequent,
/// ln(bins) if only one occurs; `None` without votes.
pub fn divergence(votes: &[f32]) -> Option<f64> {
    let sum: f64 = votes.iter().map(|&v| f64::from(v)).sum();
    if votes.is_empty() || sum <= 0.0 {
        return None;
    }
    let part = |&v: &f32| {
        let p = f64::from(v) / sum;
        // The limit of p ln p at 0 is 0.
        if p > 0.0 { p * libm::log(p * votes.len() as f64) } else { 0.0 }
    };
    Some(votes.iter().map(part).sum())
}

/// Largest curvature of a line of two or more points over `ahead_m` from its point nearest to the ego origin, 1/m. The
/// curvature at a position is the curvature of the circle through it and the positions [`BASE_M`] before and behind it
/// on the line.
pub fn curvature_ahead_per_m(line: &[[f64; 2]], ahead_m: f64) -> f64 {
    let (nearest_pair, nearest_share) = nearest_to_origin(line);
    // Samples at equal steps from BASE_M before the nearest point to BASE_M beyond the end.
    let mut walk = Walk::backwards(line, nearest_pair, nearest_share, BASE_M);
    let start_m = -walk.behind_m;
    let steps = ((ahead_m + BASE_M - start_m) / STEP_M).floor() as usize;
    let mut positions = Vec::with_capacity(steps + 1);
    for step in 0..=steps {
        match walk.position_at(step as f64 * STEP_M) {
            Some(position) => positions.push(position),
            None => break,
        }
    }
    let base = (BASE_M / STEP_M) as usize;
    let triples =
        (base..positions.len().saturating_sub(base)).map(|i| [positions[i - base], positions[i], positions[i + base]]);
    triples.map(curvature_per_m).fold(0.0, f64::max)
}

/// Index of the pair of points whose connection is nearest to the origin, and the nearest position on it, 0 to 1.
fn nearest_to_origin(line: &[[f64; 2]]) -> (usize, f64) {
    let mut nearest = (f64::INFINITY, 0, 0.0);
    for (pair, ends) in line.windows(2).enumerate() {
        let ([ax, ay], [bx, by]) = (ends[0], ends[1]);
        let (dx, dy) = (bx - ax, by - ay);
        let length_squared = dx * dx + dy * dy;
        let share = if length_squared > 0.0 { (-(ax * dx + ay * dy) / length_squared).clamp(0.0, 1.0) } else { 0.0 };
        let (x, y) = (ax + share * dx, ay + share * dy);
        if x * x + y * y < nearest.0 {
            nearest = (x * x + y * y, pair, share);
        }
    }
    (nearest.1, nearest.2)
}

/// Positions along a line by their distance from the start of the walk.
struct Walk<'a> {
    line: &'a [[f64; 2]],
    pair: usize,
    /// Distance of the pair's first point from the start, metres.
    distance_m: f64,
    /// Distance from the start to the nearest point, metres.
    behind_m: f64,
}

impl<'a> Walk<'a> {
    /// Starts `behind_m` before a position on the line, or at the line's first point.
    fn backwards(line: &'a [[f64; 2]], pair: usize, share: f64, behind_m: f64) -> Self {
        let mut pair = pair;
        let mut before_m = share * length(line, pair);
        while before_m < behind_m && pair > 0 {
            pair -= 1;
            before_m += length(line, pair);
        }
        let begins_m = before_m.min(behind_m);
        Self { line, pair, distance_m: begins_m - before_m, behind_m: begins_m }
    }

    /// The position at a distance from the start, which must not decrease from call to call; `None` beyond the line's
    /// end.
    fn position_at(&mut self, distance_m: f64) -> Option<[f64; 2]> {
        loop {
            let [ax, ay] = *self.line.get(self.pair)?;
            let [bx, by] = *self.line.get(self.pair + 1)?;
            let length_m = length(self.line, self.pair);
            let beyond = distance_m - self.distance_m;
            if beyond <= length_m && length_m > 0.0 {
                let share = beyond / length_m;
                return Some([ax + share * (bx - ax), ay + share * (by - ay)]);
            }
            self.distance_m += length_m;
            self.pair += 1;
        }
    }
}

/// Length of a pair of points of a line.
fn length(line: &[[f64; 2]], pair: usize) -> f64 {
    let ([ax, ay], [bx, by]) = (line[pair], line[pair + 1]);
    libm::hypot(bx - ax, by - ay)
}

/// Curvature of the circle through three positions: four times the triangle's area over the product of its sides.
fn curvature_per_m([a, b, c]: [[f64; 2]; 3]) -> f64 {
    let side = |p: [f64; 2], q: [f64; 2]| libm::hypot(q[0] - p[0], q[1] - p[1]);
    let twice_area = ((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])).abs();
    let sides = side(a, b) * side(b, c) * side(a, c);
    // Two of the positions are equal, because the line turns back on itself: it is the curvature of a circle whose
    // radius is half of BASE_M.
    if sides > 0.0 { 2.0 * twice_area / sides } else { 2.0 / BASE_M }
}
