//! The layer `freespace`: what is never free, and what is found.

use std::f32::consts::{PI, TAU};

use clearway_lidar::model::Model;
use clearway_mapping::config::{FreespaceConfig, ReachConfig};
use clearway_mapping::layer::freespace::Freespace;
use clearway_mapping::layer::freespace::class::FreespaceClass;
use clearway_mapping::layer::{Context, Layer, LayerMaker, Meaning};
use clearway_mapping::memory::MemoryState;
use clearway_mapping::sensor::sweep::Sweep;
use nalgebra::{Isometry3, UnitQuaternion, Vector3};
use proptest::prelude::*;

use crate::common::*;

fn freespace(sweep: &Sweep) -> Layer {
    freespace_of(sweep, &ReachConfig::default())
}

fn freespace_of(sweep: &Sweep, reach: &ReachConfig) -> Layer {
    let mut maker = Freespace::new(&FreespaceConfig { height: true, why: true, ..FreespaceConfig::default() });
    let mut layer = maker.layer();
    maker.make(sweep, &shared_with(sweep, reach).context(), &mut layer);
    layer
}

/// Centre of a cell, ego frame, metres.
fn centre(cell: usize) -> [f32; 2] {
    [cell % 512, cell / 512].map(|index| (index as f32 + 0.5) * 0.25 - 64.0)
}

fn is_own(cell: usize) -> bool {
    let [x, y] = centre(cell);
    ReachConfig::default().outline().contains(x, y)
}

/// True for the cells that the outline touches.
fn is_touched(cell: usize) -> bool {
    let [x, y] = centre(cell);
    ReachConfig::default().outline().grown_by(0.126).contains(x, y)
}

fn is_free(layer: &Layer, cell: usize) -> bool {
    layer.legend[usize::from(classes(layer)[cell])].meaning == Meaning::Free
}

/// A cell that is not at the border of the grid, and the eight around it.
fn around(cell: usize) -> [usize; 9] {
    [-513, -512, -511, -1, 0, 1, 511, 512, 513].map(|by| cell.wrapping_add_signed(by))
}

/// The cells of a class whose centres are in a rectangle of the ego frame.
fn count(layer: &Layer, class: FreespaceClass, x_m: [f32; 2], y_m: [f32; 2]) -> usize {
    let is_inside = |cell: &usize| {
        let [x, y] = centre(*cell);
        (x_m[0]..x_m[1]).contains(&x) && (y_m[0]..y_m[1]).contains(&y)
    };
    (0..classes(layer).len()).filter(is_inside).filter(|cell| classes(layer)[*cell] == class.value()).count()
}

#[test]
fn without_points_all_but_the_vehicle_is_unknown() {
    let layer = freespace(&empty(Model::Hdl64eS2));
    for (cell, class) in classes(&layer).iter().enumerate() {
        let expected = if is_touched(cell) { FreespaceClass::Vehicle } else { FreespaceClass::Unknown };
        assert_eq!(*class, expected.value(), "{:?}", centre(cell));
    }
}

#[test]
fn every_cell_of_open_level_ground_is_free_whether_a_return_fell_into_it_or_not() {
    for (model, to_m) in [(Model::Hdl64eS2, 30.0), (Model::Hdl32e, 20.0), (Model::Vlp16, 14.0)] {
        let layer = freespace(&cast(model, plain));
        let is_near = |cell: &usize| libm::hypotf(centre(*cell)[0], centre(*cell)[1]) < to_m;
        let (why, mut reasons) = (values(&layer, "why"), [0; 2]);
        for cell in (0..classes(&layer).len()).filter(is_near).filter(|cell| !is_own(*cell)) {
            assert!(is_free(&layer, cell), "{model:?} {:?}: {}", centre(cell), class_name(&layer, cell));
            reasons[why[cell] as usize - 1] += 1;
        }
        assert!(reasons.iter().all(|cells| *cells > 100), "{model:?}: seen and bridged {reasons:?}");
    }
}

#[test]
fn a_wall_is_occupied_and_nothing_behind_it_is_free() {
    let layer = freespace(&cast(Model::Hdl64eS2, court));
    assert!(count(&layer, FreespaceClass::Occupied, [14.7, 15.3], [-7.0, 7.0]) >= 50);
    assert_eq!(count(&layer, FreespaceClass::Free, [15.3, 60.0], [-20.0, 20.0]), 0);
    assert!(count(&layer, FreespaceClass::Free, [4.0, 14.0], [-7.0, 7.0]) >= 2_000);
}

#[test]
fn the_body_of_a_car_ahead_is_not_free_however_little_of_its_rear_is_seen() {
    // Farther away than 20 m one of 32 lasers meets the rear, or none.
    for (model, to_m) in [(Model::Hdl64eS2, 30.0), (Model::Hdl32e, 20.0)] {
        for rear_m in [9.0, 15.0, 20.0, 26.0, 30.0].into_iter().filter(|rear_m| *rear_m <= to_m) {
            let car = |x: f32, y: f32, z: f32| {
                let is_in = (rear_m..rear_m + 4.4).contains(&x) && y.abs() < 0.9;
                z <= 0.0 || is_in && (0.18..0.85).contains(&z)
            };
            let layer = freespace(&cast(model, car));
            let free = count(&layer, FreespaceClass::Free, [rear_m + 1.1, rear_m + 4.2], [-0.6, 0.6]);
            // A ray that passes under the body shows a row of ground there.
            assert!(free <= 5, "{model:?}, {rear_m} m: {free} of 60 cells");
        }
    }
}

#[test]
fn a_box_of_half_a_metre_that_no_ray_meets_is_not_free() {
    for model in [Model::Vlp16, Model::Hdl32e] {
        let mut unmet = 0;
        for at_m in (24..100).map(|halves| halves as f32 * 0.5) {
            let is_in = |x: f32, y: f32| (at_m..at_m + 1.0).contains(&x) && y.abs() < 1.0;
            let sweep = cast(model, |x, y, z| z <= if is_in(x, y) { 0.5 } else { 0.0 });
            // A row of the ground's estimate is as deep as a twentieth of its range.
            let mut places = sweep.x.iter().zip(&sweep.y);
            if !places.any(|(x, y)| (0.95 * at_m..at_m + 1.0).contains(x) && y.abs() < 1.0) {
                unmet += 1;
                let free = count(&freespace(&sweep), FreespaceClass::Free, [at_m, at_m + 1.0], [-1.0, 1.0]);
                assert_eq!(free, 0, "{model:?}, {at_m} m");
            }
        }
        assert!(unmet >= 3, "{model:?}: {unmet} boxes between two rays");
    }
}

#[test]
fn gaps_between_posts_are_occupied_and_ground_far_from_free_cells_is_wide() {
    // Posts of 0.25 m, half a metre apart, around a yard, and a field behind it.
    let post = |x: f32, y: f32| (8.0..8.25).contains(&x.abs().max(y.abs())) && (x + y).rem_euclid(0.75) < 0.25;
    let layer = freespace(&cast(Model::Hdl64eS2, |x, y, z| z <= if post(x, y) { 1.5 } else { 0.0 }));
    let class = |cell: usize| classes(&layer)[cell];
    let heights = values(&layer, "height");
    let (mut ground, mut filled) = (0, 0);
    for cell in (0..512 * 512).filter(|cell| (1..511).contains(&(cell % 512)) && (1..511).contains(&(cell / 512))) {
        let is_occupied = |cell: usize| class(cell) == FreespaceClass::Occupied.value();
        let is_gap = [1, 512].iter().any(|by| is_occupied(cell - by) && is_occupied(cell + by));
        let is_open = [FreespaceClass::Unknown, FreespaceClass::Hidden, FreespaceClass::NotReached];
        assert!(!is_gap || is_open.iter().all(|open| class(cell) != open.value()), "{:?}", centre(cell));
        filled += usize::from(is_occupied(cell) && heights[cell] == i32::from(i8::MIN));
        if class(cell) != FreespaceClass::NotReached.value() || around(cell).iter().any(|cell| is_free(&layer, *cell)) {
            continue;
        }
        ground += 1;
        let is_whole = |cell: usize| around(cell).iter().all(|cell| class(*cell) == FreespaceClass::NotReached.value());
        assert!(around(cell).into_iter().any(is_whole), "{:?}", centre(cell));
    }
    assert!(ground > 100 && filled > 0, "{ground} cells of ground behind the posts, {filled} of gaps");
}

#[test]
fn a_log_is_low_and_a_trench_is_a_drop() {
    for (at_m, across_m) in [(7.0, 0.0), (10.0, 0.0), (9.0, 4.0)] {
        let log = |x: f32, y: f32, z: f32| {
            let is_in = (at_m..at_m + 0.3).contains(&x) && (across_m - 1.0..across_m + 1.0).contains(&y);
            z <= if is_in { 0.2 } else { 0.0 }
        };
        let layer = freespace(&cast(Model::Hdl64eS2, log));
        let (x_m, y_m) = ([at_m, at_m + 0.25], [across_m - 0.9, across_m + 0.9]);
        assert_eq!(count(&layer, FreespaceClass::Free, x_m, y_m), 0, "{at_m} {across_m}");
        assert!(count(&layer, FreespaceClass::Low, x_m, y_m) >= 6, "{at_m} {across_m}");
    }
    for at_m in [6.5, 9.0] {
        let trench = |x: f32, y: f32, z: f32| {
            let is_in = (at_m..at_m + 2.0).contains(&x) && y.abs() < 3.0;
            z <= if is_in { -1.0 } else { 0.0 }
        };
        let layer = freespace(&cast(Model::Hdl64eS2, trench));
        let (x_m, y_m) = ([at_m + 0.1, at_m + 1.9], [-2.5, 2.5]);
        assert_eq!(count(&layer, FreespaceClass::Free, x_m, y_m), 0, "{at_m}");
        assert!(count(&layer, FreespaceClass::Drop, x_m, y_m) >= 100, "{at_m}");
    }
}

#[test]
fn a_trench_nearer_than_the_first_ring_is_a_drop_up_to_the_vehicle() {
    for from_m in [3.6, 4.5] {
        let trench = |x: f32, _: f32, z: f32| z <= if (from_m..from_m + 2.0).contains(&x) { -1.0 } else { 0.0 };
        let layer = freespace(&cast(Model::Hdl64eS2, trench));
        let (x_m, y_m) = ([from_m + 0.1, from_m + 1.9], [-2.5, 2.5]);
        assert_eq!(count(&layer, FreespaceClass::Free, x_m, y_m), 0, "{from_m}");
        assert!(count(&layer, FreespaceClass::Drop, x_m, y_m) >= 60, "{from_m}");
    }
}

#[test]
fn mirror_images_under_the_feet_of_a_person_change_nothing() {
    let person = |x: f32, y: f32, z: f32| z <= if libm::hypotf(x - 7.0, y - 1.0) < 0.3 { 1.7 } else { 0.0 };
    let plain = cast(Model::Hdl64eS2, person);
    let mut mirrored = plain.clone();
    for step in 0..60 {
        let turn = PI + (step as f32 - 30.0) / 40.0;
        let depth_m = 0.35 + step as f32 / 100.0;
        add(&mut mirrored, [7.0 + 0.3 * libm::cosf(turn), 1.0 + 0.3 * libm::sinf(turn), -depth_m]);
    }
    let [mirrored, plain] = [&mirrored, &plain].map(freespace);
    for cell in 0..classes(&plain).len() {
        assert_eq!(class_name(&mirrored, cell), class_name(&plain, cell), "{:?}", centre(cell));
    }
}

#[test]
fn behind_a_thing_whose_front_rises_like_ground_is_no_drop() {
    for front in [0.2, 0.25, 0.3] {
        let thing = |x: f32, y: f32, z: f32| {
            let height_m = if x < 10.3 { (front * (x - 9.0)).min(0.65) } else { 0.65 };
            z <= if (9.0..11.0).contains(&x) && (3.5..6.5).contains(&y) { height_m } else { 0.0 }
        };
        let layer = freespace(&cast(Model::Hdl64eS2, thing));
        assert_eq!(count(&layer, FreespaceClass::Drop, [5.0, 30.0], [-5.0, 20.0]), 0, "{front}");
        assert_eq!(count(&layer, FreespaceClass::Free, [10.3, 11.0], [4.0, 6.0]), 0, "{front}");
    }
}

#[test]
fn on_a_dam_the_road_is_free_and_its_edges_are_closed() {
    for (model, depth_m) in [(Model::Hdl64eS2, 0.4), (Model::Hdl64eS2, 0.8), (Model::Hdl32e, 0.6), (Model::Vlp16, 0.6)]
    {
        let dam = |_: f32, y: f32, z: f32| z <= if y.abs() < 3.0 { 0.0 } else { -depth_m };
        let layer = freespace(&cast(model, dam));
        let road = count(&layer, FreespaceClass::Free, [-10.0, 10.0], [-2.5, 2.5]);
        assert!(road > 1_000, "{model:?}, {depth_m} m: {road} of 1600 cells");
        // The edge is closed on both sides, as far as the road before it is seen.
        for (x_m, side) in (-30..30).flat_map(|at| [1.0, -1.0].map(|side| (at as f32 * 0.25, side))) {
            let is_closed = |y: f32| !is_free(&layer, cell_at(&layer, x_m, side * y).expect("it is near"));
            assert!((9..20).any(|at| is_closed(at as f32 * 0.25)), "{model:?}, {depth_m} m: {x_m} {side}");
        }
    }
}

#[test]
fn no_cell_of_a_lying_person_is_free_though_the_back_is_not_seen() {
    for at_m in [7.0, 10.0, 13.0] {
        let is_in = |x: f32, y: f32| (at_m..at_m + 0.5).contains(&x) && y.abs() < 0.85;
        let layer = freespace(&cast(Model::Hdl64eS2, |x, y, z| z <= if is_in(x, y) { 0.25 } else { 0.0 }));
        assert_eq!(count(&layer, FreespaceClass::Free, [at_m, at_m + 0.5], [-0.75, 0.75]), 0, "{at_m}");
    }
}

/// Free cells of a log of 0.2 m that lies 20 m ahead at the start, by distance to it, as a vehicle drives up to it.
/// `lies` is true while the log is there, `drops` how often the memory was empty, by distance.
fn free_cells_of_a_log(model: Model, lies: impl Fn(f32) -> bool, drops: impl Fn(f32) -> u64) -> Vec<(f32, usize)> {
    let mut maker = Freespace::new(&FreespaceConfig::default());
    let mut layer = maker.layer();
    let drive = (0..21).map(|map| (map, 20.0 - 0.8 * map as f32));
    let of_map = |(map, at_m): (i64, f32)| {
        let is_in = |x: f32, y: f32| (at_m..at_m + 0.3).contains(&x) && y.abs() < 1.0;
        let sweep = cast(model, |x, y, z| z <= if lies(at_m) && is_in(x, y) { 0.2 } else { 0.0 });
        let shared = shared_with(&sweep, &ReachConfig::default());
        // A heading at which the cells of the vehicle and of the world differ.
        let heading = UnitQuaternion::from_euler_angles(0.0, 0.0, 0.6);
        let middle = heading * Vector3::new(20.0 - f64::from(at_m), 0.0, 0.0);
        let context = Context {
            stamp_ns: 100_000_000 * map,
            map_from_ego: Some(Isometry3::from_parts(middle.into(), heading)),
            memory: Some(MemoryState { points: 0, drops: drops(at_m) }),
            ..shared.context()
        };
        maker.make(&sweep, &context, &mut layer);
        (at_m, count(&layer, FreespaceClass::Free, [at_m, at_m + 0.3], [-0.9, 0.9]))
    };
    drive.map(of_map).collect()
}

#[test]
fn a_log_that_earlier_maps_found_stays_low_until_it_is_gone_or_all_is_forgotten() {
    // The rings of 32 lasers leave the log alone for longer.
    for (model, from_m) in [(Model::Hdl64eS2, 18.5), (Model::Hdl32e, 9.0)] {
        let free = free_cells_of_a_log(model, |_| true, |_| 0);
        let near = free.iter().filter(|(at_m, _)| *at_m < from_m);
        assert!(near.clone().count() > 5 && near.clone().all(|(_, cells)| *cells == 0), "{model:?}: {free:?}");
    }
    let last = |free: &[(f32, usize)]| free.iter().rev().take(2).map(|(_, cells)| *cells).min().expect("maps");
    let gone = free_cells_of_a_log(Model::Hdl64eS2, |at_m| at_m > 14.0, |_| 0);
    assert!(last(&gone) > 0, "{gone:?}");
    let forgotten = free_cells_of_a_log(Model::Hdl64eS2, |at_m| at_m > 6.0, |at_m| u64::from(at_m < 6.0));
    assert!(last(&forgotten) > 0, "{forgotten:?}");
}

#[test]
fn the_sector_of_a_covered_sensor_is_never_free() {
    for middle in [0.0_f32, 1.0, 2.0, 3.0] {
        let whole = cast(Model::Hdl64eS2, plain);
        let off = |x: f32, y: f32| (libm::atan2f(y, x) - middle + 3.0 * PI) % TAU - PI;
        let mut sweep = empty(Model::Hdl64eS2);
        for ((x, y), z) in whole.x.iter().zip(&whole.y).zip(&whole.z) {
            if off(*x, *y).abs() > 0.5 {
                add(&mut sweep, [*x, *y, *z]);
            }
        }
        let layer = freespace(&sweep);
        for cell in (0..classes(&layer).len()).filter(|cell| is_free(&layer, *cell) && !is_touched(*cell)) {
            let [x, y] = centre(cell);
            let range_m = libm::hypotf(x, y);
            // The directions of the ground's estimate are two degrees wide; the blind zone has none.
            let is_inside = off(x, y).abs() < 0.5 - 0.07 && (0.5 - off(x, y).abs()) * range_m > 0.8;
            assert!(!is_inside || range_m < 3.0, "{middle}: {x} {y}");
        }
    }
}

#[test]
fn ground_before_the_first_ring_is_free_only_by_the_key_and_only_where_ground_was_seen_behind_it() {
    // A sensor that looks 40 degrees to each side and sees nothing nearer than 10 m; a car stands ahead to the left,
    // nearer than the first ring, and beyond 24 degrees to the right the view is covered.
    let mut sweep = empty(Model::Hdl64eS2);
    let whole =
        cast(Model::Hdl64eS2, |x, y, z| z <= 0.0 || z <= 1.5 && (7.0..9.0).contains(&x) && (2.0..4.0).contains(&y));
    for ((x, y), z) in whole.x.iter().zip(&whole.y).zip(&whole.z) {
        let azimuth_deg = libm::atan2f(*y, *x).to_degrees();
        let is_ahead = (-24.0..40.0).contains(&azimuth_deg);
        if is_ahead && (libm::hypotf(*x, *y) > 10.0 || *z > 0.3) {
            add(&mut sweep, [*x, *y, *z]);
        }
    }
    let free = |assumed_ground_m: f32, x_m: [f32; 2], y_m: [f32; 2]| {
        let layer = freespace_of(&sweep, &ReachConfig { assumed_ground_m, ..ReachConfig::default() });
        count(&layer, FreespaceClass::Free, x_m, y_m)
    };
    assert_eq!(free(0.0, [-64.0, 64.0], [-64.0, 64.0]), 0, "unknown is never free");
    assert_eq!(free(8.0, [-64.0, 64.0], [-64.0, 64.0]), 0, "the first ring is farther away");
    assert_eq!(free(15.0, [4.0, 20.0], [-1.0, 1.0]), 64 * 8, "the road ahead");
    assert_eq!(free(15.0, [7.0, 9.0], [2.0, 4.0]), 0, "the car");
    assert_eq!(free(15.0, [9.5, 11.0], [3.0, 3.5]), 0, "behind the car");
    assert_eq!(
        free(15.0, [-64.0, 2.0], [-64.0, -2.0]) + free(15.0, [-64.0, -2.5], [-64.0, 64.0]),
        0,
        "beside and behind"
    );
    assert_eq!(free(15.0, [5.0, 10.0], [-9.0, -5.0]), 0, "the covered sector");
}

#[test]
fn the_order_of_the_points_and_used_buffers_have_no_effect() {
    let sweep = cast(Model::Hdl64eS2, court);
    let layer = freespace(&sweep);
    let mut maker = Freespace::new(&FreespaceConfig { height: true, why: true, ..FreespaceConfig::default() });
    let mut used = maker.layer();
    maker.make(&cast(Model::Vlp16, plain), &shared(&sweep).context(), &mut used);
    let other = shuffled(&sweep, 3);
    maker.make(&other, &shared(&other).context(), &mut used);
    assert_eq!(used, layer);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    #[test]
    fn a_cell_with_an_obstacle_is_never_free_and_the_outline_is_the_vehicle(
        // Whole millimetres: nearer to the border of a cell, f32 and f64 may find two cells.
        points_mm in prop::collection::vec([-30_000..30_000, -30_000..30_000, 0..3000], 0..60),
    ) {
        let mut sweep = cast(Model::Vlp16, plain);
        points_mm.iter().for_each(|point_mm| add(&mut sweep, point_mm.map(|mm: i32| mm as f32 / 1000.0)));
        let shared = shared(&sweep);
        let layer = freespace(&sweep);
        let config = ReachConfig::default();
        let heights_m = shared.context().heights_m(&sweep).to_vec();
        for (point, height_m) in heights_m.iter().enumerate() {
            let Some(cell) = cell_at(&layer, sweep.x[point], sweep.y[point]) else { continue };
            if (config.obstacle_m_min..=config.overhang_m).contains(height_m) && !is_own(cell) {
                prop_assert!(!is_free(&layer, cell), "{} {}: {height_m}", sweep.x[point], sweep.y[point]);
            }
        }
        for cell in (0..classes(&layer).len()).filter(|cell| is_own(*cell)) {
            prop_assert_eq!(classes(&layer)[cell], FreespaceClass::Vehicle.value());
        }
    }
}
