//! Safe points: equally far from two obstacles, with exact radii, through each passage that the vehicle fits through.

use clearway_lidar::model::Model;
use clearway_mapping::config::{DrivabilityConfig, OccupancyConfig, ReachConfig, SafePathConfig};
use clearway_mapping::layer::drivability::Drivability;
use clearway_mapping::layer::drivability::class::DrivabilityClass;
use clearway_mapping::layer::occupancy::Occupancy;
use clearway_mapping::layer::safe_path::SafePath;
use clearway_mapping::layer::safe_path::class::SafePathClass;
use clearway_mapping::layer::safe_path::distance::Distances;
use clearway_mapping::layer::safe_path::free_space::State;
use clearway_mapping::layer::safe_path::links::Links;
use clearway_mapping::layer::safe_path::medial_axis::{MedialAxis, Point};
use clearway_mapping::layer::{Context, Layer, LayerMaker, Rays};
use clearway_mapping::reach::ReachCell;
use clearway_mapping::sensor::sweep::Sweep;
use proptest::prelude::*;

use crate::common::*;

const UNKNOWN: u8 = SafePathClass::Unknown.value();
const FREE: u8 = SafePathClass::Free.value();
const OBSTACLE: u8 = SafePathClass::Obstacle.value();
const PATH: u8 = SafePathClass::Path.value();
const NOT_REACHED: u8 = SafePathClass::NotReached.value();
const NOT_DRIVABLE: u8 = DrivabilityClass::NotDrivable.value();
const DRIVABLE: u8 = DrivabilityClass::Drivable.value();

/// Medial axis and links of a grid.
fn paths(side: usize, states: &[State], width_cells: f64) -> (MedialAxis, Links) {
    let mut distances = Distances::new(side);
    distances.compute(states);
    let (mut axis, mut links) = (MedialAxis::new(side), Links::default());
    axis.find(states, &distances, width_cells);
    links.link(&axis, states, &distances, width_cells, side as f64);
    (axis, links)
}

fn closed(side: usize, states: &[State]) -> Vec<[i32; 2]> {
    let cells = (0..side * side).filter(|cell| !states[*cell].is_free());
    cells.map(|cell| [(cell % side) as i32, (cell / side) as i32]).collect()
}

/// Squared distance from a position to the square of a cell, in half cells.
fn to_square(position: [i32; 2], cell: [i32; 2]) -> i32 {
    let along = |i: usize| ((position[i] - 2 * cell[i]).abs() - 1).max(0);
    along(0) * along(0) + along(1) * along(1)
}

/// A court of free cells with a wall one cell thick across it, and a passage of `passage_cells` cells in the wall. The
/// vehicle stands in the middle; the wall is five cells ahead.
fn court_with_passage(side: usize, passage_from: usize, passage_cells: usize, across_x: bool) -> Vec<State> {
    let mut states = vec![State::Drivable; side * side];
    for k in 0..side {
        for border in [k, (side - 1) * side + k, k * side, k * side + side - 1] {
            states[border] = State::Obstacle;
        }
    }
    let wall = side / 2 + 12;
    for k in (0..side).filter(|k| !(passage_from..passage_from + passage_cells).contains(k)) {
        states[if across_x { k * side + wall } else { wall * side + k }] = State::Obstacle;
    }
    states
}

#[test]
fn a_path_leads_through_a_passage_as_wide_as_the_vehicle_and_no_narrower() {
    let side = 80;
    for width in [5, 6, 7, 8, 9, 12] {
        for passage_from in [20, 33, 34, 47] {
            for (passage, across_x) in
                [(width - 1, true), (width - 1, false), (width, true), (width, false), (width + 1, true)]
            {
                let states = court_with_passage(side, passage_from, passage, across_x);
                let (_, links) = paths(side, &states, width as f64);
                let beyond = |point: &&Point| point.position[usize::from(!across_x)] > 2 * (side as i32 / 2 + 13);
                let through = links.points().iter().any(|point| beyond(&point));
                assert!(links.points().len() > 20, "there are paths on the vehicle's side");
                let case = format!("vehicle {width}, passage {passage} from {passage_from}, x {across_x}");
                assert_eq!(through, passage >= width, "{case}");
            }
        }
    }
}

#[test]
fn the_vehicle_joins_a_line_straight_through_a_gate_only_if_it_fits_through_the_gate() {
    let side = 80;
    for gate in [4, 6, 8, 10, 12, 14, 16, 18] {
        for (wider, across_x) in [(0.95, true), (0.95, false), (1.01, true), (1.05, true), (1.05, false), (1.2, true)] {
            // The gate is right ahead of the vehicle, which stands between the two middle cells.
            let states = court_with_passage(side, (side - gate) / 2, gate, across_x);
            let (_, links) = paths(side, &states, gate as f64 * wider);
            let beyond = |point: &Point| point.position[usize::from(!across_x)] > 2 * (side as i32 / 2 + 13);
            let case = format!("gate {gate}, vehicle {wider} times as wide, x {across_x}");
            assert_eq!(links.points().iter().any(beyond), wider <= 1.0, "{case}");
        }
    }
}

#[test]
fn a_corridor_has_its_middle_line_with_half_its_width_as_radius() {
    let side = 60;
    for free in [7usize, 8] {
        let inside = |cell: usize| (26..26 + free).contains(&(cell / side));
        let states: Vec<State> =
            (0..side * side).map(|cell| if inside(cell) { State::Drivable } else { State::Unknown }).collect();
        let (_, links) = paths(side, &states, 4.0);
        let line: Vec<_> = links.points().iter().skip(1).collect();
        assert_eq!(line.len(), side, "{free} cells");
        for point in line {
            assert_eq!(point.clearance_squared, (free * free) as i32);
            // The middle of 7 cells is the centre of a cell; the middle of 8 lies between two cells.
            assert_eq!(point.position[1], 2 * 26 + free as i32 - 1);
        }
    }
}

#[test]
fn open_ground_and_closed_ground_have_no_safe_points() {
    for state in [State::Drivable, State::Obstacle, State::Unknown, State::Blind] {
        let (axis, links) = paths(20, &[state; 400], 4.0);
        assert_eq!((axis.points().len(), links.points().len()), (0, 0));
    }
}

/// Rectangles of obstacles and of unknown cells on drivable ground, with a few blind cells.
fn worlds() -> impl Strategy<Value = (usize, Vec<State>)> {
    let rectangle = (0usize..48, 0usize..48, 1usize..14, 1usize..5, 0u8..4);
    (prop::collection::vec(rectangle, 0..14), prop::sample::select(vec![24usize, 40, 48])).prop_map(
        |(rectangles, side)| {
            let mut states = vec![State::Drivable; side * side];
            for (x, y, long, wide, kind) in rectangles {
                let (dx, dy) = if kind % 2 == 0 { (long, wide) } else { (wide, long) };
                for iy in y..(y + dy).min(side) {
                    for ix in x..(x + dx).min(side) {
                        states[iy * side + ix] =
                            [State::Obstacle, State::Unknown, State::Obstacle, State::Blind][usize::from(kind)];
                    }
                }
            }
            (side, states)
        },
    )
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(150))]

    #[test]
    fn the_distance_transform_agrees_with_a_search((side, states) in worlds()) {
        let mut distances = Distances::new(side);
        distances.compute(&states);
        let closed = closed(side, &states);
        for cell in 0..side * side {
            let [x, y] = [(cell % side) as i32, (cell / side) as i32];
            let squared = |[sx, sy]: [i32; 2]| (sx - x) * (sx - x) + (sy - y) * (sy - y);
            let nearest = closed.iter().map(|site| squared(*site)).min();
            prop_assert_eq!(distances.site(cell % side, cell / side).map(squared), nearest, "{} {}", x, y);
        }
    }

    #[test]
    fn safe_points_are_equally_far_from_two_obstacles_with_exact_radii(
        (side, states) in worlds(), width in 2f64..9.0,
    ) {
        let (axis, links) = paths(side, &states, width);
        let closed = closed(side, &states);
        for point in axis.points() {
            prop_assert_eq!(states[point.cell], State::Drivable);
            let exact = closed.iter().map(|cell| to_square(point.position, *cell)).min();
            prop_assert_eq!(Some(point.clearance_squared), exact, "{:?}", point);
            prop_assert!(f64::from(point.clearance_squared).sqrt() >= width, "{:?}", point);
            // The vehicle fits between two obstacles whose distances to the point are equal within a cell.
            let away = |cell: &[i32; 2]| {
                f64::from(point.position[0] - 2 * cell[0]).hypot(f64::from(point.position[1] - 2 * cell[1])) / 2.0
            };
            let nearest = closed.iter().map(away).fold(f64::INFINITY, f64::min);
            let near: Vec<_> = closed.iter().filter(|cell| away(cell) <= nearest + 1.0 + 1e-9).collect();
            let apart = |a: &[i32; 2], b: &[i32; 2]| f64::from(a[0] - b[0]).hypot(f64::from(a[1] - b[1]));
            prop_assert!(near.iter().any(|a| near.iter().any(|b| apart(a, b) >= width)), "{:?}", point);
        }
        // Lines are one cell wide: two by two cells occur only where four lines meet, one at each cell.
        let has_point = |[ix, iy]: [i32; 2]| axis.point_in(ix, iy).is_some();
        for [ix, iy] in (0..side as i32 - 1).flat_map(|iy| (0..side as i32 - 1).map(move |ix| [ix, iy])) {
            let block = [[ix, iy], [ix + 1, iy], [ix, iy + 1], [ix + 1, iy + 1]];
            let around = |[x, y]: [i32; 2]| (y - 1..=y + 1).flat_map(move |y| (x - 1..=x + 1).map(move |x| [x, y]));
            let goes_on = |cell: [i32; 2]| around(cell).any(|beside| !block.contains(&beside) && has_point(beside));
            let is_full = block.iter().all(|cell| has_point(*cell));
            prop_assert!(!is_full || block.iter().all(|cell| goes_on(*cell)), "{:?}", block);
        }
        // Links lead to earlier points, and finally to the vehicle.
        for (index, point) in links.points().iter().enumerate() {
            prop_assert_eq!(point.links.is_empty(), index == 0, "{:?}", point);
            prop_assert!(point.links.is_sorted_by(|a, b| a < b));
            for &link in &point.links {
                prop_assert!((link as usize) < index);
                let other = &links.points()[link as usize];
                let apart = [0, 1].map(|i| (point.position[i] - other.position[i]).abs());
                prop_assert!(link == 0 || apart.iter().all(|half_cells| *half_cells <= 4), "{:?} {:?}", point, other);
            }
        }
        let reached = links.points().len().saturating_sub(1);
        prop_assert_eq!(reached + links.not_reached(), axis.points().len());
    }
}

/// The layers `drivability` and `safe_path` of a sweep.
fn make(sweep: &Sweep, config: &SafePathConfig) -> (Layer, Layer) {
    make_for(&ReachConfig::default(), sweep, config)
}

/// The same for another vehicle.
fn make_for(vehicle: &ReachConfig, sweep: &Sweep, config: &SafePathConfig) -> (Layer, Layer) {
    let shared = shared_with(sweep, vehicle);
    let mut drivability = Drivability::new(&DrivabilityConfig::default());
    let mut earlier = [drivability.layer()];
    drivability.make(sweep, &shared.context(), &mut earlier[0]);
    let mut map = SafePath::new(config);
    let mut layer = map.layer();
    map.make(sweep, &Context { earlier: &earlier, ..shared.context() }, &mut layer);
    let [drivability] = earlier;
    (drivability, layer)
}

#[test]
fn paths_start_at_the_vehicle_and_stay_on_drivable_ground() {
    let config = SafePathConfig::default();
    let sweep = cast(Model::Hdl64eS2, court);
    let (drivability, layer) = make(&sweep, &config);
    assert_eq!((layer.points[0].x_m, layer.points[0].y_m), (0.0, 0.0));
    // The court is 16 m wide: its middle line runs past the vehicle, forward and back.
    assert!(layer.points.len() > 60, "{} points", layer.points.len());
    let reach = |most: fn(f64, f64) -> f64| layer.points.iter().map(|point| point.x_m).fold(0.0, most);
    assert!(reach(f64::max) > 6.0 && reach(f64::min) < -10.0, "{} {}", reach(f64::min), reach(f64::max));
    for point in &layer.points[1..] {
        let cell = cell_at(&layer, point.x_m as f32 - 1e-3, point.y_m as f32 - 1e-3).unwrap();
        assert!(point.radius_m >= 1.0, "{point:?}");
        // The point lies in its cell or on its border.
        let (_, columns) = size(&layer);
        let near = [cell, cell + 1, cell + columns, cell + columns + 1];
        assert!(near.iter().any(|cell| classes(&layer)[*cell] == PATH), "{point:?}");
    }
    let shared = shared(&sweep);
    for (cell, class) in classes(&layer).iter().enumerate() {
        let (_, columns) = size(&layer);
        let middle = |i: usize| (i as f32 + 0.5) * 0.25 - 30.0;
        let (x, y) = (middle(cell % columns), middle(cell / columns));
        let there = classes(&drivability)[cell_at(&drivability, x, y).unwrap()];
        let (closed, reached) = (shared.context().is_closed(x, y), shared.context().is_reached(x, y));
        let expected: &[u8] = match there {
            _ if closed => &[OBSTACLE],
            DRIVABLE if reached => &[FREE, PATH],
            DRIVABLE | NOT_DRIVABLE => &[NOT_REACHED],
            _ if shared.context().reach.unwrap().is_open_ground(ReachCell::at(x, y)) => &[FREE],
            _ => &[UNKNOWN],
        };
        assert!(expected.contains(class), "({x}, {y}): {class}");
    }
}

#[test]
fn the_vehicles_own_bonnet_is_no_obstacle_but_a_box_ahead_is() {
    // A box 1.6 m wide, 0.9 m high and 0.7 m deep, whose front is at `front`, hides the ground behind it.
    let with_box = |front: f32, vehicle_front_m: f32| {
        let inside = |x: f32, y: f32, z: f32| {
            court(x, y, z) || ((front - 0.7..front).contains(&x) && y.abs() < 0.8 && (0.3..0.9).contains(&z))
        };
        let vehicle = ReachConfig { vehicle_front_m, ..ReachConfig::default() };
        make_for(&vehicle, &cast(Model::Hdl64eS2, inside), &SafePathConfig::default()).1
    };
    // Number of points right ahead of the vehicle.
    let ahead = |layer: &Layer| {
        let near = |x: f64, y: f64| (3.0..6.0).contains(&x) && y.abs() < 1.0;
        layer.points.iter().filter(|point| near(point.x_m, point.y_m)).count()
    };
    let room = |layer: &Layer| layer.points[0].radius_m;
    let (own, before) = (with_box(2.9, 3.0), with_box(4.2, 3.0));
    let unknown_outline = with_box(2.9, 0.0);
    assert!(room(&own) > 2.0 && room(&unknown_outline) < 1.5, "{} {}", room(&own), room(&unknown_outline));
    let reach = |layer: &Layer| layer.points.iter().map(|point| point.x_m).fold(0.0, f64::max);
    assert!(reach(&own) > 6.0, "{}", reach(&own));
    assert_eq!(ahead(&before), 0);
    // The ground that the box hides is not free, except in the blind zone.
    let free = |layer: &Layer| classes(layer)[cell_at(layer, 4.1, 0.1).unwrap()];
    assert_eq!((free(&own), free(&before)), (UNKNOWN, OBSTACLE));
}

#[test]
fn an_occupied_cell_is_an_obstacle_where_it_stands_whichever_way_the_vehicle_heads() {
    let sweep = cast(Model::Hdl64eS2, court);
    let mut post = empty(Model::Hdl64eS2);
    (0..20).for_each(|_| add(&mut post, [9.1, 4.1, 0.5]));
    let shared = shared(&sweep);
    let mut drivability = Drivability::new(&DrivabilityConfig::default());
    let mut earlier = [drivability.layer(), Occupancy::new(&OccupancyConfig::default()).layer()];
    drivability.make(&sweep, &shared.context(), &mut earlier[0]);
    let (_, without) = make(&sweep, &SafePathConfig::default());
    for yaw in [0.0, 0.7, 2.0, -1.3] {
        let pose =
            Some(nalgebra::Isometry3::new(nalgebra::Vector3::new(31.0, -7.3, 0.0), yaw * nalgebra::Vector3::z()));
        let mut occupancy = Occupancy::new(&OccupancyConfig::default());
        occupancy.integrate(&Rays { map_from_ego: pose, speed_mps: Some(0.0), ..rays(&post) });
        occupancy.make(&sweep, &Context { map_from_ego: pose, ..Context::default() }, &mut earlier[1]);
        let mut map = SafePath::new(&SafePathConfig::default());
        let mut layer = map.layer();
        map.make(&sweep, &Context { earlier: &earlier, ..shared.context() }, &mut layer);
        let obstacle = |layer: &Layer, cell: usize| classes(layer)[cell] == OBSTACLE;
        let added: Vec<[f32; 2]> = (0..classes(&layer).len())
            .filter(|cell| obstacle(&layer, *cell) && !obstacle(&without, *cell))
            .map(|cell| [cell % 240, cell / 240].map(|index| (index as f32 + 0.5) * 0.25 - 30.0))
            .collect();
        // Half a diagonal of both kinds of cells.
        let near = |[x, y]: &[f32; 2]| (x - 9.1).hypot(y - 4.1) < 0.36;
        assert!(!added.is_empty() && added.iter().all(near), "yaw {yaw}: {added:?}");
    }
}

#[test]
fn without_drivability_all_cells_are_unknown() {
    let mut map = SafePath::new(&SafePathConfig::default());
    let mut layer = map.layer();
    map.make(&cast(Model::Vlp16, plain), &Context::default(), &mut layer);
    assert!(classes(&layer).iter().all(|class| *class == UNKNOWN));
    assert_eq!(layer.points, []);
}

#[test]
#[cfg_attr(not(clearway_data), ignore = "needs the recorded drives: set CLEARWAY_DATA")]
fn real_streets_have_paths_forward_and_backward() {
    for frame in 0..3 {
        use clearway_lidar::calibration::Calibration;
        use clearway_mapping::sensor::sweep::Mount;

        let scan = kitti(&format!("kitti/patchwork-plusplus/00000{frame}.bin"));
        // The vehicle's own bonnet returns from (2.5, ±0.5, 0.8) m in these scans: it is no obstacle.
        let mount = Mount { ego_from_sensor: nalgebra::Isometry3::translation(0.0, 0.0, 1.73), range_m_min: 2.0 };
        let mut sweep = Sweep::default();
        sweep.set_scan(&scan, &std::sync::Arc::new(Calibration::factory(Model::Hdl64eS2)), &mount);
        let (_, layer) = make(&sweep, &SafePathConfig::default());
        let reach = |most: fn(f64, f64) -> f64| layer.points.iter().map(|point| point.x_m).fold(0.0, most);
        println!("{frame}: {:?} x {} to {} m", layer.metrics, reach(f64::min), reach(f64::max));
        assert!(reach(f64::max) > 25.0 && reach(f64::min) < -25.0, "frame {frame}");
    }
}
