//! Estimates how a sensor is mounted: its height, pitch and roll, from the ground under the vehicle.
//!
//! In: the points of several revolutions, sensor frame, metres; the sensor's x axis points forward. Out: a
//! [`MountEstimate`] with its uncertainty, or an error if no ground is found. The ground does not show the horizontal
//! position and the yaw; both are 0.
//!
//! | file | in -> out |
//! |---|---|
//! | `plane` | the points of one revolution -> the plane on which the vehicle stands, with its uncertainty |
//! | `median` | values with weights -> median, standard deviation |
//! | [`check`] | the points of map after map -> how far the ground deviates from the configured mount |
//!
//! The vehicle stands on the two strips under its wheels, so their height and their slopes are what is searched. A road
//! slopes down from its crown, and a verge or pavement lies beside it: a plane through all ground around the vehicle
//! leans by up to 2 degrees there (measured: the first frames of SemanticKITTI's sequence 00). Points near the vehicle
//! and near its path have most weight. The median over the revolutions leaves out those in which the vehicle brakes or
//! passes a hump.

pub mod check;
mod median;
mod plane;

use nalgebra::{UnitQuaternion, Vector3};

use crate::error::too_far;
use crate::sensor::config::Extrinsics;
use crate::sensor::observation::nearest_beyond_reach;
use median::{weighted_median, weighted_std};
use plane::{PlaneError, PlaneEstimate};

/// Greatest number of revolutions that are read. Ours: ten in a row and one a second for ten seconds more.
const REVOLUTIONS_MAX: usize = 20;

/// Height and orientation of a sensor over the ground, with the standard deviation of each.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MountEstimate {
    /// Height over the ground, metres.
    pub height_m: f64,
    /// Rotation about y, radians; a positive value tilts the sensor down.
    pub pitch_rad: f64,
    /// Rotation about x, radians.
    pub roll_rad: f64,
    /// Standard deviation of the height, metres.
    pub height_std_m: f64,
    /// Standard deviation of the pitch, radians.
    pub pitch_std_rad: f64,
    /// Standard deviation of the roll, radians.
    pub roll_std_rad: f64,
    /// Number of cells of 0.5 m whose lowest point lies on the ground plane, over all revolutions.
    pub inliers: usize,
    /// Number of cells of 0.5 m with points, over all revolutions.
    pub samples: usize,
    /// Distance of the ground near the vehicle's path from the plane, metres: the median over the revolutions of 1.48
    /// times the median distance, which is the standard deviation if the distances are normally distributed.
    pub residual_m: f64,
    /// Number of revolutions that were read.
    pub revolutions: usize,
}

/// Why the mount cannot be estimated.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum MountError {
    /// Too few cells have points.
    #[error(
        "{samples} cells of 0.5 m with points from 2.5 to 30 m around the sensor in {revolutions} revolution(s); \
         100 a revolution are needed"
    )]
    TooFewPoints {
        /// Number of cells of 0.5 m with points.
        samples: usize,
        /// Number of revolutions that were read.
        revolutions: usize,
    },
    /// All points are farther from the sensor than any sensor measures.
    #[error("{}", too_far(*nearest_m))]
    TooFar {
        /// Distance of the nearest point, metres.
        nearest_m: f64,
    },
    /// No plane through the points can be the ground.
    #[error(
        "the best plane contains {inliers} of {samples} cells, in {sectors} of 12 directions; 100 a revolution in 4, \
         0.3 to 6 m under the sensor and within 20 degrees of level, are needed"
    )]
    NoGround {
        /// Number of cells whose lowest point lies on the best plane, in the revolution with the most.
        inliers: usize,
        /// Number of cells with points in this revolution.
        samples: usize,
        /// Number of directions in which the best plane has points.
        sectors: u32,
    },
}

/// Share of the cells that lie on the ground plane of an estimate that is not weak, percent. Ours: streets with walls
/// and cars on both sides have about half.
const INLIERS_PERCENT_MIN: usize = 20;

impl MountEstimate {
    /// True if few of the cells lie on the plane: it may be another surface than the ground.
    pub fn is_weak(&self) -> bool {
        100 * self.inliers < INLIERS_PERCENT_MIN * self.samples
    }

    /// The extrinsics with x, y and yaw 0: the ego origin lies on the ground under the sensor.
    pub fn extrinsics(&self) -> Extrinsics {
        Extrinsics {
            x_m: 0.0,
            y_m: 0.0,
            z_m: self.height_m,
            roll_deg: self.roll_rad.to_degrees(),
            pitch_deg: self.pitch_rad.to_degrees(),
            yaw_deg: 0.0,
        }
    }
}

/// Estimates the mount from the points of revolutions, sensor frame, metres. At most the first twenty are read.
///
/// # Errors
/// [`MountError::TooFewPoints`] if fewer than 100 cells a revolution have points; [`MountError::TooFar`] if all points
/// of a revolution are farther than 1 km; [`MountError::NoGround`] if no plane around the vehicle can be the ground in
/// more than half of the revolutions.
pub fn estimate<I, P>(revolutions: I) -> Result<MountEstimate, MountError>
where
    I: IntoIterator<Item = P>,
    P: AsRef<[[f32; 3]]>,
{
    let (mut found, mut samples, mut read) = (Vec::new(), 0, 0);
    let mut best = PlaneError { inliers: 0, samples: 0, sectors: 0 };
    for points in revolutions.into_iter().take(REVOLUTIONS_MAX) {
        read += 1;
        if let Some(nearest_m) = nearest_beyond_reach(points.as_ref().iter().copied()) {
            return Err(MountError::TooFar { nearest_m });
        }
        match plane::estimate(points.as_ref()) {
            Ok(plane) => {
                samples += plane.samples;
                found.push(plane);
            }
            Err(error) => {
                samples += error.samples;
                best = if error.inliers > best.inliers || best.samples == 0 { error } else { best };
            }
        }
    }
    if samples < plane::INLIERS_MIN * read.max(1) {
        return Err(MountError::TooFewPoints { samples, revolutions: read });
    }
    if found.is_empty() || found.len() < read / 2 {
        let PlaneError { inliers, samples, sectors } = best;
        return Err(MountError::NoGround { inliers, samples, sectors });
    }
    let combine = |value: fn(&PlaneEstimate) -> [f64; 2]| combined(found.iter().map(value).collect());
    let [height_m, height_std_m] = combine(|plane| [plane.height_m, plane.height_std_m]);
    let [slope_x, slope_x_std] = combine(|plane| [plane.slope[0], plane.slope_std[0]]);
    let [slope_y, slope_y_std] = combine(|plane| [plane.slope[1], plane.slope_std[1]]);
    // Rz(0) Ry(pitch) Rx(roll) rotates the ground's normal, sensor frame, onto the vertical.
    let normal = Vector3::new(-slope_x, -slope_y, 1.0).normalize();
    let roll_rad = libm::atan2(normal.y, normal.z);
    let pitch_rad = -libm::atan2(normal.x, libm::hypot(normal.y, normal.z));
    debug_assert!((UnitQuaternion::from_euler_angles(roll_rad, pitch_rad, 0.0) * normal - Vector3::z()).norm() < 1e-9);
    let residuals = found.iter().map(|plane| [plane.residual_m, 1.0]).collect();
    Ok(MountEstimate {
        height_m,
        pitch_rad,
        roll_rad,
        height_std_m,
        // The angles of a plane that is nearly level are its slopes.
        pitch_std_rad: slope_x_std,
        roll_std_rad: slope_y_std,
        inliers: found.iter().map(|plane| plane.inliers).sum(),
        samples,
        residual_m: combined(residuals)[0],
        revolutions: read,
    })
}

/// The median of values with standard deviations, weighted by the inverse of their variances, and its standard
/// deviation: the deviation of a single value together with the spread of the values. The spread is not divided by
/// their number, because revolutions that follow each other see the same road.
fn combined(mut values: Vec<[f64; 2]>) -> [f64; 2] {
    values.sort_by(|a, b| a[0].total_cmp(&b[0]));
    let weighted: Vec<[f64; 2]> = values.iter().map(|[value, std]| [*value, 1.0 / (std * std)]).collect();
    let mut stds: Vec<f64> = values.iter().map(|[_, std]| *std).collect();
    stds.sort_by(f64::total_cmp);
    let own = stds.get(stds.len() / 2).copied().unwrap_or(0.0);
    [weighted_median(&weighted), libm::hypot(own, weighted_std(&weighted))]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_wrong_value_of_five_does_not_move_the_median() {
        let [middle, std] = combined(vec![[2.0, 0.01], [2.02, 0.01], [9.0, 0.01], [1.98, 0.01], [2.01, 0.01]]);
        assert!((middle - 2.01).abs() < 1e-12 && (0.01..0.03).contains(&std), "{middle} {std}");
        let [middle, _] = combined(vec![[1.0, 1.0], [2.0, 0.1], [3.0, 1.0]]);
        assert_eq!(middle, 2.0, "the most certain value");
        let [middle, _] = combined(vec![[1.0, 0.25], [2.0, 0.7], [3.0, 0.7]]);
        assert_eq!(middle, 1.0, "one value weighs more than two that are uncertain");
        assert_eq!(combined(vec![[5.0, 0.25]]), [5.0, 0.25]);
        let [_, std] = combined(vec![[0.0, 0.1], [1.0, 0.1], [2.0, 0.1]]);
        assert!(std > 1.4, "values that differ by more than they state are uncertain: {std}");
    }

    #[test]
    fn an_estimate_from_few_of_many_cells_is_weak() {
        let of = |inliers, samples| MountEstimate {
            height_m: 1.8,
            pitch_rad: 0.0,
            roll_rad: 0.0,
            height_std_m: 0.01,
            pitch_std_rad: 0.01,
            roll_std_rad: 0.01,
            inliers,
            samples,
            residual_m: 0.085,
            revolutions: 1,
        };
        assert!(of(110, 2245).is_weak() && !of(900, 2245).is_weak());
    }
}
