//! A LIDAR of a few planes, as built into bumpers (Seo 2014, sections 2 and 3): whole scans of one field of view.
//!
//! In: a world, the vehicle's pose at any time, the unit's constants. Out: [`PlaneScan`]s in the sensor frame (x
//! forward, y left, z up), each point as measured at its own time; rays without a return are given as directions.

use nalgebra::{Isometry3, Point3, Vector3};

use super::raycast::Caster;
use crate::noise::{gaussian, mixed, uniform};
use crate::scene::scenes::Scene;

/// Least range that returns, metres.
const RANGE_M_MIN: f64 = 0.3;

/// Geometry, mounting and accuracy of a unit.
#[derive(Clone, Debug)]
pub struct PlaneUnit {
    /// Elevation of each plane, rad, lowest first.
    pub elevations: Vec<f64>,
    /// Field of view, rad, half of it to each side.
    pub field: f64,
    /// Number of rays in a plane.
    pub azimuths: u32,
    /// Time from one scan to the next, ns.
    pub period_ns: i64,
    /// Pose of the unit on the vehicle.
    pub ego_from_sensor: Isometry3<f64>,
    /// Standard deviation of the range, metres.
    pub noise_m: f64,
    /// Share of the returns that are missing, 0 to 1.
    pub dropout: f64,
    /// Greatest range that returns, metres.
    pub range_m_max: f64,
    /// Seed of noise and missing returns: the same seed gives the same scans.
    pub seed: u64,
}

impl Default for PlaneUnit {
    /// Four planes, 110 degrees in quarters of a degree, 50 scans a second, 200 m (Seo 2014, section 3). The paper
    /// prints 8 degrees from plane to plane. We use 0.8, as units of that time with the same other data have: with 8,
    /// two of the four planes would pass over or under every car beyond 10 m.
    fn default() -> Self {
        Self {
            elevations: [-1.2, -0.4, 0.4, 1.2].map(f64::to_radians).to_vec(),
            field: 110_f64.to_radians(),
            azimuths: 440,
            period_ns: 20_000_000,
            ego_from_sensor: Isometry3::translation(0.0, 0.0, 0.45),
            noise_m: 0.03,
            dropout: 0.005,
            range_m_max: 200.0,
            seed: 1,
        }
    }
}

/// One pass over the field of view. The same index in each list is the same point.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PlaneScan {
    /// End of the scan, ns after the scene's beginning.
    pub end_ns: i64,
    /// Coordinate of each point forward in the sensor frame, in metres.
    pub x: Vec<f32>,
    /// To the left, metres.
    pub y: Vec<f32>,
    /// Coordinate of each point upward in the sensor frame, in metres.
    pub z: Vec<f32>,
    /// Intensity, 0 to 1.
    pub intensity: Vec<f32>,
    /// Index of the plane, 0 for the lowest.
    pub ring: Vec<u16>,
    /// Time after the end of the scan, ns, so at most 0.
    pub offset_ns: Vec<i32>,
    /// Directions, length 1, of rays without a return.
    pub no_returns: Vec<[f32; 3]>,
}

impl PlaneUnit {
    /// Scan `number`, which ends `number` periods after the scene's beginning. The mirror rotates once a period, so it
    /// passes the field of view in the field's share of a period, from right to left.
    pub fn scan(&self, scene: &Scene, number: i64) -> PlaneScan {
        let end_ns = number * self.period_ns;
        let mut scan = PlaneScan { end_ns, ..PlaneScan::default() };
        let pass_ns = self.period_ns as f64 * self.field / std::f64::consts::TAU;
        let seconds = |offset_ns: i32| (end_ns + i64::from(offset_ns)) as f64 * 1e-9;
        let sensor_at = |time: f64| scene.pose_at(time) * self.ego_from_sensor;
        let begin = seconds(-pass_ns as i32);
        let mut caster =
            Caster::new(&*scene.world, sensor_at(begin).translation.vector.into(), begin, self.range_m_max);
        for step in 0..self.azimuths {
            let share = (f64::from(step) + 0.5) / f64::from(self.azimuths);
            let offset_ns = -((1.0 - share) * pass_ns) as i32;
            let map_from_sensor = sensor_at(seconds(offset_ns));
            let origin: [f64; 3] = map_from_sensor.translation.vector.into();
            caster.move_to(origin, seconds(offset_ns));
            let (sin_a, cos_a) = ((share - 0.5) * self.field).sin_cos();
            for (ring, elevation) in self.elevations.iter().enumerate() {
                let (sin_e, cos_e) = elevation.sin_cos();
                let direction = Vector3::new(cos_e * cos_a, cos_e * sin_a, sin_e);
                let key = mixed(self.seed ^ (number as u64) << 20) ^ u64::from(step) << 4 ^ ring as u64;
                let hit = caster.cast(origin, (map_from_sensor.rotation * direction).into(), key);
                let seen = |_: &_| self.dropout == 0.0 || uniform(key ^ 0x0d) >= self.dropout;
                match hit.filter(|hit| hit.range_m >= RANGE_M_MIN).filter(seen) {
                    None => scan.no_returns.push(direction.map(|part| part as f32).into()),
                    Some(hit) => {
                        let point = Point3::from(direction * (hit.range_m + self.noise_m * gaussian(key ^ 0x65)));
                        scan.x.push(point.x as f32);
                        scan.y.push(point.y as f32);
                        scan.z.push(point.z as f32);
                        scan.intensity.push(f32::from(hit.reflectivity) / 255.0);
                        scan.ring.push(ring as u16);
                        scan.offset_ns.push(offset_ns);
                    }
                }
            }
        }
        scan
    }
}
