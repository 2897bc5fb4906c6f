//! Memory of ground and obstacles, with simulated drives past recorded truth.

use clearway_lidar::model::Model;
use clearway_mapping::config::{Extrinsics, MapsConfig, SensorConfig, VehicleConfig};
use clearway_mapping::event::{Body, EgoPose, Event};
use clearway_mapping::layer::Layer;
use clearway_mapping::map::Map;
use clearway_mapping::pipeline::Pipeline;
use clearway_sim::scanner::ScannerConfig;
use clearway_sim::scenes;
use clearway_sim::truth::{Limits, Truth};
use clearway_sim::vehicle::SimulatedVehicle;

use crate::common::*;

const POSE_PERIOD_NS: i64 = 10_000_000;

/// Known, drivable and wrongly drivable cells within 20 m.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct Known {
    cells: usize,
    drivable: usize,
    wrong: usize,
}

fn vehicle(model: Model) -> SimulatedVehicle {
    SimulatedVehicle::new(scenes::town(), ScannerConfig { model, ..ScannerConfig::default() })
}

fn pipeline(model: Model, remembers: bool) -> Pipeline {
    let extrinsics = Extrinsics { x_m: 0.0, y_m: 0.0, z_m: 1.9, roll_deg: 0.0, pitch_deg: 0.0, yaw_deg: 0.0 };
    let sensor = SensorConfig { model: Some(model), ..SensorConfig::new("top", extrinsics) };
    let mut config = VehicleConfig::new("car", vec![sensor]);
    config.maps = MapsConfig::default();
    config.maps.memory.enabled = remembers;
    Pipeline::new(&config, vec![None]).unwrap()
}

/// Drives through the town and calls `judge` with each map. `pose` may change the poses that the pipeline gets.
fn drive(
    vehicle: &SimulatedVehicle,
    pipeline: &mut Pipeline,
    maps: usize,
    pose: impl Fn(EgoPose) -> EgoPose,
    mut judge: impl FnMut(&Map),
) {
    let (mut next_pose_ns, mut made) = (vehicle.start_ns(), 0);
    for datagram in vehicle.clone() {
        let mut step = |arrival_ns, body| {
            let event = Event { sequence: 0, arrival_ns, source: 0, body };
            if let Some(map) = pipeline.step(&event).unwrap() {
                made += 1;
                judge(map);
            }
        };
        while next_pose_ns <= datagram.stamp_ns {
            let (map_from_ego, speed_mps) = (vehicle.pose_at(next_pose_ns), vehicle.speed_at(next_pose_ns));
            let truth = EgoPose { stamp_ns: next_pose_ns, map_from_ego, speed_mps };
            step(next_pose_ns, Body::EgoPose(pose(truth)));
            next_pose_ns += POSE_PERIOD_NS;
        }
        step(datagram.stamp_ns, Body::Datagram(datagram.payload.into()));
        if made >= maps {
            return;
        }
    }
}

fn known(layer: &Layer, vehicle: &SimulatedVehicle, stamp_ns: i64) -> Known {
    let truth = vehicle.truth_at(stamp_ns, 25.0, 0.2, &Limits::default());
    let mut known = Known::default();
    let (rows, columns) = size(layer);
    for cell in 0..rows * columns {
        let middle = |index: usize| (index as f64 + 0.5 - columns as f64 / 2.0) * 0.25;
        let (x, y) = (middle(cell % columns), middle(cell / columns));
        let name = class_name(layer, cell);
        // An inferred cell is no knowledge.
        if x.hypot(y) > 20.0 || name == "unknown" || name == "flat_inferred" {
            continue;
        }
        known.cells += 1;
        if name == "flat" {
            known.drivable += 1;
            known.wrong +=
                usize::from(matches!(truth.class_at(x, y), Truth::Obstacle | Truth::Overhang | Truth::Unreachable));
        }
    }
    known
}

fn terrain(map: &Map) -> &Layer {
    map.layers.iter().find(|layer| layer.name == "terrain").unwrap()
}

fn metric(map: &Map, name: &str) -> f64 {
    figure(&map.layers[0], name)
}

#[test]
fn a_moving_vehicle_with_few_lasers_knows_several_times_the_cells() {
    // The 32 lasers of an HDL-32E leave less to remember.
    for (model, times) in [(Model::Vlp16, 5.0), (Model::Hdl32e, 2.5)] {
        let vehicle = vehicle(model);
        let [mut with, mut without] = [Known::default(); 2];
        for (remembers, sum) in [(true, &mut with), (false, &mut without)] {
            let mut number = 0;
            drive(
                &vehicle,
                &mut pipeline(model, remembers),
                60,
                |pose| pose,
                |map| {
                    number += 1;
                    // The first seconds fill the memory.
                    if number > 40 && number % 5 == 0 {
                        let found = known(terrain(map), &vehicle, map.capture_end_ns);
                        sum.cells += found.cells;
                        sum.drivable += found.drivable;
                        sum.wrong += found.wrong;
                    }
                },
            );
        }
        let precision = |known: Known| 1.0 - known.wrong as f64 / known.drivable as f64;
        println!("{model:?}: {with:?} {:.4}, without memory {without:?} {:.4}", precision(with), precision(without));
        assert!(with.drivable as f64 >= times * without.drivable as f64, "{model:?}: {with:?} {without:?}");
        assert!(precision(with) >= precision(without) - 0.001, "{model:?}: {with:?} {without:?}");
    }
}

#[test]
fn without_poses_nothing_is_remembered_and_after_a_jump_everything_is_forgotten() {
    let vehicle = vehicle(Model::Vlp16);
    let mut number = 0;
    let jump_ns = vehicle.start_ns() + 2_000_000_000;
    let moved = |pose: EgoPose| {
        let mut pose = pose;
        if pose.stamp_ns >= jump_ns {
            pose.map_from_ego.translation.vector.x += 500.0;
        }
        pose
    };
    let mut pipeline = pipeline(Model::Vlp16, true);
    let mut seen = Vec::new();
    drive(&vehicle, &mut pipeline, 40, moved, |map| {
        number += 1;
        seen.push((map.capture_end_ns, metric(map, "remembered_points"), metric(map, "memory_drops")));
    });
    let (before, after): (Vec<_>, Vec<_>) = seen.iter().partition(|(stamp_ns, ..)| *stamp_ns < jump_ns);
    assert!(before[1..].iter().all(|(_, points, drops)| *points > 0.0 && *drops == 0.0), "{before:?}");
    let first = after.iter().find(|(.., drops)| *drops > 0.0).expect("a jump is noticed");
    assert_eq!(first.1, 0.0, "everything is forgotten: {first:?}");
    assert!(after.last().unwrap().1 > 0.0, "and remembered again");
}

#[test]
fn the_same_events_give_the_same_remembered_maps() {
    let vehicle = vehicle(Model::Vlp16);
    let run = || {
        let mut maps = Vec::new();
        drive(&vehicle, &mut pipeline(Model::Vlp16, true), 12, |pose| pose, |map| maps.push(map.clone()));
        maps
    };
    assert!(run() == run());
}
