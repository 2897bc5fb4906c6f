//! The scenes: the four of the UT Austin thesis (section V, figures 5 to 8), a dirt track, and a town without end.
//!
//! Each is a [`World`] and the [`Drive`] of the vehicle in it. In the scenes of the UT Austin thesis the vehicle stands
//! at the world's origin and faces along x.

use std::f64::consts::{FRAC_PI_2, PI};
use std::sync::Arc;

use super::course::{Course, Drive};
use super::ground::{Ground, Profile, Terrace};
use super::world::{SLATS, World};

/// A world, and the drive of a vehicle through it.
#[derive(Clone, Debug, PartialEq)]
pub struct Scene {
    /// Name of the scene.
    pub name: &'static str,
    /// A world: its ground and objects.
    pub world: Arc<World>,
    /// Drive of the vehicle.
    pub drive: Drive,
    /// Drivable share that the UT Austin thesis reports for the scene (section V, table), percent.
    pub paper_share: Option<f64>,
}

const ASPHALT: u8 = 15;

fn standing(name: &'static str, world: World, paper_share: f64) -> Scene {
    let course = Arc::new(Course::from(0.0, 0.0, 0.0).straight(1.0));
    Scene { name, world: Arc::new(world), drive: Drive::steady(course, 0.0, 0.0, 0.0), paper_share: Some(paper_share) }
}

/// The scenes of the UT Austin thesis, in the order of its table.
pub fn of_the_thesis() -> [Scene; 4] {
    [flat(), slopes_with_obstacles(), fenced_road_under_canopy(), fenced_road_with_low_overhang()]
}

/// Flat ground with next to no obstacles (figure 5): 98.90 % drivable.
pub fn flat() -> Scene {
    let world = World::on(Ground { reflectivity: ASPHALT, ..Ground::default() })
        .parked_car(24.0, 13.0, 0.4)
        .parked_car(-31.0, -9.0, 1.2)
        .pole(15.0, -12.0, 0.12, 6.0)
        .pole(-14.0, 16.0, 0.12, 6.0)
        .pole(34.0, -18.0, 0.12, 6.0);
    standing("flat", world, 98.9)
}

/// A road that falls ahead and rises again, and rises behind, banks, cars and hedges on both sides (figure 6): 63.40 %.
pub fn slopes_with_obstacles() -> Scene {
    let along = Profile::default().ramp(-45.0, -15.0, -1.8).ramp(8.0, 32.0, -1.6).ramp(36.0, 58.0, 2.2);
    // A ditch and a bank on the right, a kerb and a retaining step on the left.
    let across = Profile::through(&[
        (-11.5, 1.2),
        (-9.0, 0.0),
        (-8.2, -0.7),
        (-7.4, -0.7),
        (-6.6, 0.0),
        (5.5, 0.0),
        (5.5, 0.14),
        (7.0, 0.14),
        (7.0, 0.8),
    ]);
    // The profile along begins at 0 before its first ramp, 1.8 m over the vehicle.
    let along = along.raised(1.8);
    let mut world = World::on(Ground { along, across, terraces: Vec::new(), reflectivity: ASPHALT })
        .parked_car(-9.0, 4.2, 0.0)
        .parked_car(13.5, 4.2, 0.0)
        .parked_car(20.0, 4.2, PI)
        .parked_car(39.0, -4.6, PI)
        .wall(&[[4.0, 12.0], [30.0, 12.5]], 1.8)
        .building(-14.0, 18.0, 0.0, [12.0, 9.0], 6.0)
        .building(40.0, 19.0, 0.1, [10.0, 9.0], 6.0)
        .wall(&[[-40.0, -13.0], [-12.0, -13.0]], 2.2);
    for step in 0..9 {
        let x = -34.0 + 8.5 * f64::from(step);
        world = world.tree(x, -14.5, 2.2, 2.8).pole(x + 3.0, 6.6, 0.1, 6.0);
    }
    standing("slopes with obstacles", world, 63.4)
}

/// A road that bends between fences and trees, branches high over it, open ground behind the fences (figure 7):
/// 78.30 %.
pub fn fenced_road_under_canopy() -> Scene {
    standing("fenced road under canopy", fenced_road(), 78.3)
}

/// The same scene with a beam that hangs too low over the road just ahead (figure 8): 37.00 %.
pub fn fenced_road_with_low_overhang() -> Scene {
    let (left, right) = (on_the_bend(4.0, ROAD_HALF_M), on_the_bend(4.0, -ROAD_HALF_M));
    let world = fenced_road().beam(left, right, 1.5, 2.2);
    standing("fenced road with low overhang", world, 37.0)
}

/// Half the width of the fenced road, metres.
const ROAD_HALF_M: f64 = 7.5;

/// The road's middle line: straight behind the vehicle, then a wide bend to the left.
fn on_the_bend(station: f64, left: f64) -> [f64; 2] {
    let line = Course::from(-70.0, 0.0, 0.0).straight(75.0).arc(90.0, 1.0);
    let (x, y, _) = line.at(station + 70.0, left);
    [x, y]
}

fn fenced_road() -> World {
    let line = |left: f64, from: i32, to: i32| -> Vec<[f64; 2]> {
        (from..=to).map(|step| on_the_bend(4.0 * f64::from(step), left)).collect()
    };
    // There are slats on the left; on the right, a wall is followed by slats.
    let mut world = World::on(Ground { reflectivity: ASPHALT, ..Ground::default() })
        .fence(&line(ROAD_HALF_M, BEHIND, 17), 1.4, Some(SLATS))
        .wall(&line(-ROAD_HALF_M, BEHIND, 4), 2.0)
        .fence(&line(-ROAD_HALF_M, 4, 17), 1.4, Some(SLATS));
    // The road's ends are closed, by a wall close behind and a fence far ahead, so that no ground behind them can be
    // reached.
    let across = |step: i32| [ROAD_HALF_M, -ROAD_HALF_M].map(|left| on_the_bend(4.0 * f64::from(step), left));
    world = world.wall(&across(BEHIND), 2.0).fence(&across(17), 1.4, Some(SLATS));
    for step in 0..8 {
        let station = -18.0 + 8.0 * f64::from(step);
        let ([left_x, left_y], [right_x, right_y]) = (on_the_bend(station, 9.6), on_the_bend(station + 3.0, -9.4));
        world = world.tree(left_x, left_y, 3.2, 2.9).tree(right_x, right_y, 3.0, 3.0);
    }
    for (station, left) in [(-3.5, 2.0), (6.0, -1.5), (13.0, 1.5), (21.0, 0.0)] {
        let [x, y] = on_the_bend(station, left);
        world = world.canopy(x, y, 4.0, 2.9);
    }
    let [car_x, car_y] = on_the_bend(19.0, -6.2);
    world.parked_car(car_x, car_y, 0.15).wall(&[[-30.0, 24.0], [6.0, 24.0]], 2.5).building(
        20.0,
        -26.0,
        0.3,
        [14.0, 9.0],
        6.0,
    )
}

/// End of the fenced road behind the vehicle, in steps of 4 m.
const BEHIND: i32 = -2;

/// Half the width of the dirt track, metres.
pub const TRACK_HALF_M: f64 = 3.0;

/// A smooth dirt track along x between ploughed fields, whose furrows, 5 cm deep, run along it (Neuhaus 2009, figure
/// 4).
pub fn dirt_track_between_fields() -> Scene {
    // A ridge 0.5 m wide every 1.5 m, with sides of 0.1 m.
    let ridge = |from: f64| [(from, 0.0), (from + 0.1, 0.05), (from + 0.4, 0.05), (from + 0.5, 0.0)];
    let right = (0..28).rev().flat_map(|k| ridge(-TRACK_HALF_M - 0.5 - 1.5 * f64::from(k)));
    let left = (0..28).flat_map(|k| ridge(TRACK_HALF_M + 1.5 * f64::from(k)));
    let across = Profile::through(&right.chain(left).collect::<Vec<_>>());
    let ground = Ground { across, reflectivity: 45, ..Ground::default() };
    Scene { paper_share: None, ..standing("dirt track between fields", World::on(ground), 0.0) }
}

/// Half the width of the town's street, kerb to kerb, metres: two lanes and a parking strip on either side.
const STREET_HALF_M: f64 = 5.6;
/// Half the length and width of the street's middle line, metres, and the radius of its corners.
const LOOP_HALF_M: [f64; 2] = [80.0, 50.0];
const LOOP_CORNER_M: f64 = 18.0;

/// A town: a street round a block of buildings and gardens, more buildings outside, cars parked and driving.
///
/// The vehicle drives round the block counter-clockwise in the right-hand lane, at 6 to 10 m/s, without end.
pub fn town() -> Scene {
    let street = |left: f64| {
        let radius = LOOP_CORNER_M;
        let sides = LOOP_HALF_M.map(|half| 2.0 * (half - radius));
        let mut course = Course::from(-LOOP_HALF_M[0] + radius, -LOOP_HALF_M[1], 0.0);
        for _ in 0..2 {
            course = course.straight(sides[0]).arc(radius, FRAC_PI_2).straight(sides[1]).arc(radius, FRAC_PI_2);
        }
        (Arc::new(course.close()), left)
    };
    let (course, lane) = street(-1.8);
    let block = |off: f64, outside: bool, rise: f64| Terrace {
        centre: [0.0, 0.0],
        half: LOOP_HALF_M.map(|half| half + off),
        corner: LOOP_CORNER_M + off,
        outside,
        rise,
        reflectivity: 45,
    };
    let terraces = vec![block(-STREET_HALF_M, false, 0.14), block(STREET_HALF_M, true, 0.14)];
    let ground = Ground { along: Profile::default(), across: Profile::default(), terraces, reflectivity: ASPHALT };
    let mut world = town_buildings(World::on(ground));
    world = town_street(world, &course);
    let drive = Drive { swing: 2.0, swing_s: 25.0, ..Drive::steady(course.clone(), 20.0, lane, 8.0) };
    // One car ahead keeps its distance; the others come towards the vehicle.
    world = world.moving_car(Drive { start: drive.start + 24.0, ..drive.clone() });
    for (start, speed) in [(150.0, -7.0), (260.0, -7.0), (390.0, -7.0)] {
        world = world.moving_car(Drive::steady(course.clone(), start, 1.8, speed));
    }
    Scene { name: "town", world: Arc::new(world), drive, paper_share: None }
}

/// Buildings with gardens fenced in between them, inside and outside the street.
fn town_buildings(mut world: World) -> World {
    // How far the building fronts and garden fences stand back from the street's middle line.
    let (front, depth) = (STREET_HALF_M + 3.0, 10.0);
    for (side, sign) in [(-1.0, 1.0), (-1.0, -1.0), (1.0, 1.0), (1.0, -1.0)] {
        // `sign` +1: the block inside the street; -1: beyond it.
        let line = side * (LOOP_HALF_M[1] - sign * front);
        let buildings = if sign > 0.0 { 5 } else { 7 };
        let pitch = 24.0;
        let first = -pitch * f64::from(buildings - 1) / 2.0;
        for number in 0..buildings {
            let x = first + pitch * f64::from(number);
            let size = [13.0 + f64::from(number % 3), depth];
            world = world.building(x, line - side * sign * depth / 2.0, 0.0, size, 6.0 + f64::from(number % 2));
            if number + 1 < buildings {
                let gap = [[x + size[0] / 2.0, line], [x + pitch - (13.0 + f64::from((number + 1) % 3)) / 2.0, line]];
                let slats = if number % 2 == 0 { Some(SLATS) } else { None };
                world = world.fence(&gap, 1.3, slats).tree(x + pitch / 2.0, line - side * sign * 5.0, 2.8, 2.6);
            }
        }
    }
    for (side, sign) in [(-1.0, 1.0), (-1.0, -1.0), (1.0, 1.0), (1.0, -1.0)] {
        let line = side * (LOOP_HALF_M[0] - sign * front);
        let buildings = if sign > 0.0 { 2 } else { 4 };
        let first = -11.0 * f64::from(buildings - 1);
        for number in 0..buildings {
            let y = first + 22.0 * f64::from(number);
            world = world.building(line - side * sign * depth / 2.0, y, FRAC_PI_2, [14.0, depth], 6.5);
            if number + 1 < buildings {
                world = world.fence(&[[line, y + 7.0], [line, y + 15.0]], 1.3, Some(SLATS));
            }
        }
    }
    // The corners of the inner block are closed by garden walls.
    let (x, y) = (LOOP_HALF_M[0] - front, LOOP_HALF_M[1] - front);
    for (sx, sy) in [(-1.0, -1.0), (-1.0, 1.0), (1.0, -1.0), (1.0, 1.0)] {
        let corner = [[sx * 54.0, sy * y], [sx * (x - 6.0), sy * y], [sx * x, sy * (y - 6.0)], [sx * x, sy * 17.0]];
        world = world.wall(&corner, 1.6);
    }
    // Garden walls close the corners of the buildings beyond the street too.
    let (x, y) = (LOOP_HALF_M[0] + front, LOOP_HALF_M[1] + front);
    for (sx, sy) in [(-1.0, -1.0), (-1.0, 1.0), (1.0, -1.0), (1.0, 1.0)] {
        world = world.wall(&[[sx * 78.0, sy * y], [sx * x, sy * y], [sx * x, sy * 39.0]], 1.6);
    }
    world
}

/// Adds what stands along the street: parked cars, trees, lamps, gantries.
fn town_street(mut world: World, course: &Course) -> World {
    let kerb = STREET_HALF_M;
    let spots = (course.length() / 7.0) as usize;
    for spot in 0..spots {
        let station = 7.0 * spot as f64 + 3.0;
        let chance = crate::noise::uniform(0x7041 + spot as u64);
        let (x, y, heading) = course.at(station, kerb - 1.1);
        if chance < 0.35 {
            world = world.parked_car(x, y, heading + PI);
        }
        let (x, y, heading) = course.at(station, 1.1 - kerb);
        if (0.25..0.55).contains(&chance) {
            world = world.parked_car(x, y, heading);
        }
        if spot % 4 == 1 {
            let (x, y, _) = course.at(station, kerb + 0.6);
            world = world.pole(x, y, 0.09, 7.0);
        }
        if spot % 5 == 2 {
            let (x, y, _) = course.at(station, -kerb - 0.9);
            world = world.tree(x, y, 2.6, 2.9);
        }
    }
    for station in [62.0, 290.0] {
        let (left, right) = (course.at(station, kerb + 0.7), course.at(station, -kerb - 0.7));
        world = world
            .beam([left.0, left.1], [right.0, right.1], 4.6, 5.2)
            .pole(left.0, left.1, 0.15, 5.2)
            .pole(right.0, right.1, 0.15, 5.2);
    }
    world
}
