//! Recorded vehicles with several LIDARs: three sensors of OpenCalib, two VLP-32C of Argoverse 2.

mod argoverse;

use clearway_mapping::config::{Extrinsics, SensorConfig, VehicleConfig};
use clearway_mapping::event::{Body, Event, Scan};
use clearway_mapping::layer::Layer;
use clearway_mapping::map::{Contribution, Map};
use clearway_mapping::pipeline::Pipeline;
use clearway_mapping::sensor::mount::estimate;
use nalgebra::Isometry3;

use crate::common;
use crate::common::opencalib::{top_from_sensor, unpack_lzf};

const STAMP_NS: i64 = 1_644_917_764_449_000_000;

fn extrinsics(ego_from_sensor: &Isometry3<f64>) -> Extrinsics {
    let (roll, pitch, yaw) = ego_from_sensor.rotation.euler_angles();
    let t = ego_from_sensor.translation;
    let [roll_deg, pitch_deg, yaw_deg] = [roll, pitch, yaw].map(f64::to_degrees);
    Extrinsics { x_m: t.x, y_m: t.y, z_m: t.z, roll_deg, pitch_deg, yaw_deg }
}

/// A `binary_compressed` PCD with the fields x y z intensity ring timestamp: a scan that ends at `STAMP_NS`.
fn pcd(path: &str) -> Scan {
    let file = std::fs::read(common::data(path)).unwrap();
    let header = file.windows(23).position(|line| line == b"DATA binary_compressed\n").unwrap();
    let text = std::str::from_utf8(&file[..header]).unwrap();
    assert!(text.contains("FIELDS x y z intensity ring timestamp\nSIZE 4 4 4 4 2 8\n"), "{text}");
    let points: usize = text.lines().find_map(|line| line.strip_prefix("POINTS ")).unwrap().parse().unwrap();
    let columns = unpack_lzf(&file[header + 31..]);
    assert_eq!(columns.len(), points * 26, "{path}");
    let floats = |column: usize| -> Vec<f32> {
        let bytes = &columns[column * 4 * points..(column + 1) * 4 * points];
        bytes.chunks_exact(4).map(|value| f32::from_le_bytes(value.try_into().unwrap())).collect()
    };
    let rings = columns[16 * points..18 * points].chunks_exact(2).map(|value| u16::from_le_bytes([value[0], value[1]]));
    let times = columns[18 * points..].chunks_exact(8).map(|value| f64::from_le_bytes(value.try_into().unwrap()));
    let times: Vec<f64> = times.collect();
    let end = times.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let offset = |time: &f64| ((time - end) * 1e9) as i32;
    Scan {
        stamp_ns: STAMP_NS,
        x: floats(0),
        y: floats(1),
        z: floats(2),
        intensity: floats(3),
        ring: rings.collect(),
        offset_ns: times.iter().map(offset).collect(),
        no_returns: Vec::new(),
    }
}

fn points(scan: &Scan) -> Vec<[f32; 3]> {
    scan.x.iter().zip(&scan.y).zip(&scan.z).map(|((&x, &y), &z)| [x, y, z]).collect()
}

/// The map of the first sensor's scan, which arrives after the others.
fn map(config: &VehicleConfig, scans: &[Scan]) -> (Map, Pipeline) {
    let mut pipeline = Pipeline::new(config, vec![None; config.sensors.len()]).unwrap();
    let mut made = None;
    for (sensor, scan) in scans.iter().enumerate().rev() {
        let body = Body::Scan(scan.clone());
        let event = Event { sequence: 0, arrival_ns: scan.stamp_ns, source: sensor as u16, body };
        made = pipeline.step(&event).unwrap().cloned();
    }
    (made.expect("the reference sensor makes a map"), pipeline)
}

/// Classes of the cells of a Cartesian layer within `reach_m`.
fn near(layer: &Layer, reach_m: f32) -> Vec<u8> {
    let steps = (reach_m / 0.25) as i32;
    let places = (-steps..steps).flat_map(|i| (-steps..steps).map(move |j| (i, j)));
    let middles = places.map(|(i, j)| ((i as f32 + 0.5) * 0.25, (j as f32 + 0.5) * 0.25));
    middles.map(|(x, y)| common::cell_at(layer, x, y).map_or(0, |cell| common::classes(layer)[cell])).collect()
}

#[test]
#[cfg_attr(not(clearway_data), ignore = "needs the recorded drives: set CLEARWAY_DATA")]
fn opencalibs_side_sensors_show_ground_where_the_top_sensor_is_blind() {
    for (scene, files) in [
        ("0001", ["top.pcd", "left.pcd", "right.pcd"]),
        (
            "0002",
            [
                "top-2022-02-15-17-36-04-449.pcd",
                "left-2022-02-15-17-36-04-414.pcd",
                "right-2022-02-15-17-36-04-445.pcd",
            ],
        ),
    ] {
        let folder = format!("multilidar/opencalib/real_world/{scene}");
        let scans = files.map(|file| pcd(&format!("{folder}/{file}")));
        let json = std::fs::read_to_string(common::data(&format!("{folder}/extrinsics_from_result.json"))).unwrap();
        let mount = estimate(&[points(&scans[0])]).unwrap();
        let ego_from_top = mount.extrinsics().ego_from_sensor();
        let sensors = files.map(|file| {
            let ego_from_sensor = ego_from_top * top_from_sensor(&json, file);
            SensorConfig::new(file.split(['.', '-']).next().unwrap(), extrinsics(&ego_from_sensor))
        });
        let three = VehicleConfig::new("car", sensors.to_vec());
        let alone = VehicleConfig::new("car", sensors[..1].to_vec());
        let (fused, pipeline) = map(&three, &scans);
        let (top, _) = map(&alone, &scans[..1]);
        assert!(fused.sensors.iter().all(|sensor| sensor.contribution == Contribution::Ok), "{:?}", fused.sensors);
        let sum: usize = scans.iter().map(|scan| scan.x.len()).sum();
        let returns: u32 = fused.sensors.iter().map(|sensor| sensor.returns).sum();
        assert_eq!(returns as usize, sum, "{scene}");
        assert!(pipeline.newest_sweep().x.len() * 1000 >= sum * 999, "{scene}: few returns are the vehicle itself");
        // Class 1 of terrain is flat ground. The top sensor sees none within 3 m: its first ring lies at 5 m.
        let flat = |map: &Map| near(&map.layers[2], 3.0).iter().filter(|class| **class == 1).count();
        println!("{scene}: flat ground seen within 3 m, cells: {} -> {}", flat(&top), flat(&fused));
        assert!(flat(&top) == 0 && flat(&fused) >= 250, "{scene}");
        assert!(newly_drivable(&top, &fused) >= 80, "{scene}");
        if scene == "0001" {
            check_rail(&pipeline);
            // The top sensor alone sees gaps in the rail, but the vehicle does not fit through them.
            let [behind_top, behind] = [&top, &fused].map(|map| drivable(map, [-10.0, 9.0], [-9.0, -6.0]));
            let [lane_top, lane] = [&top, &fused].map(|map| drivable(map, [-10.0, 9.0], [-4.0, 0.0]));
            println!("drivable of the pavement {behind_top} -> {behind}, of the lane {lane_top} -> {lane} cells");
            assert!(behind_top == 0 && behind == 0, "{behind_top} {behind}");
            assert!(lane >= lane_top, "{lane_top} {lane}");
        }
    }
}

/// Checks the guard rail of scene 0001, to the right of the vehicle, between the lane and a pavement 15 cm above it:
/// every metre of it has a return 0.4 m or higher.
fn check_rail(pipeline: &Pipeline) {
    let sweep = pipeline.newest_sweep();
    for x_m in -10..9 {
        let x_m = x_m as f32;
        let near = |i: &usize| (x_m..x_m + 1.0).contains(&sweep.x[*i]) && (-6.0..-4.0).contains(&sweep.y[*i]);
        let highest = (0..sweep.x.len()).filter(near).map(|i| sweep.z[i]).fold(f32::NEG_INFINITY, f32::max);
        assert!(highest > 0.4, "{highest} m at {x_m}");
    }
}

/// Number of drivable cells of 0.25 m in a rectangle.
fn drivable(map: &Map, [back, ahead]: [f32; 2], [right, left]: [f32; 2]) -> usize {
    let layer = &map.layers[0];
    let steps = |from: f32, to: f32| (0..((to - from) / 0.25) as i32).map(move |i| from + (i as f32 + 0.5) * 0.25);
    let places = steps(back, ahead).flat_map(|x| steps(right, left).map(move |y| (x, y)));
    places.filter(|&(x, y)| common::cell_at(layer, x, y).is_some_and(|cell| common::classes(layer)[cell] == 1)).count()
}

/// Number of cells of 0.25 m within 8 m that are drivable in the fused map and unknown in the first.
fn newly_drivable(first: &Map, fused: &Map) -> usize {
    let both = near(&first.layers[0], 8.0).into_iter().zip(near(&fused.layers[0], 8.0));
    let new = both.filter(|both| *both == (0, 1)).count();
    println!("drivable where one sensor is blind: {new} cells");
    new
}

#[test]
#[cfg_attr(not(clearway_data), ignore = "needs the recorded drives: set CLEARWAY_DATA")]
fn argoverses_second_vlp32c_shows_ground_where_the_first_is_blind() {
    let drive = "argoverse2/adcf7d18-0510-35b0-a2fa-b4cea13a6d76/sensors/lidar/315973157959879000.feather";
    let scans = argoverse::scans(&std::fs::read(common::data(drive)).unwrap(), 315_973_157_959_879_000);
    assert!(scans.iter().all(|scan| scan.x.len() > 40_000), "{:?}", scans.each_ref().map(|scan| scan.x.len()));
    // The points of Argoverse are in the frame of the rear axle, 33 cm over the ground.
    let axle = Extrinsics { x_m: 0.0, y_m: 0.0, z_m: 0.33, roll_deg: 0.0, pitch_deg: 0.0, yaw_deg: 0.0 };
    let sensors = ["up", "down"].map(|name| SensorConfig::new(name, axle));
    let (fused, pipeline) = map(&VehicleConfig::new("car", sensors.to_vec()), &scans);
    let (up, _) = map(&VehicleConfig::new("car", sensors[..1].to_vec()), &scans[..1]);
    assert!(fused.sensors.iter().all(|sensor| sensor.contribution == Contribution::Ok), "{:?}", fused.sensors);
    assert!(fused.sensors[1].age_ms.unwrap().abs() < 100.0, "{:?}", fused.sensors[1]);
    assert_eq!(pipeline.ledger().decoded, 2);
    assert!(newly_drivable(&up, &fused) >= 20);
}
