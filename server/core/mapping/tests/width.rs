//! A wider vehicle reaches no ground that a narrower one does not reach, in any layer.

mod common;

use bytes::Bytes;
use clearway_lidar::model::Model;
use clearway_mapping::config::{Extrinsics, SensorConfig, VehicleConfig};
use clearway_mapping::event::{Body, EgoPose, Event};
use clearway_mapping::layer::{Layer, Meaning};
use clearway_mapping::map::Map;
use clearway_mapping::pipeline::Pipeline;
use clearway_sim::random::random_world;
use clearway_sim::scanner::ScannerConfig;
use clearway_sim::vehicle::SimulatedVehicle;
use common::*;

const LAYERS: [&str; 4] = ["drivability", "terrain", "speed", "safe_path"];
const WIDTHS_M: [f32; 7] = [0.8, 1.2, 1.7, 1.9, 2.0, 2.5, 3.2];

/// The events of a random world up to the end of its first revolution.
fn events(seed: u64, model: Model) -> (Vec<Event>, Extrinsics) {
    let world = random_world(seed);
    let at = world.ego_from_sensor.translation;
    let scanner = ScannerConfig { model, ego_from_sensor: world.ego_from_sensor, seed, ..ScannerConfig::default() };
    let vehicle = SimulatedVehicle::new(world.scene, scanner);
    let pose = |stamp_ns: i64| {
        let (map_from_ego, speed_mps) = (vehicle.pose_at(stamp_ns), vehicle.speed_at(stamp_ns));
        Body::EgoPose(EgoPose { stamp_ns, map_from_ego, speed_mps })
    };
    let event = |arrival_ns, body| Event { sequence: 0, arrival_ns, source: 0, body };
    let mut events = vec![event(vehicle.start_ns(), pose(vehicle.start_ns()))];
    // A revolution at 10 Hz, and the beginning of the next.
    let end_ns = vehicle.start_ns() + 120_000_000;
    for datagram in vehicle.clone().take_while(|datagram| datagram.stamp_ns < end_ns) {
        events.push(event(datagram.stamp_ns, Body::Datagram(Bytes::from(datagram.payload))));
    }
    (events, Extrinsics { x_m: at.x, y_m: at.y, z_m: at.z, roll_deg: 0.0, pitch_deg: 0.0, yaw_deg: 0.0 })
}

/// The first map of a vehicle of this width.
fn map(events: &[Event], model: Model, extrinsics: Extrinsics, width_m: f32) -> Map {
    let sensor = SensorConfig { model: Some(model), ..SensorConfig::new("top", extrinsics) };
    let mut config = VehicleConfig::new("car", vec![sensor]);
    config.maps.reach.vehicle_width_m = width_m;
    let mut pipeline = Pipeline::new(&config, vec![None]).unwrap();
    let map = events.iter().find_map(|event| pipeline.step(event).unwrap().cloned());
    map.expect("the events have a whole revolution")
}

/// By cell of a layer: true if it is free.
fn is_free(layer: &Layer) -> Vec<bool> {
    let free = |class: &u8| matches!(layer.legend[usize::from(*class)].meaning, Meaning::Free | Meaning::Inferred);
    classes(layer).iter().map(free).collect()
}

#[test]
fn a_wider_vehicle_never_reaches_more() {
    // Fences with openings, parked cars, poles, bushes and kerbs.
    let worlds = [(6, Model::Hdl64eS2), (14, Model::Hdl64eS2), (34, Model::Hdl32e), (102, Model::Hdl32e)];
    let mut lost = [0; LAYERS.len()];
    for (seed, model) in worlds.into_iter().chain([(4, Model::Vlp16)]) {
        let (events, extrinsics) = events(seed, model);
        let maps = WIDTHS_M.map(|width_m| map(&events, model, extrinsics, width_m));
        for (name, lost) in LAYERS.into_iter().zip(&mut lost) {
            let layer = |map: &Map| is_free(map.layers.iter().find(|layer| layer.name == name).unwrap());
            let free = maps.each_ref().map(layer);
            for (number, pair) in free.windows(2).enumerate() {
                let gained = pair[0].iter().zip(&pair[1]).filter(|(narrow, wide)| **wide && !**narrow).count();
                let widths_m = &WIDTHS_M[number..number + 2];
                assert_eq!(gained, 0, "seed {seed}, {name}: cells that only the wider of {widths_m:?} m reaches");
            }
            let count = |free: &[bool]| free.iter().filter(|free| **free).count();
            *lost += count(&free[0]) - count(&free[WIDTHS_M.len() - 1]);
        }
    }
    assert!(lost.iter().all(|cells| *cells > 100), "the width matters in each of {LAYERS:?}: {lost:?}");
}
