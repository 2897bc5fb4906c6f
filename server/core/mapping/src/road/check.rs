//! Checks of roads, and the error they give.

use crate::road::Road;

/// Greatest number of points of one road. Ours: the route of the Grand Challenge of 2004 has 2586.
pub const POINTS_MAX: usize = 65_536;
/// Greatest coordinate of a point, metres. A quarter of the Earth's circumference: no point of a local frame is farther
/// away.
const COORDINATE_M_MAX: f64 = 1e7;
/// Greatest width, metres. Ours: the widest corridor of the route of 2004 is 488 m.
const WIDTH_M_MAX: f64 = 1000.0;
/// Least distance between neighbouring points, metres. Ours: nearer points give no direction.
const SPACING_M_MIN: f64 = 0.01;
/// Greatest speed limit, m/s. Ours: the greatest speed of an ego pose.
const SPEED_LIMIT_MPS_MAX: f64 = 1000.0;
/// Greatest number of bins of a histogram of orientations. Ours: a tenth of a degree each.
const BINS_MAX: usize = 3600;

/// A road that cannot be used.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum RoadError {
    /// The road has too few points to have a direction, or too many.
    #[error("road with {points} point(s): 2 to 65536 are allowed")]
    Points {
        /// Number of points.
        points: usize,
    },
    /// The number of widths differs from the number of points.
    #[error("road with {points} points and {widths} widths: one width a point is allowed")]
    Widths {
        /// Number of points.
        points: usize,
        /// Number of widths.
        widths: usize,
    },
    /// A coordinate of a point is not finite or too large.
    #[error("road point {index} at ({x_m}, {y_m}) m: coordinates within 10000 km are allowed")]
    Point {
        /// Index of the point, counted from 0.
        index: usize,
        /// The point's x coordinate, metres.
        x_m: f64,
        /// The point's y coordinate, metres.
        y_m: f64,
    },
    /// A point is too near to the point before it.
    #[error("road point {index} is {distance_m} m from the one before: 0.01 m or more is allowed")]
    Coinciding {
        /// Index of the point, counted from 0.
        index: usize,
        /// Distance from the point before, metres.
        distance_m: f64,
    },
    /// A width is not positive or too large.
    #[error("road point {index} is {width_m} m wide: more than 0 and up to 1000 m is allowed")]
    Width {
        /// Index of the point, counted from 0.
        index: usize,
        /// The width, metres.
        width_m: f64,
    },
    /// The histogram of orientations has no votes, a negative vote, or a number of bins that is not allowed.
    #[error(
        "{bins} orientation bins with {votes} votes together: 2 to 3600 bins, none negative, and a vote are allowed"
    )]
    Orientations {
        /// Number of bins.
        bins: usize,
        /// Sum of the votes.
        votes: f64,
    },
    /// The number of speed limits is neither 0 nor the number of points.
    #[error("road with {points} points and {limits} speed limits: none or one a point are allowed")]
    SpeedLimits {
        /// Number of points.
        points: usize,
        /// Number of speed limits.
        limits: usize,
    },
    /// A speed limit is not finite, negative or too large.
    #[error("road point {index} with a speed limit of {mps} m/s: 0 to 1000 m/s is allowed")]
    SpeedLimit {
        /// Index of the point.
        index: usize,
        /// The speed limit, m/s.
        mps: f64,
    },
}

impl RoadError {
    /// The key under which a ledger counts the error.
    pub fn reason(&self) -> &'static str {
        match self {
            Self::Points { .. } => "road_points",
            Self::Widths { .. } => "road_widths",
            Self::Point { .. } => "road_point",
            Self::Coinciding { .. } => "road_coinciding",
            Self::Width { .. } => "road_width",
            Self::Orientations { .. } => "road_orientations",
            Self::SpeedLimits { .. } => "road_speed_limits",
            Self::SpeedLimit { .. } => "road_speed_limit",
        }
    }
}

/// Checks all values of a road.
///
/// # Errors
/// [`RoadError`] for the first value that is not allowed.
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
        let is_in_range = x_m.abs() <= COORDINATE_M_MAX && y_m.abs() <= COORDINATE_M_MAX;
        if !is_in_range {
            return Err(RoadError::Point { index, x_m, y_m });
        }
        if !(width_m > 0.0 && width_m <= WIDTH_M_MAX) {
            return Err(RoadError::Width { index, width_m });
        }
        if index > 0 {
            let [bx, by] = road.points[index - 1];
            let distance_m = libm::hypot(x_m - bx, y_m - by);
            if distance_m < SPACING_M_MIN {
                return Err(RoadError::Coinciding { index, distance_m });
            }
        }
    }
    let bins = road.orientations.len();
    if bins > 0 {
        let votes: f64 = road.orientations.iter().map(|&v| f64::from(v)).sum();
        let are_valid = road.orientations.iter().all(|v| *v >= 0.0 && v.is_finite());
        if !(2..=BINS_MAX).contains(&bins) || !are_valid || votes <= 0.0 {
            return Err(RoadError::Orientations { bins, votes });
        }
    }
    let limits = road.speed_limits_mps.len();
    if limits != 0 && limits != points {
        return Err(RoadError::SpeedLimits { points, limits });
    }
    // NaN is in no range.
    let is_valid = |mps: &f64| (0.0..=SPEED_LIMIT_MPS_MAX).contains(mps);
    match road.speed_limits_mps.iter().position(|mps| !is_valid(mps)) {
        Some(index) => Err(RoadError::SpeedLimit { index, mps: road.speed_limits_mps[index] }),
        None => Ok(()),
    }
}
