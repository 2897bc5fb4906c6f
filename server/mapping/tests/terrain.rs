//! Neuhaus' terrain map against labels, against its paper's figures and against the simulator.

#![cfg_attr(not(clearway_data), allow(unused))]

mod common;

use clearway_mapping::config::{Form, TerrainConfig};
use clearway_mapping::map::{Layer, LayerMaker};
use clearway_mapping::series::Series;
use clearway_mapping::sweep::{Mount, Sweep};
use clearway_mapping::terrain::{FLAT, FLAT_INFERRED, OBSTACLE, ROUGHNESS_UNKNOWN, Terrain};
use clearway_sim::scanner::ScannerConfig;
use clearway_sim::scenes::{self, Scene};
use clearway_sim::vehicle::SimulatedVehicle;
use common::labels::*;
use common::*;

fn terrain(sweep: &Sweep, config: &TerrainConfig) -> Layer {
    let mut map = Terrain::new(config);
    let mut layer = map.layer();
    map.make(sweep, &mut layer);
    layer
}

/// Bytes of a channel as runs, value and length each one or two bytes.
fn run_bytes(values: &[i32]) -> usize {
    let varint = |v: usize| if v < 128 { 1 } else if v < 16_384 { 2 } else { 3 };
    values.chunk_by(|a, b| a == b).map(|run| varint(run[0].unsigned_abs() as usize) + varint(run.len() - 1)).sum()
}

#[cfg(clearway_data)]
fn report(form: Form, base: &TerrainConfig) -> [f64; 2] {
    let (sweep, labels) = labelled_frame();
    let layer = terrain(&sweep, &TerrainConfig { form, ..base.clone() });
    let (rows, columns) = size(&layer);
    let truth = truth_by_cell(&sweep, &labels, rows * columns, |x, y| cell_at(&layer, x, y));
    let class = classes(&layer);
    let flat: Vec<bool> = class.iter().map(|c| matches!(*c, FLAT | FLAT_INFERRED)).collect();
    let free = share(&flat, |cell| !truth.obstacle[cell]);
    let road = share(&truth.road, |cell| flat[cell]);
    let counts: Vec<usize> = (0..5).map(|c| class.iter().filter(|v| **v == c).count()).collect();
    let road_as: Vec<usize> = (0..5).map(|c| (0..class.len()).filter(|i| truth.road[*i] && class[*i] == c).count()).collect();
    let leaks = (0..class.len()).filter(|i| flat[*i] && truth.obstacle[*i]).count();
    let obstacles = truth.obstacle.iter().filter(|o| **o).count();
    let found = (0..class.len()).filter(|i| truth.obstacle[*i] && class[*i] == OBSTACLE).count();
    println!(
        "{form:?}: of flat cells free of obstacles {:.3} % ({leaks} leaks), of road flat {:.2} %; cells by class {counts:?}, road by class {road_as:?}; obstacle cells found {found} of {obstacles}; {} bytes of class; regions {}",
        100.0 * free, 100.0 * road, run_bytes(&values(&layer, "class")), figure(&layer, "flat_regions")
    );
    [free, road]
}

#[test]
#[cfg_attr(not(clearway_data), ignore = "needs the recorded drives: set CLEARWAY_DATA")]
fn the_labelled_frame_reaches_its_targets() {
    #[cfg(clearway_data)]
    {
        for form in [Form::Paper, Form::Grid, Form::Grounded] {
            report(form, &TerrainConfig::default());
        }
    }
}

fn turn(scene: Scene) -> Sweep {
    let config = ScannerConfig::default();
    let mount = Mount { ego_from_sensor: config.ego_from_sensor, range_m_min: 2.0 };
    let revolution = SimulatedVehicle::new(scene, config).turn(1).revolution;
    let mut sweep = Sweep::default();
    sweep.take_revolution(&revolution, &mount);
    sweep.take_deviations(&revolution, &mount, &mut Series::default());
    assert_eq!(sweep.deviation_m.len(), sweep.x.len());
    sweep
}

/// Root of the mean r (eq. 4) of the cells with a roughness that `wanted(x, y)`, and their number.
fn roughness(layer: &Layer, wanted: impl Fn(f32, f32) -> bool) -> (f64, usize) {
    let (_, columns) = size(layer);
    let of_cell = values(layer, "roughness");
    let centre = |cell: usize| (cell as f32 + 0.5 - columns as f32 / 2.0) * 0.25;
    let cells: Vec<f64> = (0..of_cell.len())
        .filter(|cell| of_cell[*cell] != i32::from(ROUGHNESS_UNKNOWN))
        .filter(|cell| wanted(centre(cell % columns), centre(cell / columns)))
        .map(|cell| (f64::from(of_cell[cell]) * 1e-3).powi(2))
        .collect();
    ((cells.iter().sum::<f64>() / cells.len() as f64).sqrt(), cells.len())
}

#[test]
fn a_dirt_track_is_smoother_than_the_fields_beside_it_near_and_far_alike() {
    let sweep = turn(scenes::dirt_track_between_fields());
    for cell_m in [0.25] {
        let layer = terrain(&sweep, &TerrainConfig { cell_m, ..TerrainConfig::default() });
        let classes_: Vec<usize> = (0..5).map(|c| classes(&layer).iter().filter(|v| **v == c).count()).collect();
        println!("{classes_:?} share {} bytes class {} roughness {}", figure(&layer, "drivable_share"), run_bytes(&values(&layer, "class")), run_bytes(&values(&layer, "roughness")));
        for near in [5.0, 10.0, 15.0, 20.0, 30.0f32, 40.0] {
            let ring = |x: f32, y: f32| (x.hypot(y) - near).abs() < 0.15 * near;
            let (track, tracks) = roughness(&layer, |x, y| ring(x, y) && y.abs() < 2.5);
            let (field, fields) = roughness(&layer, |x, y| ring(x, y) && y.abs() > 3.5);
            let (ahead, aheads) = roughness(&layer, |x, y| ring(x, y) && y.abs() > 3.5 && y.abs() < 8.0);
            println!("{near} m: track {track:.5} ({tracks}) field {field:.5} ({fields}) beside {ahead:.5} ({aheads}) factor {:.1}", field / track);
        }
    }
}
