//! A car with six units of four planes (Seo 2014, figure 2) in traffic, and what each object covers of the ground.
//!
//! In: the ego vehicle's speed. Out: a [`Scene`], the six [`PlaneUnit`]s, and for any time the ground that objects
//! cover.

use std::f64::consts::PI;
use std::sync::Arc;

use nalgebra::{Isometry3, Point3, Translation3, UnitQuaternion};

use crate::scene::course::{Course, Drive};
use crate::scene::ground::Ground;
use crate::scene::object::{Kind, Shape};
use crate::scene::scenes::Scene;
use crate::scene::world::World;
use crate::sensor::planes::PlaneUnit;

/// A street along x with two lanes each way: parked cars, walls, poles and buildings beside it, cars ahead, behind and
/// coming the other way. The vehicle drives in the right-hand lane at `speed_mps`, or stands there.
pub fn street(speed_mps: f64) -> Scene {
    let course = Arc::new(Course::from(-400.0, 0.0, 0.0).straight(1200.0));
    let mut world = World::on(Ground { reflectivity: 15, ..Ground::default() })
        .wall(&[[-350.0, 14.0], [700.0, 14.0]], 1.2)
        .building(12.0, -24.0, 0.1, [14.0, 10.0], 6.0)
        .building(60.0, -23.0, -0.2, [12.0, 9.0], 6.0);
    for spot in 0..90 {
        let x = -180.0 + 8.0 * f64::from(spot);
        let chance = crate::noise::uniform(0x5741 + spot as u64);
        if chance < 0.45 {
            world = world.parked_car(x, -7.4, 0.02 * chance);
        }
        if chance > 0.35 {
            world = world.parked_car(x + 3.0, 10.6, PI - 0.03 * chance);
        }
        if spot % 3 == 0 {
            world = world.pole(x + 4.0, -9.4, 0.15, 6.0);
        }
    }
    // Each its lane, its place at the beginning beside the vehicle's, and its own speed, negative the other way.
    let others = [
        (-1.8, 28.0, speed_mps + 2.0),
        (-1.8, -22.0, speed_mps),
        (-4.9, 12.0, speed_mps + 6.0),
        (-4.9, -14.0, speed_mps + 10.0),
        (1.8, 60.0, -15.0),
        (1.8, 95.0, -15.0),
        (5.0, 45.0, -25.0),
        (5.0, 120.0, -25.0),
    ];
    for (left, ahead, speed) in others {
        world = world.moving_car(Drive::steady(course.clone(), 400.0 + ahead, left, speed));
    }
    let drive = Drive::steady(course, 400.0, -1.8, speed_mps);
    Scene { name: "street", world: Arc::new(world), drive, paper_share: None }
}

/// The six units about the vehicle, 110 degrees each: ahead, behind, and to each side one before and one behind the
/// middle.
pub fn six_units() -> [PlaneUnit; 6] {
    let at = [
        (2.2, 0.0, 0.0),
        (1.6, 0.95, 60.0),
        (-1.6, 0.95, 120.0),
        (-2.2, 0.0, 180.0),
        (-1.6, -0.95, 240.0),
        (1.6, -0.95, 300.0),
    ];
    let mut seed = 0;
    at.map(|(x, y, yaw_deg): (f64, f64, f64)| {
        seed += 1;
        let turned = UnitQuaternion::from_euler_angles(0.0, 0.0, yaw_deg.to_radians());
        let ego_from_sensor = Isometry3::from_parts(Translation3::new(x, y, 0.45), turned);
        PlaneUnit { ego_from_sensor, seed, ..PlaneUnit::default() }
    })
}

/// The scans of the six units in the first 100 ms of a [`street`], 52,800 rays with and without a return (Seo 2014): of
/// each the returns, x, y and z, and the position of its unit, ego frame, metres. Six scans, one of each unit, follow
/// six.
pub fn scans_of_six_units() -> Vec<([Vec<f32>; 3], [f32; 3])> {
    let (scene, units) = (street(0.0), six_units());
    let in_ego_frame = |unit: &PlaneUnit, number| {
        let scan = unit.scan(&scene, number);
        let mut returns: [Vec<f32>; 3] = Default::default();
        for ((x, y), z) in scan.x.iter().zip(&scan.y).zip(&scan.z) {
            let point = (unit.ego_from_sensor * Point3::new(*x, *y, *z).cast::<f64>()).cast::<f32>();
            returns.iter_mut().zip(point.iter()).for_each(|(axis, value)| axis.push(*value));
        }
        (returns, unit.ego_from_sensor.translation.vector.cast::<f32>().into())
    };
    (1..=5).flat_map(|number| units.iter().map(move |unit| (unit, number))).map(|(u, n)| in_ego_frame(u, n)).collect()
}

/// The objects on the ground at one time.
#[derive(Clone, Debug)]
pub struct Footprints(Vec<(Kind, Shape)>);

impl Footprints {
    /// The objects of a world at `time` s, without objects that hang over the ground or are too thin to cover any.
    pub fn at(world: &World, time: f64) -> Self {
        let shapes = world.objects.iter().map(|object| (object.kind, object.at(time, &world.ground)));
        Self(shapes.filter(|(kind, _)| !matches!(kind, Kind::Leaves | Kind::Beam | Kind::Fence)).collect())
    }

    /// True if an object covers a place (metres, world frame), or is nearer to it than `margin_m` along its own sides.
    pub fn near(&self, [x, y]: [f64; 2], margin_m: f64) -> bool {
        self.0.iter().any(|(_, shape)| shape.column(x, y, margin_m).is_some())
    }

    /// The thing that covers all these places (metres, world), if one does; a thing that covers corners covers what
    /// lies between them.
    pub fn covering(&self, places: &[[f64; 2]]) -> Option<Kind> {
        let covers = |shape: &Shape| places.iter().all(|[x, y]| shape.column(*x, *y, 0.0).is_some());
        self.0.iter().find(|(_, shape)| covers(shape)).map(|(kind, _)| *kind)
    }
}
