//! Whether a scan can be one of the configured model.
//!
//! In: a scan in the sensor's frame, the model. Out: nothing, or the error that names what contradicts the model. A
//! wrong model gives each point a wrong ring, and radial maps rows in wrong places.

use clearway_lidar::Model;

use crate::error::EventError;
use crate::sensor::observation::Scan;

/// How far outside of the model's elevations a point may lie, degrees. Ours: the lasers of a unit differ from the
/// nominal ones by less, and a sender that compensates the motion of the vehicle turns points by less.
const TOLERANCE_DEG: f32 = 2.0;

/// Share of the points that may lie farther outside, percent. Ours: 17 % of the points of a KITTI scan of an HDL-64E
/// lie outside of a VLP-16's elevations.
const OUTSIDE_PERCENT_MAX: usize = 5;

/// One of so many points is looked at. Ours: a scan of the wrong model has thousands outside, and no sensor has a
/// number of lasers that divides by it, so that points of all lasers are looked at.
const STRIDE: usize = 17;

/// Least number of points of a scan whose elevations are judged. Ours: a scan of few points shows an object, not the
/// field of view.
const POINTS_MIN: usize = 1000;

/// Least horizontal range of a point that is judged. Ours: the lasers do not leave the sensor at its origin, which
/// turns near points, mostly those on the vehicle itself, by degrees.
const RANGE_M_MIN: f32 = 2.0;

/// Checks that a scan has no ring that the model lacks and that its points lie where lasers of the model point.
///
/// # Errors
/// [`EventError::ScanRing`] or [`EventError::ScanElevation`] if not.
pub(super) fn check(scan: &Scan, model: Model) -> Result<(), EventError> {
    let (lasers, elevation_deg) = (model.spec().lasers, model.spec().elevation_deg);
    let greatest = scan.ring.iter().copied().max();
    if let Some(ring) = greatest.filter(|ring| usize::from(*ring) >= lasers) {
        return Err(EventError::ScanRing { ring, model: model.as_str(), lasers });
    }
    if scan.x.len() < POINTS_MIN {
        return Ok(());
    }
    let [low, high] =
        [elevation_deg.0 - TOLERANCE_DEG, elevation_deg.1 + TOLERANCE_DEG].map(|of| libm::tanf(of.to_radians()));
    let (mut points, mut outside) = (0, 0);
    for i in (0..scan.x.len()).step_by(STRIDE) {
        let (range_m, z_m) = ((scan.x[i] * scan.x[i] + scan.y[i] * scan.y[i]).sqrt(), scan.z[i]);
        // Comparisons with NaN are false.
        let is_judged = range_m >= RANGE_M_MIN;
        points += usize::from(is_judged);
        outside += usize::from(is_judged && (z_m < low * range_m || z_m > high * range_m));
    }
    if outside * 100 > points * OUTSIDE_PERCENT_MAX {
        let outside_percent = (outside * 100 / points.max(1)).clamp(OUTSIDE_PERCENT_MAX + 1, 100);
        let (model, allowed_percent) = (model.as_str(), OUTSIDE_PERCENT_MAX);
        return Err(EventError::ScanElevation { outside_percent, allowed_percent, model, elevation_deg });
    }
    Ok(())
}
