//! The steps of the layer `drivability` (UT Austin thesis, section IV), one by one, on small worlds.

use std::sync::Arc;

use clearway_lidar::calibration::Calibration;
use clearway_lidar::model::Model;
use clearway_mapping::config::{DrivabilityConfig, DrivabilityVariant};
use clearway_mapping::layer::drivability::Drivability;
use clearway_mapping::layer::drivability::class::DrivabilityClass;
use clearway_mapping::layer::radial_grid::{ring_radii_m, row_radii_m};
use clearway_mapping::layer::{Context, Layer, LayerMaker};
use clearway_mapping::sensor::sweep::Sweep;
use proptest::prelude::*;

use crate::common::*;

const UNKNOWN: u8 = DrivabilityClass::Unknown.value();
const DRIVABLE: u8 = DrivabilityClass::Drivable.value();
const NOT_DRIVABLE: u8 = DrivabilityClass::NotDrivable.value();
const OBSTACLE: u8 = DrivabilityClass::Obstacle.value();

/// A sweep with one point in the middle of each cell, at the height `z(row, column, x, y)`; no point for `None`.
fn painted(z: impl Fn(usize, usize, f32, f32) -> Option<f32>) -> Sweep {
    let mut sweep = empty(Model::Hdl64eS2);
    let rings = ring_radii_m(sweep.calibration.as_ref().unwrap(), HEIGHT_M, 60.0);
    for (row, ring) in rings.iter().enumerate() {
        for column in 0..360 {
            let azimuth = (column as f32 + 0.5).to_radians();
            let (x, y) = (ring * azimuth.cos(), ring * azimuth.sin());
            if let Some(z) = z(row, column, x, y) {
                add(&mut sweep, [x, y, z]);
            }
        }
    }
    sweep
}

/// First row whose ring has at least this radius.
fn row_at(radius_m: f32) -> usize {
    let rings = ring_radii_m(&Calibration::factory(Model::Hdl64eS2), HEIGHT_M, 60.0);
    rings.iter().position(|r| *r >= radius_m).unwrap()
}

fn map(config: &DrivabilityConfig, sweep: &Sweep) -> Layer {
    let mut drivability = Drivability::new(config);
    let mut layer = drivability.layer();
    drivability.make(sweep, &Context::default(), &mut layer);
    layer
}

/// Class of a cell by its ring, 0 the innermost, and its column.
fn class(layer: &Layer, ring: usize, column: usize) -> u8 {
    classes(layer)[(rows_before_rings(benches(layer)) + ring) * size(layer).1 + column]
}

#[test]
fn rows_follow_the_rings_and_end_at_60_m() {
    let calibration = Calibration::factory(Model::Vlp16);
    let rings = ring_radii_m(&calibration, 2.0, 60.0);
    // -15 to -3 degrees meet the ground within 60 m; -1 degree meets it at 115 m.
    assert_eq!(rings.len(), 7);
    assert!((rings[0] - 2.0 / 15f32.to_radians().tan()).abs() < 0.05, "{rings:?}");
    let rows = row_radii_m(&rings, 60.0);
    let (before, radii) = rows.split_at(rows_before_rings(&rows));
    assert_eq!(radii.len(), 7);
    assert_eq!(radii[6], 60.0);
    // The first ring's row begins half a ring's distance before it; the rows before it are at most half a metre deep.
    assert!((before.last().unwrap() - (3.0 * rings[0] - rings[1]) / 2.0).abs() < 1e-4, "{before:?}");
    assert!(before[0] <= 0.5 && before.len() == 14, "{before:?}");
    for (radius, pair) in radii.iter().zip(rings.windows(2)) {
        assert!((radius - (pair[0] + pair[1]) / 2.0).abs() < 1e-6);
    }
}

#[test]
fn no_sensor_has_more_rows_of_rings_than_lasers_and_rows_ascend() {
    let models = [
        Model::Hdl64eS1,
        Model::Hdl64eS2,
        Model::Hdl64eS3,
        Model::Hdl32e,
        Model::Vlp16,
        Model::PuckHiRes,
        Model::Vlp32c,
        Model::Vls128,
    ];
    for model in models {
        let calibration = Calibration::factory(model);
        for height in [0.3, 1.0, 1.73, 4.0] {
            let radii = row_radii_m(&ring_radii_m(&calibration, height, 60.0), 60.0);
            let rings = radii.len() - rows_before_rings(&radii);
            assert!(rings <= calibration.lasers.len(), "{model:?}");
            assert!(radii.is_sorted_by(|a, b| a < b), "{model:?} at {height} m: {radii:?}");
        }
    }
}

#[test]
fn points_beyond_60_m_or_above_the_overhang_are_dropped() {
    let mut sweep = painted(|_, _, _, _| Some(0.0));
    let before = map(&DrivabilityConfig::default(), &sweep);
    add(&mut sweep, [61.0, 0.0, 0.0]);
    add(&mut sweep, [10.0, 0.0, 2.51]);
    let after = map(&DrivabilityConfig::default(), &sweep);
    assert_eq!(before, after);
    add(&mut sweep, [10.0, 0.0, 2.49]);
    assert_ne!(map(&DrivabilityConfig::default(), &sweep), before);
}

#[test]
fn the_offset_keeps_noise_on_level_ground_in_one_unit() {
    let noisy = painted(|row, column, _, _| Some(if (row + column) % 2 == 0 { 0.01 } else { -0.01 }));
    let middle = map(&DrivabilityConfig::default(), &noisy);
    assert_eq!(middle.planes.len(), 2, "segment 0 and the unreachable one");
    let thesis = map(&DrivabilityConfig { offset_m: 0.0, ..DrivabilityConfig::default() }, &noisy);
    assert!(thesis.planes.len() > 1000, "with offset 0 the ground is divided into {} segments", thesis.planes.len());
}

#[test]
fn a_cell_not_reached_is_an_obstacle_and_an_empty_one_is_unknown() {
    let row = row_at(10.0);
    let sweep = painted(|r, column, _, _| match (r == row, column) {
        (true, 90) => Some(1.0),
        (true, 180) => None,
        _ => Some(0.0),
    });
    let layer = map(&DrivabilityConfig::default(), &sweep);
    assert_eq!(class(&layer, row, 90), OBSTACLE);
    assert_eq!(class(&layer, row, 180), UNKNOWN);
    assert_eq!(class(&layer, row, 270), DRIVABLE);
}

#[test]
fn criterion_1_a_step_above_the_limit_is_not_crossed() {
    // Half the world lies 0.2 m higher, which is one unit.
    let terrace = |step: f32| painted(move |_, _, x, _| Some(if x > 10.0 { step } else { 0.0 }));
    let ahead = row_at(20.0);
    let layer = map(&DrivabilityConfig::default(), &terrace(0.2));
    assert_eq!(class(&layer, ahead, 0), NOT_DRIVABLE);
    let layer = map(&DrivabilityConfig::default(), &terrace(0.14));
    assert_eq!(class(&layer, ahead, 0), DRIVABLE);
    // The thesis allows one unit height.
    let thesis = DrivabilityConfig { step_m_max: 0.5, plane_error_m_max: 0.25, ..DrivabilityConfig::default() };
    assert_eq!(class(&map(&thesis, &terrace(0.2)), ahead, 0), DRIVABLE);
}

#[test]
fn criterion_2_a_boundary_that_the_plane_misses_is_not_crossed() {
    let terrace = painted(|_, _, x, _| Some(if x > 10.0 { 0.3 } else { 0.0 }));
    let ahead = row_at(20.0);
    let without = DrivabilityConfig { step_m_max: 0.5, plane_error_m_max: 10.0, ..DrivabilityConfig::default() };
    assert_eq!(class(&map(&without, &terrace), ahead, 0), DRIVABLE);
    let with = DrivabilityConfig { plane_error_m_max: 0.25, ..without };
    assert_eq!(class(&map(&with, &terrace), ahead, 0), NOT_DRIVABLE);
}

#[test]
fn criterion_2_the_plane_of_the_larger_segment_decides() {
    // A platform 16 columns wide and two rows deep rises by 0.14 m a row. Its own plane meets the ground before it, but
    // the plane of the ground misses its first row by 0.14 m.
    let first = row_at(15.0);
    let platform = painted(|row, column, _, _| match (row.wrapping_sub(first), column) {
        (rows @ 0..2, 172..188) => Some(0.14 * (rows + 1) as f32),
        _ => Some(0.0),
    });
    for (plane_error_m_max, expected) in [(0.1, NOT_DRIVABLE), (0.2, DRIVABLE)] {
        let config = DrivabilityConfig { plane_error_m_max, ..DrivabilityConfig::default() };
        assert_eq!(class(&map(&config, &platform), first, 180), expected, "{plane_error_m_max}");
    }
}

#[test]
fn criterion_3_a_passage_narrower_than_3_m_is_not_crossed() {
    // A bank 0.14 m high behind a wall 15 m ahead, with a gap in the wall.
    let passage = |half_width: f32| {
        painted(move |_, _, x, y| {
            let wall = (15.0..17.0).contains(&x.hypot(y)) && (y.abs() > half_width || x < 0.0);
            Some(if wall {
                1.0
            } else if x.hypot(y) >= 15.0 {
                0.14
            } else {
                0.0
            })
        })
    };
    let behind = row_at(25.0);
    assert_eq!(class(&map(&DrivabilityConfig::default(), &passage(2.0)), behind, 0), DRIVABLE);
    assert_eq!(class(&map(&DrivabilityConfig::default(), &passage(1.0)), behind, 0), NOT_DRIVABLE);
    let open = DrivabilityConfig { passage_m_min: 0.0, ..DrivabilityConfig::default() };
    assert_eq!(class(&map(&open, &passage(1.0)), behind, 0), DRIVABLE);
}

/// The opening of [`walled_bank`].
#[derive(Clone, Debug)]
enum Opening {
    /// In the wall across the rows, this many columns wide.
    Columns(usize),
    /// In the wall along the first column, this many rows deep.
    Rows(usize),
}

/// A bank 0.14 m high between columns 30 and 90, from `first_row` outwards, behind a wall one cell thick with one
/// opening, and the width of the opening, metres.
fn walled_bank(first_row: usize, opening: &Opening) -> (Sweep, f32) {
    let is_open = |row: usize, column: usize| match opening {
        Opening::Columns(columns) => row == first_row && (40..40 + columns).contains(&column),
        Opening::Rows(rows) => column == 30 && (first_row + 2..first_row + 2 + rows).contains(&row),
    };
    let sweep = painted(|row, column, _, _| {
        let is_bank = row >= first_row && (30..=90).contains(&column);
        let is_wall = is_bank && (row == first_row || column == 30 || column == 90) && !is_open(row, column);
        Some(if is_wall {
            1.0
        } else if is_bank {
            0.14
        } else {
            0.0
        })
    });
    let rows = row_radii_m(&ring_radii_m(&Calibration::factory(Model::Hdl64eS2), HEIGHT_M, 60.0), 60.0);
    let radii = &rows[rows_before_rings(&rows)..];
    let width_m = match opening {
        Opening::Columns(columns) => *columns as f32 * radii[first_row - 1] * 1f32.to_radians(),
        Opening::Rows(rows) => radii[first_row + 1 + rows] - radii[first_row + 1],
    };
    (sweep, width_m)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(40))]

    #[test]
    fn criterion_3_a_passage_is_crossed_exactly_if_it_is_as_wide_as_configured(
        first_row in 12usize..36, opening in prop_oneof![(3usize..40).prop_map(Opening::Columns),
        (3usize..12).prop_map(Opening::Rows)], wider in prop::sample::select(vec![0.5f32, 0.9, 0.99, 1.01, 1.1, 2.0]),
    ) {
        let (sweep, width_m) = walled_bank(first_row, &opening);
        let config = DrivabilityConfig { passage_m_min: width_m / wider, ..DrivabilityConfig::default() };
        let expected = if wider >= 1.0 { DRIVABLE } else { NOT_DRIVABLE };
        prop_assert_eq!(class(&map(&config, &sweep), first_row + 5, 60), expected, "{} m wide", width_m);
    }
}

#[test]
fn empty_rows_are_bridged_as_far_as_configured() {
    let (near, far) = (row_at(15.0), row_at(25.0));
    let gap = |rows: usize| painted(move |row, _, _, _| (!(near..near + rows).contains(&row)).then_some(0.0));
    for (bridge_rows, empty_rows, reached) in [(0, 1, false), (1, 1, true), (1, 2, false), (2, 2, true), (2, 3, false)]
    {
        let config = DrivabilityConfig { bridge_rows, ..DrivabilityConfig::default() };
        let layer = map(&config, &gap(empty_rows));
        let expected = if reached { DRIVABLE } else { OBSTACLE };
        assert_eq!(class(&layer, far, 7), expected, "{bridge_rows} bridged, {empty_rows} empty");
        assert_eq!(class(&layer, near, 7), UNKNOWN, "a bridged cell is still unknown");
    }
}

#[test]
fn a_grade_is_climbed_across_empty_rows_in_every_direction() {
    let row = row_at(15.0);
    let rings = ring_radii_m(&Calibration::factory(Model::Hdl64eS2), HEIGHT_M, 60.0);
    let apart_m = rings[row + 3] - rings[row];
    let config = DrivabilityConfig { bridge_rows: 3, grade_max: 0.2, ..DrivabilityConfig::default() };
    for (grade, expected) in [(0.19, NOT_DRIVABLE), (0.21, OBSTACLE)] {
        for direction in [5, 50, 95, 140, 185, 230, 275, 320] {
            let terrace = painted(|r, column, _, _| match r {
                r if r <= row => Some(0.0),
                r if r == row + 3 && column.abs_diff(direction) <= 2 => Some(grade * apart_m),
                _ => None,
            });
            // The terrace is too narrow for the vehicle; a cell that was not reached would be an obstacle.
            let found = class(&map(&config, &terrace), row + 3, direction);
            assert_eq!(found, expected, "a grade of {grade} towards {direction} degrees");
        }
    }
}

#[test]
fn a_ring_that_changes_its_row_is_one_piece_of_ground() {
    // The only returns: a ring in the last row where segments start, which goes on in the next row.
    let last = ring_benches(&map(&DrivabilityConfig::default(), &painted(|_, _, _, _| Some(0.0))))
        .iter()
        .position(|radius_m| *radius_m >= 7.0)
        .unwrap();
    for (from, to) in [(100..140, 140..180), (100..140, 60..100)] {
        let ring = painted(|row, column, _, _| {
            (row == last && from.contains(&column) || row == last + 1 && to.contains(&column)).then_some(0.0)
        });
        for (bridge_rows, expected) in [(0, OBSTACLE), (1, DRIVABLE)] {
            let config = DrivabilityConfig { bridge_rows, passage_m_min: 0.0, ..DrivabilityConfig::default() };
            let layer = map(&config, &ring);
            assert_eq!(class(&layer, last, from.start + 20), DRIVABLE);
            assert_eq!(class(&layer, last + 1, to.start + 20), expected, "columns {to:?}, {bridge_rows} rows bridged");
        }
    }
}

#[test]
fn the_thesis_whole_starts_in_the_vehicles_own_cell_whatever_returns_from_it() {
    let config = DrivabilityConfig { variant: DrivabilityVariant::Paper, ..DrivabilityConfig::default() };
    let mut sweep = painted(|_, _, _, _| Some(0.01));
    assert_eq!(figure(&map(&config, &sweep), "drivable_share"), 1.0);
    // The bonnet, the roof rack and the rear of the vehicle, and the first ring's place in column 0 alone.
    for [x, y] in [[0.1, 0.001], [2.5, 0.3], [-1.5, -0.4]] {
        add(&mut sweep, [x, y, 1.2]);
    }
    let own = map(&config, &sweep);
    assert!(figure(&own, "drivable_share") > 0.999, "{}", figure(&own, "drivable_share"));
    let memory = Sweep { remembered: sweep.x.len(), ..sweep };
    assert_eq!(figure(&map(&config, &memory), "drivable_share"), 0.0, "the thesis has no memory");
}

#[test]
fn a_high_object_beside_the_vehicle_is_no_seed() {
    // A wall fills the innermost rows of the left side, like a car beside the vehicle at a traffic light.
    let (first, last) = (0, row_at(6.0));
    let sweep = painted(move |row, column, _, _| {
        Some(if (60..120).contains(&column) && (first..last).contains(&row) { 1.5 } else { 0.0 })
    });
    let layer = map(&DrivabilityConfig::default(), &sweep);
    assert_eq!(class(&layer, 0, 90), OBSTACLE);
    assert_eq!(class(&layer, 0, 0), DRIVABLE);
}

#[test]
fn a_plane_is_found_through_sloping_ground() {
    // All around, and in a sector in which x and y depend on each other.
    for columns in [0..360, 20..80] {
        let height = |x: f32, y: f32| 0.001 * x - 0.0005 * y + 0.01;
        let sweep = painted(|_, column, x, y| columns.contains(&column).then(|| height(x, y)));
        let layer = map(&DrivabilityConfig::default(), &sweep);
        assert_eq!(layer.planes.len(), 2);
        let [a, b, c] = layer.planes[0];
        assert!((a - 0.001).abs() < 1e-6 && (b + 0.0005).abs() < 1e-6 && (c - 0.01).abs() < 1e-5, "{a} {b} {c}");
        assert_eq!(layer.planes[1], [0.0; 3], "the unreachable segment has none");
    }
}

#[test]
fn a_blocked_sector_is_unknown_and_never_drivable() {
    let sweep = painted(|_, column, _, _| (!(30..60).contains(&column)).then_some(0.0));
    let layer = map(&DrivabilityConfig::default(), &sweep);
    for ring in 0..ring_benches(&layer).len() {
        for column in 30..60 {
            assert_eq!(class(&layer, ring, column), UNKNOWN);
        }
    }
}

#[test]
fn a_shared_calibration_and_an_equal_one_give_the_same_rows() {
    let sweep = painted(|_, _, _, _| Some(0.0));
    let mut drivability = Drivability::new(&DrivabilityConfig::default());
    let (mut one, mut two) = (drivability.layer(), drivability.layer());
    drivability.make(&sweep, &Context::default(), &mut one);
    let equal = Arc::new(Calibration::clone(sweep.calibration.as_ref().unwrap()));
    drivability.make(&Sweep { calibration: Some(equal), ..sweep }, &Context::default(), &mut two);
    assert_eq!(one, two);
}
