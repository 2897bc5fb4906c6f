//! The vehicle's own outline, in the layers of whole maps.

use clearway_lidar::model::Model;
use clearway_mapping::config::{Extrinsics, ReachConfig, SensorConfig, VehicleConfig};
use clearway_mapping::event::{Body, Event, Scan};
use clearway_mapping::layer::Meaning;
use clearway_mapping::map::Map;
use clearway_mapping::pipeline::Pipeline;
use clearway_mapping::sensor::sweep::Sweep;

use crate::common::*;

/// The map of one scan, which is a sweep of a sensor over the ego origin.
fn map(model: Model, sweep: &Sweep) -> Map {
    let extrinsics =
        Extrinsics { x_m: 0.0, y_m: 0.0, z_m: f64::from(HEIGHT_M), roll_deg: 0.0, pitch_deg: 0.0, yaw_deg: 0.0 };
    let sensor = SensorConfig { model: Some(model), ..SensorConfig::new("top", extrinsics) };
    let mut pipeline = Pipeline::new(&VehicleConfig::new("car", vec![sensor]), vec![None]).unwrap();
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
            let map = map(model, &sweep);
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
