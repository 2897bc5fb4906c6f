//! Estimates how a sensor is mounted: its height, pitch and roll, from the ground around the vehicle.
//!
//! In: the points of the first revolutions, sensor frame, metres. Out: a [`MountEstimate`], or an error if no ground is
//! found. The ground is the plane that contains most of the low points near the vehicle. Candidates are planes through
//! three points, drawn with a fixed seed; the best one is refined by least squares. The ground does not show the
//! horizontal position and the yaw; both are 0.

use nalgebra::{Matrix3, UnitQuaternion, Vector3};

use crate::config::sensor::Extrinsics;

/// Least range of a point, metres. Ours: nearer returns are the vehicle itself.
const RANGE_M_MIN: f32 = 2.5;
/// Greatest coordinate of a point, metres. Ours: ground that is farther away is seldom in the plane under the vehicle.
const RADIUS_M_MAX: f32 = 20.0;
/// Heights of a sensor over the ground, metres. Ours: from a cargo bike to a haul truck.
const HEIGHT_M: std::ops::RangeInclusive<f64> = 0.3..=4.0;
/// Greatest tilt, radians. Ours: a sensor that is tilted more does not scan around its vehicle.
const TILT_RAD_MAX: f64 = 0.35;
/// Side of a cell, metres. Ours: one sample a cell, its lowest point, keeps dense near rings from outweighing far ones.
const CELL_M: f32 = 0.5;
const CELLS_ACROSS: usize = (2.0 * RADIUS_M_MAX / CELL_M) as usize;
/// Greatest distance of a point on a plane from the plane, metres: twice a Velodyne's noise on asphalt. With twice as
/// much the plane leans onto kerbs and verges, by half a degree in a street with pavements 0.12 m high (measured).
const INLIER_M: f64 = 0.03;
/// Number of candidate planes. If 40 % of the samples are ground, all candidates fail once in 10^14 estimates.
const CANDIDATES: usize = 500;
/// Least number of cells of a revolution whose lowest point lies on the ground plane. Measured: a VLP-16 on a road
/// gives some 500; indoors, or with half its view blocked, floors and chance give fewer than 60.
const INLIERS_MIN: usize = 100;
/// Least number of directions, of 12, in which the ground plane has points. Ours: a floor on one side is not the
/// ground.
const SECTORS_MIN: u32 = 4;
/// Greatest number of revolutions that are read: a second at 10 Hz.
const REVOLUTIONS_MAX: usize = 10;

/// Height and orientation of a sensor over the ground.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MountEstimate {
    /// Height over the ground, metres.
    pub height_m: f64,
    /// Rotation about y, radians; a positive value tilts the sensor down.
    pub pitch_rad: f64,
    /// Rotation about x, radians.
    pub roll_rad: f64,
    /// Number of cells of 0.5 m whose lowest point lies on the ground plane, over all revolutions.
    pub inliers: usize,
    /// Number of cells of 0.5 m with points, over all revolutions.
    pub samples: usize,
    /// Root mean square distance of the inliers from the plane, metres.
    pub residual_m: f64,
    /// Number of revolutions that were read.
    pub revolutions: usize,
}

/// Why the mount cannot be estimated.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum MountError {
    /// Too few cells have points.
    #[error(
        "{samples} cells of 0.5 m with points from 2.5 to 20 m around the sensor in {revolutions} revolution(s); \
         100 a revolution are needed"
    )]
    TooFewPoints {
        /// Number of cells of 0.5 m with points.
        samples: usize,
        /// Number of revolutions that were read.
        revolutions: usize,
    },
    /// No plane through the points can be the ground.
    #[error(
        "the best plane contains {inliers} of {samples} cells, in {sectors} of 12 directions; 100 a revolution in 4, \
         0.3 to 4 m under the sensor and within 20 degrees of level, are needed"
    )]
    NoGround {
        /// Number of cells whose lowest point lies on the best plane.
        inliers: usize,
        /// Number of cells with points.
        samples: usize,
        /// Number of directions in which the best plane has points.
        sectors: u32,
    },
}

impl MountEstimate {
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

/// Estimates the mount from the points of revolutions, sensor frame, metres. At most the first ten are read.
///
/// # Errors
/// [`MountError::TooFewPoints`] if fewer than 100 cells a revolution have points; [`MountError::NoGround`] if no plane
/// around the vehicle can be the ground.
pub fn estimate<I, P>(revolutions: I) -> Result<MountEstimate, MountError>
where
    I: IntoIterator<Item = P>,
    P: AsRef<[[f32; 3]]>,
{
    let near: Vec<Vec<[f32; 3]>> =
        revolutions.into_iter().take(REVOLUTIONS_MAX).map(|points| near_points(points.as_ref())).collect();
    let read = near.len();
    let samples: Vec<_> = near.iter().flat_map(|points| lowest_points(points)).collect();
    if samples.len() < INLIERS_MIN * read.max(1) {
        return Err(MountError::TooFewPoints { samples: samples.len(), revolutions: read });
    }
    let no_ground = |inliers, sectors| MountError::NoGround { inliers, samples: samples.len(), sectors };
    let mut plane = best_candidate(&samples).ok_or(no_ground(0, 0))?;
    let mut on_plane = Vec::new();
    // The noise puts the lowest points under the ground, so each fit uses the mean of each cell's points on the plane.
    // Each fit moves the plane by less than the fit before; after eight it moves by a fraction of a millimetre.
    for _ in 0..8 {
        on_plane = near.iter().flat_map(|points| points_on(&plane, points)).collect();
        plane = match Plane::through(&on_plane) {
            Some(plane) if plane.is_plausible() => plane,
            _ => return Err(no_ground(on_plane.len(), 0)),
        };
    }
    let sectors = sectors(&on_plane);
    let inliers = samples.iter().filter(|p| plane.distance(p).abs() <= INLIER_M).count();
    if inliers < INLIERS_MIN * read || sectors < SECTORS_MIN {
        return Err(no_ground(inliers, sectors));
    }
    let squares: f64 = on_plane.iter().map(|p| plane.distance(p).powi(2)).sum();
    // Rz(0) Ry(pitch) Rx(roll) rotates the ground's normal, sensor frame, onto the vertical.
    let [nx, ny, nz] = plane.normal.into();
    let roll_rad = ny.atan2(nz);
    let pitch_rad = -nx.atan2(ny.hypot(nz));
    debug_assert!(
        (UnitQuaternion::from_euler_angles(roll_rad, pitch_rad, 0.0) * plane.normal - Vector3::z()).norm() < 1e-9
    );
    Ok(MountEstimate {
        height_m: plane.height,
        pitch_rad,
        roll_rad,
        inliers,
        samples: samples.len(),
        residual_m: (squares / on_plane.len() as f64).sqrt(),
        revolutions: read,
    })
}

/// The plane of the points p with `normal · p = -height`, sensor frame, metres; the normal points up.
#[derive(Clone, Copy, Debug)]
struct Plane {
    normal: Vector3<f64>,
    height: f64,
}

impl Plane {
    fn distance(&self, p: &Vector3<f64>) -> f64 {
        self.normal.dot(p) + self.height
    }

    fn is_plausible(&self) -> bool {
        HEIGHT_M.contains(&self.height) && self.normal.z >= TILT_RAD_MAX.cos()
    }

    /// The plane of total least squares through points; `None` for fewer than three points and for points in a line.
    fn through(points: &[Vector3<f64>]) -> Option<Self> {
        if points.len() < 3 {
            return None;
        }
        let centroid = points.iter().sum::<Vector3<f64>>() / points.len() as f64;
        let spread = points.iter().fold(Matrix3::zeros(), |sum, p| sum + (p - centroid) * (p - centroid).transpose());
        let eigen = spread.symmetric_eigen();
        let least = (0..3).min_by(|a, b| eigen.eigenvalues[*a].total_cmp(&eigen.eigenvalues[*b]))?;
        let normal: Vector3<f64> = eigen.eigenvectors.column(least).into();
        let normal = if normal.z < 0.0 { -normal } else { normal };
        let plane = Self { normal, height: -normal.dot(&centroid) };
        (plane.normal.iter().all(|v| v.is_finite())).then_some(plane)
    }
}

/// The points from 2.5 to 20 m around the sensor, in which the ground is searched.
fn near_points(points: &[[f32; 3]]) -> Vec<[f32; 3]> {
    let is_near = |[x, y, z]: &[f32; 3]| {
        // NaN fails these comparisons. The bound of z removes stray returns far under the ground.
        let near = x.abs() < RADIUS_M_MAX && y.abs() < RADIUS_M_MAX && z.abs() < RADIUS_M_MAX;
        near && x * x + y * y + z * z >= RANGE_M_MIN * RANGE_M_MIN
    };
    points.iter().copied().filter(is_near).collect()
}

/// Index of the cell of a point.
fn cell([x, y, _]: &[f32; 3]) -> usize {
    let index = |v: f32| (((v + RADIUS_M_MAX) / CELL_M) as usize).min(CELLS_ACROSS - 1);
    index(*x) * CELLS_ACROSS + index(*y)
}

/// The lowest point of every cell of half a metre, in the order of the cells.
fn lowest_points(points: &[[f32; 3]]) -> Vec<Vector3<f64>> {
    let mut lowest: Vec<Option<[f32; 3]>> = vec![None; CELLS_ACROSS * CELLS_ACROSS];
    for point in points {
        let cell_lowest = &mut lowest[cell(point)];
        if cell_lowest.is_none_or(|before| point[2] < before[2]) {
            *cell_lowest = Some(*point);
        }
    }
    lowest.into_iter().flatten().map(|p| Vector3::from(p.map(f64::from))).collect()
}

/// The mean of each cell's points on a plane, in the order of the cells.
fn points_on(plane: &Plane, points: &[[f32; 3]]) -> Vec<Vector3<f64>> {
    let mut sums = vec![(0.0, Vector3::zeros()); CELLS_ACROSS * CELLS_ACROSS];
    for point in points {
        let position = Vector3::from(point.map(f64::from));
        if plane.distance(&position).abs() <= INLIER_M {
            let (count, sum) = &mut sums[cell(point)];
            *count += 1.0;
            *sum += position;
        }
    }
    sums.into_iter().filter(|(count, _)| *count > 0.0).map(|(count, sum)| sum / count).collect()
}

/// The plausible plane through three samples that most samples lie on.
fn best_candidate(samples: &[Vector3<f64>]) -> Option<Plane> {
    let mut random = RandomIndices(0x2545_f491_4f6c_dd1d);
    let candidates = (0..CANDIDATES).filter_map(|_| {
        let [a, b, c] = [(); 3].map(|()| samples[random.below(samples.len())]);
        let normal = (b - a).cross(&(c - a)).try_normalize(1e-6)?;
        let normal = if normal.z < 0.0 { -normal } else { normal };
        let plane = Plane { normal, height: -normal.dot(&a) };
        let inliers = || samples.iter().filter(|p| plane.distance(p).abs() <= INLIER_M).count();
        plane.is_plausible().then(|| (inliers(), plane))
    });
    // The first of several equally good candidates.
    candidates
        .fold(None, |best: Option<(usize, Plane)>, next| match best {
            Some(before) if before.0 >= next.0 => Some(before),
            _ => Some(next),
        })
        .map(|(_, plane)| plane)
}

/// Number of directions, of 12, in which there are points.
fn sectors(points: &[Vector3<f64>]) -> u32 {
    let sector = |p: &Vector3<f64>| ((p.y.atan2(p.x) / std::f64::consts::TAU).rem_euclid(1.0) * 12.0) as u32 % 12;
    points.iter().fold(0u32, |seen, p| seen | 1 << sector(p)).count_ones()
}

/// A generator of pseudo-random numbers (xorshift64*) with a fixed seed, so that the estimate is a function of the
/// points.
struct RandomIndices(u64);

impl RandomIndices {
    /// The next number from 0 to n - 1.
    fn below(&mut self, n: usize) -> usize {
        self.0 ^= self.0 >> 12;
        self.0 ^= self.0 << 25;
        self.0 ^= self.0 >> 27;
        ((self.0.wrapping_mul(0x2545_f491_4f6c_dd1d) >> 33) as usize) % n
    }
}
