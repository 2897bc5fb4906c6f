//! The shapes that questions are about: rectangles and polygons of ground, outlines of vehicles, paths.
//!
//! In: values in the ego frame (x forward, y left, metres, radians). Out: checked corners and poses. A value that is
//! not finite, or a polygon that crosses itself, is an error with that value, and never an answer.

use std::f64::consts::{PI, TAU};

use super::touched::edges;

/// Most corners of a polygon and places of a path. Ours: far more than a vehicle or a plan has.
const CORNERS_MAX: usize = 1_000;
/// Longest path, in metres. Ours: far beyond any map.
const PATH_M_MAX: f64 = 1_000.0;
/// Greatest distance between two poses at which a path is judged, in metres, and greatest way of the farthest corner
/// by turning between them. Ours: less than half a cell.
const STEP_M: f64 = 0.1;

/// Why a shape cannot be judged.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ShapeError {
    /// A value is NaN or infinite.
    #[error("{what} is {value}; a finite number is needed")]
    NotFinite {
        /// The value's name, such as `corner 2, y`.
        what: String,
        /// The value that is NaN or infinite.
        value: f64,
    },
    /// A length is negative, or a path is too long.
    #[error("{what} is {value} m; {allowed} m is allowed")]
    Length {
        /// Name of the value, such as `front_m`.
        what: &'static str,
        /// The value, in metres.
        value: f64,
        /// The range that is allowed, in metres.
        allowed: &'static str,
    },
    /// Too few or too many different corners or places.
    #[error("{what} has {number} different places; {least} to {CORNERS_MAX} are needed")]
    Places {
        /// The polygon or path.
        what: &'static str,
        /// Number of different places.
        number: usize,
        /// Least number of different places that is needed.
        least: usize,
    },
    /// Two edges of a polygon cross.
    #[error(
        "edges {} and {} of the polygon cross near ({:.3}, {:.3}) m; a polygon that does not cross itself is needed",
        edges[0], edges[1], at_m[0], at_m[1]
    )]
    Crossing {
        /// The edges, by the number of their first corner.
        edges: [usize; 2],
        /// Point at which the edges cross, in metres.
        at_m: [f64; 2],
    },
}

impl ShapeError {
    /// Name of the kind of error, the same in every client: `not_finite`, `length`, `places` or `crossing`.
    pub fn kind(&self) -> &'static str {
        match self {
            Self::NotFinite { .. } => "not_finite",
            Self::Length { .. } => "length",
            Self::Places { .. } => "places",
            Self::Crossing { .. } => "crossing",
        }
    }
}

/// An area of ground: a [`Footprint`], or the corners of a polygon (x, y in metres, in order).
pub trait Area {
    /// The corners, checked.
    ///
    /// # Errors
    /// [`ShapeError`] if a value is not finite or negative, corners are missing, or the polygon crosses itself.
    fn checked_corners(&self) -> Result<Vec<[f64; 2]>, ShapeError>;
}

/// The rectangle of ground that a vehicle covers, including its border.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Footprint {
    /// Centre: distance forward, in metres.
    pub x_m: f64,
    /// Centre: distance to the left, in metres.
    pub y_m: f64,
    /// Heading in radians, counter-clockwise from the ego x axis.
    pub heading_rad: f64,
    /// Length along the heading, in metres.
    pub length_m: f64,
    /// Width across the heading, in metres.
    pub width_m: f64,
}

impl Footprint {
    /// The corners (x, y) in metres, counter-clockwise, starting at the front right.
    pub fn corners(&self) -> [[f64; 2]; 4] {
        let ahead = self.length_m / 2.0;
        let outline = Outline { front_m: ahead, rear_m: ahead, width_m: self.width_m };
        outline.at([self.x_m, self.y_m], self.heading_rad)
    }
}

impl Area for Footprint {
    fn checked_corners(&self) -> Result<Vec<[f64; 2]>, ShapeError> {
        let Self { x_m, y_m, heading_rad, length_m, width_m } = *self;
        for (what, value) in [("x_m", x_m), ("y_m", y_m), ("heading_rad", heading_rad)] {
            finite(|| what.into(), value)?;
        }
        length("length_m", length_m)?;
        length("width_m", width_m)?;
        Ok(self.corners().into())
    }
}

impl Area for [[f64; 2]] {
    fn checked_corners(&self) -> Result<Vec<[f64; 2]>, ShapeError> {
        let corners = places("polygon", self, "corner", 3)?;
        check_crossings(&corners)?;
        Ok(corners)
    }
}

impl<const N: usize> Area for [[f64; 2]; N] {
    fn checked_corners(&self) -> Result<Vec<[f64; 2]>, ShapeError> {
        self.as_slice().checked_corners()
    }
}

impl Area for Vec<[f64; 2]> {
    fn checked_corners(&self) -> Result<Vec<[f64; 2]>, ShapeError> {
        self.as_slice().checked_corners()
    }
}

/// Outline of a vehicle about its reference point, in metres.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Outline {
    /// Distance from the reference point to the front.
    pub front_m: f64,
    /// Distance from the reference point to the rear.
    pub rear_m: f64,
    /// Width of the outline; half of it lies on each side of the reference point.
    pub width_m: f64,
}

impl Outline {
    /// The corners of the vehicle with its reference point at a place, counter-clockwise from the front right.
    pub(super) fn at(&self, [x, y]: [f64; 2], heading_rad: f64) -> [[f64; 2]; 4] {
        let (sin, cos) = heading_rad.sin_cos();
        let left = self.width_m / 2.0;
        [(self.front_m, -left), (self.front_m, left), (-self.rear_m, left), (-self.rear_m, -left)]
            .map(|(ahead, left)| [x + ahead * cos - left * sin, y + ahead * sin + left * cos])
    }

    /// Distance of the farthest corner from the reference point, in metres.
    fn reach_m(&self) -> f64 {
        self.front_m.max(self.rear_m).hypot(self.width_m / 2.0)
    }

    pub(super) fn check(&self) -> Result<(), ShapeError> {
        length("front_m", self.front_m)?;
        length("rear_m", self.rear_m)?;
        length("width_m", self.width_m)
    }
}

/// A way of the vehicle's reference point.
#[derive(Clone, Debug, PartialEq)]
pub enum Path {
    /// Straight from place to place (x, y in metres); the vehicle heads along each stretch, and turns at the place
    /// between two of them the shorter way, to the left if both are equal.
    Places(Vec<[f64; 2]>),
    /// An arc of constant curvature from the ego origin, straight ahead at its beginning.
    Arc {
        /// Curvature in 1/m, positive to the left; 0 is a straight line.
        curvature_per_m: f64,
        /// Length in metres; negative if the vehicle drives backwards.
        length_m: f64,
    },
}

/// One pose of a path.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct PathPose {
    /// Distance along the path from its beginning, in metres.
    pub along_m: f64,
    pub place: [f64; 2],
    pub heading_rad: f64,
}

impl Path {
    /// Poses of a vehicle, each at most [`STEP_M`] from the pose before and turned by so little that its farthest
    /// corner moves at most as far by that; with both ends.
    pub(super) fn poses(&self, outline: &Outline) -> Result<Vec<PathPose>, ShapeError> {
        match self {
            Self::Places(given) => straight_poses(given, outline.reach_m()),
            Self::Arc { curvature_per_m, length_m } => arc_poses(*curvature_per_m, *length_m, outline.reach_m()),
        }
    }
}

fn straight_poses(given: &[[f64; 2]], reach_m: f64) -> Result<Vec<PathPose>, ShapeError> {
    let places = places("path", given, "place", 2)?;
    let (mut poses, mut before_m) = (Vec::<PathPose>::new(), 0.0);
    for pair in places.windows(2) {
        let [from, to] = [pair[0], pair[1]];
        let (dx, dy) = (to[0] - from[0], to[1] - from[1]);
        let (stretch_m, heading_rad) = (dx.hypot(dy), dy.atan2(dx));
        path_length("the path", before_m + stretch_m)?;
        if let Some(before) = poses.last().copied() {
            let turn_rad = shorter_turn(before.heading_rad, heading_rad);
            let steps = steps(turn_m(turn_rad, reach_m)?);
            poses.extend((1..steps).map(|step| {
                let turned_rad = f64::from(step) / f64::from(steps) * turn_rad;
                PathPose { heading_rad: before.heading_rad + turned_rad, ..before }
            }));
        }
        let steps = steps(stretch_m);
        poses.extend((0..=steps).map(|step| {
            let share = f64::from(step) / f64::from(steps);
            let place = [from[0] + share * dx, from[1] + share * dy];
            PathPose { along_m: before_m + share * stretch_m, place, heading_rad }
        }));
        before_m += stretch_m;
    }
    Ok(poses)
}

fn arc_poses(curvature_per_m: f64, length_m: f64, reach_m: f64) -> Result<Vec<PathPose>, ShapeError> {
    finite(|| "curvature_per_m".into(), curvature_per_m)?;
    finite(|| "length_m".into(), length_m)?;
    path_length("the path", length_m.abs())?;
    let steps = steps(length_m.abs().max(turn_m(curvature_per_m * length_m, reach_m)?));
    let pose = |step: u32| {
        let along_m = f64::from(step) / f64::from(steps) * length_m;
        let heading_rad = curvature_per_m * along_m;
        // Both forms of the chord are exact; the second one has no division by a small curvature.
        let half = heading_rad / 2.0;
        let chord_m = if half.abs() < 1e-9 { along_m } else { along_m * half.sin() / half };
        let (sin, cos) = half.sin_cos();
        PathPose { along_m: along_m.abs(), place: [chord_m * cos, chord_m * sin], heading_rad: heading_rad % TAU }
    };
    Ok((0..=steps).map(pose).collect())
}

/// Steps of at most [`STEP_M`] on a way.
fn steps(way_m: f64) -> u32 {
    (way_m / STEP_M).ceil().max(1.0) as u32
}

/// The turn from one heading to another, in radians, positive to the left.
fn shorter_turn(from_rad: f64, to_rad: f64) -> f64 {
    let turn_rad = to_rad - from_rad;
    if turn_rad > PI {
        turn_rad - TAU
    } else if turn_rad <= -PI {
        turn_rad + TAU
    } else {
        turn_rad
    }
}

/// The way of the farthest corner by a turn, in metres.
fn turn_m(turn_rad: f64, reach_m: f64) -> Result<f64, ShapeError> {
    let way_m = turn_rad.abs() * reach_m;
    path_length("the turn of the farthest corner", way_m)?;
    Ok(way_m)
}

fn finite(what: impl Fn() -> String, value: f64) -> Result<(), ShapeError> {
    if value.is_finite() { Ok(()) } else { Err(ShapeError::NotFinite { what: what(), value }) }
}

/// Checks a length in metres.
pub(super) fn length(what: &'static str, value: f64) -> Result<(), ShapeError> {
    finite(|| what.into(), value)?;
    if value < 0.0 { Err(ShapeError::Length { what, value, allowed: "0 or more" }) } else { Ok(()) }
}

/// Checks the coordinates of a point.
pub(super) fn finite_point(point: [f64; 2]) -> Result<(), ShapeError> {
    ["x_m", "y_m"].into_iter().zip(point).try_for_each(|(what, value)| finite(|| what.into(), value))
}

/// Checks the length of a way. A length that is not a number is too long.
fn path_length(what: &'static str, value: f64) -> Result<(), ShapeError> {
    let allowed = "0 to 1000";
    if value <= PATH_M_MAX { Ok(()) } else { Err(ShapeError::Length { what, value, allowed }) }
}

/// The places, without places that repeat the place before.
fn places(what: &'static str, given: &[[f64; 2]], one: &str, least: usize) -> Result<Vec<[f64; 2]>, ShapeError> {
    for (index, place) in given.iter().enumerate() {
        for (axis, value) in ["x", "y"].into_iter().zip(place) {
            finite(|| format!("{one} {index}, {axis}"), *value)?;
        }
    }
    let mut places = given.to_vec();
    places.dedup();
    // A ring that ends where it begins has that place once.
    if what == "polygon" && places.len() > 1 && places.first() == places.last() {
        places.pop();
    }
    let number = places.len();
    if !(least..=CORNERS_MAX).contains(&number) {
        return Err(ShapeError::Places { what, number, least });
    }
    Ok(places)
}

/// Refuses a polygon with two edges that cross. Edges that only touch one another are allowed.
fn check_crossings(corners: &[[f64; 2]]) -> Result<(), ShapeError> {
    let side = |[a, b]: [[f64; 2]; 2], p: [f64; 2]| (b[0] - a[0]) * (p[1] - a[1]) - (b[1] - a[1]) * (p[0] - a[0]);
    let parted = |a: f64, b: f64| (a > 0.0 && b < 0.0) || (a < 0.0 && b > 0.0);
    for (first, one) in edges(corners).enumerate() {
        for (second, other) in edges(corners).enumerate().skip(first + 1) {
            let (from, to) = (side(one, other[0]), side(one, other[1]));
            if parted(from, to) && parted(side(other, one[0]), side(other, one[1])) {
                let share = from / (from - to);
                let at_m = [0, 1].map(|axis| other[0][axis] + share * (other[1][axis] - other[0][axis]));
                return Err(ShapeError::Crossing { edges: [first, second], at_m });
            }
        }
    }
    Ok(())
}
