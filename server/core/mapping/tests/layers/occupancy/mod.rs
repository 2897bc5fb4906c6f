//! The layer `occupancy` (Seo 2014): the transitions of a cell, the scrolling window, and six sensors in traffic
//! against the simulator's truth.

mod laws;
mod lines;

use clearway_lidar::model::Model;
use clearway_mapping::config::{Extrinsics, MapsConfig, OccupancyConfig, SensorConfig, VehicleConfig};
use clearway_mapping::event::{Body, EgoPose, Event, Scan};
use clearway_mapping::layer::occupancy::Occupancy;
use clearway_mapping::layer::occupancy::class::OccupancyClass;
use clearway_mapping::layer::occupancy::states::{Cell, Evidence};
use clearway_mapping::layer::{Context, Layer, LayerMaker, Rays};
use clearway_mapping::map::Map;
use clearway_mapping::pipeline::Pipeline;
use clearway_mapping::sensor::sweep::{Mount, Sweep};
use clearway_sim::planes::{PlaneScan, PlaneUnit};
use clearway_sim::raycast::Caster;
use clearway_sim::scanner::ScannerConfig;
use clearway_sim::traffic::{self, Footprints, six_units};
use clearway_sim::vehicle::SimulatedVehicle;
use nalgebra::{Isometry3, Point3, Translation3, UnitQuaternion, Vector3};

use crate::common::street::{Street, cell_corners};
use crate::common::*;

const UNKNOWN: u8 = OccupancyClass::Unknown.value();
const CLEAR: u8 = OccupancyClass::Clear.value();
const OCCUPIED: u8 = OccupancyClass::Occupied.value();
const OCCLUDED: u8 = OccupancyClass::Occluded.value();
const OUT_OF_RANGE: u8 = OccupancyClass::OutOfRange.value();

fn occupancy() -> Occupancy {
    Occupancy::new(&OccupancyConfig::default())
}

/// The map of the scans so far.
fn made(occupancy: &mut Occupancy, map_from_ego: Option<Isometry3<f64>>) -> Layer {
    let mut layer = occupancy.layer();
    occupancy.make(&Sweep::default(), &Context { map_from_ego, ..Context::default() }, &mut layer);
    layer
}

fn class_at(layer: &Layer, x: f32, y: f32) -> u8 {
    cell_at(layer, x, y).map_or(UNKNOWN, |cell| classes(layer)[cell])
}

fn pose(x: f64, y: f64, yaw: f64) -> Isometry3<f64> {
    Isometry3::from_parts(Translation3::new(x, y, 0.0), UnitQuaternion::from_euler_angles(0.0, 0.0, yaw))
}

#[test]
fn each_transition_of_a_cell_agrees_with_the_table() {
    const NEEDED: u8 = 4;
    const HOLD: u8 = 2;
    // Evidence about the cell: rays without its returns, then its new returns.
    let evidence = [
        ("silence", Evidence::Silence, 0),
        ("nothing", Evidence::Nothing, 0),
        ("overhead", Evidence::Overhead, 0),
        ("hidden", Evidence::Hidden, 0),
        ("through", Evidence::Through, 0),
        ("few hits", Evidence::Through, NEEDED - 1),
        ("few hits, hidden", Evidence::Hidden, NEEDED - 1),
        ("hits", Evidence::Hidden, NEEDED),
    ];
    // A capital letter: the state is held for `hold_maps` first.
    let expected = [
        (OccupancyClass::Unknown, "u o u h c u h x"),
        (OccupancyClass::Clear, "u o u h c u h x"),
        (OccupancyClass::Occupied, "U O U H u x x x"),
        (OccupancyClass::Occluded, "u o u h c u h x"),
        (OccupancyClass::OutOfRange, "u o u h c u h x"),
    ];
    let state_of = |letter: char| match letter.to_ascii_lowercase() {
        'u' => OccupancyClass::Unknown,
        'c' => OccupancyClass::Clear,
        'x' => OccupancyClass::Occupied,
        'h' => OccupancyClass::Occluded,
        _ => OccupancyClass::OutOfRange,
    };
    for (state, row) in expected {
        let hits = if state == OccupancyClass::Occupied { u8::MAX } else { 0 };
        for ((name, told, fresh), letter) in evidence.into_iter().zip(row.split(' ')) {
            let letter = letter.chars().next().unwrap();
            let mut cell = Cell { state, hits, age: 0 };
            for held in 0..HOLD {
                let next = cell.next(fresh, told, NEEDED, HOLD);
                if !letter.is_uppercase() {
                    assert_eq!(next.state, state_of(letter), "{state:?} when {name}");
                    break;
                }
                assert_eq!(next.state, state, "{state:?} when {name}, map {held}");
                cell = next;
            }
            if letter.is_uppercase() {
                let next = cell.next(fresh, told, NEEDED, HOLD);
                let expected = Cell { state: state_of(letter), hits: 0, age: HOLD + 1 };
                assert_eq!(next, expected, "{state:?} when {name}, in the end");
            }
        }
    }
}

#[test]
fn hits_add_up_saturate_and_fade() {
    let hit = |cell: Cell, fresh| cell.next(fresh, Evidence::Nothing, 20, 2);
    let passed = |cell: Cell| cell.next(0, Evidence::Through, 20, 2);
    // With a few returns in each map the cell is unknown, then occupied.
    let mut cell = Cell::default();
    for turn in 1..=3 {
        cell = hit(cell, 6);
        assert_eq!((cell.state, cell.hits), (OccupancyClass::Unknown, 6 * turn), "turn {turn}");
    }
    cell = hit(cell, 6);
    assert_eq!((cell.state, cell.hits), (OccupancyClass::Occupied, u8::MAX));
    assert_eq!(hit(cell, 1), cell, "one more return keeps it");
    // After the object has gone, the cell is unknown at once, and clear some maps later.
    let states: Vec<(OccupancyClass, u8)> = std::iter::successors(Some(passed(cell)), |cell| Some(passed(*cell)))
        .take(4)
        .map(|cell| (cell.state, cell.hits))
        .collect();
    assert_eq!(
        states,
        [
            (OccupancyClass::Unknown, 19),
            (OccupancyClass::Unknown, 4),
            (OccupancyClass::Unknown, 1),
            (OccupancyClass::Clear, 0)
        ]
    );
    assert_eq!(
        hit(passed(cell), 1).state,
        OccupancyClass::Occupied,
        "after one miss, one return makes it occupied again"
    );
    // The stronger evidence counts within one map.
    assert_eq!(Cell::default().next(20, Evidence::Through, 20, 2).state, OccupancyClass::Occupied);
}

#[test]
fn a_faster_vehicle_needs_fewer_hits() {
    let needed = Occupancy::hits_needed;
    let speeds = [0.0, 4.4, 4.5, 15.6, 26.7, 26.8, 60.0, -26.8];
    assert_eq!(speeds.map(|speed| needed(Some(speed))), [20, 20, 20, 11, 3, 2, 2, 2]);
    assert_eq!(needed(None), 2, "an unknown speed may be fast");
}

/// A wall 10 m ahead of a sensor 0.45 m over the ground, seen by rays half a degree apart, up to 60 degrees to both
/// sides.
fn wall() -> Sweep {
    let mut sweep = Sweep { mount_height_m: 0.45, ..Sweep::default() };
    for step in -120..=120 {
        let (sin, cos) = (step as f32 * 0.5_f32.to_radians() / 1.0).sin_cos();
        for height in [0.35, 0.4, 0.45, 0.5, 0.6] {
            add(&mut sweep, [10.1, 10.1 * sin / cos, height]);
        }
    }
    sweep
}

#[test]
fn cells_before_a_wall_are_clear_and_cells_behind_it_occluded() {
    let sweep = wall();
    let mut occupancy = occupancy();
    occupancy.integrate(&rays(&sweep));
    let layer = made(&mut occupancy, None);
    for (x, y, expected) in [
        (5.0, 0.1, CLEAR),
        (9.6, 4.0, CLEAR),
        (9.6, -4.0, CLEAR),
        (10.1, 0.1, OCCUPIED),
        (10.1, -3.1, OCCUPIED),
        (12.0, 0.1, OCCLUDED),
        (45.0, -40.0, OCCLUDED),
        (-5.0, 0.1, OUT_OF_RANGE),
        (5.0, 30.0, OUT_OF_RANGE),
    ] {
        assert_eq!(class_at(&layer, x, y), expected, "({x}, {y})");
    }
    // The next map has no rays and no pose: all cells are unknown.
    assert!(classes(&made(&mut occupancy, None)).iter().all(|class| *class == UNKNOWN));
}

#[test]
fn cells_beyond_the_reliable_range_are_out_of_range() {
    let sweep = wall();
    let mut occupancy = Occupancy::new(&OccupancyConfig { range_m_max: 20.0, ..OccupancyConfig::default() });
    occupancy.integrate(&rays(&sweep));
    let layer = made(&mut occupancy, None);
    assert_eq!([19.0, 21.0].map(|x| class_at(&layer, x, 0.1)), [OCCLUDED, OUT_OF_RANGE]);
}

#[test]
fn rays_without_a_return_clear_as_far_as_configured() {
    let empty = Sweep { mount_height_m: 0.45, ..Sweep::default() };
    let ahead: Vec<[f32; 3]> =
        (-20..=20).map(|step| (step as f32 * 0.00436).sin_cos()).map(|(y, x)| [x, y, 0.0]).collect();
    for (no_return_m, expected) in [(0.0, [UNKNOWN, UNKNOWN]), (30.0, [CLEAR, UNKNOWN])] {
        let mut occupancy = Occupancy::new(&OccupancyConfig { no_return_m, ..OccupancyConfig::default() });
        occupancy.integrate(&Rays { no_returns: &ahead, ..rays(&empty) });
        let layer = made(&mut occupancy, None);
        assert_eq!([29.0, 31.0].map(|x| class_at(&layer, x, 0.1)), expected, "{no_return_m}");
        assert!(values(&layer, "hits").iter().all(|hits| *hits == 0));
    }
}

#[test]
fn a_ray_that_passes_under_or_over_an_object_does_not_clear_it() {
    // A sensor on the roof sees a car's side from 9 m on. One ray returns from the ground 1 m under the car, another
    // from behind it.
    let mut sweep = Sweep { mount_height_m: 1.8, ..Sweep::default() };
    for step in -8..=8 {
        let y = step as f32 * 0.04;
        [0.4, 0.6, 0.8].into_iter().for_each(|z| add(&mut sweep, [9.0, y, z]));
        add(&mut sweep, [10.1, y * 1.1, 0.0]);
        add(&mut sweep, [18.1, y * 2.0, 0.0]);
        add(&mut sweep, [8.0, y * 0.9, 0.0]);
    }
    let mut occupancy = occupancy();
    occupancy.integrate(&rays(&sweep));
    let layer = made(&mut occupancy, None);
    let seen = [6.5, 9.1, 10.1, 12.0, 15.9].map(|x| class_at(&layer, x, 0.1));
    assert_eq!(seen, [CLEAR, OCCUPIED, OCCLUDED, OCCLUDED, CLEAR]);
}

#[test]
fn a_return_below_the_ground_tells_nothing_unless_the_range_excuses_it() {
    // 0.3 m below the ground are allowed, and a hundredth of the range.
    for (x, depth_m, tells) in [(5.0, 0.33, true), (5.0, 0.37, false), (40.0, 0.68, true), (40.0, 0.72, false)] {
        let mut sweep = Sweep { mount_height_m: 1.8, ..Sweep::default() };
        add(&mut sweep, [x, 0.1, -depth_m]);
        let mut occupancy = occupancy();
        occupancy.integrate(&rays(&sweep));
        let layer = made(&mut occupancy, None);
        let is_clear = classes(&layer).contains(&CLEAR);
        assert_eq!(is_clear, tells, "{depth_m} m below the ground at {x} m");
    }
}

#[test]
fn the_grid_scrolls_with_the_vehicle_and_the_world_stays() {
    // A post with 20 returns at (30, 5) of the world, and free ground before it, are seen once; then no scan arrives.
    let mut occupancy = occupancy();
    let mut sweep = Sweep { mount_height_m: 0.45, ..Sweep::default() };
    for _ in 0..20 {
        add(&mut sweep, [29.9, 5.1, 0.5]);
    }
    let start = pose(0.0, 0.0, 0.0);
    occupancy.integrate(&Rays { map_from_ego: Some(start), speed_mps: Some(0.0), ..rays(&sweep) });
    let first = made(&mut occupancy, Some(start));
    assert_eq!(class_at(&first, 29.9, 5.1), OCCUPIED);
    for (number, ego) in [pose(3.3, -7.9, 2.0), pose(6.6, -15.8, -1.0)].into_iter().enumerate() {
        let layer = made(&mut occupancy, Some(ego));
        let post = ego.inverse() * Point3::new(29.9, 5.1, 0.0);
        let occupied = classes(&layer).iter().filter(|class| **class == OCCUPIED).count();
        assert_eq!((class_at(&layer, post.x as f32, post.y as f32), occupied), (OCCUPIED, 1), "map {number}");
    }
    // The post leaves the window and comes back: its cell is unknown.
    made(&mut occupancy, Some(pose(500.0, 0.0, 0.0)));
    assert!(classes(&made(&mut occupancy, Some(start))).iter().all(|class| *class == UNKNOWN));
}

#[test]
fn a_silent_sensor_leaves_nothing_clear() {
    let sweep = wall();
    let ego = Some(pose(4.0, 2.0, 0.3));
    let mut occupancy = occupancy();
    occupancy.integrate(&Rays { map_from_ego: ego, ..rays(&sweep) });
    assert_eq!(class_at(&made(&mut occupancy, ego), 5.0, 0.1), CLEAR);
    let after = made(&mut occupancy, ego);
    assert!(classes(&after).iter().all(|class| *class != CLEAR && *class != OCCLUDED));
    assert_eq!(class_at(&after, 10.1, 0.1), OCCUPIED, "an object seen a moment ago may still be there");
}

#[test]
fn a_scan_before_a_long_silence_clears_nothing() {
    let sweep = wall();
    for (earliest_ns, expected) in [(999, CLEAR), (1000, CLEAR), (1001, UNKNOWN)] {
        let mut occupancy = occupancy();
        occupancy.integrate(&Rays { stamp_ns: 1000, ..rays(&sweep) });
        let mut layer = occupancy.layer();
        let context = Context { stamp_ns: 5000, earliest_ns, ..Context::default() };
        occupancy.make(&Sweep::default(), &context, &mut layer);
        assert_eq!(class_at(&layer, 5.0, 0.1), expected, "seen at 1000, {earliest_ns} is the earliest that counts");
    }
}

/// Compares a map with the simulator's truth.
fn compare_with_truth(layer: &Layer, map_from_ego: &Isometry3<f64>, world: &clearway_sim::world::World, time: f64) {
    let now = Footprints::at(world, time);
    let lately: Vec<Footprints> = (0..=6).map(|step| Footprints::at(world, time - 0.05 * f64::from(step))).collect();
    for (cell, class) in classes(layer).iter().enumerate() {
        if *class != CLEAR && *class != OCCUPIED {
            continue;
        }
        let corners = cell_corners(layer, cell, map_from_ego);
        if *class == CLEAR {
            assert_eq!(now.covering(&corners), None, "clear inside an object, {:?} at {time} s", corners[0]);
        } else {
            let middle = [0, 1].map(|axis| corners.iter().map(|corner| corner[axis]).sum::<f64>() / 4.0);
            // The tolerance is half a cell's diagonal, and three standard deviations of the range.
            let touched = lately.iter().any(|footprints| footprints.near(middle, 0.28));
            assert!(touched, "occupied without an object for 0.3 s: {middle:?} at {time} s");
        }
    }
}

#[test]
fn six_sensors_in_traffic_clear_no_object_and_leave_no_trail() {
    for speed_mps in [0.0, 25.0] {
        let mut street =
            Street { scene: traffic::street(speed_mps), units: six_units().to_vec(), occupancy: occupancy() };
        for number in 0..20 {
            let (layer, map_from_ego, time) = street.map(number);
            compare_with_truth(&layer, &map_from_ego, &street.scene.world, time);
        }
    }
}

#[test]
fn no_gap_appears_where_fields_of_view_meet() {
    for speed_mps in [0.0, 25.0] {
        let mut street =
            Street { scene: traffic::street(speed_mps), units: six_units().to_vec(), occupancy: occupancy() };
        (0..3).for_each(|number| drop(street.map(number)));
        let (layer, map_from_ego, time) = street.map(3);
        let footprints = Footprints::at(&street.scene.world, time);
        let sensors: Vec<_> = street.units.iter().map(|unit| map_from_ego * unit.ego_from_sensor).collect();
        let caster = |at: &Isometry3<f64>| Caster::new(&*street.scene.world, at.translation.vector.into(), time, 200.0);
        let casters: Vec<_> = sensors.iter().map(caster).collect();
        // The sensors are at the height of a bumper, so that vehicles hide the ground behind them.
        let sees = |unit: usize, [x, y]: [f64; 2]| {
            let eye = sensors[unit].translation.vector;
            let (place, way) = (sensors[unit].inverse() * Point3::new(x, y, 0.35), Vector3::new(x, y, 0.35) - eye);
            let within = place.y.atan2(place.x).abs() < street.units[unit].field / 2.0;
            let met = casters[unit].cast_behind_leaves(eye.into(), way.normalize().into());
            within && met.is_none_or(|hit| hit.range_m > way.norm())
        };
        let (mut free, mut clear) = (0, 0);
        for (cell, class) in classes(&layer).iter().enumerate() {
            let corners = cell_corners(&layer, cell, &map_from_ego);
            let middle = [0, 1].map(|axis| corners.iter().map(|corner| corner[axis]).sum::<f64>() / 4.0);
            let ego = map_from_ego.inverse() * Point3::new(middle[0], middle[1], 0.0);
            let range = ego.x.hypot(ego.y);
            // The vehicle itself, and the ground just beside it between two neighbouring fields of view, are left out.
            if !(5.0..30.0).contains(&range) {
                continue;
            }
            assert_ne!(*class, OUT_OF_RANGE, "{speed_mps} m/s: no sensor sees ({:.2}, {:.2})", ego.x, ego.y);
            // Visible ground away from objects.
            let lonely = !footprints.near(middle, 1.5);
            if lonely && (0..sensors.len()).any(|unit| sees(unit, middle)) {
                free += 1;
                clear += u32::from(*class == CLEAR);
            }
        }
        println!("{speed_mps} m/s: {clear} of {free} free cells in sight are clear");
        // The rest lies at the edges of shadows, which count as shadow.
        assert!(f64::from(clear) >= 0.96 * f64::from(free), "{clear} of {free}");
    }
}

#[test]
fn a_sensor_on_the_roof_clears_no_cell_of_a_car() {
    for model in [Model::Hdl64eS2, Model::Vlp16] {
        let vehicle = SimulatedVehicle::new(traffic::street(0.0), ScannerConfig { model, ..ScannerConfig::default() });
        let mount = Mount { ego_from_sensor: Isometry3::translation(0.0, 0.0, 1.9), range_m_min: 2.0 };
        let mut occupancy = occupancy();
        let mut sweep = Sweep::default();
        for turn in 1..=4 {
            let revolution = vehicle.revolution(turn);
            sweep.set_revolution(&revolution, &mount);
            let map_from_ego = vehicle.pose_at(revolution.end_ns);
            let time = (revolution.end_ns - vehicle.start_ns()) as f64 * 1e-9;
            occupancy.integrate(&Rays { map_from_ego: Some(map_from_ego), speed_mps: Some(0.0), ..rays(&sweep) });
            let layer = made(&mut occupancy, Some(map_from_ego));
            let (now, before) = (time, time - 0.1);
            let world = &vehicle.scene().world;
            let (now, before) = (Footprints::at(world, now), Footprints::at(world, before));
            for (cell, _) in classes(&layer).iter().enumerate().filter(|(_, class)| **class == CLEAR) {
                let corners = cell_corners(&layer, cell, &map_from_ego);
                // A revolution takes 0.1 s; only objects that are there the whole time count.
                let inside = now.covering(&corners).and(before.covering(&corners));
                assert_eq!(inside, None, "{model:?}, revolution {turn}: clear inside an object at {:?}", corners[0]);
            }
            if turn == 4 {
                let [clear, occupied] = ["clear_share", "occupied_share"].map(|name| figure(&layer, name));
                println!("{model:?}: clear {clear:.3}, occupied {occupied:.4}");
                assert!(clear > 0.05 && occupied > 0.001, "{model:?}: clear {clear}, occupied {occupied}");
            }
        }
    }
}

/// The scans of six sensors and the vehicle's poses for `maps` maps, in the order of arrival.
fn events_of_the_street(scene: &clearway_sim::scenes::Scene, units: &[PlaneUnit], maps: i64) -> Vec<Event> {
    const START_NS: i64 = 1_800_000_000_000_000_000;
    let mut events = Vec::new();
    let mut push = |stamp_ns: i64, source: usize, body| {
        let sequence = events.len() as u64;
        events.push(Event { sequence, arrival_ns: START_NS + stamp_ns + 1_000_000, source: source as u16, body });
    };
    // One scan more than for the maps: the reference sensor's fifth scan makes a map before the fifth scans of the
    // others arrive.
    for number in 0..=maps * street::SCANS + 1 {
        let stamp_ns = number * 20_000_000;
        let map_from_ego = scene.pose_at(stamp_ns as f64 * 1e-9);
        let speed_mps = scene.drive.speed;
        push(stamp_ns, 0, Body::EgoPose(EgoPose { stamp_ns: START_NS + stamp_ns, map_from_ego, speed_mps }));
        // The reference sensor is the last of each time step.
        for (source, unit) in units.iter().enumerate().rev().filter(|_| number > 0) {
            let PlaneScan { x, y, z, intensity, ring, offset_ns, no_returns, .. } = unit.scan(scene, number);
            let stamp_ns = START_NS + stamp_ns;
            let scan = Scan { stamp_ns, x, y, z, intensity, ring, offset_ns, no_returns };
            push(stamp_ns - START_NS, source, Body::Scan(scan));
        }
    }
    events
}

#[test]
fn the_same_events_of_six_sensors_give_the_same_maps() {
    let (scene, units) = (traffic::street(25.0), six_units());
    let sensors = units.iter().enumerate().map(|(number, unit)| {
        let ([x_m, y_m, z_m], (_, _, yaw)): ([f64; 3], _) =
            (unit.ego_from_sensor.translation.vector.into(), unit.ego_from_sensor.rotation.euler_angles());
        let extrinsics = Extrinsics { x_m, y_m, z_m, roll_deg: 0.0, pitch_deg: 0.0, yaw_deg: yaw.to_degrees() };
        SensorConfig { range_m_min: 0.3, ..SensorConfig::new(format!("unit_{number}"), extrinsics) }
    });
    let mut config = VehicleConfig::new("car", sensors.collect());
    config.fusion.period_ms = 100;
    config.maps = MapsConfig { occupancy: OccupancyConfig::default(), ..MapsConfig::none() };
    let events = events_of_the_street(&scene, &units, 6);
    let run = || {
        let mut pipeline = Pipeline::new(&config, vec![None; units.len()]).unwrap();
        let maps: Vec<Map> = events.iter().filter_map(|event| pipeline.step(event).unwrap().cloned()).collect();
        maps
    };
    let maps = run();
    assert!(maps.len() >= 6, "{} maps", maps.len());
    for map in &maps {
        let map_from_ego = map.map_from_ego.unwrap();
        let time = (map.capture_end_ns - 1_800_000_000_000_000_000) as f64 * 1e-9;
        compare_with_truth(&map.layers[0], &map_from_ego, &scene.world, time);
    }
    let clear_share = figure(&maps[5].layers[0], "clear_share");
    assert!(clear_share > 0.19, "{clear_share}");
    assert_eq!(maps, run());
}

#[test]
#[cfg_attr(not(clearway_data), ignore = "needs the recorded drives: set CLEARWAY_DATA")]
fn few_clear_cells_of_the_labelled_frame_contain_an_obstacle() {
    let (sweep, labels) = labels::labelled_frame();
    let mut occupancy = occupancy();
    let shared = shared(&sweep);
    occupancy.integrate(&Rays { heights_m: shared.context().heights_m(&sweep), ..rays(&sweep) });
    let layer = made(&mut occupancy, None);
    let cells = classes(&layer).len();
    let truth = labels::truth_by_cell(&sweep, &labels, cells, |x, y| cell_at(&layer, x, y));
    let is = |class: u8| classes(&layer).iter().map(|is| *is == class).collect::<Vec<_>>();
    let free = labels::share(&is(CLEAR), |cell| !truth.obstacle[cell]);
    let road = labels::share(&truth.road, |cell| classes(&layer)[cell] == CLEAR);
    let obstacle = labels::share(&truth.obstacle, |cell| classes(&layer)[cell] == OCCUPIED);
    println!(
        "of clear cells free of obstacles {:.3} %; clear of road {:.2} %; occupied of obstacles {:.2} %",
        100.0 * free,
        100.0 * road,
        100.0 * obstacle
    );
    // The obstacles in clear cells are little higher than the vehicle's clearance.
    assert!(free >= 0.999, "{free}");
    assert!(road >= 0.95, "{road}");
    assert!(obstacle >= 0.7, "{obstacle}");
}

#[test]
#[cfg_attr(not(clearway_data), ignore = "needs the recorded drives: set CLEARWAY_DATA")]
fn three_lidars_together_see_more_than_each_alone() {
    for scene in ["0001", "0002"] {
        let sensors = opencalib::sensors(scene);
        let make = |sensors: &[opencalib::Sensor]| {
            let mut occupancy = occupancy();
            for (number, sensor) in sensors.iter().enumerate() {
                let origin_m = sensor.origin_m;
                occupancy.integrate(&Rays { sensor: number as u16, origin_m, ..rays(&sensor.sweep) });
            }
            made(&mut occupancy, None)
        };
        let clear = |layer: &Layer| classes(layer).iter().filter(|class| **class == CLEAR).count();
        let together = clear(&make(&sensors));
        let alone: Vec<usize> = sensors.iter().map(|sensor| clear(&make(std::slice::from_ref(sensor)))).collect();
        println!("{scene}: {together} cells clear together, {alone:?} alone");
        assert!(alone.iter().all(|alone| *alone > 0 && *alone < together), "{scene}: {together} of {alone:?}");
    }
}
