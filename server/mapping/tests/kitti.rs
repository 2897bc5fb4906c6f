//! Real HDL-64E scans: the labelled SemanticKITTI frame against its labels.

#![cfg_attr(not(clearway_data), allow(unused))]

mod common;

use std::collections::BTreeMap;
use std::sync::Arc;

use clearway_lidar::calibration::Calibration;
use clearway_lidar::model::Model;
use clearway_mapping::config::{DrivabilityConfig, Extrinsics, Gate};
use clearway_mapping::drivability::{DRIVABLE, Drivability, UNKNOWN};
use clearway_mapping::map::{Layer, LayerMaker};
use clearway_mapping::radial::RadialGrid;
use clearway_mapping::sweep::{Mount, Sweep};
use common::*;

/// Height of KITTI's sensor over the ground, metres, as its makers publish it.
const KITTI_HEIGHT_M: f64 = 1.73;

/// What the labels say of the frame, cell by cell.
struct Labelled {
    /// Cells with road or lane marking, and without an obstacle.
    road: Vec<bool>,
    /// Cells with an obstacle: a point of anything but ground, 0.3 to 2.5 m over the ground about it.
    obstacle: Vec<bool>,
    /// Ground without obstacle that can be reached over such cells from the blind zone, empty rows bridged.
    reachable: Vec<bool>,
}

fn is_ground(label: u32) -> bool {
    // Road, parking, sidewalk, other-ground, lane-marking, terrain.
    matches!(label, 40 | 44 | 48 | 49 | 60 | 72)
}

/// Height of the labelled ground about a place: the median of a square of 2 m, or of the nearest squares that hold any.
struct GroundHeight(BTreeMap<(i32, i32), Vec<f32>>);

impl GroundHeight {
    fn new<'a>(points: impl Iterator<Item = (&'a [f32; 3], &'a u32)>) -> Self {
        let mut squares: BTreeMap<_, Vec<f32>> = BTreeMap::new();
        for (point, _) in points.filter(|(_, label)| is_ground(**label)) {
            squares.entry(Self::square(point)).or_default().push(point[2]);
        }
        squares.values_mut().for_each(|heights| heights.sort_by(f32::total_cmp));
        Self(squares)
    }

    fn square(point: &[f32; 3]) -> (i32, i32) {
        ((point[0] / 2.0).floor() as i32, (point[1] / 2.0).floor() as i32)
    }

    fn about(&self, point: &[f32; 3]) -> f32 {
        let (i, j) = Self::square(point);
        for reach in 0..4 {
            let around = (-reach..=reach).flat_map(|di| (-reach..=reach).map(move |dj| (i + di, j + dj)));
            let mut medians: Vec<f32> = around.filter_map(|s| self.0.get(&s)).map(|h| h[h.len() / 2]).collect();
            medians.sort_by(f32::total_cmp);
            if !medians.is_empty() {
                return medians[medians.len() / 2];
            }
        }
        0.0
    }
}

fn labelled_frame() -> (Sweep, Vec<u32>) {
    let scan = kitti("kitti/patchwork-plusplus/000000.bin");
    let bytes = std::fs::read(data("kitti/mmdet3d/000000.label")).unwrap();
    let labels: Vec<u32> =
        bytes.chunks_exact(4).map(|label| u32::from_le_bytes(label.try_into().unwrap()) & 0xffff).collect();
    assert_eq!(labels.len(), scan.x.len());
    let extrinsics =
        Extrinsics { x_m: 0.0, y_m: 0.0, z_m: KITTI_HEIGHT_M, roll_deg: 0.0, pitch_deg: 0.0, yaw_deg: 0.0 };
    let mount = Mount { ego_from_sensor: extrinsics.ego_from_sensor(), range_m_min: 2.0 };
    let mut sweep = Sweep::default();
    sweep.take_scan(&scan, &Arc::new(Calibration::factory(Model::Hdl64eS2)), &mount);
    // The sweep leaves out what lies within 2 m; so must the labels.
    let seen = |i: &usize| (scan.x[*i].powi(2) + scan.y[*i].powi(2) + scan.z[*i].powi(2)) >= 4.0;
    let labels: Vec<u32> = (0..labels.len()).filter(seen).map(|i| labels[i]).collect();
    assert_eq!(labels.len(), sweep.x.len());
    (sweep, labels)
}

fn by_cell(sweep: &Sweep, labels: &[u32], layer: &Layer) -> Labelled {
    let (rows, columns) = size(layer);
    let grid = RadialGrid::new(benches(layer).to_vec(), columns as u16);
    let points: Vec<[f32; 3]> = (0..sweep.x.len()).map(|i| [sweep.x[i], sweep.y[i], sweep.z[i]]).collect();
    let height = GroundHeight::new(points.iter().zip(labels));
    let cells = rows * columns;
    let (mut road, mut ground, mut obstacle) = (vec![false; cells], vec![false; cells], vec![false; cells]);
    for (point, label) in points.iter().zip(labels) {
        let Some(cell) = grid.cell(point[0], point[1]) else { continue };
        road[cell] |= matches!(label, 40 | 60);
        ground[cell] |= is_ground(*label);
        // 0 and 1 are unlabelled and outliers.
        let over = point[2] - height.about(point);
        obstacle[cell] |= !is_ground(*label) && *label > 1 && over > 0.3 && over <= 2.5;
    }
    let free: Vec<bool> = ground.iter().zip(&obstacle).map(|(ground, obstacle)| *ground && !*obstacle).collect();
    let road = road.iter().zip(&obstacle).map(|(road, obstacle)| *road && !*obstacle).collect();

    let known = |cell: &usize| classes(layer)[*cell] != UNKNOWN;
    let mut reachable = vec![false; cells];
    let mut waiting = Vec::new();
    for column in 0..columns {
        let innermost = (0..rows).take_while(|row| grid.row_span_m(*row).0 < 7.0).map(|row| row * columns + column);
        waiting.extend(innermost.into_iter().find(known).filter(|cell| free[*cell]));
    }
    while let Some(cell) = waiting.pop() {
        if std::mem::replace(&mut reachable[cell], true) {
            continue;
        }
        let (row, column) = (cell / columns, cell % columns);
        let outward = (1..=3).map(|step| cell + step * columns).take_while(|c| *c < cells).find(known);
        let inward = (1..=3).take_while(|step| *step <= row).map(|step| cell - step * columns).find(known);
        let sideways = [1, columns - 1].map(|step| Some(row * columns + (column + step) % columns));
        let next = [outward, inward].into_iter().chain(sideways).flatten();
        waiting.extend(next.filter(|next| free[*next] && !reachable[*next]));
    }
    Labelled { road, obstacle, reachable }
}

/// Of the cells that hold, the share that also hold the other.
fn share(of: &[bool], that: impl Fn(usize) -> bool) -> f64 {
    let cells: Vec<usize> = (0..of.len()).filter(|cell| of[*cell]).collect();
    cells.iter().filter(|cell| that(**cell)).count() as f64 / cells.len() as f64
}

fn shares(config: &DrivabilityConfig) -> [f64; 3] {
    let (sweep, labels) = labelled_frame();
    let mut map = Drivability::new(config);
    let mut layer = map.layer();
    map.make(&sweep, &mut layer);
    let truth = by_cell(&sweep, &labels, &layer);
    let drivable: Vec<bool> = classes(&layer).iter().map(|class| *class == DRIVABLE).collect();
    let free = share(&drivable, |cell| !truth.obstacle[cell]);
    let road = share(&truth.road, |cell| drivable[cell]);
    let reachable = share(&truth.reachable, |cell| drivable[cell]);
    println!(
        "{:>3} columns, {} bridged, close_gaps {:<5}: share {:.4}; of drivable cells free of obstacles {:.3} %; drivable of \
         road {:.2} %, of reachable ground {:.2} %",
        config.columns,
        config.bridge_rows,
        config.close_gaps,
        figure(&layer, "drivable_share"),
        100.0 * free,
        100.0 * road,
        100.0 * reachable
    );
    [free, road, reachable]
}

#[test]
#[cfg_attr(not(clearway_data), ignore = "needs the recorded drives: set CLEARWAY_DATA")]
fn the_labelled_frame_reaches_its_targets() {
    let [free, road, reachable] = shares(&DrivabilityConfig::default());
    assert!(free >= 0.9995, "{free}");
    assert!(road >= 0.99, "{road}");
    assert!(reachable >= 0.95, "{reachable}");
}

#[test]
#[cfg_attr(not(clearway_data), ignore = "needs the recorded drives: set CLEARWAY_DATA")]
fn wider_columns_and_the_thesis_own_reading_stay_useful() {
    let own = DrivabilityConfig::default();
    let thesis = DrivabilityConfig {
        bridge_rows: 0,
        close_gaps: false,
        step_m_max: 0.5,
        gate: Gate::BetweenSegments,
        ..own.clone()
    };
    let readings = [
        DrivabilityConfig { columns: 180, ..own.clone() },
        DrivabilityConfig { columns: 90, ..own.clone() },
        thesis.clone(),
        DrivabilityConfig { offset_m: 0.0, ..thesis },
    ];
    for config in readings {
        let [free, road, reachable] = shares(&config);
        assert!(free >= 0.997 && road >= 0.97 && reachable >= 0.95, "{config:?}");
    }
}
