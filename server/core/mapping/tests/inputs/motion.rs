//! Motion compensation: walls stay straight if poses or a speed are known, and bend if not; the map states what moved
//! its points.

use bytes::Bytes;
use clearway_lidar::model::Model;
use clearway_lidar::revolution::Revolution;
use clearway_lidar::telemetry::Telemetry;
use clearway_lidar::{Sensor, SensorConfig as LidarConfig};
use clearway_mapping::config::{Extrinsics, MapsConfig, MotionConfig, SensorConfig, VehicleConfig};
use clearway_mapping::error::EventError;
use clearway_mapping::event::{Body, EgoPose, Event, Scan};
use clearway_mapping::map::Map;
use clearway_mapping::pipeline::Pipeline;
use clearway_mapping::sensor::motion::{Compensation, EgoTrajectory, Motion};
use clearway_mapping::sensor::sweep::{Mount, Sweep};
use clearway_sim::course::{Course, Drive};
use clearway_sim::ground::Ground;
use clearway_sim::scanner::ScannerConfig;
use clearway_sim::scenes::Scene;
use clearway_sim::vehicle::{Kind, SimulatedVehicle};
use clearway_sim::world::World;
use nalgebra::{Isometry3, Point3, Translation3, UnitQuaternion, Vector3};

use crate::common;

const SPEED_MPS: f64 = 15.0;

fn pose(stamp_ns: i64, map_from_ego: Isometry3<f64>) -> EgoPose {
    EgoPose { stamp_ns, map_from_ego, speed_mps: SPEED_MPS }
}

fn at(x: f64, y: f64, yaw: f64) -> Isometry3<f64> {
    Isometry3::from_parts(Translation3::new(x, y, 0.0), UnitQuaternion::from_axis_angle(&Vector3::z_axis(), yaw))
}

#[test]
fn between_poses_translation_is_linear_and_rotation_a_slerp() {
    let mut motion = Motion::new(&MotionConfig::default());
    assert_eq!(motion.map_from_ego(0), None);
    motion.push_pose(&pose(0, at(10.0, 0.0, 3.0)), 0);
    motion.push_pose(&pose(100_000_000, at(11.0, 2.0, -3.0)), 0);
    assert_eq!(motion.map_from_ego(0), Some(at(10.0, 0.0, 3.0)), "a pose's own stamp gives the pose, to the bit");
    let quarter = motion.map_from_ego(25_000_000).unwrap();
    // From 3 to -3 rad the shorter rotation passes π.
    let expected = at(10.25, 0.5, 3.0 + 0.25 * (std::f64::consts::TAU - 6.0));
    assert!((quarter.translation.vector - expected.translation.vector).norm() < 1e-12);
    assert!(quarter.rotation.angle_to(&expected.rotation) < 1e-9, "{quarter}");
}

#[test]
fn beyond_the_poses_the_motion_continues_for_a_limited_time() {
    let mut motion = Motion::new(&MotionConfig::default());
    motion.push_pose(&pose(0, at(0.0, 0.0, 0.0)), 0);
    let alone = motion.map_from_ego(100_000_000).unwrap();
    assert!((alone.translation.x - 1.5).abs() < 1e-12, "one pose continues with its own speed: {alone}");
    motion.push_pose(&pose(100_000_000, at(1.0, 0.5, 0.1)), 0);
    let later = motion.map_from_ego(300_000_000).unwrap();
    assert!((later.translation.vector - Vector3::new(3.0, 1.5, 0.0)).norm() < 1e-12, "{later}");
    assert!((later.rotation.euler_angles().2 - 0.3).abs() < 1e-12);
    assert_eq!(motion.map_from_ego(300_000_001), None);
    let earlier = motion.map_from_ego(-200_000_000).unwrap();
    assert!((earlier.translation.vector - Vector3::new(-2.0, -1.0, 0.0)).norm() < 1e-12, "{earlier}");
    assert_eq!(motion.map_from_ego(-200_000_001), None);
    motion.push_pose(&pose(1_200_000_001, at(9.0, 9.0, 0.0)), 0);
    assert_eq!(motion.map_from_ego(700_000_000), None, "poses more than a second apart are not interpolated");
}

#[test]
fn only_the_newest_thousand_poses_are_kept() {
    let mut motion = Motion::new(&MotionConfig::default());
    (0..5000).for_each(|i| motion.push_pose(&pose(i * 1_000_000, at(i as f64, 0.0, 0.0)), 0));
    assert_eq!(motion.map_from_ego(3_975_000_000 - 200_000_000), None);
    assert!((motion.map_from_ego(4_500_500_000).unwrap().translation.x - 4500.5).abs() < 1e-9);
}

/// A car among walls, without noise, that drives a bend of 60 m at 15 m/s.
fn vehicle() -> SimulatedVehicle {
    let world = World::on(Ground::default())
        .wall(&[[18.0, -14.0], [18.0, 14.0]], 2.5)
        .wall(&[[-16.0, -12.0], [-10.0, 14.0]], 2.5)
        .wall(&[[-8.0, 16.0], [14.0, 16.0]], 2.5)
        .wall(&[[-8.0, -13.0], [14.0, -17.0]], 2.5);
    let course = std::sync::Arc::new(Course::from(-3.0, 0.0, 0.0).arc(60.0, 3.0));
    let drive = Drive::steady(course, 0.0, 0.0, SPEED_MPS);
    let scene = Scene { name: "walls", world: world.into(), drive, paper_share: None };
    SimulatedVehicle::new(scene, ScannerConfig { model: Model::Hdl32e, ..ScannerConfig::default() }.noiseless())
}

fn config(motion: MotionConfig) -> VehicleConfig {
    let maps = MapsConfig { motion, ..MapsConfig::default() };
    let extrinsics = Extrinsics { x_m: 0.0, y_m: 0.0, z_m: 1.9, roll_deg: 0.0, pitch_deg: 0.0, yaw_deg: 0.0 };
    let sensor = SensorConfig { model: Some(Model::Hdl32e), ..SensorConfig::new("top", extrinsics) };
    VehicleConfig { maps, ..VehicleConfig::new("car", vec![sensor]) }
}

/// Events of 300 ms: datagrams, telemetry unless `silent`, and a pose every `pose_ns` if it is given.
fn drive(pose_ns: Option<i64>, silent: bool) -> Vec<Event> {
    let vehicle = vehicle();
    let (start_ns, mut next_ns) = (vehicle.start_ns(), vehicle.start_ns());
    let mut bodies = Vec::new();
    for datagram in vehicle.clone().take_while(|datagram| datagram.stamp_ns < start_ns + 300_000_000) {
        while let Some(period_ns) = pose_ns.filter(|_| next_ns <= datagram.stamp_ns) {
            bodies.push((next_ns, Body::EgoPose(pose(next_ns, vehicle.pose_at(next_ns)))));
            next_ns += period_ns;
        }
        if datagram.kind == Kind::Data || !silent {
            bodies.push((datagram.stamp_ns, Body::Datagram(Bytes::from(datagram.payload))));
        }
    }
    let event = |(sequence, (arrival_ns, body))| Event { sequence, arrival_ns, source: 0, body };
    (0..).zip(bodies).map(event).collect()
}

/// The second map of a drive, and its points.
fn second(motion: MotionConfig, events: &[Event]) -> (Map, Sweep) {
    let mut pipeline = Pipeline::new(&config(motion), vec![None]).unwrap();
    for event in events {
        if let Some(map) = pipeline.step(event).unwrap().filter(|map| map.sequence == 1).cloned() {
            return (map, pipeline.newest_sweep().clone());
        }
    }
    panic!("the drive holds two revolutions");
}

/// Distances of points from the walls they belong to, metres: the root mean square and the largest. `map_from_ego` is
/// the simulator's own, so the distances show position errors as well as bends.
fn off_the_walls(sweep: &Sweep, map_from_ego: &Isometry3<f64>) -> (f64, f64) {
    let world = vehicle().scene().world.clone();
    let shapes = world.shapes_at(0.0);
    let (mut sum, mut largest, mut points) = (0.0, 0.0f64, 0);
    for ((&x, &y), &z) in sweep.x.iter().zip(&sweep.y).zip(&sweep.z) {
        if !(0.5..2.2).contains(&z) {
            continue;
        }
        let point = map_from_ego * Point3::new(f64::from(x), f64::from(y), f64::from(z));
        // The least margin at which a wall contains the point.
        let is_wall = |margin: f64| shapes.iter().any(|shape| shape.column(point.x, point.y, margin).is_some());
        let (mut near, mut far) = (0.0, 4.0);
        for _ in 0..14 {
            let middle = (near + far) / 2.0;
            if is_wall(middle) { far = middle } else { near = middle }
        }
        sum += far * far;
        largest = largest.max(far);
        points += 1;
    }
    assert!(points > 3000, "{points} points on the walls");
    ((sum / f64::from(points)).sqrt(), largest)
}

#[test]
fn at_15_mps_walls_are_straight_with_poses_and_bent_without() {
    let vehicle = vehicle();
    let mut measured = Vec::new();
    let off = MotionConfig { enabled: false };
    for (name, motion, events) in [
        ("poses at 100 Hz", MotionConfig::default(), drive(Some(10_000_000), true)),
        ("poses at 10 Hz", MotionConfig::default(), drive(Some(100_000_000), true)),
        ("GPRMC speed alone", MotionConfig::default(), drive(None, false)),
        ("switched off", off, drive(Some(10_000_000), false)),
    ] {
        let (map, sweep) = second(motion, &events);
        let (rms, largest) = off_the_walls(&sweep, &vehicle.pose_at(map.capture_end_ns));
        println!("{name:<18}: {:<5} walls off by {rms:.3} m rms, {largest:.3} m at most", map.compensation.as_str());
        measured.push((map, rms, largest));
    }
    let [(often, often_rms, often_max), (seldom, seldom_rms, _), (speed, speed_rms, _), (off, off_rms, off_max)] =
        &measured[..]
    else {
        unreachable!()
    };
    assert_eq!((often.compensation, seldom.compensation), (Compensation::Poses, Compensation::Poses));
    assert_eq!((speed.compensation, off.compensation), (Compensation::Speed, Compensation::None));
    assert!(*often_rms < 0.01 && *often_max < 0.03, "{often_rms} {often_max}");
    assert!(*seldom_rms < 0.05, "{seldom_rms}");
    // The speed alone does not know the bend, but removes the larger part of the error.
    assert!(*speed_rms < 0.7 * off_rms, "{speed_rms} {off_rms}");
    assert!(*off_rms > 0.3 && *off_max > 1.0, "{off_rms} {off_max}");

    // The pose of the map is the pose at the capture's end, whether points are moved or not.
    for map in [often, off] {
        let (given, truth) = (map.map_from_ego.unwrap(), vehicle.pose_at(map.capture_end_ns));
        assert!((given.translation.vector - truth.translation.vector).norm() < 0.01);
        assert!(given.rotation.angle_to(&truth.rotation) < 1e-3);
        assert_eq!(map.speed_mps, Some(SPEED_MPS));
    }
    assert_eq!(speed.map_from_ego, None);
    assert!((speed.speed_mps.unwrap() - SPEED_MPS).abs() < 0.1, "GPRMC states tenths of a knot: {:?}", speed.speed_mps);
}

#[test]
fn without_poses_and_speed_no_point_is_moved() {
    let events = drive(None, true);
    let (map, sweep) = second(MotionConfig::default(), &events);
    assert_eq!((map.compensation, map.speed_mps, map.map_from_ego), (Compensation::None, None, None));
    let off = MotionConfig { enabled: false };
    assert_eq!(second(off, &events).1, sweep);
}

#[test]
fn the_same_events_move_each_point_equally() {
    let events = drive(Some(20_000_000), false);
    let (map, sweep) = second(MotionConfig::default(), &events);
    assert_eq!(second(MotionConfig::default(), &events), (map.clone(), sweep.clone()));
    // Without the events after the event that completed the map.
    let last = events.iter().position(|event| event.arrival_ns > map.completed_ns).unwrap();
    assert_eq!(second(MotionConfig::default(), &events[..last]), (map, sweep));
}

#[test]
fn poses_out_of_order_are_refused_and_change_no_map() {
    let mut events = drive(Some(10_000_000), true);
    let (expected, points) = second(MotionConfig::default(), &events);
    let repeated: Vec<usize> =
        (0..events.len()).filter(|i| matches!(events[*i].body, Body::EgoPose(_)) && i % 3 == 0).collect();
    for index in repeated.iter().rev() {
        let Body::EgoPose(mut late) = events[*index].body.clone() else { unreachable!() };
        late.map_from_ego.translation.x += 100.0;
        events.insert(index + 1, Event { body: Body::EgoPose(late), ..events[*index].clone() });
    }
    let mut pipeline = Pipeline::new(&config(MotionConfig::default()), vec![None]).unwrap();
    let (mut refused, mut made) = (0, None);
    for event in &events {
        match pipeline.step(event) {
            Ok(Some(map)) if map.sequence == 1 => {
                made = Some(map.clone());
                break;
            }
            Ok(_) => {}
            Err(rejected) => {
                assert!(matches!(rejected, EventError::Stamp { .. }), "{rejected}");
                refused += 1;
            }
        }
    }
    assert!(refused > 2);
    assert_eq!(pipeline.ledger().poses_refused, refused);
    assert_eq!((made.unwrap().layers, pipeline.newest_sweep()), (expected.layers, &points));
}

#[test]
fn poses_that_jump_within_a_revolution_are_not_used_for_it() {
    let mut events = drive(Some(10_000_000), false);
    let expected = second(MotionConfig::default(), &drive(None, false));
    let middle = events.len() / 2;
    for event in &mut events[middle..] {
        if let Body::EgoPose(pose) = &mut event.body {
            pose.map_from_ego.translation.x += 80.0;
        }
    }
    let (map, sweep) = second(MotionConfig::default(), &events);
    assert_eq!(map.compensation, Compensation::Speed, "the jump lies in the second revolution");
    assert_eq!(sweep.x.len(), expected.1.x.len());
    let off = sweep.x.iter().zip(&expected.1.x).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
    assert!(off < 0.05, "{off}: as with GPRMC alone, up to its resolution of a tenth of a knot");
}

#[test]
fn extreme_stamps_and_positions_move_no_point() {
    let mut pipeline = Pipeline::new(&config(MotionConfig::default()), vec![None]).unwrap();
    let mut step = |event: &Event| pipeline.step(event).map(|map| map.map(|map| map.compensation));
    let far = |stamp_ns, x| EgoPose { stamp_ns, map_from_ego: at(x, 0.0, 0.0), speed_mps: 0.0 };
    for (stamp_ns, x) in [(0, 1e9), (1, -1e9)] {
        let body = Body::EgoPose(far(stamp_ns, x));
        step(&Event { sequence: 0, arrival_ns: i64::MIN, source: 0, body }).unwrap();
    }
    for stamp_ns in [i64::MIN, -1, (1 << 62) + 1, i64::MAX] {
        let body = Body::EgoPose(far(stamp_ns, 0.0));
        let rejected = step(&Event { sequence: 0, arrival_ns: 0, source: 0, body }).unwrap_err();
        assert_eq!((&rejected, rejected.reason()), (&EventError::StampRange { stamp_ns }, "stamp_range"));
    }
    for pose in [far(2, 1.1e9), EgoPose { speed_mps: 1e300, ..far(2, 0.0) }] {
        let rejected = step(&Event { sequence: 0, arrival_ns: 0, source: 0, body: Body::EgoPose(pose) }).unwrap_err();
        assert!(rejected.to_string().contains("within 1000 m/s"), "{rejected}");
    }
    let made: Vec<_> = drive(None, true).iter().filter_map(|event| step(event).unwrap()).collect();
    step(&Event { sequence: 0, arrival_ns: i64::MAX, source: 0, body: Body::EgoPose(far(1 << 62, 0.0)) }).unwrap();
    assert!(made.len() >= 2 && made.iter().all(|compensation| *compensation == Compensation::None));
    let motion = |stamps: [i64; 2]| {
        let mut motion = Motion::new(&MotionConfig::default());
        stamps.into_iter().for_each(|stamp_ns| motion.push_pose(&far(stamp_ns, 1.0), 0));
        motion
    };
    for stamps in [[i64::MIN, i64::MAX], [i64::MIN, 0], [0, i64::MAX]] {
        for stamp_ns in [i64::MIN, -1, 0, 1, i64::MAX] {
            let pose = motion(stamps).map_from_ego(stamp_ns);
            assert!(pose.is_none_or(|pose| pose.translation.x.is_finite()), "{stamps:?} {stamp_ns}");
        }
    }
}

#[test]
fn a_speed_is_not_used_when_it_is_too_old() {
    let telemetry = drive(None, false).into_iter().find_map(|event| match event.body {
        Body::Datagram(payload) => Telemetry::new(&payload).ok(),
        _ => None,
    });
    let gprmc = telemetry.unwrap().gprmc.unwrap();
    let mut motion = Motion::new(&MotionConfig::default());
    let known = |motion: &Motion, stamp_ms: i64| motion.at(stamp_ms * 1_000_000).1.is_some();
    assert!(!known(&motion, 0));
    motion.apply_gprmc(&gprmc, None);
    // Until the first scan has ended the time of the speed is unknown, and it is used.
    assert_eq!([0, 100_000].map(|stamp_ms| known(&motion, stamp_ms)), [true, true]);
    for end_ms in [100, 200, 300] {
        motion.note_scan_end(end_ms * 1_000_000);
        // The receiver repeats its first sentence.
        motion.apply_gprmc(&gprmc, Some(end_ms * 1_000_000));
    }
    assert_eq!([400, 2_100, 2_101].map(|stamp_ms| known(&motion, stamp_ms)), [true, true, false]);
}

#[test]
fn a_vlp16_in_dual_return_moves_both_echoes() {
    let config = ScannerConfig {
        model: Model::Vlp16,
        return_mode: clearway_lidar::model::ReturnMode::Dual,
        ..ScannerConfig::default()
    };
    let revolution = SimulatedVehicle::new(vehicle().scene().clone(), config).revolution(1);
    let mut motion = Motion::new(&MotionConfig::default());
    motion.push_pose(&pose(revolution.start_ns, at(0.0, 0.0, 0.0)), 0);
    motion.push_pose(&pose(revolution.end_ns, at(1.5, 0.0, 0.0)), 0);
    let mut trajectory = EgoTrajectory::default();
    motion.follow_revolution(&revolution, &mut trajectory);
    let mount = Mount { ego_from_sensor: Isometry3::translation(0.0, 0.0, 1.9), range_m_min: 2.0 };
    let (mut rest, mut sweep) = (Sweep::default(), Sweep::default());
    rest.set_revolution(&revolution, &mount);
    sweep.set_moving_revolution(&revolution, &mount, &trajectory.end_from_ego, None);
    assert_eq!((sweep.returns, sweep.x.len()), (rest.returns, rest.x.len()));
    // A point of the first firing is moved back by 1.5 m, one of the last firing is not moved.
    let mut index = 0;
    for echo in &revolution.echoes {
        for slot in (0..echo.range_m.len()).filter(|slot| echo.range_m[*slot] >= 2.0) {
            let since_ns = revolution.firings[slot / revolution.lasers].offset_ns;
            let share = f64::from(since_ns) / (revolution.end_ns - revolution.start_ns) as f64;
            let expected = f64::from(echo.x[slot]) - 1.5 * (1.0 - share);
            assert!((f64::from(sweep.x[index]) - expected).abs() < 1e-4, "slot {slot}");
            index += 1;
        }
    }
    assert_eq!(index, sweep.x.len());
}

/// Median and mean horizontal distance from the points of `a` to the nearest of `b`, metres; at most 1 m each.
fn apart(a: &[[f64; 3]], b: &[[f64; 3]]) -> (f64, f64) {
    let key = |point: &[f64; 3]| [0, 1].map(|axis| point[axis].floor() as i64);
    let mut cells: std::collections::HashMap<[i64; 2], Vec<[f64; 3]>> = Default::default();
    b.iter().for_each(|point| cells.entry(key(point)).or_default().push(*point));
    let nearest = |point: &[f64; 3]| {
        let [i, j] = key(point);
        let around = (0..9).map(|n| [i + n % 3 - 1, j + n / 3 - 1]);
        let others = around.filter_map(|cell| cells.get(&cell)).flatten();
        others.map(|other| (point[0] - other[0]).hypot(point[1] - other[1])).fold(1.0, f64::min)
    };
    let mut distances: Vec<f64> = a.iter().map(nearest).collect();
    distances.sort_by(f64::total_cmp);
    (distances[distances.len() / 2], distances.iter().sum::<f64>() / distances.len() as f64)
}

/// Revolutions of the HDL-32E capture, cut at an azimuth; `motion` gets the speeds of its telemetry.
fn hdl32e(cut_azimuth_deg: f32, motion: &mut Motion) -> Vec<Revolution> {
    let mut sensor = Sensor::new(LidarConfig { cut_azimuth_deg, ..LidarConfig::default() });
    let mut revolutions = Vec::new();
    for datagram in common::datagrams("pcap/rust-lidar-utils/hdl32_example.pcap") {
        if let Ok(Some(revolution)) = sensor.push(&datagram.payload, datagram.stamp_ns) {
            revolutions.extend(revolution.partial.is_none().then(|| revolution.clone()));
        }
        if let Some(gprmc) = sensor.gprmc() {
            motion.apply_gprmc(gprmc, sensor.newest().map(|revolution| revolution.end_ns));
        }
    }
    revolutions
}

#[test]
#[cfg_attr(not(clearway_data), ignore = "needs the recorded drives: set CLEARWAY_DATA")]
fn a_recorded_street_is_the_same_wherever_its_revolutions_are_cut() {
    // Revolutions cut at 90 and at 270 degrees. They share half of the directions; one of them scans these a whole
    // revolution before the other, and the car moves by 1.3 m in between. Each sweep is expressed in the ego frame at
    // its own end, and the car's speed propagates one to the other. They match only if motion is compensated in both.
    let mut motion = Motion::new(&MotionConfig::default());
    let (right, left) = (hdl32e(90.0, &mut motion), hdl32e(270.0, &mut motion));
    let mount = Mount {
        ego_from_sensor: Extrinsics { x_m: 0.0, y_m: 0.0, z_m: 2.165, roll_deg: 1.4, pitch_deg: -1.4, yaw_deg: 0.0 }
            .ego_from_sensor(),
        range_m_min: 2.5,
    };
    // Upright objects in the directions that both sweeps share, ego frame at `to_ns`, metres.
    let street = |revolution: &Revolution, compensate: bool, first_half: bool, to_ns: i64| {
        let mut trajectory = EgoTrajectory::default();
        motion.follow_revolution(revolution, &mut trajectory);
        assert_eq!(trajectory.compensation, Compensation::Speed);
        let speed_mps = trajectory.speed_mps.unwrap();
        if !compensate {
            trajectory.end_from_ego.clear();
        }
        let mut half = revolution.clone();
        let middle = half.firings.len() / 2;
        let lasers = half.lasers;
        for echo in &mut half.echoes {
            let drop = if first_half { middle * lasers..echo.range_m.len() } else { 0..middle * lasers };
            echo.range_m[drop].fill(0.0);
        }
        let mut sweep = Sweep::default();
        sweep.set_moving_revolution(&half, &mount, &trajectory.end_from_ego, None);
        let since = (to_ns - revolution.end_ns) as f64 * 1e-9 * speed_mps;
        let place = |i: usize| [f64::from(sweep.x[i]) - since, f64::from(sweep.y[i]), f64::from(sweep.z[i])];
        let places: Vec<[f64; 3]> = (0..sweep.x.len()).map(place).collect();
        let standing = |p: &[f64; 3]| (0.5..4.0).contains(&p[2]) && p[0].hypot(p[1]) < 25.0;
        places.into_iter().filter(standing).collect::<Vec<_>>()
    };
    let mut pairs = 0;
    for early in &right {
        // The revolution that ends half a revolution later: its second half has the directions of the first half of
        // this one.
        let period_ns = early.end_ns - early.start_ns;
        let later = left.iter().find(|later| {
            let since = later.end_ns - early.end_ns;
            since > period_ns / 4 && since < period_ns * 3 / 4
        });
        let Some(later) = later else { continue };
        // How far one must still be shifted along the road to lie best on the other.
        let off = |compensate: bool| {
            let a = street(early, compensate, true, later.end_ns);
            let b = street(later, compensate, false, later.end_ns);
            assert!(a.len() > 500 && b.len() > 500, "{} and {} points", a.len(), b.len());
            let shifts = (-20..=20).map(|step| f64::from(step) * 0.05);
            let shifted = |shift: f64| a.iter().step_by(4).map(|p| [p[0] + shift, p[1], p[2]]).collect::<Vec<_>>();
            let scores = shifts.map(|shift| (apart(&shifted(shift), &b).1, shift));
            scores.min_by(|a, b| a.0.total_cmp(&b.0)).unwrap()
        };
        let (with, without) = (off(true), off(false));
        println!(
            "off by {:.2} m along the road with the car's own speed (then {:.3} m apart), {:.2} m without",
            with.1, with.0, without.1
        );
        assert!(with.1.abs() <= 0.1 && without.1.abs() >= 0.5, "{with:?} {without:?}");
        pairs += 1;
    }
    assert!(pairs >= 3, "{pairs} pairs");
}

#[test]
#[cfg_attr(not(clearway_data), ignore = "needs the recorded drives: set CLEARWAY_DATA")]
fn recorded_scans_of_kitti_match_in_the_world_frame() {
    let text = std::fs::read_to_string(common::data("kitti/patchwork-plusplus/icp_poses_DERIVED.json")).unwrap();
    let numbers = |pose: &str| -> Vec<f64> {
        let matrix = &pose[..pose.find("]\n  ]").unwrap()];
        matrix.split([',', '[', ']', '\n']).filter_map(|word| word.trim().parse().ok()).collect()
    };
    let poses: Vec<Vec<f64>> = text.split("\"T_first_from_this\":").skip(1).map(numbers).collect();
    let mut config = config(MotionConfig::default());
    config.sensors[0].model = Some(Model::Hdl64eS2);
    config.sensors[0].extrinsics.z_m = 1.73;
    let ego_from_sensor = config.sensors[0].extrinsics.ego_from_sensor();
    let mut pipeline = Pipeline::new(&config, vec![None]).unwrap();
    let mut clouds = Vec::new();
    for (index, p) in poses.iter().enumerate().take(3) {
        let stamp_ns = index as i64 * 100_000_000;
        let rotation = nalgebra::Matrix3::new(p[0], p[1], p[2], p[4], p[5], p[6], p[8], p[9], p[10]);
        let first_from_this =
            Isometry3::from_parts(Translation3::new(p[3], p[7], p[11]), UnitQuaternion::from_matrix(&rotation));
        // The derived poses are the sensor's; the world frame is the first ego frame.
        let map_from_ego = ego_from_sensor * first_from_this * ego_from_sensor.inverse();
        let event = |body| Event { sequence: 0, arrival_ns: stamp_ns, source: 0, body };
        pipeline.step(&event(Body::EgoPose(pose(stamp_ns, map_from_ego)))).unwrap();
        let scan = Scan { stamp_ns, ..common::kitti(&format!("kitti/patchwork-plusplus/00000{index}.bin")) };
        let map = pipeline.step(&event(Body::Scan(scan))).unwrap().unwrap();
        assert_eq!(map.compensation, Compensation::None, "the points of KITTI are compensated already");
        let from_header = map.map_from_ego.unwrap();
        assert_eq!(from_header, map_from_ego, "a pose of the scan's own stamp is used unchanged");
        let sweep = pipeline.newest_sweep();
        let near = |i: &usize| sweep.z[*i] > 0.4 && sweep.x[*i].hypot(sweep.y[*i]) < 25.0;
        let point = |i: usize| Point3::new(sweep.x[i], sweep.y[i], sweep.z[i]).cast::<f64>();
        let points: Vec<Point3<f64>> = (0..sweep.x.len()).filter(near).map(point).collect();
        let placed: Vec<[f64; 3]> = points.iter().map(|point| (from_header * point).into()).collect();
        let raw: Vec<[f64; 3]> = points.iter().map(|point| (*point).into()).collect();
        clouds.push((placed, raw));
    }
    for pair in clouds.windows(2) {
        let (with, without) = (apart(&pair[1].0, &pair[0].0), apart(&pair[1].1, &pair[0].1));
        println!("median and mean distance: {with:.3?} m with the headers' poses, {without:.3?} m without");
        assert!(with.0 < 0.05 && with.0 < 0.6 * without.0, "{with:?} {without:?}");
    }
}
