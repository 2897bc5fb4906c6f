//! The rays of one scan: its returns, and the directions without a return.
//!
//! In: a [`Revolution`], how its sensor is mounted, how the vehicle moved, and the sensor's self filter. Out: the
//! directions of the rays without a return, unit vectors, ego frame at the end of the revolution; [`Rays`] for the
//! layers that gather evidence.

use clearway_lidar::revolution::Revolution;
use nalgebra::{Isometry3, Vector3};

use crate::sensor::motion::{EgoTrajectory, KNOT_FIRINGS};
use crate::sensor::self_filter::SelfFilter;
use crate::sensor::sweep::{Mount, Sweep};

/// The rays of one sensor's scan, for layers that collect evidence between two maps.
#[derive(Clone, Copy, Debug)]
pub struct Rays<'a> {
    /// Index of the sensor in the vehicle's configuration.
    pub sensor: u16,
    /// End of the scan, ns since the Unix epoch. "Ego frame" below means the ego frame at this stamp.
    pub stamp_ns: i64,
    /// The returns, ego frame.
    pub returns: &'a Sweep,
    /// Height of each return over the ground, metres; NaN for a return that may be ground where no ground is known.
    pub heights_m: &'a [f32],
    /// Position of the sensor, ego frame, metres.
    pub origin_m: [f32; 3],
    /// Height of the sensor over the ground under it, metres.
    pub origin_height_m: f32,
    /// Directions (unit vectors, ego frame) of rays without a return; empty if the sensor does not report them.
    pub no_returns: &'a [[f32; 3]],
    /// Ego frame in the world frame at `stamp_ns`; `None` if no pose is near enough.
    pub map_from_ego: Option<Isometry3<f64>>,
    /// Forward speed, m/s, if known.
    pub speed_mps: Option<f64>,
}

/// Optional data of a sensor's scan and of a map. The pipeline computes it only if an active layer uses it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ScanExtras {
    /// The local ground and what closes it (`Context::ground`, `Context::reach` of the layers).
    pub ground: bool,
    /// What the vehicle can reach on it ([`crate::reach::Reach::flood`]).
    pub reached: bool,
    /// Range deviations of the distance series of all sensors ([`Sweep::deviation`]).
    pub deviations: bool,
    /// Directions of the rays without a return ([`Rays::no_returns`]).
    pub no_returns: bool,
}

/// Writes the directions of all firings' lasers without a return to `no_returns`, in place of what it held. Blind
/// sectors and blocked parts of the window are left out: a ray there shows nothing. The direction of a laser is taken
/// at the azimuth of its firing's first laser, which is off by 0.2 degrees at most.
pub(crate) fn find_no_returns(
    revolution: &Revolution,
    mount: &Mount,
    trajectory: &EgoTrajectory,
    filter: Option<&SelfFilter>,
    no_returns: &mut Vec<[f32; 3]>,
) {
    no_returns.clear();
    let Some(echo) = revolution.echoes.first() else { return };
    let lasers: Vec<(f32, [f32; 2])> = (revolution.calibration.lasers.iter())
        .map(|laser| (laser.rot_correction as f32, sin_cos(laser.vert_correction)))
        .collect();
    for (number, (firing, range_m)) in revolution.firings.iter().zip(echo.range_m.chunks(revolution.lasers)).enumerate()
    {
        if !range_m.contains(&0.0) {
            continue;
        }
        // The pose at the knot before the firing: at a yaw rate of 1 rad/s it is off by a milliradian.
        let ego_from_sensor = trajectory
            .end_from_ego
            .get(number / KNOT_FIRINGS)
            .map_or(mount.ego_from_sensor, |end_from_ego| end_from_ego * mount.ego_from_sensor);
        let without_return = range_m.iter().zip(&lasers).enumerate().filter(|(_, (range, _))| **range == 0.0);
        for (laser, (_, &(rotation, elevation))) in without_return {
            let azimuth_rad = firing.azimuth_rad - rotation;
            let ray = direction(azimuth_rad, elevation);
            let is_blind = filter.is_some_and(|filter| filter.is_blind(ray));
            if !is_blind && !revolution.blocked.hides(laser, azimuth_rad) {
                no_returns.push(rotated(&ego_from_sensor, ray));
            }
        }
    }
}

/// Direction of a laser, sensor frame, from its azimuth (clockwise) and the sine and cosine of its elevation.
fn direction(azimuth_rad: f32, [sin_elevation, cos_elevation]: [f32; 2]) -> [f32; 3] {
    let (sin, cos) = libm::sincosf(azimuth_rad);
    [cos_elevation * cos, -cos_elevation * sin, sin_elevation]
}

/// Sine and cosine of an angle, in radians.
fn sin_cos(angle_rad: f64) -> [f32; 2] {
    let (sin, cos) = libm::sincos(angle_rad);
    [sin as f32, cos as f32]
}

/// A direction turned by the rotation of a transform.
pub(crate) fn rotated(transform: &Isometry3<f64>, direction: [f32; 3]) -> [f32; 3] {
    let rotated = transform.rotation * Vector3::from(direction.map(f64::from));
    [rotated.x, rotated.y, rotated.z].map(|component| component as f32)
}

#[cfg(test)]
mod tests {
    use clearway_lidar::model::Model;
    use clearway_sim::scanner::ScannerConfig;
    use clearway_sim::scenes;
    use clearway_sim::vehicle::SimulatedVehicle;

    use super::*;

    #[test]
    fn a_ray_without_a_return_points_where_its_laser_points() {
        let config = ScannerConfig { model: Model::Vlp16, ..ScannerConfig::default() };
        let revolution = SimulatedVehicle::new(scenes::flat(), config).revolution(1);
        let echo = &revolution.echoes[0];
        let at = |slot: usize| (slot / revolution.lasers, slot % revolution.lasers);
        let mut checked = 0;
        for slot in (0..echo.range_m.len()).filter(|slot| echo.range_m[*slot] > 5.0) {
            let (firing, laser) = at(slot);
            let laser = &revolution.calibration.lasers[laser];
            let azimuth_rad = revolution.firings[firing].azimuth_rad - laser.rot_correction as f32;
            let ray = direction(azimuth_rad, sin_cos(laser.vert_correction));
            let along = [echo.x[slot], echo.y[slot], echo.z[slot]].iter().zip(ray).map(|(p, r)| p * r).sum::<f32>();
            // The cosine of half a degree.
            assert!(along / echo.range_m[slot] > 0.99996, "slot {slot}");
            checked += 1;
        }
        assert!(checked > 5000);
        let to_the_left = Vector3::new(0.0, 0.0, std::f64::consts::FRAC_PI_2);
        let (mut level, mut left) = (Vec::new(), Vec::new());
        let mut mount = Mount { ego_from_sensor: Isometry3::translation(0.0, 0.0, 1.9), range_m_min: 2.0 };
        find_no_returns(&revolution, &mount, &EgoTrajectory::default(), None, &mut level);
        mount.ego_from_sensor = Isometry3::new(Vector3::new(0.0, 0.0, 1.9), to_the_left);
        find_no_returns(&revolution, &mount, &EgoTrajectory::default(), None, &mut left);
        assert_eq!(level.len(), echo.range_m.iter().filter(|range| **range == 0.0).count());
        assert!(level.len() > 10_000 && level.iter().any(|ray| ray[2] > 0.2), "the sky returns nothing");
        for (level, left) in level.iter().zip(&left) {
            assert!((level[0] - left[1]).abs() < 1e-5 && (level[1] + left[0]).abs() < 1e-5 && level[2] == left[2]);
        }
    }
}
