//! The layer `speed` (Lindström 2005): the speed of the ground, the bonus of the road, and the painting conditions.

mod measured_road;
mod route;

use clearway_lidar::model::Model;
use clearway_mapping::config::{Bonus, SpeedConfig};
use clearway_mapping::event::{Road, RoadFrame, RoadPurpose};
use clearway_mapping::layer::speed::class::{SPEED_SCALE_MPS, SpeedClass};
use clearway_mapping::layer::speed::painting::{NO_ROAD, Painter, edge_points};
use clearway_mapping::layer::speed::{Speed, painting_conditions};
use clearway_mapping::layer::{Context, Layer, LayerMaker};
use clearway_mapping::road::{self, StoredRoad};
use clearway_mapping::sensor::deviation::Deviation;
use clearway_mapping::sensor::sweep::Sweep;
use proptest::prelude::*;

use crate::common::*;

const UNKNOWN: u8 = SpeedClass::Unknown.value();
const PASSABLE: u8 = SpeedClass::Passable.value();
const OBSTACLE: u8 = SpeedClass::Obstacle.value();
const NOT_REACHED: u8 = SpeedClass::NotReached.value();
const ROAD: u8 = SpeedClass::Road.value();

/// Level ground: a point each 10 cm, up to 20 m to each side.
fn level() -> Sweep {
    let mut sweep = empty(Model::Hdl64eS2);
    for ix in -200..200 {
        for iy in -200..200 {
            add(&mut sweep, [0.1 * ix as f32 + 0.05, 0.1 * iy as f32 + 0.05, 0.0]);
        }
    }
    sweep
}

fn straight(width_m: f64) -> Road {
    road([[-15.0, 0.0], [0.0, 0.0], [15.0, 0.0]].to_vec(), vec![width_m; 3])
}

fn road(points: Vec<[f64; 2]>, widths_m: Vec<f64>) -> Road {
    let (purpose, frame) = (RoadPurpose::Paint, RoadFrame::Ego);
    Road { stamp_ns: 0, purpose, frame, points, widths_m, orientations: Vec::new(), speed_limits_mps: Vec::new() }
}

fn route(points: Vec<[f64; 2]>) -> StoredRoad {
    let widths_m = vec![10.0; points.len()];
    stored(Road { purpose: RoadPurpose::Route, ..road(points, widths_m) })
}

fn stored(road: Road) -> StoredRoad {
    road::check(&road).unwrap();
    StoredRoad { road, map_from_ego: None }
}

fn fine(bonus: Bonus) -> SpeedConfig {
    SpeedConfig { extent_m: 20.0, cell_m: 0.25, bonus, ..SpeedConfig::default() }
}

fn make(config: &SpeedConfig, sweep: &Sweep, context: &Context<'_>) -> Layer {
    let mut map = Speed::new(config);
    let mut layer = map.layer();
    let shared = shared(sweep);
    let Context { ground, reach, .. } = shared.context();
    map.make(sweep, &Context { ground, reach, ..*context }, &mut layer);
    layer
}

fn painted(config: &SpeedConfig, sweep: &Sweep, road: &Road) -> Layer {
    make(config, sweep, &Context { road: Some(&stored(road.clone())), ..Context::default() })
}

/// Lateral positions, 5 m ahead and 0.25 m apart, at which a vehicle 2 m wide is fastest: the cost of a position is the
/// sum of the times past the cells that the vehicle covers. Returns the positions within 1 % of the least cost.
fn best_places(layer: &Layer) -> Vec<f64> {
    let speeds = values(layer, "speed");
    let (_, columns) = size(layer);
    let cost = |middle: i32| -> f64 {
        let covered = middle - 4..middle + 4;
        covered.map(|iy| 1.0 / (f64::from(speeds[iy as usize * columns + columns / 2 + 20]) * 0.25).max(0.01)).sum()
    };
    let places = 10..columns as i32 - 10;
    let least = places.clone().map(cost).fold(f64::INFINITY, f64::min);
    let best = places.filter(|place| cost(*place) <= least * 1.001);
    best.map(|place| f64::from(place - columns as i32 / 2) * 0.25).collect()
}

#[test]
fn a_relative_bonus_draws_the_vehicle_to_the_middle_of_the_road() {
    let sweep = level();
    for width_m in [4.0, 12.0] {
        let uniform = best_places(&painted(&fine(Bonus::Uniform), &sweep, &straight(width_m)));
        let spread = uniform.last().unwrap() - uniform[0];
        assert!(spread >= width_m - 2.5, "{width_m} m wide: {uniform:?}");
        let touches_edge = uniform.iter().any(|place| place.abs() + 1.0 >= width_m / 2.0 - 0.25);
        assert!(touches_edge, "the vehicle may drive at the road's very edge: {uniform:?}");
        let relative = best_places(&painted(&fine(Bonus::Relative), &sweep, &straight(width_m)));
        assert!(relative.iter().all(|place| place.abs() <= 0.5), "{width_m} m wide: {relative:?}");
        assert!(relative.contains(&0.0), "{width_m} m wide: {relative:?}");
    }
}

#[test]
fn a_relative_bonus_falls_faster_on_a_narrow_road_than_on_a_wide_one() {
    let sweep = level();
    let loss = |bonus, width_m| {
        let layer = painted(&fine(bonus), &sweep, &straight(width_m));
        let (_, columns) = size(&layer);
        let at = |cells: usize| values(&layer, "speed")[(columns / 2 + cells) * columns + columns / 2];
        f64::from(at(0) - at(4)) * f64::from(SPEED_SCALE_MPS)
    };
    // The loss is 8 m/s * (1.125² - 0.125²) / r², within one raw step.
    assert!((loss(Bonus::Relative, 4.0) - 2.5).abs() <= 0.26, "{}", loss(Bonus::Relative, 4.0));
    assert!((loss(Bonus::Relative, 12.0) - 0.28).abs() <= 0.26, "{}", loss(Bonus::Relative, 12.0));
    assert_eq!(loss(Bonus::Absolute, 4.0), loss(Bonus::Absolute, 12.0));
    assert_eq!((loss(Bonus::Uniform, 4.0), loss(Bonus::Uniform, 12.0)), (0.0, 0.0));
}

#[test]
fn a_road_makes_neither_an_obstacle_nor_unknown_ground_passable() {
    let mut sweep = level();
    // A post stands in the middle of the road, and points are missing behind it.
    for k in 0..20 {
        add(&mut sweep, [8.1, 0.1, 0.05 * k as f32]);
    }
    let hole = |x: f32, y: f32| (10.0..13.0).contains(&x) && y.abs() < 2.0;
    let keep: Vec<usize> = (0..sweep.x.len()).filter(|i| !hole(sweep.x[*i], sweep.y[*i])).collect();
    let pick = |axis: &[f32]| keep.iter().map(|i| axis[*i]).collect();
    let sweep = Sweep { x: pick(&sweep.x), y: pick(&sweep.y), z: pick(&sweep.z), ..sweep.clone() };
    for bonus in [Bonus::Uniform, Bonus::Absolute, Bonus::Relative] {
        let config = fine(bonus);
        let bare = make(&config, &sweep, &Context::default());
        let layer = painted(&config, &sweep, &straight(6.0));
        let (_, columns) = size(&layer);
        let at = |x: f64, y: f64| (y / 0.25 + 80.0) as usize * columns + (x / 0.25 + 80.0) as usize;
        assert_eq!(classes(&layer)[at(8.1, 0.1)], OBSTACLE);
        assert_eq!(classes(&layer)[at(11.5, 0.1)], UNKNOWN);
        assert_eq!(classes(&layer)[at(5.0, 0.1)], ROAD);
        assert_eq!(classes(&layer)[at(5.0, 5.0)], PASSABLE);
        let number = |wanted: &[u8]| classes(&layer).iter().filter(|class| wanted.contains(class)).count() as f64;
        let known = number(&[OBSTACLE, PASSABLE, ROAD]);
        assert_eq!(figure(&layer, "passable_share"), number(&[PASSABLE, ROAD]) / known);
        assert_eq!(figure(&layer, "road_share"), number(&[ROAD]) / known);
        let (before, after) = (values(&bare, "speed"), values(&layer, "speed"));
        for (cell, class) in classes(&layer).iter().enumerate() {
            match *class {
                OBSTACLE => assert_eq!(after[cell], 0),
                UNKNOWN => assert_eq!(after[cell], layer.channels[1].unknown),
                PASSABLE => assert_eq!(after[cell], before[cell]),
                _ => assert!(after[cell] >= before[cell]),
            }
            let unknown_before = classes(&bare)[cell] == UNKNOWN;
            assert_eq!(*class == UNKNOWN, unknown_before);
            assert_eq!(*class == OBSTACLE, classes(&bare)[cell] == OBSTACLE);
        }
    }
}

#[test]
fn bumps_slow_down_and_a_slope_does_not() {
    let ground = |height: fn(f32, f32) -> f32| {
        let mut sweep = level();
        for i in 0..sweep.x.len() {
            sweep.z[i] = height(sweep.x[i], sweep.y[i]);
        }
        let layer = make(&fine(Bonus::Relative), &sweep, &Context::default());
        let (_, columns) = size(&layer);
        let middle = columns / 4 * columns..columns / 2 * columns;
        let speeds: Vec<i32> = values(&layer, "speed")[middle].to_vec();
        let inner = speeds.chunks(columns).flat_map(|row| row[columns / 4..columns / 2].to_vec());
        let inner: Vec<i32> = inner.collect();
        f64::from(inner.iter().sum::<i32>()) / inner.len() as f64 * 0.25
    };
    let (flat, slope) = (ground(|_, _| 0.0), ground(|x, y| 0.1 * x + 0.05 * y));
    let ripples = ground(|x, _| 0.05 * (x * 6.0).sin());
    let furrows = ground(|x, _| 0.10 * (x * 6.0).sin());
    assert_eq!((flat, slope), (10.0, 10.0));
    assert!(furrows < ripples - 1.0 && ripples < flat - 0.25, "{furrows} {ripples} {flat}");
}

#[test]
fn mirrored_returns_below_the_ground_make_no_obstacle() {
    let config = SpeedConfig::default();
    let mut sweep = level();
    // KITTI's scans have such returns: a line of one laser 3 m below the ground, 2.5 m long.
    (0..25).for_each(|k| add(&mut sweep, [9.0, 2.0 + 0.1 * k as f32, -3.0]));
    let plain = make(&config, &level(), &Context::default());
    let layer = make(&config, &sweep, &Context::default());
    assert_eq!(classes(&layer), classes(&plain));
    assert_eq!(values(&layer, "speed"), values(&plain, "speed"));

    // A drop that wide is real.
    let mut ditch = level();
    let within = |x: f32| (8.0..11.0).contains(&x);
    ditch.z.iter_mut().zip(&ditch.x).for_each(|(z, x)| *z = if within(*x) { -3.0 } else { *z });
    let layer = make(&config, &ditch, &Context::default());
    let at = |x: f32, k: i32| classes(&layer)[cell_at(&layer, x, 0.5 * k as f32).unwrap()];
    (-10..10).for_each(|k| assert!(![PASSABLE, ROAD].contains(&at(9.5, k)), "the bottom is not passable"));
}

#[test]
#[cfg_attr(not(clearway_data), ignore = "needs the recorded drives: set CLEARWAY_DATA")]
fn the_road_of_the_labelled_frame_is_passable() {
    let (sweep, labels) = labels::labelled_frame();
    let layer = make(&SpeedConfig::default(), &sweep, &Context::default());
    let truth = labels::truth_by_cell(&sweep, &labels, classes(&layer).len(), |x, y| cell_at(&layer, x, y));
    let passable: Vec<bool> = classes(&layer).iter().map(|class| matches!(*class, PASSABLE | ROAD)).collect();
    let road = labels::share(&truth.road, |cell| passable[cell]);
    let free = labels::share(&passable, |cell| !truth.obstacle[cell]);
    println!("road passable {:.2} %, passable free {:.2} %", 100.0 * road, 100.0 * free);
    assert!(road >= 0.99 && free >= 0.97, "{road} {free}");
}

#[test]
fn painting_stops_when_the_orientations_are_random() {
    let sweep = level();
    let config = SpeedConfig::default();
    let mut map = Speed::new(&config);
    let mut layer = map.layer();
    let clear: Vec<f32> = (0..36).map(|bin| if bin == 9 { 300.0 } else { 10.0 }).collect();
    let random = vec![10.0; 36];
    for (votes, painting) in [(&clear, 1.0), (&random, 0.0), (&clear, 1.0), (&random, 0.0)] {
        let road = stored(Road { orientations: votes.clone(), ..straight(6.0) });
        map.make(&sweep, &Context { road: Some(&road), ..shared(&sweep).context() }, &mut layer);
        assert_eq!(figure(&layer, "painting"), painting);
        assert_eq!(figure(&layer, "stopped_by_divergence"), 1.0 - painting);
        assert_eq!(figure(&layer, "stopped_by_curvature"), 0.0);
        assert_eq!(classes(&layer).contains(&ROAD), painting == 1.0);
    }
    assert_eq!(painting_conditions::divergence(&[1.0; 8]), Some(0.0));
    let one = painting_conditions::divergence(&[0.0, 5.0, 0.0, 0.0]).unwrap();
    assert!((one - 4f64.ln()).abs() < 1e-12, "{one}");
    assert_eq!(painting_conditions::divergence(&[]), None);
}

#[test]
fn painting_stops_when_the_route_bends_within_30_m() {
    let sweep = level();
    let mut map = Speed::new(&SpeedConfig::default());
    let mut layer = map.layer();
    let road = stored(straight(6.0));
    // The route has a right angle this far ahead; the vehicle drives towards it.
    for (corner_m, painting) in [(60.0, 1.0), (36.0, 1.0), (30.0, 0.0), (12.0, 0.0), (1.0, 0.0), (0.0, 0.0)] {
        let route = route(vec![[corner_m - 100.0, 0.5], [corner_m, 0.5], [corner_m, 100.0]]);
        let context = Context { road: Some(&road), route: Some(&route), ..Context::default() };
        map.make(&sweep, &context, &mut layer);
        assert_eq!(figure(&layer, "painting"), painting, "corner {corner_m} m ahead");
        assert_eq!(figure(&layer, "stopped_by_curvature"), 1.0 - painting, "corner {corner_m} m ahead");
        assert_eq!(figure(&layer, "stopped_by_divergence"), 0.0);
        assert_eq!(classes(&layer).contains(&ROAD), painting == 1.0);
    }
    // The corner lies 6 m behind, farther than the length over which the curvature is measured.
    let behind = route(vec![[-6.0, -100.0], [-6.0, 0.5], [100.0, 0.5]]);
    let context = Context { road: Some(&road), route: Some(&behind), ..Context::default() };
    map.make(&sweep, &context, &mut layer);
    assert_eq!((figure(&layer, "painting"), figure(&layer, "route_curvature_per_m")), (1.0, 0.0));
}

#[test]
fn the_curvature_of_a_circle_is_one_over_its_radius() {
    for radius in [15.0f64, 40.0, 200.0] {
        for step_m in [0.5, 2.0] {
            let angle = |i: i32| f64::from(i) * step_m / radius;
            let points: Vec<_> = (-40..140)
                .map(|i| [radius * angle(i).sin(), radius * (1.0 - angle(i).cos())])
                .filter(|[_, y]| *y < 1.9 * radius)
                .collect();
            let curvature = painting_conditions::curvature_ahead_per_m(&points, 30.0);
            assert!((curvature * radius - 1.0).abs() < 0.05, "{radius} m, {step_m} m: {curvature}");
        }
    }
    assert_eq!(painting_conditions::curvature_ahead_per_m(&[[-5.0, 0.0], [200.0, 0.0]], 30.0), 0.0);
}

#[test]
fn an_old_road_or_one_without_a_pose_is_not_painted() {
    let (sweep, config) = (level(), SpeedConfig::default());
    let road = stored(straight(6.0));
    let at = |stamp_ns| make(&config, &sweep, &Context { road: Some(&road), stamp_ns, ..Context::default() });
    assert_eq!(figure(&at(500_000_000), "painting"), 1.0);
    let old = at(500_000_001);
    assert_eq!((figure(&old, "painting"), figure(&old, "stopped_by_age")), (0.0, 1.0));
    let lane = stored(Road { frame: RoadFrame::Map, ..straight(6.0) });
    let nowhere = make(&config, &sweep, &Context { road: Some(&lane), stamp_ns: i64::MAX, ..Context::default() });
    assert_eq!((figure(&nowhere, "painting"), figure(&nowhere, "stopped_by_missing_pose")), (0.0, 1.0));
    assert_eq!(figure(&nowhere, "stopped_by_age"), 0.0, "a lane does not age");
}

#[test]
fn a_road_stays_where_it_was_seen_while_the_vehicle_drives_on() {
    let (sweep, config) = (level(), fine(Bonus::Uniform));
    let pose = |x, y, yaw| nalgebra::Isometry3::new(nalgebra::vector![x, y, 0.0], nalgebra::vector![0.0, 0.0, yaw]);
    let across = road(vec![[6.0, -15.0], [6.0, 15.0]], vec![2.0; 2]);
    let seen = StoredRoad { road: across, map_from_ego: Some(pose(100.0, 50.0, 0.0)) };
    let now = |pose| {
        let context = Context { road: Some(&seen), map_from_ego: Some(pose), ..Context::default() };
        let layer = make(&config, &sweep, &context);
        let (_, columns) = size(&layer);
        let row = &classes(&layer)[columns / 2 * columns..][..columns];
        let first = row.iter().position(|class| *class == ROAD).unwrap();
        (first as f64 - 80.0) * 0.25
    };
    assert_eq!(now(pose(100.0, 50.0, 0.0)), 5.0);
    assert_eq!(now(pose(103.0, 50.0, 0.0)), 2.0);
    assert_eq!(now(pose(103.0, 50.0, std::f64::consts::PI)), -4.0);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(100))]

    /// A cell is painted if its centre lies in one of the quads; its bonus follows from d²/r² of such a quad.
    #[test]
    fn painting_agrees_with_the_formula_cell_by_cell(
        turns in prop::collection::vec(-0.3f64..0.3, 1..8), widths in prop::collection::vec(1.0f64..8.0, 10),
        heading in 0f64..6.3, start in (-15f64..15.0, -15f64..15.0),
    ) {
        let mut points = vec![[start.0, start.1]];
        let mut heading = heading;
        for turn in &turns {
            heading += turn;
            let [x, y] = *points.last().unwrap();
            points.push([x + 9.0 * heading.cos(), y + 9.0 * heading.sin()]);
        }
        let widths = &widths[..points.len()];
        let config = SpeedConfig { extent_m: 20.0, cell_m: 0.5, ..SpeedConfig::default() };
        let mut painter = Painter::new(80, &config);
        painter.paint(&points, widths);
        let mut edges = Vec::new();
        edge_points(&points, widths, &mut edges);
        for (cell, &bonus) in painter.bonus_mps().iter().enumerate() {
            let q = [((cell % 80) as f64 + 0.5) * 0.5 - 20.0, ((cell / 80) as f64 + 0.5) * 0.5 - 20.0];
            let mut expected = None::<f64>;
            let mut on_border = false;
            for i in 0..points.len() - 1 {
                let corners = [edges[i][0], edges[i][1], edges[i + 1][1], edges[i + 1][0]];
                let side = |a: [f64; 2], b: [f64; 2]| {
                    ((b[0] - a[0]) * (q[1] - a[1]) - (b[1] - a[1]) * (q[0] - a[0])) / (b[0] - a[0]).hypot(b[1] - a[1])
                };
                let least = (0..4).map(|k| side(corners[k], corners[(k + 1) % 4])).fold(f64::INFINITY, f64::min);
                on_border |= least.abs() < 1e-6;
                if least > 0.0 {
                    let d = [points[i + 1][0] - points[i][0], points[i + 1][1] - points[i][1]];
                    let v = [q[0] - points[i][0], q[1] - points[i][1]];
                    let squared = d[0] * d[0] + d[1] * d[1];
                    let t = (d[0] * v[0] + d[1] * v[1]) / squared;
                    let away = [v[0] - t * d[0], v[1] - t * d[1]];
                    let r = (widths[i] + t * (widths[i + 1] - widths[i])) / 2.0;
                    let rd_squared = (away[0] * away[0] + away[1] * away[1]) / (r * r);
                    let bonus = (8.0 * (1.0 - rd_squared)).max(0.0);
                    expected = Some(expected.map_or(bonus, |e: f64| e.max(bonus)));
                }
            }
            if on_border {
                continue;
            }
            match expected {
                None => prop_assert_eq!(bonus, NO_ROAD, "{:?}", q),
                Some(expected) => {
                    prop_assert!((f64::from(bonus) - expected).abs() < 1e-2, "{:?}: {} {}", q, bonus, expected)
                }
            }
        }
    }

    #[test]
    fn a_cell_is_known_where_a_point_fell_and_nowhere_else(
        points in prop::collection::vec((
            prop_oneof![8 => -50f32..50.0, 1 => any::<f32>()],
            prop_oneof![8 => -50f32..50.0, 1 => any::<f32>()],
            prop_oneof![6 => -0.5f32..0.5, 2 => -40f32..5.0, 1 => any::<f32>()],
        ), 0..300),
        seed in any::<u64>(),
    ) {
        // Single precision resolves 4 µm at 40 m: a point nearer to a border may fall on either side.
        let near_a_border = |v: f32| v.abs() < 41.0 && (v * 2.0 - (v * 2.0).round()).abs() < 1e-4;
        let mut points = points;
        points.retain(|(x, y, _)| !near_a_border(*x) && !near_a_border(*y));
        let mut sweep = empty(Model::Vlp16);
        points.iter().for_each(|(x, y, z)| add(&mut sweep, [*x, *y, *z]));
        let config = SpeedConfig::default();
        let layer = make(&config, &sweep, &Context::default());
        let shared = shared(&sweep);
        let mut held = vec![false; 160 * 160];
        for ((x, y, _), &height) in points.iter().zip(shared.context().heights_m(&sweep)) {
            // A point without a known height proves nothing.
            let inside = [*x, *y].iter().all(|v| (-40.0..40.0).contains(v));
            if inside && height > -0.5 && height <= config.overhang_m {
                held[cell_at(&layer, *x, *y).unwrap()] = true;
            }
        }
        let speeds = values(&layer, "speed");
        for (cell, held) in held.iter().enumerate() {
            let (class, raw) = (classes(&layer)[cell], speeds[cell]);
            prop_assert_eq!(class != UNKNOWN, *held);
            prop_assert_eq!(class == UNKNOWN, raw == layer.channels[1].unknown);
            prop_assert_eq!(class == OBSTACLE || class == NOT_REACHED, raw == 0);
        }
        prop_assert_eq!(&make(&config, &shuffled(&sweep, seed), &Context::default()), &layer);
    }

    #[test]
    fn a_checked_road_is_painted_and_any_other_is_refused(
        points in prop::collection::vec((prop_oneof![-60f64..60.0, any::<f64>()], -60f64..60.0), 0..8),
        widths in prop::collection::vec(prop_oneof![8 => 0f64..20.0, 1 => any::<f64>()], 0..8),
        votes in prop::collection::vec(prop_oneof![0f32..9.0, any::<f32>()], 0..5),
    ) {
        let points: Vec<[f64; 2]> = points.into_iter().map(|(x, y)| [x, y]).collect();
        let road = Road { orientations: votes, ..road(points, widths) };
        if road::check(&road).is_ok() {
            for bonus in [Bonus::Uniform, Bonus::Absolute, Bonus::Relative] {
                let config = SpeedConfig { extent_m: 10.0, bonus, ..SpeedConfig::default() };
                let (lane, route) = (stored(road.clone()), stored(road.clone()));
                let mut painter = Painter::new(40, &config);
                painter.paint(&road.points, &road.widths_m);
                prop_assert!(painter.bonus_mps().iter().all(|b| *b == NO_ROAD || (0.0..=8.0).contains(b)));
                let context = Context { road: Some(&lane), route: Some(&route), ..Context::default() };
                make(&config, &empty(Model::Vlp16), &context);
            }
        }
    }
}

#[test]
fn rough_ground_is_slower_than_smooth_ground_of_the_same_height() {
    let mut sweep = level();
    // The left has the deviations of a field, the right the deviations of a road.
    let share = |i: usize| if sweep.y[i] < 0.0 { 0.0 } else { 0.02 * (-1.0_f32).powi(i as i32) };
    sweep.deviation = (0..sweep.x.len()).map(|i| Deviation::new(share(i), 0.001)).collect();
    let at = |config: &SpeedConfig, y: f32| {
        let layer = make(config, &sweep, &Context::default());
        f64::from(values(&layer, "speed")[cell_at(&layer, 5.1, y).unwrap()]) * f64::from(SPEED_SCALE_MPS)
    };
    let config = fine(Bonus::Relative);
    // Half of the speed above crawl_mps: 2 + 8 / 2.
    assert_eq!([at(&config, -3.1), at(&config, 3.1)], [10.0, 6.0]);
    assert_eq!(at(&SpeedConfig { rough_share: 1.0, ..config }, 3.1), 10.0);
}
