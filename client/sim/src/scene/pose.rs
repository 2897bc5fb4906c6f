//! The pose of a vehicle: its drive projected on the ground.
//!
//! In: world, drive, time. Out: `map_from_ego`. The ego frame leans with the ground under the wheels.

use nalgebra::{Isometry3, Matrix3, Rotation3, Translation3, UnitQuaternion, Vector3};

use super::scenes::Scene;

/// Half the distances between the axles and between the wheels of an axle, metres: a mid-size car's.
const WHEELS_M: [f64; 2] = [1.4, 0.8];

impl Scene {
    /// `map_from_ego` of the vehicle at `time` s: x forward, y left, origin on the ground under its middle.
    pub fn pose_at(&self, time: f64) -> Isometry3<f64> {
        let (x, y, heading) = self.drive.at(time);
        let (sin, cos) = heading.sin_cos();
        let ground = |ahead: f64, left: f64| {
            self.world.ground.height(x + ahead * cos - left * sin, y + ahead * sin + left * cos)
        };
        let [ahead, left] = WHEELS_M;
        let wheels = [ground(ahead, left), ground(ahead, -left), ground(-ahead, left), ground(-ahead, -left)];
        let climb = (wheels[0] + wheels[1] - wheels[2] - wheels[3]) / (4.0 * ahead);
        let bank = (wheels[0] - wheels[1] + wheels[2] - wheels[3]) / (4.0 * left);
        let forward = Vector3::new(cos, sin, climb).normalize();
        let up = forward.cross(&Vector3::new(-sin, cos, bank)).normalize();
        let axes = Rotation3::from_matrix_unchecked(Matrix3::from_columns(&[forward, up.cross(&forward), up]));
        let z = wheels.iter().sum::<f64>() / 4.0;
        Isometry3::from_parts(Translation3::new(x, y, z), UnitQuaternion::from_rotation_matrix(&axes))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::course::{Course, Drive};
    use crate::scene::ground::{Ground, Profile};
    use crate::scene::world::World;

    #[test]
    fn a_vehicle_on_a_slope_leans_with_it() {
        let along = Profile::through(&[(0.0, 0.0), (100.0, 10.0)]);
        let across = Profile::through(&[(-100.0, 0.0), (100.0, 10.0)]);
        let world = World::on(Ground { along, across, ..Ground::default() });
        let course = std::sync::Arc::new(Course::from(20.0, 0.0, 0.3).straight(1.0));
        let scene = Scene {
            name: "slope",
            world: world.into(),
            drive: Drive::steady(course, 0.0, 0.0, 0.0),
            paper_share: None,
        };
        let pose = scene.pose_at(0.0);
        for place in [[3.0, 0.0], [0.0, 2.0], [-4.0, -1.0]] {
            let point = pose * nalgebra::Point3::new(place[0], place[1], 0.0);
            assert!((point.z - scene.world.ground.height(point.x, point.y)).abs() < 1e-9, "{point}");
        }
        let forward = pose * Vector3::x();
        assert!((forward.y.atan2(forward.x) - 0.3).abs() < 1e-9, "{forward}");
    }
}
