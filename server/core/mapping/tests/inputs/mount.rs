//! Mounts estimated from the ground, compared with simulated mounts and recorded drives, and scenes without ground.

use clearway_lidar::model::Model;
use clearway_mapping::config::Extrinsics;
use clearway_mapping::sensor::mount::{MountError, estimate};
use clearway_sim::scanner::ScannerConfig;
use clearway_sim::scenes;
use clearway_sim::vehicle::SimulatedVehicle;

use crate::common;

fn points(revolution: &clearway_lidar::revolution::Revolution) -> Vec<[f32; 3]> {
    revolution.points().map(|p| [p.x, p.y, p.z]).collect()
}

#[test]
fn a_simulated_mount_is_found_within_2_cm_and_a_fifth_of_a_degree() {
    let mounts = [
        (Model::Hdl64eS2, 1.9, 0.0, 0.0),
        (Model::Hdl64eS2, 1.6, 2.5, -1.5),
        (Model::Hdl32e, 2.1, -1.8, 1.2),
        (Model::Vlp16, 1.2, 4.0, 3.0),
        (Model::Hdl64eS2, 5.8, 1.0, -0.5),
    ];
    for (model, height, pitch_deg, roll_deg) in mounts {
        // From 5.8 m above the ground the sensor looks over the town's cars and onto its roofs.
        let scenes = if height > 4.0 { vec![scenes::flat()] } else { vec![scenes::flat(), scenes::town()] };
        for scene in scenes {
            let name = scene.name;
            let extrinsics = Extrinsics { x_m: 0.0, y_m: 0.0, z_m: height, roll_deg, pitch_deg, yaw_deg: 0.0 };
            let ego_from_sensor = extrinsics.ego_from_sensor();
            let vehicle = SimulatedVehicle::new(scene, ScannerConfig { model, ego_from_sensor, ..Default::default() });
            let found = estimate((1..4).map(|number| points(&vehicle.revolution(number)))).unwrap();
            println!("{model:?} {height} m {pitch_deg}° {roll_deg}° in {name}: {found:?}");
            assert!((found.height_m - height).abs() < 0.02, "{model:?} in {name}: {found:?}");
            assert!((found.pitch_rad.to_degrees() - pitch_deg).abs() < 0.2, "{model:?} in {name}: {found:?}");
            assert!((found.roll_rad.to_degrees() - roll_deg).abs() < 0.2, "{model:?} in {name}: {found:?}");
            assert_eq!(found.extrinsics().z_m, found.height_m);
            let stds = [found.height_std_m, found.pitch_std_rad.to_degrees(), found.roll_std_rad.to_degrees()];
            assert!(stds.iter().zip([0.02, 0.2, 0.2]).all(|(std, most)| (0.0..most).contains(std)), "{found:?}");
        }
    }
}

/// True at a position within the ground or an object.
type World<'a> = &'a dyn Fn(f32, f32, f32) -> bool;

#[test]
fn crowned_roads_and_pavements_do_not_lean_the_estimate() {
    // The lane under the vehicle is level; the other lane falls by 4 % from the crown, and a pavement is on the right.
    let crowned = |_: f32, y: f32, z: f32| z <= -0.04 * (y - 1.75).max(0.0) || (z <= 0.13 && y < -2.2);
    // A bank rises by a tenth on the left.
    let bank = |_: f32, y: f32, z: f32| z <= 0.1 * (y - 2.5).max(0.0);
    let worlds: [(&str, World<'_>); 2] = [("crown", &crowned), ("bank", &bank)];
    for (name, world) in worlds {
        for model in [Model::Hdl64eS2, Model::Vlp16] {
            let sweep = common::cast(model, world);
            let points: Vec<[f32; 3]> =
                (0..sweep.x.len()).map(|i| [sweep.x[i], sweep.y[i], sweep.z[i] - common::HEIGHT_M]).collect();
            let found = estimate([points]).unwrap();
            println!("{name} {model:?}: {found:?}");
            assert!((found.height_m - f64::from(common::HEIGHT_M)).abs() < 0.03, "{name} {model:?}: {found:?}");
            assert!(found.roll_rad.to_degrees().abs() < 0.4, "{name} {model:?}: {found:?}");
            assert!(found.pitch_rad.to_degrees().abs() < 0.2, "{name} {model:?}: {found:?}");
        }
    }
}

#[test]
fn frames_in_which_the_vehicle_brakes_do_not_move_the_estimate() {
    let sweep = common::cast(Model::Hdl32e, common::plain);
    let frame = |pitch: f32| -> Vec<[f32; 3]> {
        (0..sweep.x.len()).map(|i| [sweep.x[i], sweep.y[i], sweep.z[i] + pitch * sweep.x[i] - 1.8]).collect()
    };
    let still: Vec<_> = (0..10).map(|_| frame(0.0)).collect();
    let braking: Vec<_> = (0..10).map(|number| frame(if number < 3 { 0.05 } else { 0.0 })).collect();
    let [still, braking] = [estimate(still).unwrap(), estimate(braking).unwrap()];
    assert!((still.pitch_rad - braking.pitch_rad).abs() < 1e-3, "{still:?} {braking:?}");
    // Half of the frames pitch: the estimate states that it is uncertain.
    let half: Vec<_> = (0..10).map(|number| frame(if number % 2 == 0 { 0.05 } else { 0.0 })).collect();
    let half = estimate(half).unwrap();
    assert!(half.pitch_std_rad > 0.02 && still.pitch_std_rad < 0.005, "{half:?} {still:?}");
}

#[test]
fn a_drive_contradicts_a_wrong_mount_and_not_a_right_one() {
    use clearway_mapping::config::{SensorConfig, VehicleConfig};
    use clearway_mapping::event::{Body, Event};
    use clearway_mapping::pipeline::Pipeline;
    let true_m = 1.6;
    let ego_from_sensor = nalgebra::Isometry3::translation(0.0, 0.0, true_m);
    let scanner = ScannerConfig { model: Model::Vlp16, ego_from_sensor, ..Default::default() };
    let vehicle = SimulatedVehicle::new(scenes::town(), scanner);
    let until_ns = vehicle.start_ns() + 2_600_000_000;
    let datagrams: Vec<_> = vehicle.take_while(|datagram| datagram.stamp_ns < until_ns).collect();
    // The height configured, the pitch configured, what the ground shows.
    for (z_m, pitch_deg, contradicts) in [(1.6, 0.0, false), (1.7, 0.5, false), (2.18, 0.0, true), (1.6, 3.0, true)] {
        let extrinsics = Extrinsics { x_m: 0.0, y_m: 0.0, z_m, roll_deg: 0.0, pitch_deg, yaw_deg: 0.0 };
        let config = VehicleConfig::new("car", vec![SensorConfig::new("top", extrinsics)]);
        let mut pipeline = Pipeline::new(&config, vec![None]).unwrap();
        pipeline.set_active_layers(|_| false);
        for (sequence, datagram) in (0..).zip(&datagrams) {
            let body = Body::Datagram(datagram.payload.clone().into());
            pipeline.step(&Event { sequence, arrival_ns: datagram.stamp_ns, source: 0, body }).unwrap();
        }
        let found = pipeline.sensors()[0].mount.unwrap();
        println!("{z_m} m, {pitch_deg}: {found:?}");
        assert_eq!(found.contradicts, contradicts, "{z_m} m, {pitch_deg}: {found:?}");
        assert!((found.height_m - (true_m - z_m)).abs() < 0.06, "{z_m} m, {pitch_deg}: {found:?}");
        assert!((found.pitch_rad.to_degrees() + pitch_deg).abs() < 0.6, "{z_m} m, {pitch_deg}: {found:?}");
    }
}

#[test]
fn without_ground_the_estimate_is_an_error() {
    assert!(matches!(estimate([Vec::new()]), Err(MountError::TooFewPoints { samples: 0, revolutions: 1 })));
    let none: [Vec<[f32; 3]>; 0] = [];
    assert!(matches!(estimate(none), Err(MountError::TooFewPoints { revolutions: 0, .. })));
    // Walls of a tunnel, and no point under the sensor.
    let wall = |i: i32| [(i % 300) as f32 * 0.1 - 15.0, if i % 2 == 0 { 4.0 } else { -4.0 }, (i / 300) as f32 * 0.1];
    let refused = estimate([(0..9000).map(wall).collect::<Vec<_>>()]);
    assert!(refused.is_err(), "{refused:?}");
    // A floor on one side only.
    let beside = |i: i32| [5.0 + (i % 100) as f32 * 0.1, (i / 100) as f32 * 0.1, -1.7];
    let refused = estimate([(0..9000).map(beside).collect::<Vec<_>>()]);
    assert!(matches!(refused, Err(MountError::NoGround { .. })), "{refused:?}");
    let message = refused.unwrap_err().to_string();
    assert!(message.contains("of 12 directions"), "{message}");
}

#[test]
fn points_that_are_not_finite_give_an_error() {
    let wild = [[f32::NAN; 3], [f32::INFINITY, 0.0, 0.0], [1e30; 3], [0.0; 3]];
    assert!(estimate([wild.repeat(1000)]).is_err());
}

fn recorded(path: &str, model: Option<Model>) -> Vec<Vec<[f32; 3]>> {
    use clearway_lidar::{Sensor, SensorConfig};
    let mut sensor = Sensor::new(SensorConfig { model, ..SensorConfig::default() });
    let mut revolutions = Vec::new();
    for datagram in common::datagrams(path) {
        if let Ok(Some(revolution)) = sensor.push(&datagram.payload, datagram.stamp_ns)
            && revolution.partial.is_none()
        {
            revolutions.push(points(revolution));
        }
    }
    revolutions
}

#[test]
#[cfg_attr(not(clearway_data), ignore = "needs the recorded drives: set CLEARWAY_DATA")]
fn recorded_drives_give_the_mount_that_their_ground_shows() {
    // The sensor of one car, in two streets: 13 frames. Around the first street's frames the ground slopes by 2 degrees
    // to the left, and the car stands on a lane that is nearly level.
    let points = |scan: clearway_mapping::event::Scan| -> Vec<[f32; 3]> {
        (0..scan.x.len()).map(|i| [scan.x[i], scan.y[i], scan.z[i]]).collect()
    };
    let first = (0..3).map(|frame| common::kitti(&format!("kitti/patchwork-plusplus/00000{frame}.bin")));
    let second = (0..10).map(|frame| {
        let file = common::data(&format!("kitti/udacity_data_2/000000000{frame}.pcd"));
        clearway_mapping::scan_file::read_pcd(&std::fs::read(file).unwrap()).unwrap()
    });
    let frames: Vec<Vec<[f32; 3]>> = first.chain(second).map(points).collect();
    let alone: Vec<_> = frames.iter().map(|points| estimate([points]).unwrap()).collect();
    for found in &alone {
        let [pitch, roll] = [found.pitch_rad, found.roll_rad].map(f64::to_degrees);
        let [pitch_std, roll_std] = [found.pitch_std_rad, found.roll_std_rad].map(f64::to_degrees);
        let (height, std) = (found.height_m, found.height_std_m);
        println!("{height:.3} ± {std:.3} m, pitch {pitch:.2} ± {pitch_std:.2}, roll {roll:.2} ± {roll_std:.2}");
        assert!((height - 1.78).abs() < 0.05, "{found:?}");
    }
    let rolls = || alone.iter().map(|found| found.roll_rad.to_degrees());
    let spread = rolls().fold(f64::NEG_INFINITY, f64::max) - rolls().fold(f64::INFINITY, f64::min);
    assert!(spread < 1.2, "{spread} degrees");
    let together = [estimate(&frames[..3]).unwrap(), estimate(&frames[3..]).unwrap(), estimate(&frames).unwrap()];
    let [first, second, all] = &together;
    println!("{together:#?}");
    let apart = (first.roll_rad - second.roll_rad).abs();
    assert!(apart < 2.0 * first.roll_std_rad.hypot(second.roll_std_rad), "the streets agree within their deviations");
    assert!(all.roll_rad.to_degrees().abs() < 0.4 && (all.height_m - 1.79).abs() < 0.03, "{all:?}");
    let found = estimate(recorded("pcap/rust-lidar-utils/hdl32_example.pcap", None)).unwrap();
    println!("HDL-32E: {found:?}");
    assert!((found.height_m - 2.2).abs() < 0.05 && found.residual_m < 0.05, "{found:?}");
    let found = estimate(recorded("pcap/opendlv/proxy-velodyne16/sampleShort.pcap", None)).unwrap();
    println!("VLP-16: {found:?}");
    assert!((found.height_m - 1.56).abs() < 0.05 && found.residual_m < 0.05, "{found:?}");
    // Indoors, on a table.
    let refused = estimate(recorded("pcap/rust-lidar-utils/velodyne_example.pcap", None));
    println!("indoors: {refused:?}");
    assert!(refused.is_err());
}
