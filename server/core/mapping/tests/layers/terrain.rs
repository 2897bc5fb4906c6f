//! The layer `terrain` (Neuhaus 2009) against labels, against the figures of the paper and against the simulator.

#![cfg_attr(not(clearway_data), allow(unused))]

use clearway_lidar::model::Model;
use clearway_mapping::config::{Extrinsics, ReachConfig, SensorConfig, TerrainConfig, Variant, VehicleConfig};
use clearway_mapping::event::{Body, Event};
use clearway_mapping::ground::Ground;
use clearway_mapping::layer::roughness::RoughnessSums;
use clearway_mapping::layer::terrain::Terrain;
use clearway_mapping::layer::terrain::class::{ROUGHNESS, Shape, TerrainClass};
use clearway_mapping::layer::{Layer, LayerMaker};
use clearway_mapping::pipeline::Pipeline;
use clearway_mapping::sensor::distance_series::DistanceSeries;
use clearway_mapping::sensor::sweep::{Mount, Sweep};
use clearway_sim::scanner::ScannerConfig;
use clearway_sim::scenes::{self, Scene};
use clearway_sim::truth::Truth;
use clearway_sim::vehicle::SimulatedVehicle;

use crate::common::labels::*;
use crate::common::*;

const FLAT: u8 = TerrainClass::Flat.value();
const FLAT_INFERRED: u8 = TerrainClass::FlatInferred.value();
const FLAT_ELEVATED: u8 = TerrainClass::FlatElevated.value();
const OBSTACLE: u8 = TerrainClass::Obstacle.value();
const FLAT_UNREACHABLE: u8 = TerrainClass::FlatUnreachable.value();

fn terrain(sweep: &Sweep, config: &TerrainConfig) -> Layer {
    let mut map = Terrain::new(config);
    let mut layer = map.layer();
    map.make(sweep, &shared(sweep).context(), &mut layer);
    layer
}

fn with(variant: Variant) -> TerrainConfig {
    TerrainConfig { variant, ..TerrainConfig::default() }
}

/// Cells by class, in the order of the legend.
fn counts(layer: &Layer) -> Vec<usize> {
    (0..5).map(|class| classes(layer).iter().filter(|value| **value == class).count()).collect()
}

fn is_drivable(class: u8) -> bool {
    matches!(class, FLAT | FLAT_INFERRED)
}

/// Bytes of a channel as runs of value and length, a varint each.
fn run_bytes(layer: &Layer, channel: &str) -> usize {
    let varint = |v: usize| (1..10).find(|bytes| v < 1 << (7 * bytes)).unwrap();
    let runs = values(layer, channel);
    runs.chunk_by(|a, b| a == b).map(|run| varint(run[0].unsigned_abs() as usize) + varint(run.len() - 1)).sum()
}

/// Share of the flat cells, seen or inferred, without an obstacle; share of the road cells that are flat.
fn against_the_labels(config: &TerrainConfig) -> [f64; 2] {
    let (sweep, labels) = labelled_frame();
    let layer = terrain(&sweep, config);
    let (rows, columns) = size(&layer);
    let truth = truth_by_cell(&sweep, &labels, rows * columns, |x, y| cell_at(&layer, x, y));
    let flat: Vec<bool> = classes(&layer).iter().map(|class| is_drivable(*class)).collect();
    let leaks = (0..flat.len()).filter(|cell| flat[*cell] && truth.obstacle[*cell]).count();
    let [free, road] = [share(&flat, |cell| !truth.obstacle[cell]), share(&truth.road, |cell| flat[cell])];
    let seen_flat: Vec<bool> = classes(&layer).iter().map(|class| *class == FLAT).collect();
    println!(
        "{:?}: of flat cells free of obstacles {:.3} % ({leaks} are not), of those seen {:.3} %; of road flat {:.2} %; \
         cells {:?}",
        config.variant,
        100.0 * free,
        100.0 * share(&seen_flat, |cell| !truth.obstacle[cell]),
        100.0 * road,
        counts(&layer)
    );
    [free, road]
}

#[test]
#[cfg_attr(not(clearway_data), ignore = "needs the recorded drives: set CLEARWAY_DATA")]
fn the_labelled_frame_reaches_its_targets_in_all_variants() {
    let [grid_free, grid_road] = against_the_labels(&with(Variant::Grid));
    let [paper_free, paper_road] = against_the_labels(&with(Variant::Paper));
    let [free, road] = against_the_labels(&with(Variant::Grounded));
    assert!(free >= 0.998, "{free}");
    assert!(road >= 0.99, "{road}");
    // The paper's hierarchy finds more of the road than the grid, and calls more obstacles flat than ours.
    assert!(paper_road > 0.99 && grid_road < 0.8, "{paper_road} {grid_road}");
    assert!(paper_free < 0.99 && grid_free < 0.99, "{paper_free} {grid_free}");
}

/// Cells that are unknown in the variant `grid`, between two flat cells of a row or column at most 3 m apart.
fn holes(grid: &Layer) -> Vec<usize> {
    let (_, width) = size(grid);
    let class = classes(grid);
    let mut holes = vec![false; class.len()];
    for line in 0..width {
        for (first, stride) in [(line * width, 1), (line, width)] {
            let mut last: Option<usize> = None;
            for cell in (0..width).map(|index| first + index * stride) {
                match class[cell] {
                    FLAT => {
                        if let Some(last) = last.filter(|last| (cell - last) / stride <= 13) {
                            (last + stride..cell).step_by(stride).for_each(|cell| holes[cell] = true);
                        }
                        last = Some(cell);
                    }
                    OBSTACLE => last = None,
                    _ => {}
                }
            }
        }
    }
    (0..class.len()).filter(|cell| holes[*cell]).collect()
}

#[test]
#[cfg_attr(not(clearway_data), ignore = "needs the recorded drives: set CLEARWAY_DATA")]
fn the_hierarchy_closes_holes_of_the_grid_on_real_scans() {
    for number in 0..3 {
        let sweep = kitti_sweep(&format!("kitti/patchwork-plusplus/00000{number}.bin"));
        let [grid, paper, grounded] =
            [Variant::Grid, Variant::Paper, Variant::Grounded].map(|variant| terrain(&sweep, &with(variant)));
        let holes = holes(&grid);
        let closed = |layer: &Layer| {
            let closed = holes.iter().filter(|cell| is_drivable(classes(layer)[**cell])).count();
            closed as f64 / holes.len() as f64
        };
        let (paper, grounded) = (closed(&paper), closed(&grounded));
        println!(
            "scan {number}: {} holes in figure 5's grid; figure 6 closes {:.1} %, grounded {:.1} %",
            holes.len(),
            100.0 * paper,
            100.0 * grounded
        );
        assert!(holes.len() > 5_000 && paper > 0.9 && grounded > 0.85, "{paper} {grounded}");
    }
}

#[test]
fn a_town_and_an_open_plain_fit_a_message_of_64_kib() {
    for scene in [scenes::flat(), scenes::town(), scenes::dirt_track_between_fields()] {
        let layer = terrain(&simulate(scene), &TerrainConfig::default());
        let [class, roughness] = ["class", "roughness"].map(|channel| run_bytes(&layer, channel));
        println!("{class} bytes of class, {roughness} of roughness");
        assert!(class + roughness < 65_000);
    }
}

#[test]
fn an_evenly_sloping_plane_is_flat() {
    for (grade, variants) in
        [(0.15, &[Variant::Grounded, Variant::Paper, Variant::Grid][..]), (0.5, &[Variant::Paper, Variant::Grid])]
    {
        let sweep = cast(Model::Hdl64eS2, |x, y, z| z <= grade * (0.8 * x + 0.6 * y));
        for &variant in variants {
            let layer = terrain(&sweep, &TerrainConfig { variant, overhang_m: 100.0, ..TerrainConfig::default() });
            let [_, flat, _, elevated, obstacle] = counts(&layer)[..] else { unreachable!() };
            println!("{grade} {variant:?}: {flat} flat, {elevated} elevated, {obstacle} obstacles");
            assert!(flat > 1000 && elevated == 0 && obstacle == 0, "{variant:?} {grade}");
        }
    }
    // A plane too steep to drive on is flat only for the paper.
    let steep = cast(Model::Hdl64eS2, |x, _, z| z <= 0.5 * x);
    let layer = terrain(&steep, &TerrainConfig { overhang_m: 100.0, ..TerrainConfig::default() });
    assert_eq!(counts(&layer)[usize::from(FLAT)], 0);
}

#[test]
fn a_roof_is_flat_for_the_paper_and_elevated_for_the_grounded_variant() {
    // The sensor looks down on the flat top of a low block, 4 m by 6 m.
    let block = |x: f32, y: f32, z: f32| z <= 0.0 || (z <= 1.2 && (8.03..12.03).contains(&x) && y.abs() <= 3.03);
    let sweep = cast(Model::Hdl64eS2, block);
    let top = |layer: &Layer| {
        let cells = (0..12).flat_map(|i| (0..16).map(move |j| (8.6 + 0.25 * i as f32, -1.9 + 0.25 * j as f32)));
        let mut seen = [0; 5];
        cells.for_each(|(x, y)| seen[usize::from(classes(layer)[cell_at(layer, x, y).unwrap()])] += 1);
        seen
    };
    let paper = top(&terrain(&sweep, &with(Variant::Paper)));
    let grounded = top(&terrain(&sweep, &with(Variant::Grounded)));
    println!("on top: paper {paper:?}, grounded {grounded:?}");
    assert!(paper[usize::from(FLAT)] > 20 && paper[usize::from(FLAT_INFERRED)] > 20);
    assert!(grounded[usize::from(FLAT_ELEVATED)] > 20);
    assert_eq!(grounded[usize::from(FLAT)] + grounded[usize::from(FLAT_INFERRED)], 0);
}

#[test]
fn nothing_is_inferred_beyond_the_last_point_or_across_a_wide_hole() {
    // Level ground lies only ahead, from 4 to 10 m and from 14 m on. The hole of 4 m is wider than the configured 3 m.
    let mut sweep = empty(Model::Hdl64eS2);
    for i in 0..80 {
        for j in -40..40 {
            let x = 4.1 + 0.2 * i as f32;
            if !(10.0..14.0).contains(&x) {
                add(&mut sweep, [x, 0.05 + 0.1 * j as f32, 0.0]);
            }
        }
    }
    let at = |layer: &Layer, x: f32, y: f32| class_name(layer, cell_at(layer, x, y).unwrap());
    let grounded = terrain(&sweep, &with(Variant::Grounded));
    assert_eq!(at(&grounded, 6.1, 0.1), "flat");
    assert_eq!(at(&grounded, 17.1, 0.1), "flat");
    for (x, y) in [(12.1, 0.1), (6.1, 8.1), (-6.1, 0.1), (40.0, 40.0)] {
        assert_eq!(at(&grounded, x, y), "unknown", "{x} {y}");
        assert_eq!(at(&terrain(&sweep, &with(Variant::Paper)), x, y), "flat_inferred", "{x} {y}");
    }
    let wide = TerrainConfig { inference_m_max: 5.0, ..TerrainConfig::default() };
    assert_eq!(at(&terrain(&sweep, &wide), 12.1, 0.1), "flat_inferred");
}

#[test]
fn the_grid_variant_tells_scatter_line_and_plane_apart() {
    let mut sweep = empty(Model::Hdl64eS2);
    for k in 0..64 {
        let (i, j) = (0.03 * (k % 8) as f32, 0.03 * (k / 8) as f32);
        add(&mut sweep, [5.01 + i, 5.01 + j, 0.0]);
        add(&mut sweep, [10.01 + 0.5 * i, 5.1, 0.01 * k as f32]);
        let quarter = |place: i32| 0.06 * (place % 4) as f32;
        add(&mut sweep, [15.02 + quarter(k), 5.02 + quarter(k / 4), quarter(k / 16)]);
    }
    add(&mut sweep, [20.1, 5.1, 0.0]);
    let layer = terrain(&sweep, &with(Variant::Grid));
    let shape = |x: f32| values(&layer, "shape")[cell_at(&layer, x, 5.1).unwrap()];
    let found = [5.1, 10.1, 15.1, 20.1].map(shape);
    assert_eq!(found, [Shape::Plane, Shape::Line, Shape::Scatter, Shape::Unknown].map(|shape| shape as i32));
}

#[test]
fn the_plane_of_a_cell_is_the_ground_under_it() {
    let sweep = cast(Model::Hdl64eS2, |x, y, z| z <= 0.04 * x - 0.08 * y);
    let layer = terrain(&sweep, &TerrainConfig { planes: true, ..TerrainConfig::default() });
    let (height, slope_x, slope_y) = (values(&layer, "height"), values(&layer, "slope_x"), values(&layer, "slope_y"));
    for (x, y) in [(6.1f32, 2.1f32), (-8.4, 6.6), (5.1, -9.9)] {
        let cell = cell_at(&layer, x, y).unwrap();
        assert!((height[cell] as f32 * 0.05 - (0.04 * x - 0.08 * y)).abs() < 0.05, "{x} {y}: {}", height[cell]);
        assert_eq!((slope_x[cell], slope_y[cell]), (2, -4));
    }
}

#[test]
fn the_near_plane_is_the_ground_around_the_vehicle() {
    for [a, b] in [[0.04, -0.08], [0.0, 0.0], [-0.1, 0.05]] {
        let mut ground = Ground::new(ReachConfig::default().outline());
        ground.estimate(&cast(Model::Hdl64eS2, |x, y, z| z <= a * x + b * y));
        let near = ground.near_plane();
        let apart = [near.abc[0] - a, near.abc[1] - b, near.abc[2]].map(f32::abs);
        assert!(near.is_seen && apart.iter().all(|apart| *apart < 0.01), "{a} {b}: {near:?}");
    }
    let mut blind = Ground::new(ReachConfig::default().outline());
    blind.estimate(&empty(Model::Hdl64eS2));
    assert_eq!(blind.near_plane(), Default::default(), "no return defines a plane");
}

fn simulate(scene: Scene) -> Sweep {
    let config = ScannerConfig::default();
    let mount = Mount { ego_from_sensor: config.ego_from_sensor, range_m_min: 2.0 };
    let revolution = SimulatedVehicle::new(scene, config).true_revolution(1).revolution;
    let mut sweep = Sweep::default();
    sweep.set_revolution(&revolution, &mount);
    sweep.set_deviations(&revolution, &mut DistanceSeries::default(), 0.02);
    assert_eq!(sweep.deviation.len(), sweep.x.len());
    sweep
}

/// Root of the mean r (eq. 4) of the cells with a roughness for which `wanted(x, y)` is true, and their number.
fn roughness(layer: &Layer, wanted: impl Fn(f32, f32) -> bool) -> (f64, usize) {
    let (_, columns) = size(layer);
    let channel = layer.channels.iter().find(|channel| channel.name == "roughness").unwrap();
    let of_cell = values(layer, "roughness");
    let centre = |index: usize| (index as f32 + 0.5 - columns as f32 / 2.0) * 0.25;
    let cells: Vec<f64> = (0..of_cell.len())
        .filter(|cell| of_cell[*cell] != i32::from(ROUGHNESS.unknown))
        .filter(|cell| wanted(centre(cell % columns), centre(cell / columns)))
        .map(|cell| (f64::from(of_cell[cell]) * f64::from(channel.scale)).powi(2))
        .collect();
    ((cells.iter().sum::<f64>() / cells.len() as f64).sqrt(), cells.len())
}

#[test]
fn a_dirt_track_is_smoother_than_the_fields_beside_it_near_and_far_alike() {
    let sweep = simulate(scenes::dirt_track_between_fields());
    // At 30 m a cell has three points of one ring.
    let layer = terrain(&sweep, &TerrainConfig { roughness_points_min: 3, ..TerrainConfig::default() });
    assert_eq!(figure(&layer, "drivable_share"), 1.0);
    let [near, far] = [10.0f32, 30.0].map(|distance| {
        let ring = |x: f32, y: f32| (x.hypot(y) - distance).abs() < 0.15 * distance;
        let half = scenes::TRACK_HALF_M as f32;
        let (track, tracks) = roughness(&layer, |x, y| ring(x, y) && y.abs() < half - 0.5);
        let (field, fields) = roughness(&layer, |x, y| ring(x, y) && (half + 0.5..8.0).contains(&y.abs()));
        println!(
            "at {distance} m: track {track:.5} ({tracks} cells), fields {field:.5} ({fields} cells): {:.1} times",
            field / track
        );
        assert!(tracks > 50 && fields > 50);
        assert!(field > 5.0 * track, "{track} {field}");
        field
    });
    assert!((0.7..1.4).contains(&(near / far)), "{near} near, {far} far");
}

/// Cell of 0.5 m of a position within 50 m.
fn coarse_cell(x: f32, y: f32) -> Option<usize> {
    let (i, j) = ((x * 2.0).floor() + 100.0, (y * 2.0).floor() + 100.0);
    ((0.0..200.0).contains(&i) && (0.0..200.0).contains(&j)).then(|| j as usize * 200 + i as usize)
}

/// Roughness by [`coarse_cell`], from the points up to 2.5 m over the ground.
fn coarse_roughness(sweep: &Sweep) -> Vec<Option<f32>> {
    let mut cells = vec![RoughnessSums::EMPTY; 200 * 200];
    for index in (0..sweep.x.len()).filter(|index| sweep.z[*index] < 2.5) {
        if let Some(cell) = coarse_cell(sweep.x[index], sweep.y[index]) {
            cells[cell].add(sweep.deviation[index]);
        }
    }
    cells.iter().map(|cell| cell.roughness(4)).collect()
}

/// Mean, median and number of the roughness of the cells within a range whose points all have this label.
fn labelled_roughness(
    roughness: &[Option<f32>],
    sweep: &Sweep,
    labels: &[u32],
    wanted: u32,
    [from, to]: [f32; 2],
) -> (f32, f32, usize) {
    // By cell: 0 without a point, 1 with points of this label only, 2 with others.
    let mut kind = vec![0_u8; roughness.len()];
    for (index, label) in labels.iter().enumerate() {
        let (x, y) = (sweep.x[index], sweep.y[index]);
        if let Some(cell) = coarse_cell(x, y).filter(|_| (from..to).contains(&x.hypot(y)) && sweep.z[index] < 2.5) {
            kind[cell] = kind[cell].max(if *label == wanted { 1 } else { 2 });
        }
    }
    let mut known: Vec<f32> =
        (0..kind.len()).filter(|cell| kind[*cell] == 1).filter_map(|cell| roughness[cell]).collect();
    known.sort_by(f32::total_cmp);
    (known.iter().sum::<f32>() / known.len() as f32, known[known.len() / 2], known.len())
}

#[test]
#[cfg_attr(not(clearway_data), ignore = "needs the recorded drives: set CLEARWAY_DATA")]
fn a_real_road_is_smoother_than_grass_and_grass_than_bushes() {
    let (sweep, labels) = labelled_frame_with_deviations();
    let roughness = coarse_roughness(&sweep);
    for ranges in [[8.0, 15.0], [15.0, 25.0], [25.0, 40.0]] {
        let of = |label| labelled_roughness(&roughness, &sweep, &labels, label, ranges);
        let found = [of(40), of(48), of(72), of(70)];
        println!("{ranges:?} m: road, sidewalk, terrain, vegetation (mean, median, cells): {found:?}");
        let [road, _, terrain, vegetation] = found;
        assert!(road.2 > 100 && terrain.2 > 30 && vegetation.2 > 100);
        assert!(road.1 < 1e-4 && terrain.1 > 0.003, "medians: {road:?} {terrain:?}");
        assert!(terrain.0 > 4.0 * road.0 && vegetation.0 > 2.0 * terrain.0, "{road:?} {terrain:?} {vegetation:?}");
    }
}

#[test]
#[cfg_attr(not(clearway_data), ignore = "needs the recorded drives: set CLEARWAY_DATA")]
fn the_roads_of_captures_of_32_and_16_lasers_are_smooth() {
    for path in ["pcap/rust-lidar-utils/hdl32_example.pcap", "pcap/opendlv/proxy-velodyne16/sampleShort.pcap"] {
        let extrinsics = Extrinsics { x_m: 0.0, y_m: 0.0, z_m: 1.9, roll_deg: 0.0, pitch_deg: 0.0, yaw_deg: 0.0 };
        let config = VehicleConfig::new("car", vec![SensorConfig::new("top", extrinsics)]);
        let mut pipeline = Pipeline::new(&config, vec![None]).unwrap();
        for (sequence, datagram) in (0..).zip(datagrams(path)) {
            let body = Body::Datagram(datagram.payload.into());
            let event = Event { sequence, arrival_ns: datagram.stamp_ns, source: 0, body };
            let _ = pipeline.step(&event);
        }
        let map = pipeline.newest_map().unwrap();
        let drivability = map.layers.iter().find(|layer| layer.name == "drivability").unwrap();
        let roughness = coarse_roughness(pipeline.newest_sweep());
        let is_road = |cell: &usize| {
            let [x, y] = [cell % 200, cell / 200].map(|index| (index as f32 - 99.5) / 2.0);
            let cell = cell_at(drivability, x, y).filter(|_| (4.0..15.0).contains(&x) && y.abs() < 1.5);
            cell.is_some_and(|cell| class_name(drivability, cell) == "drivable")
        };
        let mut road: Vec<f32> = (0..roughness.len()).filter(is_road).filter_map(|cell| roughness[cell]).collect();
        road.sort_by(f32::total_cmp);
        let known = roughness.iter().flatten().count();
        println!(
            "{path}: {known} cells have a roughness; of {} of the road the median is {}",
            road.len(),
            road[road.len() / 2]
        );
        assert!(known > 600 && road.len() > 20 && road[road.len() / 2] < 0.001, "{known} {road:?}");
    }
}

#[test]
fn a_sweep_without_deviations_has_unknown_roughness() {
    let sweep = Sweep { deviation: Vec::new(), ..simulate(scenes::flat()) };
    let layer = terrain(&sweep, &TerrainConfig::default());
    assert!(counts(&layer)[usize::from(FLAT)] > 10_000);
    assert!(values(&layer, "roughness").iter().all(|raw| *raw == i32::from(ROUGHNESS.unknown)));
}

#[test]
fn flat_cells_of_the_simulated_worlds_contain_no_object() {
    for scene in scenes::of_the_thesis().into_iter().chain([scenes::town()]) {
        let name = scene.name;
        let config = ScannerConfig::default();
        let mount = Mount { ego_from_sensor: config.ego_from_sensor, range_m_min: 2.0 };
        let simulated = SimulatedVehicle::new(scene, config).true_revolution(1);
        let mut sweep = Sweep::default();
        sweep.set_revolution(&simulated.revolution, &mount);
        let [wrong, flat, found] = [Variant::Grid, Variant::Paper, Variant::Grounded].map(|variant| {
            let layer = terrain(&sweep, &with(variant));
            let mut high = vec![false; classes(&layer).len()];
            let mut free = vec![false; classes(&layer).len()];
            for ((&x, &y), &z) in sweep.x.iter().zip(&sweep.y).zip(&sweep.z) {
                let (Some(cell), Some(ground)) = (cell_at(&layer, x, y), simulated.truth.height_at(x.into(), y.into()))
                else {
                    continue;
                };
                high[cell] |= z - ground > 0.3 && z <= 2.5;
                free[cell] |= simulated.truth.class_at(x.into(), y.into()) == Truth::Drivable && z - ground < 0.1;
            }
            let of = |counts: &dyn Fn(usize) -> bool| (0..high.len()).filter(|cell| counts(*cell)).count();
            let drivable = |cell: usize| is_drivable(classes(&layer)[cell]);
            let wrong = of(&|cell| drivable(cell) && high[cell]);
            let is = of(&|cell| free[cell] && !high[cell]);
            let found = of(&|cell| free[cell] && !high[cell] && drivable(cell));
            [wrong as f64, of(&drivable) as f64, found as f64 / is as f64]
        });
        println!(
            "{name}: grid {wrong:?}, paper {flat:?}, grounded {found:?} (flat cells with an object, flat, recall)"
        );
        assert!(found[0] <= 0.001 * found[1], "{name}: {found:?}");
        assert!(found[2] >= 0.95, "{name}: {found:?}");
    }
}

#[test]
fn ground_behind_a_closed_fence_or_a_low_beam_is_flat_but_not_reached() {
    for (scene, behind_min) in
        [(scenes::fenced_road_under_canopy(), 1500), (scenes::fenced_road_with_low_overhang(), 2000)]
    {
        let name = scene.name;
        let config = ScannerConfig::default();
        let mount = Mount { ego_from_sensor: config.ego_from_sensor, range_m_min: 2.0 };
        let simulated = SimulatedVehicle::new(scene, config).true_revolution(1);
        let mut sweep = Sweep::default();
        sweep.set_revolution(&simulated.revolution, &mount);
        let layer = terrain(&sweep, &TerrainConfig::default());
        let unreachable = |cell: usize| {
            let centre = |i: usize| (i as f64 + 0.5) * 0.25 - 50.0;
            simulated.truth.class_at(centre(cell % 400), centre(cell / 400)) == Truth::Unreachable
        };
        let count = |wanted: &dyn Fn(u8) -> bool| {
            let cells = classes(&layer).iter().enumerate();
            cells.filter(|(cell, class)| wanted(**class) && unreachable(*cell)).count()
        };
        let (reached, behind) = (count(&is_drivable), count(&|class| class == FLAT_UNREACHABLE));
        println!("{name}: {reached} cells behind are drivable, {behind} are not");
        // A cell on the line of the fence may contain ground of both sides.
        assert!(reached <= 10 && behind >= behind_min, "{name}: {reached} {behind}");
        // The paper's variant has no rule about passages.
        let open = terrain(&sweep, &TerrainConfig { variant: Variant::Paper, ..TerrainConfig::default() });
        assert!(!classes(&open).contains(&FLAT_UNREACHABLE));
    }
}
