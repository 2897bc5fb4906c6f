//! Properties that hold for any points: no panic, every cell is written, and no cell without a point is known.

use std::sync::Arc;

use clearway_lidar::calibration::Calibration;
use clearway_lidar::model::Model;
use clearway_mapping::config::{DrivabilityConfig, HeightDifferenceConfig, Seed, TerrainConfig, Variant};
use clearway_mapping::event::Scan;
use clearway_mapping::layer::drivability::Drivability;
use clearway_mapping::layer::height_difference::HeightDifference;
use clearway_mapping::layer::terrain::Terrain;
use clearway_mapping::layer::terrain::class::TerrainClass;
use clearway_mapping::layer::{Context, LayerMaker};
use clearway_mapping::sensor::deviation::Deviation;
use clearway_mapping::sensor::sweep::{Mount, Sweep};
use nalgebra::Isometry3;
use proptest::prelude::*;

use crate::common::*;

/// Cases of each property: a sample; `PROPTEST_CASES=200` runs as many.
const CASES: u32 = 48;

fn proptest_config() -> ProptestConfig {
    let is_set = std::env::var_os("PROPTEST_CASES").is_some();
    if is_set { ProptestConfig::default() } else { ProptestConfig::with_cases(CASES) }
}

/// Class 0 of every layer.
const UNKNOWN: u8 = 0;

fn models() -> impl Strategy<Value = Model> {
    prop::sample::select(vec![Model::Hdl64eS1, Model::Hdl64eS2, Model::Hdl32e, Model::Vlp16, Model::Vls128])
}

/// Coordinates near the vehicle, and any other float.
fn coordinate() -> impl Strategy<Value = f32> {
    prop_oneof![8 => -70f32..70.0, 1 => -0.5f32..0.5, 1 => any::<f32>()]
}

fn points() -> impl Strategy<Value = Vec<[f32; 3]>> {
    let height = prop_oneof![4 => -0.6f32..0.6, 1 => coordinate()];
    let point = (coordinate(), coordinate(), height).prop_map(|(x, y, z)| [x, y, z]);
    prop::collection::vec(point, 0..400)
}

fn config() -> impl Strategy<Value = DrivabilityConfig> {
    let columns = prop::sample::select(vec![8u16, 90, 180, 360, 1440]);
    (columns, 0u8..9, any::<bool>(), any::<bool>(), 0f32..1.0, 0f32..4.0).prop_map(
        |(columns, bridge_rows, close_gaps, first, offset_m, passage_m_min)| DrivabilityConfig {
            columns,
            bridge_rows,
            close_gaps,
            offset_m,
            passage_m_min,
            seed: if first { Seed::FirstCell } else { Seed::BlindZone },
            ..DrivabilityConfig::default()
        },
    )
}

proptest! {
    #![proptest_config(proptest_config())]

    #[test]
    fn over_the_plane_a_cell_is_known_exactly_if_it_contains_a_point(
        model in models(), height in 0.1f32..4.0, place in [-3f32..3.0, -3f32..3.0], points in points(),
        config in config(), seed in any::<u64>(),
    ) {
        let mut sweep = Sweep { mount_height_m: height, mount_m: place, ..empty(model) };
        points.iter().for_each(|point| add(&mut sweep, *point));
        let mut map = Drivability::new(&config);
        let mut layer = map.layer();
        map.make(&sweep, &Context::default(), &mut layer);

        let (rows, columns) = size(&layer);
        let grid = radial_grid(&layer);
        let mut held = vec![false; rows * columns];
        for [x, y, z] in &points {
            if let Some(cell) = grid.cell(*x, *y) {
                held[cell] |= *z <= config.overhang_m && *z > f32::NEG_INFINITY;
            }
        }
        prop_assert_eq!(classes(&layer).len(), held.len());
        for (class, held) in classes(&layer).iter().zip(&held) {
            prop_assert_eq!(*class != UNKNOWN, *held);
        }
        for plane in &layer.planes {
            prop_assert!(plane.iter().all(|v| v.is_finite()), "{:?}", plane);
        }

        let mut again = map.layer();
        map.make(&shuffled(&sweep, seed), &Context::default(), &mut again);
        prop_assert_eq!(layer, again);
    }

    #[test]
    fn the_baseline_writes_every_cell_of_any_sweep(model in models(), points in points()) {
        let mut sweep = empty(model);
        points.iter().for_each(|point| add(&mut sweep, *point));
        let mut map = HeightDifference::new(&HeightDifferenceConfig::default());
        let mut layer = map.layer();
        map.make(&sweep, &shared(&sweep).context(), &mut layer);
        let (rows, columns) = size(&layer);
        prop_assert_eq!(classes(&layer).len(), rows * columns);
        prop_assert_eq!(values(&layer, "difference").len(), rows * columns);
    }

    #[test]
    fn terrain_knows_no_more_cells_than_there_are_points(
        points in points(), variant in prop::sample::select(vec![Variant::Grounded, Variant::Paper, Variant::Grid]),
        cell_m in 0.1f32..2.0, range_m_max in 5f32..100.0, points_min in 1u16..6, planes in any::<bool>(),
        deviations in prop::collection::vec(any::<f32>(), 400), seed in any::<u64>(),
    ) {
        let mut sweep = empty(Model::Hdl64eS2);
        points.iter().for_each(|point| add(&mut sweep, *point));
        sweep.deviation = deviations[..points.len()].iter().map(|share| Deviation::new(*share, 0.001)).collect();
        let config = TerrainConfig {
            variant, cell_m, range_m_max, points_min, planes, roughness_points_min: 1, ..TerrainConfig::default()
        };
        let mut map = Terrain::new(&config);
        let mut layer = map.layer();
        map.make(&sweep, &shared(&sweep).context(), &mut layer);

        let (rows, columns) = size(&layer);
        // Not by cell_at: rounding decides to which cell a point on a border belongs.
        let judged = [TerrainClass::Flat.value(), TerrainClass::Obstacle.value()];
        let held = classes(&layer).iter().filter(|class| judged.contains(class)).count();
        prop_assert!(held <= points.len());
        for channel in &layer.channels {
            let written = values(&layer, channel.name);
            prop_assert_eq!(written.len(), rows * columns);
            for (value, class) in written.iter().zip(classes(&layer)) {
                let known = *class != UNKNOWN || channel.name == "shape";
                prop_assert!(known || *value == channel.unknown, "{} {}", channel.name, value);
            }
        }

        sweep.deviation.clear();
        map.make(&sweep, &shared(&sweep).context(), &mut layer);
        let mut again = map.layer();
        map.make(&shuffled(&sweep, seed), &shared(&shuffled(&sweep, seed)).context(), &mut again);
        prop_assert_eq!(layer, again);
    }

    #[test]
    fn a_scan_keeps_the_points_that_are_positions(points in points()) {
        let column = |axis: usize| points.iter().map(|p| p[axis]).collect::<Vec<_>>();
        let (x, y, z) = (column(0), column(1), column(2));
        let scan = Scan { x, y, z, intensity: vec![0.0; points.len()], ..Scan::default() };
        let mount = Mount { ego_from_sensor: Isometry3::translation(0.0, 0.0, 1.9), range_m_min: 2.0 };
        let mut sweep = Sweep::default();
        let removed = sweep.set_scan(&scan, &Arc::new(Calibration::factory(Model::Vlp16)), &mount);
        let is_position = |p: &&[f32; 3]| p.iter().all(|v| v.abs() <= 1000.0);
        prop_assert_eq!(removed as usize, points.len() - points.iter().filter(is_position).count());
        prop_assert!(sweep.x.iter().chain(&sweep.y).chain(&sweep.z).all(|v| v.is_finite()));
        prop_assert!(sweep.x.len() == sweep.y.len() && sweep.x.len() == sweep.z.len());
        prop_assert!(sweep.x.len() <= sweep.returns as usize);
    }
}
