//! Mounts estimated from the ground, compared with simulated mounts and recorded drives, and scenes without ground.

mod common;

use clearway_lidar::model::Model;
use clearway_mapping::config::Extrinsics;
use clearway_mapping::sensor::mount::{MountError, estimate};
use clearway_sim::scanner::ScannerConfig;
use clearway_sim::scenes;
use clearway_sim::vehicle::SimulatedVehicle;

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
    ];
    for (model, height, pitch_deg, roll_deg) in mounts {
        for scene in [scenes::flat(), scenes::town()] {
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
        }
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
    // 1.73 m is published; the labelled road of frame 0 itself lies on a plane 1.795 m under the sensor, tilted 0.5
    // degrees in pitch and 1.5 in roll.
    for frame in 0..3 {
        let scan = common::kitti(&format!("kitti/patchwork-plusplus/00000{frame}.bin"));
        let points: Vec<_> = (0..scan.x.len()).map(|i| [scan.x[i], scan.y[i], scan.z[i]]).collect();
        let found = estimate([points]).unwrap();
        println!("KITTI {frame}: {found:?}");
        assert!((found.height_m - 1.795).abs() < 0.03, "{found:?}");
        assert!((found.roll_rad.to_degrees() - 1.55).abs() < 0.3, "{found:?}");
    }
    let found = estimate(recorded("pcap/rust-lidar-utils/hdl32_example.pcap", None)).unwrap();
    println!("HDL-32E: {found:?}");
    assert!((found.height_m - 2.14).abs() < 0.05 && found.residual_m < 0.05, "{found:?}");
    let found = estimate(recorded("pcap/opendlv/proxy-velodyne16/sampleShort.pcap", None)).unwrap();
    println!("VLP-16: {found:?}");
    assert!((found.height_m - 1.59).abs() < 0.05 && found.residual_m < 0.05, "{found:?}");
    // Indoors, on a table.
    let refused = estimate(recorded("pcap/rust-lidar-utils/velodyne_example.pcap", None));
    println!("indoors: {refused:?}");
    assert!(refused.is_err());
}
