//! Free footprints and nearest obstacles, compared with a search over all points.

use std::f64::consts::{FRAC_PI_2, PI};

use bytes::Bytes;
use clearway_client::codec::{CellsRef, encode_grid};
use clearway_client::v1::layer::Geometry;
use clearway_client::{Footprint, MapView, v1};
use clearway_proto::legend::encode_legend;
use clearway_proto::map::{encode_header, encode_layer};
use clearway_proto::v1::ClassMeaning;
use proptest::prelude::*;

use crate::common;

const SIDE: u32 = 6;
const ROW_RADII_M: [f32; 3] = [0.6, 1.3, 2.5];
/// Distance between two sample points in metres. The search may miss a little more than this.
const STEP_M: f64 = 0.02;

fn radial(columns: u32, [centre_x_m, centre_y_m]: [f32; 2]) -> Geometry {
    Geometry::Radial(v1::RadialGrid { row_radius_m: ROW_RADII_M.to_vec(), columns, centre_x_m, centre_y_m })
}

fn cartesian(yaw_rad: f64) -> Geometry {
    let (origin_x_m, origin_y_m) = (-1.4, -1.7);
    let (width, height) = (SIDE, SIDE);
    Geometry::Cartesian(v1::CartesianGrid {
        origin_x_m,
        origin_y_m,
        width,
        height,
        cell_m: 0.5,
        yaw_rad,
        ..Default::default()
    })
}

/// A map of one layer `drivability` with these classes.
fn view(geometry: Geometry, classes: &[u8]) -> MapView {
    view_of(geometry, classes, &common::LEGEND)
}

/// A map of one layer `drivability` with these classes and this legend.
fn view_of(geometry: Geometry, classes: &[u8], legend: &[(&str, ClassMeaning, u32)]) -> MapView {
    let columns = match &geometry {
        Geometry::Radial(grid) => grid.columns,
        Geometry::Cartesian(grid) => grid.width,
    };
    let mut layer = v1::Layer {
        name: "drivability".into(),
        geometry: Some(geometry),
        channels: vec![encode_grid(CellsRef::U8(classes), columns as usize).into_channel("class", "", 1.0, 0)],
        ..Default::default()
    };
    encode_legend(&mut layer, legend.iter().copied());
    MapView::decode(Bytes::from([encode_header(&v1::Header::default()), encode_layer(&layer)].concat())).unwrap()
}

/// Sample points of a footprint grown by `margin_m`, including its border.
fn points(footprint: &Footprint, margin_m: f64) -> impl Iterator<Item = (f64, f64)> {
    let (length, width) = (footprint.length_m + 2.0 * margin_m, footprint.width_m + 2.0 * margin_m);
    let (sin, cos) = footprint.heading_rad.sin_cos();
    let (x, y) = (footprint.x_m, footprint.y_m);
    let steps = |side: f64| (side / STEP_M).ceil().max(1.0) as i32;
    let at = move |i: i32, side: f64| side * (f64::from(i) / f64::from(steps(side)) - 0.5);
    (0..=steps(length)).flat_map(move |i| {
        (0..=steps(width)).map(move |j| {
            let (ahead, left) = (at(i, length), at(j, width));
            (x + ahead * cos - left * sin, y + ahead * sin + left * cos)
        })
    })
}

fn geometries() -> impl Strategy<Value = (Geometry, usize)> {
    prop_oneof![
        (1_u32..9, [-0.7_f32..0.7, -0.7_f32..0.7])
            .prop_map(|(columns, centre_m)| { (radial(columns, centre_m), ROW_RADII_M.len() * columns as usize) }),
        (-4.0..4.0).prop_map(|yaw| (cartesian(yaw), (SIDE * SIDE) as usize)),
        Just((cartesian(0.0), (SIDE * SIDE) as usize)),
    ]
}

/// Maps whose cells are mostly drivable, so that both answers occur.
fn maps() -> impl Strategy<Value = MapView> {
    let class = prop_oneof![12 => Just(1_u8), 1 => Just(0_u8), 1 => Just(2_u8), 1 => Just(3_u8)];
    geometries().prop_flat_map(move |(geometry, cells)| {
        proptest::collection::vec(class.clone(), cells).prop_map(move |classes| view(geometry.clone(), &classes))
    })
}

fn footprints() -> impl Strategy<Value = Footprint> {
    (-1.5..1.5, -1.5..1.5, -PI..PI, 0.0..1.2, 0.0..0.8)
        .prop_map(|(x_m, y_m, heading_rad, length_m, width_m)| Footprint { x_m, y_m, heading_rad, length_m, width_m })
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(200))]

    #[test]
    fn a_footprint_is_free_if_and_only_if_every_point_of_it_is(map in maps(), footprint in footprints()) {
        let layer = map.layer("drivability").unwrap();
        let drivable = |(x, y): (f64, f64)| layer.class_at(x, y).0 == 1;
        let free = map.is_free("drivability", &footprint).unwrap();
        if free {
            prop_assert!(points(&footprint, 0.0).all(drivable), "is free, but a point of it is not");
        } else {
            prop_assert!(!points(&footprint, 1.5 * STEP_M).all(drivable), "is not free, but all of it is");
        }
    }

    #[test]
    fn the_nearest_obstacle_is_not_farther_than_any_point_of_one(
        map in maps(), x in -3.0_f64..3.0, y in -3.0_f64..3.0,
    ) {
        let layer = map.layer("drivability").unwrap();
        let grid = Footprint { x_m: 0.0, y_m: 0.0, heading_rad: 0.0, length_m: 7.0, width_m: 7.0 };
        let seen = points(&grid, 0.0).filter(|&(x, y)| layer.class_at(x, y).0 == 3);
        let seen = seen.map(|(ox, oy): (f64, f64)| (ox - x).hypot(oy - y)).min_by(f64::total_cmp);
        let Some(obstacle) = map.nearest_obstacle("drivability", [x, y], None).unwrap() else {
            prop_assert_eq!(seen, None);
            return Ok(());
        };
        let seen = seen.expect("cells are larger than the distance of sample points");
        let distance_m = obstacle.distance_m;
        prop_assert!(distance_m <= seen + 1e-9 && distance_m > seen - 2.0 * STEP_M, "{obstacle:?}, {seen}");
        let (sin, cos) = obstacle.bearing_rad.sin_cos();
        let point = (x + obstacle.distance_m * cos, y + obstacle.distance_m * sin);
        prop_assert!((point.0 - obstacle.x_m).hypot(point.1 - obstacle.y_m) < 1e-9, "{obstacle:?}");
        // The point lies in its cell or on the border.
        let nudges = [-1e-7, 0.0, 1e-7];
        let (ox, oy) = (obstacle.x_m, obstacle.y_m);
        let is_obstacle = |(dx, dy): (f64, f64)| layer.class_at(ox + dx, oy + dy).0 == 3;
        prop_assert!(nudges.iter().any(|&dx| nudges.iter().any(|&dy| is_obstacle((dx, dy)))), "{obstacle:?}");
    }
}

#[test]
fn unknown_cells_and_points_outside_the_grid_are_never_free() {
    let known = view(cartesian(0.0), &[1; (SIDE * SIDE) as usize]);
    let footprint = Footprint { x_m: 0.0, y_m: 0.0, heading_rad: 0.3, length_m: 1.0, width_m: 0.5 };
    assert!(known.is_free("drivability", &footprint).unwrap());
    let unknown = view(cartesian(0.0), &[0; (SIDE * SIDE) as usize]);
    assert!(!unknown.is_free("drivability", &footprint).unwrap());
    assert_eq!(unknown.nearest_obstacle("drivability", [0.0, 0.0], None).unwrap(), None);
    for x_m in [1.3, 100.0] {
        assert!(!known.is_free("drivability", &Footprint { x_m, ..footprint }).unwrap(), "{x_m}");
    }
    assert!(known.is_free("speed", &footprint).is_err() && known.nearest_obstacle("speed", [0.0, 0.0], None).is_err());
}

#[test]
fn only_the_meaning_free_is_free_and_only_occupied_is_an_obstacle() {
    use ClassMeaning::{Free, Hidden, Inferred, Low, NotReached, Occupied, Unknown};
    let footprint = Footprint { x_m: 0.0, y_m: 0.0, heading_rad: 0.3, length_m: 1.0, width_m: 0.5 };
    for meaning in [Unknown, Free, Inferred, Occupied, Hidden, NotReached, Low] {
        // The name of the class has no influence.
        let classes = [("unknown", Unknown, 0), ("drivable", meaning, 0)];
        let map = view_of(cartesian(0.0), &[1; (SIDE * SIDE) as usize], &classes);
        assert_eq!(map.is_free("drivability", &footprint).unwrap(), meaning == Free, "{meaning:?}");
        let obstacle = map.nearest_obstacle("drivability", [0.0, 0.0], None).unwrap();
        assert_eq!(obstacle.is_some(), meaning == Occupied, "{meaning:?}");
        let low = map.nearest_low("drivability", [0.0, 0.0], None).unwrap();
        assert_eq!(low.is_some(), meaning == Low, "{meaning:?}");
    }
}

#[test]
fn an_obstacle_in_an_innermost_cell_is_0_m_away() {
    let map = view(radial(8, [0.0; 2]), &[[0, 0, 0, 0, 0, 0, 0, 3], [0; 8], [0; 8]].concat());
    let obstacle = map.nearest_obstacle("drivability", [0.0, 0.0], None).unwrap().unwrap();
    assert_eq!(obstacle.distance_m, 0.0, "{obstacle:?}");
}

#[test]
fn distance_and_bearing_are_those_of_the_cells_border() {
    let map = MapView::decode(common::map(5, common::CAPTURE_END_NS)).unwrap();
    // The obstacle is from 10 to 20 m, ahead and to the right: its nearest point is on the inner border of its row.
    let obstacle = map.nearest_obstacle("drivability", [0.0, -4.0], None).unwrap().unwrap();
    assert!(
        (obstacle.distance_m - 6.0).abs() < 1e-9 && (obstacle.bearing_rad + FRAC_PI_2).abs() < 1e-9,
        "{obstacle:?}"
    );
    assert_eq!(map.nearest_obstacle("drivability", [10.0, -10.0], None).unwrap().unwrap().distance_m, 0.0);
}
