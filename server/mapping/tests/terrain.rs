//! Neuhaus' terrain map against labels, against its paper's figures and against the simulator.

#![cfg_attr(not(clearway_data), allow(unused))]

mod common;

use std::sync::Arc;

use clearway_lidar::calibration::Calibration;
use clearway_lidar::model::Model;
use clearway_mapping::config::{Extrinsics, Form, TerrainConfig};
use clearway_mapping::map::{Layer, LayerMaker};
use clearway_mapping::sweep::{Mount, Sweep};
use clearway_mapping::terrain::{FLAT, FLAT_INFERRED, OBSTACLE, Terrain, UNKNOWN};
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
