//! Roads: checked when they come, kept until the next, carried into the ego frame of the map that is being made.
//!
//! In: [`Road`] events; or a route or lane file as text ([`rddf`], [`rndf`]), whose latitudes and longitudes
//! [`LocalFrame`] makes metres. Out: points and half widths for [`crate::layer::speed`]. A road is one strip; the newest of
//! each purpose counts.

pub mod rddf;
pub mod rndf;

use nalgebra::{Isometry3, Point3};

use crate::event::{Road, RoadFrame, RoadPurpose};

/// Points of one road. The route of 2004 had 2586.
pub const POINTS_MAX: usize = 65_536;
/// Coordinates beyond are no place on Earth's surface in a local frame.
const COORDINATE_M_MAX: f64 = 1e7;
/// The widest corridor of the 2004 route is 488 m.
const WIDTH_M_MAX: f64 = 1000.0;
/// Points nearer to one another give no direction.
const SPACING_M_MIN: f64 = 0.01;
/// A foot, metres: both file formats give widths in feet.
pub const FOOT_M: f64 = 0.3048;

/// A road that is no road.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum RoadError {
    /// Too few points to have a direction, or too many.
    #[error("road with {points} point(s): 2 to 65536 are allowed")]
    Points {
        /// How many.
        points: usize,
    },
    /// Points and widths do not belong together.
    #[error("road with {points} points and {widths} widths: one width a point is allowed")]
    Widths {
        /// How many points.
        points: usize,
        /// How many widths.
        widths: usize,
    },
    /// A point that is nowhere.
    #[error("road point {index} at ({x_m}, {y_m}) m: coordinates within 10000 km are allowed")]
    Point {
        /// Counted from 0.
        index: usize,
        /// As it came.
        x_m: f64,
        /// As it came.
        y_m: f64,
    },
    /// A point where the one before is.
    #[error("road point {index} is {distance_m} m from the one before: 0.01 m or more is allowed")]
    Coinciding {
        /// Counted from 0.
        index: usize,
        /// From the point before.
        distance_m: f64,
    },
    /// A width that is none.
    #[error("road point {index} is {width_m} m wide: more than 0 and up to 1000 m is allowed")]
    Width {
        /// Counted from 0.
        index: usize,
        /// As it came.
        width_m: f64,
    },
    /// A histogram without votes, or with votes that cannot be.
    #[error(
        "{bins} orientation bins with {votes} votes together: 2 to 3600 bins, none negative, and a vote are allowed"
    )]
    Orientations {
        /// How many.
        bins: usize,
        /// Their sum.
        votes: f64,
    },
}

impl RoadError {
    /// The ledger's key.
    pub fn reason(&self) -> &'static str {
        match self {
            Self::Points { .. } => "road_points",
            Self::Widths { .. } => "road_widths",
            Self::Point { .. } => "road_point",
            Self::Coinciding { .. } => "road_coinciding",
            Self::Width { .. } => "road_width",
            Self::Orientations { .. } => "road_orientations",
        }
    }
}

/// Checks all that painting relies on.
///
/// # Errors
/// [`RoadError`] for the first thing wrong.
pub fn check(road: &Road) -> Result<(), RoadError> {
    let points = road.points.len();
    if !(2..=POINTS_MAX).contains(&points) {
        return Err(RoadError::Points { points });
    }
    if road.widths_m.len() != points {
        return Err(RoadError::Widths { points, widths: road.widths_m.len() });
    }
    for (index, (&[x_m, y_m], &width_m)) in road.points.iter().zip(&road.widths_m).enumerate() {
        // NaN fails every comparison.
        let somewhere = x_m.abs() <= COORDINATE_M_MAX && y_m.abs() <= COORDINATE_M_MAX;
        if !somewhere {
            return Err(RoadError::Point { index, x_m, y_m });
        }
        if !(width_m > 0.0 && width_m <= WIDTH_M_MAX) {
            return Err(RoadError::Width { index, width_m });
        }
        if index > 0 {
            let [bx, by] = road.points[index - 1];
            let distance_m = (x_m - bx).hypot(y_m - by);
            if distance_m < SPACING_M_MIN {
                return Err(RoadError::Coinciding { index, distance_m });
            }
        }
    }
    let bins = road.orientations.len();
    if bins > 0 {
        let votes: f64 = road.orientations.iter().map(|&v| f64::from(v)).sum();
        let fine = road.orientations.iter().all(|v| *v >= 0.0 && v.is_finite());
        if !(2..=3600).contains(&bins) || !fine || votes <= 0.0 {
            return Err(RoadError::Orientations { bins, votes });
        }
    }
    Ok(())
}

/// A checked road, and where the vehicle was when it came.
#[derive(Clone, Debug, PartialEq)]
pub struct TakenRoad {
    /// As it came.
    pub road: Road,
    /// Newest ego pose at that time.
    pub map_from_ego: Option<Isometry3<f64>>,
}

impl TakenRoad {
    /// The points in the ego frame of a vehicle now at `map_from_ego`, written to `points`; `false`, and nothing
    /// written, where the road lies in the map frame and no pose is known. A road seen before any pose is taken as if
    /// the vehicle stood since: it does not live long.
    pub fn points_in_ego(&self, map_from_ego: Option<&Isometry3<f64>>, points: &mut Vec<[f64; 2]>) -> bool {
        let (ego_from_road, z) = match (self.road.frame, map_from_ego, &self.map_from_ego) {
            (RoadFrame::Map, None, _) => return false,
            // Roads have no heights: their points are taken to lie as high as the vehicle.
            (RoadFrame::Map, Some(now), _) => (now.inverse(), now.translation.z),
            (RoadFrame::Ego, Some(now), Some(then)) => (now.inverse() * then, 0.0),
            (RoadFrame::Ego, _, _) => (Isometry3::identity(), 0.0),
        };
        let moved = |&[x, y]: &[f64; 2]| {
            let point = ego_from_road * Point3::new(x, y, z);
            [point.x, point.y]
        };
        points.clear();
        points.extend(self.road.points.iter().map(moved));
        true
    }
}

/// The newest road of each purpose.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Roads {
    paint: Option<TakenRoad>,
    route: Option<TakenRoad>,
}

impl Roads {
    /// Takes a road that [`check`] has passed, in place of the one before.
    pub fn take(&mut self, road: &Road, map_from_ego: Option<Isometry3<f64>>) {
        let taken = Some(TakenRoad { road: road.clone(), map_from_ego });
        match road.purpose {
            RoadPurpose::Paint => self.paint = taken,
            RoadPurpose::Route => self.route = taken,
        }
    }

    /// The road to paint.
    pub fn to_paint(&self) -> Option<&TakenRoad> {
        self.paint.as_ref()
    }

    /// The route.
    pub fn route(&self) -> Option<&TakenRoad> {
        self.route.as_ref()
    }

    /// Stamp of the newest road of a purpose.
    pub fn newest_stamp_ns(&self, purpose: RoadPurpose) -> Option<i64> {
        let newest = match purpose {
            RoadPurpose::Paint => &self.paint,
            RoadPurpose::Route => &self.route,
        };
        newest.as_ref().map(|taken| taken.road.stamp_ns)
    }
}

/// A map frame about a place on Earth: x east, y north, metres.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LocalFrame {
    latitude_rad: f64,
    longitude_rad: f64,
}

impl LocalFrame {
    /// The frame whose origin is there.
    pub fn about(latitude_deg: f64, longitude_deg: f64) -> Self {
        Self { latitude_rad: latitude_deg.to_radians(), longitude_rad: longitude_deg.to_radians() }
    }

    /// East and north of the origin, metres, along the WGS 84 ellipsoid's curvatures half-way; within 10 km of the
    /// origin off by less than 0.1 m.
    pub fn metres(&self, latitude_deg: f64, longitude_deg: f64) -> [f64; 2] {
        const SEMI_MAJOR_M: f64 = 6_378_137.0;
        const ECCENTRICITY_SQUARED: f64 = 6.694_379_990_14e-3;
        let (latitude, longitude) = (latitude_deg.to_radians(), longitude_deg.to_radians());
        let (sin, cos) = ((latitude + self.latitude_rad) / 2.0).sin_cos();
        let w = 1.0 - ECCENTRICITY_SQUARED * sin * sin;
        let across_m = SEMI_MAJOR_M / w.sqrt();
        let along_m = SEMI_MAJOR_M * (1.0 - ECCENTRICITY_SQUARED) / (w * w.sqrt());
        [(longitude - self.longitude_rad) * cos * across_m, (latitude - self.latitude_rad) * along_m]
    }
}

/// A line of a route or lane file that was left out.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("line {line}: {what} is {found:?}: allowed is {allowed}")]
pub struct LineRefused {
    /// Counted from 1.
    pub line: usize,
    /// The field's name.
    pub what: &'static str,
    /// As it stands there; empty where it is missing.
    pub found: String,
    /// What would have been taken.
    pub allowed: &'static str,
}

/// A number of a line, within what is allowed.
fn number(
    (line, what): (usize, &'static str),
    field: Option<&str>,
    range: std::ops::RangeInclusive<f64>,
    allowed: &'static str,
) -> Result<f64, LineRefused> {
    let found = field.unwrap_or("").trim();
    match found.parse::<f64>() {
        Ok(value) if range.contains(&value) => Ok(value),
        _ => Err(LineRefused { line, what, found: found.to_owned(), allowed }),
    }
}

fn latitude(line: usize, field: Option<&str>) -> Result<f64, LineRefused> {
    number((line, "latitude"), field, -90.0..=90.0, "-90 to 90 degrees")
}

fn longitude(line: usize, field: Option<&str>) -> Result<f64, LineRefused> {
    number((line, "longitude"), field, -180.0..=180.0, "-180 to 180 degrees")
}
