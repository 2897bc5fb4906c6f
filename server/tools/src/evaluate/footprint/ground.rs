//! Points of known truth -> the squares of ground on which the truth lets a vehicle stand.
//!
//! In: [`JudgedPoint`]s, the position of the sensor, and for simulated worlds what the truth knows beside the returns.
//! Out: [`FreeGround`], a raster in the ego frame. A square is free if labelled ground lies before and beyond it along
//! the sensor's azimuth, nothing stands within [`MARGIN_M`] of it, and a disc of a vehicle's width gets there from the
//! vehicle over such squares. Ground between two returns is judged, because a planner asks for it.

use super::super::judge::{JudgedPoint, OBSTACLE_M_MAX, Scored, Vote};

/// Half the edge of the raster, in metres: the farthest footprint with its corners.
const HALF_M: f32 = 33.0;
/// Edge of a square, in metres.
const EDGE_M: f32 = 0.25;
/// Number of squares of an edge.
const SIDE: usize = (2.0 * HALF_M / EDGE_M) as usize;
/// Number of azimuth columns about the sensor.
const COLUMNS: usize = 720;
/// Depth of a step of a column, in metres, and number of steps.
const STEP_M: f32 = 0.1;
const STEPS: usize = 360;
/// Greatest distance between two returns on ground that proves the ground between them, in metres: more than the rings
/// of 64 lasers are apart at 30 m, of 32 at 15 m and of 16 at 12 m.
const GAP_M_MAX: f32 = 5.0;
/// Greatest range of the first return of a column that proves the ground up to the vehicle, in metres.
const BLIND_M_MAX: f32 = 8.0;
/// Greatest difference of height over a gap: a part that does not depend on it, and rise over run.
const GAP_RISE: (f32, f32) = (0.2, 0.15);
/// Distance that a footprint keeps from everything labelled, in metres: the diagonal of a layer's square of 0.25 m.
const MARGIN_M: f32 = 0.4;
/// Least height of an unlabelled point that counts as a thing, in metres.
const UNLABELLED_M_MIN: f32 = 0.15;
/// Radius of the disc that must get to a footprint, in metres: half the footprint's width.
const DISC_M: f32 = 1.0;
/// The squares under the vehicle itself: rear, front and half the width, in metres. Returns there are its own.
const OWN_M: (f32, f32, f32) = (-2.5, 3.5, 1.5);

/// A place whose truth is known without a return: its position (x, y) in the ego frame, in metres, and its vote.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct KnownPlace {
    /// Position (x, y), in metres.
    pub place: [f32; 2],
    /// The vote of the place, as of a point there.
    pub vote: Vote,
}

/// What a point is to a footprint.
#[derive(Clone, Copy, PartialEq)]
enum PointRole {
    Ground,
    /// Ground on which no vehicle may stand: too steep, or not to be reached.
    Barred,
    Thing,
}

/// The squares on which the truth lets a vehicle stand.
pub struct FreeGround {
    free: Vec<bool>,
    /// Sum and number of the heights of returns on ground, by square.
    heights: Vec<(f32, u32)>,
    /// Whether the square has returns on a road (first bit) and on a pavement (second).
    paved: Vec<u8>,
}

/// How even the ground under a footprint is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Surface {
    /// One level: a plane fits.
    Level,
    /// Across a kerb or another step that a vehicle drives over.
    Stepped,
}

impl FreeGround {
    /// The free ground about a sensor at `sensor_m` (x, y).
    pub fn new(points: &[JudgedPoint], known: &[KnownPlace], sensor_m: [f32; 2]) -> Self {
        let mut ground =
            Self { free: vec![false; SIDE * SIDE], heights: vec![(0.0, 0); SIDE * SIDE], paved: vec![0; SIDE * SIDE] };
        let covered = ground.cover(points, sensor_m);
        ground.free = closed(&covered);
        ground.block(points, known);
        ground.keep_reached();
        ground
    }

    /// The surface of a rectangle if the truth lets a vehicle stand on all of it. `squares` are from
    /// [`squares_within`].
    pub fn surface(&self, squares: &[usize]) -> Option<Surface> {
        if !squares.iter().all(|square| self.free[*square]) {
            return None;
        }
        let paved = squares.iter().fold(0, |paved, square| paved | self.paved[*square]);
        let places = squares.iter().filter(|square| self.heights[**square].1 > 0).map(|square| {
            let ([x, y], (sum, number)) = (middle(*square), self.heights[*square]);
            [x, y, sum / number as f32].map(f64::from)
        });
        let is_level = paved != 3 && spread_over_plane(&places.collect::<Vec<_>>()) <= LEVEL_M_MAX;
        Some(if is_level { Surface::Level } else { Surface::Stepped })
    }

    /// The squares that ground returns prove, before anything is taken away.
    fn cover(&mut self, points: &[JudgedPoint], sensor_m: [f32; 2]) -> Vec<bool> {
        let mut columns: Vec<Vec<(f32, f32, PointRole)>> = vec![Vec::new(); COLUMNS];
        for (point, role) in points.iter().filter_map(|point| Some((point, role(point)?))) {
            let (x, y) = (point.place[0] - sensor_m[0], point.place[1] - sensor_m[1]);
            columns[column(x, y)].push((x.hypot(y), point.place[2], role));
            if let (PointRole::Ground, Some(square)) = (role, square(point.place[0], point.place[1])) {
                self.heights[square].0 += point.place[2];
                self.heights[square].1 += 1;
                self.paved[square] |= match point.class {
                    "road" | "parking" | "lane-marking" => 1,
                    "sidewalk" => 2,
                    _ => 0,
                };
            }
        }
        let proven: Vec<Vec<bool>> = columns.into_iter().map(proven_steps).collect();
        (0..SIDE * SIDE)
            .map(|square| {
                let [x, y] = middle(square);
                let (x, y) = (x - sensor_m[0], y - sensor_m[1]);
                let step = (x.hypot(y) / STEP_M) as usize;
                is_own(middle(square)) || step < STEPS && proven[column(x, y)][step]
            })
            .collect()
    }

    /// Takes away the squares near things, and barred ground.
    fn block(&mut self, points: &[JudgedPoint], known: &[KnownPlace]) {
        for (point, role) in points.iter().filter_map(|point| Some((point, role(point)?))) {
            let place = [point.place[0], point.place[1]];
            match role {
                PointRole::Ground => {}
                PointRole::Barred => self.block_about(place, 0.0),
                PointRole::Thing => self.block_about(place, MARGIN_M),
            }
        }
        for KnownPlace { place, vote } in known {
            match vote {
                Vote::Drivable => {}
                Vote::Obstacle => self.block_about(*place, MARGIN_M),
                _ => self.block_about(*place, 0.0),
            }
        }
    }

    fn block_about(&mut self, [x, y]: [f32; 2], margin_m: f32) {
        if is_own([x, y]) {
            return;
        }
        // To the square's middle: half a square more than to its edge.
        let reach_m = margin_m + EDGE_M / 2.0;
        for square in squares_about([x, y], reach_m) {
            let [sx, sy] = middle(square);
            if (sx - x).hypot(sy - y) <= reach_m && !is_own([sx, sy]) {
                self.free[square] = false;
            }
        }
        if let Some(square) = square(x, y) {
            self.free[square] = false;
        }
    }

    /// Keeps the squares that a disc covers on its way from the vehicle.
    fn keep_reached(&mut self) {
        let reach = (DISC_M / EDGE_M) as isize;
        let disc: Vec<(isize, isize)> = (-reach..=reach)
            .flat_map(|dx| (-reach..=reach).map(move |dy| (dx, dy)))
            .filter(|(dx, dy)| dx * dx + dy * dy <= reach * reach)
            .collect();
        let near = |square: usize, (dx, dy): (isize, isize)| {
            let (x, y) = ((square % SIDE) as isize + dx, (square / SIDE) as isize + dy);
            let inside = |index: isize| (0..SIDE as isize).contains(&index);
            (inside(x) && inside(y)).then(|| y as usize * SIDE + x as usize)
        };
        let passes: Vec<bool> = (0..SIDE * SIDE)
            .map(|square| disc.iter().all(|by| near(square, *by).is_some_and(|square| self.free[square])))
            .collect();
        let mut reached = vec![false; SIDE * SIDE];
        let mut waiting: Vec<usize> =
            (0..SIDE * SIDE).filter(|square| passes[*square] && is_own(middle(*square))).collect();
        while let Some(square) = waiting.pop() {
            if !std::mem::replace(&mut reached[square], true) {
                let sides = [(1, 0), (-1, 0), (0, 1), (0, -1)].into_iter().filter_map(|by| near(square, by));
                waiting.extend(sides.filter(|square| passes[*square]));
            }
        }
        let mut free = vec![false; SIDE * SIDE];
        for square in (0..SIDE * SIDE).filter(|square| reached[*square]) {
            disc.iter().filter_map(|by| near(square, *by)).for_each(|square| free[square] = true);
        }
        self.free = free;
    }
}

/// Greatest spread of heights over a plane that is one level, in metres: less than a kerb, more than noise.
const LEVEL_M_MAX: f64 = 0.10;

fn role(point: &JudgedPoint) -> Option<PointRole> {
    let (over, is_ground) = (point.over_m, point.ground[0] == Scored::Ground);
    match point.vote {
        _ if is_own([point.place[0], point.place[1]]) && !is_ground => None,
        Vote::Steep | Vote::Forbidden => Some(PointRole::Barred),
        Vote::Drivable | Vote::Either if is_ground => Some(PointRole::Ground),
        Vote::Seen | Vote::Obstacle => Some(PointRole::Thing),
        // A point without a label or a class, or above simulated ground.
        _ => (over > UNLABELLED_M_MIN && over <= OBSTACLE_M_MAX).then_some(PointRole::Thing),
    }
}

/// The steps of one column that returns on ground prove.
fn proven_steps(mut returns: Vec<(f32, f32, PointRole)>) -> Vec<bool> {
    let mut proven = vec![false; STEPS];
    returns.sort_by(|a, b| a.0.total_cmp(&b.0));
    let mut prove = |from: f32, to: f32| {
        let last = ((to / STEP_M) as usize).min(STEPS - 1);
        proven[((from / STEP_M) as usize).min(last)..=last].fill(true);
    };
    if let Some((range, _, PointRole::Ground)) = returns.first().filter(|first| first.0 <= BLIND_M_MAX) {
        prove(0.0, *range);
    }
    for pair in returns.windows(2) {
        let [(from, low, PointRole::Ground), (to, high, PointRole::Ground)] = pair else { continue };
        let gap = to - from;
        if gap <= GAP_M_MAX && (high - low).abs() <= GAP_RISE.0 + GAP_RISE.1 * gap {
            prove(*from, *to);
        }
    }
    proven
}

/// Fills holes up to two squares wide, as thin shadows are.
fn closed(squares: &[bool]) -> Vec<bool> {
    let around = |squares: &[bool], square: usize, wanted: bool| {
        squares_about(middle(square), EDGE_M).any(|other| squares[other] == wanted)
    };
    let grown: Vec<bool> = (0..SIDE * SIDE).map(|square| around(squares, square, true)).collect();
    (0..SIDE * SIDE).map(|square| !around(&grown, square, false)).collect()
}

fn is_own([x, y]: [f32; 2]) -> bool {
    (OWN_M.0..OWN_M.1).contains(&x) && y.abs() < OWN_M.2
}

fn column(x: f32, y: f32) -> usize {
    let share = (y.atan2(x) / std::f32::consts::TAU).rem_euclid(1.0);
    ((share * COLUMNS as f32) as usize).min(COLUMNS - 1)
}

fn square(x: f32, y: f32) -> Option<usize> {
    let index = |place: f32| {
        let index = ((place + HALF_M) / EDGE_M).floor();
        (index >= 0.0 && index < SIDE as f32).then_some(index as usize)
    };
    Some(index(y)? * SIDE + index(x)?)
}

fn middle(square: usize) -> [f32; 2] {
    [square % SIDE, square / SIDE].map(|index| (index as f32 + 0.5) * EDGE_M - HALF_M)
}

/// The squares whose middles lie in the box of `reach_m` about a place.
pub fn squares_about([x, y]: [f32; 2], reach_m: f32) -> impl Iterator<Item = usize> {
    let span = move |place: f32| {
        let index = |place: f32| ((place + HALF_M) / EDGE_M - 0.5).clamp(0.0, SIDE as f32 - 1.0);
        index(place - reach_m).ceil() as usize..=index(place + reach_m).floor() as usize
    };
    span(y).flat_map(move |iy| span(x).map(move |ix| iy * SIDE + ix))
}

/// The squares whose middles lie within a rectangle.
pub fn squares_within(centre: [f32; 2], heading_rad: f32, half: [f32; 2]) -> Vec<usize> {
    let reach_m = half[0].hypot(half[1]);
    let within = |square: &usize| is_within(middle(*square), centre, heading_rad, half);
    squares_about(centre, reach_m).filter(within).collect()
}

/// True if a place lies within a rectangle.
pub fn is_within([x, y]: [f32; 2], centre: [f32; 2], heading_rad: f32, half: [f32; 2]) -> bool {
    let ((sin, cos), dx, dy) = (heading_rad.sin_cos(), x - centre[0], y - centre[1]);
    (dx * cos + dy * sin).abs() <= half[0] && (dy * cos - dx * sin).abs() <= half[1]
}

/// Greatest less least distance of places (x, y, z) above the plane that fits them best; 0 of fewer than 4 places.
fn spread_over_plane(places: &[[f64; 3]]) -> f64 {
    if places.len() < 4 {
        return 0.0;
    }
    let design =
        nalgebra::DMatrix::from_fn(places.len(), 3, |row, column| [places[row][0], places[row][1], 1.0][column]);
    let heights = nalgebra::DVector::from_fn(places.len(), |row, _| places[row][2]);
    let Ok(plane) = design.clone().svd(true, true).solve(&heights, 1e-9) else { return 0.0 };
    let off = heights - design * plane;
    off.max() - off.min()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn point(range: f32, azimuth: f32, z: f32, class: &'static str) -> JudgedPoint {
        let is_ground = class == "road" || class == "sidewalk";
        JudgedPoint {
            place: [range * azimuth.cos(), range * azimuth.sin(), z],
            over_m: if is_ground { 0.0 } else { z },
            class,
            vote: if is_ground { Vote::Drivable } else { Vote::Obstacle },
            road: false,
            ground: [if is_ground { Scored::Ground } else { Scored::Other }; 2],
        }
    }

    /// Rings of level road at these ranges; behind a pole at 10 m ahead there is no return.
    fn rings(ranges: &[f32]) -> Vec<JudgedPoint> {
        let azimuths =
            (0..1440).map(|step| (step as f32 + 0.5) * std::f32::consts::TAU / 1440.0 - std::f32::consts::PI);
        let mut points: Vec<JudgedPoint> = azimuths
            .flat_map(|azimuth| ranges.iter().map(move |range| (*range, azimuth)))
            .filter(|(range, azimuth)| *range < 10.0 || (azimuth * 10.0).abs() > 0.1)
            .map(|(range, azimuth)| point(range, azimuth, 0.0, "road"))
            .collect();
        points.push(point(10.0, 0.0, 1.0, "pole"));
        points
    }

    fn surface(ground: &FreeGround, x: f32, y: f32) -> Option<Surface> {
        ground.surface(&squares_within([x, y], 0.0, [0.5, 0.5]))
    }

    #[test]
    fn ground_between_rings_is_free_but_not_near_a_thing_nor_beyond_the_last_ring() {
        let ground = FreeGround::new(&rings(&[4.0, 6.0, 8.0, 9.5, 11.0, 13.0, 16.0]), &[], [0.0; 2]);
        let free = |x: f32, y: f32| surface(&ground, x, y) == Some(Surface::Level);
        assert!(free(7.0, 0.0) && free(0.0, 14.5) && free(2.0, 0.0), "also under and near the vehicle");
        assert!(!free(10.0, 0.0) && !free(10.0, 0.8), "0.4 m to the pole");
        assert!(free(10.0, 1.3) && free(14.0, 0.0), "beside it, and over its thin shadow");
        assert!(!free(16.5, 0.0));
    }

    #[test]
    fn a_gap_over_five_metres_proves_nothing_nor_does_ground_without_a_way() {
        let ground = FreeGround::new(&rings(&[4.0, 8.0, 13.5, 17.0]), &[], [0.0; 2]);
        assert_eq!(surface(&ground, 0.0, 6.0), Some(Surface::Level));
        assert_eq!([surface(&ground, 0.0, 11.0), surface(&ground, 0.0, 15.0)], [None; 2], "the ring beyond has no way");
        let ground = FreeGround::new(&rings(&[9.0, 12.0]), &[], [0.0; 2]);
        assert_eq!(surface(&ground, 0.0, 10.0), None, "the first ring is beyond the blind zone");
    }

    #[test]
    fn a_known_place_takes_ground_away_and_a_kerb_is_no_level() {
        let mut points = rings(&[3.4, 3.8, 4.2, 4.6, 5.0, 5.4, 5.8, 6.2, 6.6, 8.0, 9.5, 11.0, 13.0]);
        for point in points.iter_mut().filter(|point| point.place[1] > 5.0) {
            point.place[2] = 0.18;
        }
        let known = [KnownPlace { place: [0.0, -8.0], vote: Vote::Steep }];
        let ground = FreeGround::new(&points, &known, [0.0; 2]);
        assert_eq!([surface(&ground, 0.0, -8.0), surface(&ground, 0.0, -6.5)], [None, Some(Surface::Level)]);
        let across = ground.surface(&squares_within([0.0, 5.0], 1.57, [2.0, 1.0]));
        assert_eq!(across, Some(Surface::Stepped));
    }
}
