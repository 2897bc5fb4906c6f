//! Properties of the layer `occupancy` for any rays: each cell is written, and the order of the points does not matter.

use clearway_mapping::config::{Hits, OccupancyConfig, OccupancyVariant};
use clearway_mapping::layer::occupancy::Occupancy;
use clearway_mapping::layer::occupancy::class::OccupancyClass;
use clearway_mapping::layer::{LayerMaker, Rays};
use clearway_mapping::sensor::sweep::Sweep;
use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use proptest::prelude::*;

use crate::common::*;
use crate::layers::occupancy::{CLEAR, OCCLUDED, made};

/// Coordinates near the vehicle, and any float except NaN.
fn coordinate() -> impl Strategy<Value = f32> {
    prop_oneof![8 => -70f32..70.0, 1 => -0.5f32..0.5, 1 => any::<f32>().prop_filter("NaN", |v| !v.is_nan())]
}

fn any_pose() -> impl Strategy<Value = Option<Isometry3<f64>>> {
    let place = || prop_oneof![4 => -60f64..60.0, 1 => -1e9f64..1e9];
    let turn = (-4f64..4.0, -0.2f64..0.2, -0.2f64..0.2);
    prop::option::of((place(), place(), turn).prop_map(|(x, y, (yaw, pitch, roll))| {
        let rotation = UnitQuaternion::from_euler_angles(roll, pitch, yaw);
        Isometry3::from_parts(Translation3::from(Vector3::new(x, y, 0.0)), rotation)
    }))
}

/// Returns, rays without a return, sensor position, sensor index, ego pose.
type AnyScan = (Vec<[f32; 3]>, Vec<[f32; 3]>, [f32; 3], u16, Option<Isometry3<f64>>);

fn any_scan() -> impl Strategy<Value = AnyScan> {
    let height = prop_oneof![4 => -0.6f32..6.0, 1 => coordinate()];
    let points = prop::collection::vec((coordinate(), coordinate(), height).prop_map(|(x, y, z)| [x, y, z]), 0..300);
    let unit = || -1f32..1.0;
    let none = prop::collection::vec((unit(), unit(), unit()).prop_map(|(x, y, z)| [x, y, z]), 0..20);
    let origin = (coordinate(), coordinate(), 0.0f32..4.0).prop_map(|(x, y, z)| [x, y, z]);
    (points, none, origin, any::<u16>(), any_pose())
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    #[test]
    fn each_cell_is_written_and_the_order_of_points_does_not_matter(
        scans in prop::collection::vec(any_scan(), 1..4), cell_m in 0.2f32..1.0, range_m_max in 5f32..200.0,
        no_return_m in 0f32..100.0, seed in any::<u64>(),
        is_paper in any::<bool>(), is_counted in any::<bool>(),
    ) {
        let variant = if is_paper { OccupancyVariant::Paper } else { OccupancyVariant::Polar };
        let hits = if is_counted { Hits::Counted } else { Hits::Reduced };
        let config = OccupancyConfig {
            variant, cell_m, range_m_max, no_return_m, hits, ..OccupancyConfig::default()
        };
        let [mut map, mut again] = [Occupancy::new(&config), Occupancy::new(&config)];
        for (points, no_returns, origin_m, sensor, map_from_ego) in &scans {
            let mut sweep = Sweep::default();
            points.iter().for_each(|point| add(&mut sweep, *point));
            let other = shuffled(&sweep, seed);
            let [rays, rays_again] = [&sweep, &other].map(|returns| Rays {
                sensor: *sensor, stamp_ns: 0, returns, heights_m: &returns.z, origin_m: *origin_m,
                origin_height_m: origin_m[2], no_returns, map_from_ego: *map_from_ego, speed_mps: Some(3.0),
            });
            map.integrate(&rays);
            again.integrate(&rays_again);
            let layer = made(&mut map, *map_from_ego);
            let (rows, columns) = size(&layer);
            let hits = values(&layer, "hits");
            prop_assert_eq!((classes(&layer).len(), hits.len()), (rows * columns, rows * columns));
            for (class, hits) in classes(&layer).iter().zip(&hits) {
                prop_assert!(usize::from(*class) < OccupancyClass::LEGEND.len() && (*class != CLEAR || *hits == 0));
            }
            if points.is_empty() && no_returns.is_empty() {
                prop_assert!(classes(&layer).iter().all(|class| *class != CLEAR && *class != OCCLUDED));
            }
            prop_assert_eq!(layer, made(&mut again, *map_from_ego));
        }
    }
}
