//! The labels of the SemanticKITTI frame, by point and by cell.
#![cfg_attr(not(clearway_data), allow(unused))]

use std::collections::BTreeMap;
use std::sync::Arc;

use clearway_lidar::calibration::Calibration;
use clearway_lidar::model::Model;
use clearway_mapping::config::Extrinsics;
use clearway_mapping::event::Scan;
use clearway_mapping::sensor::ring_series::RingSeries;
use clearway_mapping::sensor::sweep::{Mount, Sweep};

use super::{data, kitti};

/// Height of KITTI's sensor over the ground, metres, as published with the data set.
pub const KITTI_HEIGHT_M: f64 = 1.73;

/// True for the labels road, parking, sidewalk, other-ground, lane-marking and terrain.
pub fn is_ground(label: u32) -> bool {
    matches!(label, 40 | 44 | 48 | 49 | 60 | 72)
}

/// Height of the labelled ground around a point: the median of a square of 2 m, or of the nearest squares with ground.
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

    fn around(&self, point: &[f32; 3]) -> f32 {
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

/// A KITTI scan as a sweep.
pub fn kitti_sweep(path: &str) -> Sweep {
    sweep_from(&kitti(path))
}

fn sweep_from(scan: &Scan) -> Sweep {
    let extrinsics =
        Extrinsics { x_m: 0.0, y_m: 0.0, z_m: KITTI_HEIGHT_M, roll_deg: 0.0, pitch_deg: 0.0, yaw_deg: 0.0 };
    let mount = Mount { ego_from_sensor: extrinsics.ego_from_sensor(), range_m_min: 2.0 };
    let mut sweep = Sweep::default();
    sweep.set_scan(scan, &Arc::new(Calibration::factory(Model::Hdl64eS2)), &mount);
    sweep
}

/// The frame as a sweep, and the label of each of its points.
pub fn labelled_frame() -> (Sweep, Vec<u32>) {
    let scan = kitti("kitti/patchwork-plusplus/000000.bin");
    let bytes = std::fs::read(data("kitti/mmdet3d/000000.label")).unwrap();
    let labels: Vec<u32> =
        bytes.chunks_exact(4).map(|label| u32::from_le_bytes(label.try_into().unwrap()) & 0xffff).collect();
    assert_eq!(labels.len(), scan.x.len());
    let sweep = sweep_from(&scan);
    // The sweep has no points within 2 m, so the labels of these points are removed.
    let seen = |i: &usize| (scan.x[*i].powi(2) + scan.y[*i].powi(2) + scan.z[*i].powi(2)) >= 4.0;
    let labels: Vec<u32> = (0..labels.len()).filter(seen).map(|i| labels[i]).collect();
    assert_eq!(labels.len(), sweep.x.len());
    (sweep, labels)
}

/// The labelled frame with the deviations of its distance series: the points of the file lie ring by ring, the highest
/// first, each from azimuth 0 counter-clockwise.
pub fn labelled_frame_with_deviations() -> (Sweep, Vec<u32>) {
    let mut scan = kitti("kitti/patchwork-plusplus/000000.bin");
    scan.ring.clear();
    let mut ring = 63;
    for index in 0..scan.x.len() {
        let is_first = index > 0 && scan.y[index - 1] < 0.0 && scan.y[index] >= 0.0 && scan.x[index] > 0.0;
        ring -= u16::from(is_first);
        scan.ring.push(ring);
    }
    let (mut sweep, labels) = labelled_frame();
    sweep.set_scan_deviations(&scan, RingSeries::default().deviations(&scan), 0.02);
    assert_eq!((ring, sweep.deviation.len()), (0, sweep.x.len()));
    (sweep, labels)
}

/// What the labels state about each cell.
pub struct TruthByCell {
    /// True if the cell contains road or lane marking, and no obstacle.
    pub road: Vec<bool>,
    /// True if the cell contains ground of any kind, and no obstacle.
    pub free: Vec<bool>,
    /// True if the cell contains a point that is not ground, 0.3 to 2.5 m over the ground around it.
    pub obstacle: Vec<bool>,
}

/// The truth of each cell from the labels of a sweep's points; `cell(x, y)` is one of `cells` cells.
pub fn truth_by_cell(
    sweep: &Sweep,
    labels: &[u32],
    cells: usize,
    cell: impl Fn(f32, f32) -> Option<usize>,
) -> TruthByCell {
    let points: Vec<[f32; 3]> = (0..sweep.x.len()).map(|i| [sweep.x[i], sweep.y[i], sweep.z[i]]).collect();
    let height = GroundHeight::new(points.iter().zip(labels));
    let (mut road, mut ground, mut obstacle) = (vec![false; cells], vec![false; cells], vec![false; cells]);
    for (point, label) in points.iter().zip(labels) {
        let Some(cell) = cell(point[0], point[1]) else { continue };
        road[cell] |= matches!(label, 40 | 60);
        ground[cell] |= is_ground(*label);
        // Labels 0 and 1 mean unlabelled and outlier.
        let over = point[2] - height.around(point);
        obstacle[cell] |= !is_ground(*label) && *label > 1 && over > 0.3 && over <= 2.5;
    }
    let without_obstacle =
        |held: &[bool]| held.iter().zip(&obstacle).map(|(held, obstacle)| *held && !*obstacle).collect();
    TruthByCell { road: without_obstacle(&road), free: without_obstacle(&ground), obstacle }
}

/// Share of the cells of `of` for which `that` is true.
pub fn share(of: &[bool], that: impl Fn(usize) -> bool) -> f64 {
    let cells: Vec<usize> = (0..of.len()).filter(|cell| of[*cell]).collect();
    cells.iter().filter(|cell| that(**cell)).count() as f64 / cells.len() as f64
}
