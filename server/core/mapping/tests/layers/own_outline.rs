//! The vehicle's own outline, in the layers of whole maps.

use clearway_lidar::model::Model;
use clearway_mapping::config::{Extrinsics, ReachConfig, SensorConfig, VehicleConfig};
use clearway_mapping::event::{Body, Event, Scan};
use clearway_mapping::layer::Meaning;
use clearway_mapping::map::Map;
use clearway_mapping::pipeline::Pipeline;
use clearway_mapping::sensor::sweep::Sweep;

use crate::common::*;

/// The map of one scan, which is a sweep of a sensor over the ego origin, around a vehicle.
fn map(model: Model, sweep: &Sweep, reach: ReachConfig) -> Map {
    let extrinsics =
        Extrinsics { x_m: 0.0, y_m: 0.0, z_m: f64::from(HEIGHT_M), roll_deg: 0.0, pitch_deg: 0.0, yaw_deg: 0.0 };
    let sensor = SensorConfig { model: Some(model), ..SensorConfig::new("top", extrinsics) };
    let mut config = VehicleConfig::new("car", vec![sensor]);
    config.maps.reach = reach;
    let mut pipeline = Pipeline::new(&config, vec![None]).unwrap();
    let scan = Scan {
        stamp_ns: 1_000_000,
        x: sweep.x.clone(),
        y: sweep.y.clone(),
        z: sweep.z.iter().map(|z| z - HEIGHT_M).collect(),
        intensity: vec![0.5; sweep.x.len()],
        ..Scan::default()
    };
    let event = Event { sequence: 0, arrival_ns: scan.stamp_ns, source: 0, body: Body::Scan(scan) };
    pipeline.step(&event).unwrap().unwrap().clone()
}

#[test]
fn nothing_around_the_vehicle_occupies_a_cell_in_its_outline() {
    let outline = ReachConfig::default().outline();
    for model in [Model::Vlp16, Model::Hdl32e, Model::Hdl64eS2, Model::Vls128] {
        // Walls nearer and farther than the first ring, and returns from the roof rack and the bonnet.
        let walls = [4.0, 5.5, 7.3, 9.0];
        let world = |wall_m: f32| {
            move |x: f32, y: f32, z: f32| {
                z <= 0.0 || (z <= 3.0 && (wall_m..wall_m + 0.3).contains(&x.abs().max(y.abs())))
            }
        };
        for wall_m in walls {
            let mut sweep = cast(model, world(wall_m));
            (0..40).for_each(|i| add(&mut sweep, [2.9, -0.9 + 0.045 * i as f32, 0.9]));
            let map = map(model, &sweep, ReachConfig::default());
            assert_eq!(map.layers.len(), 7);
            for layer in &map.layers {
                let meaning = |x: f32, y: f32| {
                    let class = cell_at(layer, x, y).map_or(0, |cell| classes(layer)[cell]);
                    layer.legend[usize::from(class)].meaning
                };
                let places =
                    (-100..100).flat_map(|i| (-100..100).map(move |j| [i, j].map(|at| at as f32 * 0.1 + 0.05)));
                for [x, y] in places.clone().filter(|[x, y]| outline.contains(*x, *y)) {
                    assert_ne!(meaning(x, y), Meaning::Occupied, "{model:?} {} {wall_m}: {x} {y}", layer.name);
                }
                let around = places.filter(|[x, y]| (wall_m - 0.5..wall_m + 0.8).contains(&x.abs().max(y.abs())));
                let walls = around.filter(|[x, y]| meaning(*x, *y) == Meaning::Occupied).count();
                assert!(walls > 0, "{model:?} {} {wall_m}: the wall", layer.name);
            }
        }
    }
}

#[test]
fn a_vehicle_stands_free_on_every_cell_that_its_outline_touches() {
    for (vehicle_front_m, vehicle_rear_m, vehicle_width_m) in
        [(3.0, 2.0, 2.0), (3.6, 1.0, 1.8), (2.87, 1.13, 1.7), (4.4, 1.4, 2.55), (0.4, 0.4, 0.6)]
    {
        let reach = ReachConfig { vehicle_front_m, vehicle_rear_m, vehicle_width_m, ..ReachConfig::default() };
        for model in [Model::Vlp16, Model::Hdl64eS2] {
            let map = map(model, &cast(model, |_, _, z| z <= 0.0), reach.clone());
            let layer = map.layers.iter().find(|layer| layer.name == "freespace").unwrap();
            let touches = |at: f32| [at - 1e-3, at + 1e-3];
            let steps = (0..=100).map(|step| step as f32 / 100.0);
            let border = steps.flat_map(|share| {
                let x = share * (vehicle_front_m + vehicle_rear_m) - vehicle_rear_m;
                let y = (share - 0.5) * vehicle_width_m;
                let sides = [-0.5, 0.5].map(|side| [x, side * vehicle_width_m]);
                sides.into_iter().chain([[-vehicle_rear_m, y], [vehicle_front_m, y]])
            });
            for [x, y] in border.flat_map(|[x, y]| touches(x).into_iter().flat_map(move |x| touches(y).map(|y| [x, y])))
            {
                let class = classes(layer)[cell_at(layer, x, y).unwrap()];
                assert_eq!(layer.legend[usize::from(class)].meaning, Meaning::Free, "{model:?} {reach:?}: {x} {y}");
            }
        }
    }
}
