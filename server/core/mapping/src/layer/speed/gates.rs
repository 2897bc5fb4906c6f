//! Whether a road may be painted now (§3.3, "No road data"): either gate stops the painting at once.
//!
//! In: the newest road and route with the newest ego pose. Out: [`Gates`]: the road in the ego frame, and which gates
//! are closed. The paper's two: (1) the orientations that dominate the detector's image are as good as random; (2) the
//! route bends more than the detector can follow. Two more that any system with clocks and frames needs: (3) the road
//! was seen too long ago; (4) it lies in the map frame and no pose is known.

use crate::layer::speed::config::SpeedConfig;
use crate::event::RoadFrame;
use crate::layer::maker::Context;

/// Half the base over which the route's curvature is measured: RDDF rows are metres to hundreds of metres apart, so a
/// corner is a circle through the points this far before and behind it.
const BASE_M: f64 = 5.0;
/// How finely the route ahead is looked at.
const STEP_M: f64 = 1.0;

/// What may stop the painting.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Gate {
    /// The road was seen too long ago.
    Age,
    /// The road or route lies in the map frame, and no pose is known.
    Pose,
    /// Orientations as even as without a road.
    Divergence,
    /// The route ahead bends more than the detector follows.
    Curvature,
}

/// The gates' state for one map.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Gates {
    /// Kullback-Leibler divergence of the road's orientations from even ones, nats; `None` without a histogram.
    pub divergence: Option<f64>,
    /// Largest curvature of the route ahead; `None` without a route.
    pub curvature_per_m: Option<f64>,
    closed: Vec<Gate>,
    has_road: bool,
    road_m: Vec<[f64; 2]>,
    route_m: Vec<[f64; 2]>,
}

impl Gates {
    /// Judges what is known now; nothing of the map before stays.
    pub fn judge(&mut self, context: &Context<'_>, config: &SpeedConfig) {
        self.closed.clear();
        self.road_m.clear();
        (self.divergence, self.curvature_per_m, self.has_road) = (None, None, false);
        let Some(taken) = context.road else { return };
        self.has_road = true;

        let age_ns = context.stamp_ns.saturating_sub(taken.road.stamp_ns);
        let ages = taken.road.frame == RoadFrame::Ego;
        // One of the future is as little this moment's as an old one.
        self.close(Gate::Age, ages && age_ns.unsigned_abs() > u64::from(config.road_age_ms_max) * 1_000_000);

        let pose = context.map_from_ego.as_ref();
        let road_placed = taken.points_in_ego(pose, &mut self.road_m);
        let route_placed = context.route.is_none_or(|route| route.points_in_ego(pose, &mut self.route_m));
        self.close(Gate::Pose, !road_placed || !route_placed);

        self.divergence = divergence(&taken.road.orientations);
        self.close(Gate::Divergence, self.divergence.is_some_and(|found| found < f64::from(config.divergence_min)));

        if context.route.is_some() && route_placed {
            let curvature = curvature_ahead_per_m(&self.route_m, f64::from(config.route_ahead_m));
            self.curvature_per_m = Some(curvature);
            self.close(Gate::Curvature, curvature > f64::from(config.curvature_per_m_max));
        }
    }

    fn close(&mut self, gate: Gate, closed: bool) {
        if closed {
            self.closed.push(gate);
        }
    }

    /// Whether there is a road and every gate is open.
    pub fn painting(&self) -> bool {
        self.has_road && self.closed.is_empty()
    }

    /// Whether this gate stops the painting.
    pub fn closed(&self, gate: Gate) -> bool {
        self.closed.contains(&gate)
    }

    /// The road's points, ego frame.
    pub fn road_m(&self) -> &[[f64; 2]] {
        &self.road_m
    }
}

/// Kullback-Leibler divergence of a histogram from the even one, nats: 0 where every orientation is as likely, ln(bins)
/// where there is but one. `None` without bins.
pub fn divergence(votes: &[f32]) -> Option<f64> {
    let sum: f64 = votes.iter().map(|&v| f64::from(v)).sum();
    if votes.is_empty() || sum <= 0.0 {
        return None;
    }
    let part = |&v: &f32| {
        let p = f64::from(v) / sum;
        // p ln p goes to 0 with p.
        if p > 0.0 { p * (p * votes.len() as f64).ln() } else { 0.0 }
    };
    Some(votes.iter().map(part).sum())
}

/// Largest curvature of a line of two or more points over `ahead_m` from its point nearest to the ego origin. The
/// curvature at a place is that of the circle through it and the places [`BASE_M`] before and behind it on the line.
pub fn curvature_ahead_per_m(line: &[[f64; 2]], ahead_m: f64) -> f64 {
    let (nearest_pair, nearest_share) = nearest_to_origin(line);
    // Along the line from BASE_M before the nearest point to BASE_M beyond the end, at equal steps.
    let mut walk = Walk::backwards(line, nearest_pair, nearest_share, BASE_M);
    let start_m = -walk.behind_m;
    let steps = ((ahead_m + BASE_M - start_m) / STEP_M).floor() as usize;
    let mut places = Vec::with_capacity(steps + 1);
    for step in 0..=steps {
        match walk.to(step as f64 * STEP_M) {
            Some(place) => places.push(place),
            None => break,
        }
    }
    let base = (BASE_M / STEP_M) as usize;
    let triples = (base..places.len().saturating_sub(base)).map(|i| [places[i - base], places[i], places[i + base]]);
    triples.map(curvature_per_m).fold(0.0, f64::max)
}

/// Pair of points whose join is nearest to the origin, and where on it, 0 to 1.
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

/// Places along a line by the way from where the walk began.
struct Walk<'a> {
    line: &'a [[f64; 2]],
    pair: usize,
    /// Way at the pair's first point.
    way_m: f64,
    /// How far before the nearest point the walk began.
    behind_m: f64,
}

impl<'a> Walk<'a> {
    /// Begins `behind_m` before a place on the line, or at the line's first point.
    fn backwards(line: &'a [[f64; 2]], pair: usize, share: f64, behind_m: f64) -> Self {
        let mut pair = pair;
        let mut before_m = share * length(line, pair);
        while before_m < behind_m && pair > 0 {
            pair -= 1;
            before_m += length(line, pair);
        }
        let begins_m = before_m.min(behind_m);
        Self { line, pair, way_m: begins_m - before_m, behind_m: begins_m }
    }

    /// The place that far from the beginning; asked with growing ways. `None` beyond the line's end.
    fn to(&mut self, way_m: f64) -> Option<[f64; 2]> {
        loop {
            let [ax, ay] = *self.line.get(self.pair)?;
            let [bx, by] = *self.line.get(self.pair + 1)?;
            let length_m = length(self.line, self.pair);
            let beyond = way_m - self.way_m;
            if beyond <= length_m && length_m > 0.0 {
                let share = beyond / length_m;
                return Some([ax + share * (bx - ax), ay + share * (by - ay)]);
            }
            self.way_m += length_m;
            self.pair += 1;
        }
    }
}

fn length(line: &[[f64; 2]], pair: usize) -> f64 {
    let ([ax, ay], [bx, by]) = (line[pair], line[pair + 1]);
    (bx - ax).hypot(by - ay)
}

/// Of the circle through three places: four times the triangle's area over the product of its sides.
fn curvature_per_m([a, b, c]: [[f64; 2]; 3]) -> f64 {
    let side = |p: [f64; 2], q: [f64; 2]| (q[0] - p[0]).hypot(q[1] - p[1]);
    let twice_area = ((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])).abs();
    let sides = side(a, b) * side(b, c) * side(a, c);
    // The line goes back the way it came: no circle is as narrow.
    if sides > 0.0 { 2.0 * twice_area / sides } else { 2.0 / BASE_M }
}
