//! The four scenes of the UT Austin thesis in the simulator: drivable shares beside the thesis' table, precision and
//! recall against the simulator's truth, and the failures of the baseline that the thesis reports.
//!
//! The truth of a cell follows from votes: each point of the sweep within the grid and under the overhang cut-off votes
//! in its cell. A point more than 0.3 m over the true ground makes the cell an obstacle. Otherwise the most frequent
//! class of the truth at the points' positions counts. The truth is a raster of 0.2 m. Ground within a raster cell with
//! an object counts as `Tight`: both answers are right. Precision is the share of the cells called drivable that are
//! not forbidden (obstacle, steep, unreachable). Recall is the share of the drivable cells that are called drivable.

use clearway_lidar::model::Model;
use clearway_mapping::config::{DrivabilityConfig, DrivabilityVariant, HeightDifferenceConfig};
use clearway_mapping::layer::drivability::Drivability;
use clearway_mapping::layer::drivability::class::DrivabilityClass;
use clearway_mapping::layer::height_difference::HeightDifference;
use clearway_mapping::layer::height_difference::class::HeightDifferenceClass;
use clearway_mapping::layer::{Context, Layer, LayerMaker};
use clearway_mapping::sensor::sweep::{Mount, Sweep};
use clearway_sim::ground::{Ground, Profile};
use clearway_sim::scanner::ScannerConfig;
use clearway_sim::scenes::{self, Scene};
use clearway_sim::truth::{Truth, TruthGrid};
use clearway_sim::vehicle::SimulatedVehicle;
use clearway_sim::world::World;
use std::sync::Arc;

use crate::common::*;

/// One revolution of a standing simulated vehicle: its points, and the truth about them.
struct SimulatedScan {
    sweep: Sweep,
    truth: TruthGrid,
}

fn simulate(scene: Scene) -> SimulatedScan {
    simulate_with(ScannerConfig::default(), scene)
}

fn simulate_with(config: ScannerConfig, scene: Scene) -> SimulatedScan {
    let mount = Mount { ego_from_sensor: config.ego_from_sensor, range_m_min: 2.0 };
    let simulated = SimulatedVehicle::new(scene, config).true_revolution(1);
    let mut sweep = Sweep::default();
    sweep.set_revolution(&simulated.revolution, &mount);
    SimulatedScan { sweep, truth: simulated.truth }
}

fn drivability(sweep: &Sweep, columns: u16) -> Layer {
    let mut map = Drivability::new(&DrivabilityConfig { columns, ..DrivabilityConfig::default() });
    let mut layer = map.layer();
    map.make(sweep, &shared(sweep).context(), &mut layer);
    layer
}

fn height_difference(sweep: &Sweep) -> Layer {
    let mut map = HeightDifference::new(&HeightDifferenceConfig::default());
    let mut layer = map.layer();
    map.make(sweep, &shared(sweep).context(), &mut layer);
    layer
}

/// The voted truth of each cell; `None` if no point voted.
fn voted(scan: &SimulatedScan, layer: &Layer) -> Vec<Option<Truth>> {
    const CLASSES: [Truth; 4] = [Truth::Unreachable, Truth::Steep, Truth::Tight, Truth::Drivable];
    let (rows, columns) = size(layer);
    let grid = radial_grid(layer);
    let mut votes = vec![([0u32; 4], false); rows * columns];
    for ((&x, &y), &z) in scan.sweep.x.iter().zip(&scan.sweep.y).zip(&scan.sweep.z) {
        let (Some(cell), Some(ground)) = (grid.cell(x, y), scan.truth.height_at(x.into(), y.into())) else { continue };
        if z - ground > 2.5 {
            continue;
        }
        let class = match scan.truth.class_at(x.into(), y.into()) {
            Truth::Overhang | Truth::Obstacle | Truth::Outside => Truth::Tight,
            class => class,
        };
        votes[cell].0[CLASSES.iter().position(|c| *c == class).unwrap()] += 1;
        votes[cell].1 |= z - ground > 0.3;
    }
    let truth = |(counts, high): &([u32; 4], bool)| {
        if *high {
            return Some(Truth::Obstacle);
        }
        let most = (0..4).max_by_key(|i| (counts[*i], 4 - i)).unwrap();
        (counts[most] > 0).then_some(CLASSES[most])
    };
    votes.iter().map(truth).collect()
}

#[derive(Debug)]
struct Score {
    share: f64,
    precision: f64,
    recall: f64,
    /// Number of cells called drivable by their forbidden class.
    wrong: Vec<(Truth, usize)>,
}

fn score(scan: &SimulatedScan, layer: &Layer, drivable: u8) -> Score {
    let truth = voted(scan, layer);
    let cells = || classes(layer).iter().zip(&truth).filter_map(|(class, truth)| truth.map(|truth| (*class, truth)));
    let called = cells().filter(|(class, _)| *class == drivable).count();
    let wrong: Vec<_> = [Truth::Obstacle, Truth::Steep, Truth::Unreachable]
        .map(|forbidden| (forbidden, cells().filter(|cell| *cell == (drivable, forbidden)).count()))
        .into();
    let wrong_cells: usize = wrong.iter().map(|(_, cells)| cells).sum();
    let is = cells().filter(|(_, truth)| *truth == Truth::Drivable).count();
    let found = cells().filter(|cell| *cell == (drivable, Truth::Drivable)).count();
    Score {
        share: figure(layer, "drivable_share"),
        precision: 1.0 - wrong_cells as f64 / called as f64,
        recall: found as f64 / is as f64,
        wrong,
    }
}

fn wrong(score: &Score, class: Truth) -> usize {
    score.wrong.iter().find(|(truth, _)| *truth == class).unwrap().1
}

/// Least precision and recall of a scene. The targets are 99.9 % and 98 %.
///
/// The precision on slopes is 99.9 % with columns of one degree, and less with wider ones: most points of a cell on the
/// rim of a ditch or of a step lie on its face, but the highest point, the only point that the thesis keeps, lies on
/// the level ground.
fn required(scene: &str) -> (f64, f64) {
    match scene {
        "slopes with obstacles" => (0.996, 0.985),
        // Where the vehicle's disc does not fit beside a fence, the ground is not reached.
        _ => (0.9999, 0.9975),
    }
}

#[test]
fn the_four_scenes_of_the_thesis_reach_precision_and_recall() {
    println!("scene                         columns   paper %  share %  precision %  recall %  wrong");
    for scene in scenes::of_the_thesis() {
        let (name, paper) = (scene.name, scene.paper_share.unwrap());
        let scan = simulate(scene);
        for columns in [360, 180, 90] {
            let score = score(&scan, &drivability(&scan.sweep, columns), DrivabilityClass::Drivable.value());
            let percent = [score.share, score.precision, score.recall].map(|share| 100.0 * share);
            let [share, precision, recall] = percent;
            println!(
                "{name:<30} {:>4}°  {paper:>8.2}  {share:>7.2}  {precision:>11.3}  {recall:>8.3}  {:?}",
                360 / columns,
                score.wrong
            );
            let (precision, recall) = required(name);
            assert!(score.precision >= precision, "{name}, {columns} columns: {score:?}");
            assert!(score.recall >= recall, "{name}, {columns} columns: {score:?}");
            // No cell is behind a closed fence, under a low overhang or in an object. A cell on the edge of a step may
            // contain ground of both sides.
            assert!(wrong(&score, Truth::Unreachable) <= 4, "{name}, {columns} columns: {score:?}");
            assert_eq!(wrong(&score, Truth::Obstacle), 0, "{name}, {columns} columns");
        }
    }
}

#[test]
fn a_low_overhang_removes_a_third_of_the_drivable_ground() {
    let share = |scene| figure(&drivability(&simulate(scene).sweep, 360), "drivable_share");
    let (open, closed) = (share(scenes::fenced_road_under_canopy()), share(scenes::fenced_road_with_low_overhang()));
    println!("{open:.4} without, {closed:.4} with the overhang; the thesis has 0.783 and 0.370");
    assert!(closed < open - 0.2);
}

#[test]
fn the_baseline_fails_as_the_thesis_reports() {
    // An upward slope of 10 %, 16 % at its steepest: a row is metres deep there, and the road within it rises by more
    // than the threshold.
    let ground = Ground { along: Profile::default().ramp(14.0, 40.0, 26.0 * 0.1), ..Ground::default() };
    let slope = simulate(Scene { world: Arc::new(World::on(ground)), ..scenes::flat() });
    let (ours, theirs) = (drivability(&slope.sweep, 360), height_difference(&slope.sweep));
    let truth = voted(&slope, &theirs);
    let (_, columns) = size(&theirs);
    let on_the_slope = |cell: &usize| {
        let (row, column) = (*cell / columns, *cell % columns);
        (24.0..38.0).contains(&benches(&theirs)[row]) && !(20..340).contains(&column)
    };
    let road: Vec<usize> =
        (0..truth.len()).filter(on_the_slope).filter(|cell| truth[*cell] == Some(Truth::Drivable)).collect();
    let share = |layer: &Layer, class: u8| {
        road.iter().filter(|cell| classes(layer)[**cell] == class).count() as f64 / road.len() as f64
    };
    let (ours, theirs) =
        (share(&ours, DrivabilityClass::Drivable.value()), share(&theirs, HeightDifferenceClass::Drivable.value()));
    println!("upward slope, {} cells: drivability calls {ours:.3} drivable, height_difference {theirs:.3}", road.len());
    assert!(ours > 0.95 && theirs < 0.8);

    // The baseline calls the road under branches an obstacle, and ground behind the fence drivable. An HDL-64E looks up
    // by at most 2 degrees, so the branches hang 30 m ahead, 2.6 m over the road, where the sensor sees them.
    let scene = scenes::fenced_road_under_canopy();
    let world = World::clone(&scene.world).canopy(29.7, 3.4, 4.0, 2.6);
    let canopy = simulate(Scene { world: Arc::new(world), ..scene });
    let (ours, theirs) = (drivability(&canopy.sweep, 360), height_difference(&canopy.sweep));
    let truth = voted(&canopy, &theirs);
    let count = |layer: &Layer, class: u8, is: Truth| {
        classes(layer).iter().zip(&truth).filter(|(c, t)| **c == class && **t == Some(is)).count()
    };
    let under = count(&theirs, HeightDifferenceClass::Obstacle.value(), Truth::Drivable);
    let under_ours = count(&ours, DrivabilityClass::Obstacle.value(), Truth::Drivable);
    println!("canopy: drivable cells called obstacle: drivability {under_ours}, height_difference {under}");
    // 30 m away the ground is known to a decimetre, as much as the branches hang over the cut-off.
    assert!(under >= 20 && under_ours <= 2);
    let behind = count(&theirs, HeightDifferenceClass::Drivable.value(), Truth::Unreachable);
    let behind_ours = count(&ours, DrivabilityClass::Drivable.value(), Truth::Unreachable);
    println!("behind the fence: cells called drivable: drivability {behind_ours}, height_difference {behind}");
    assert!(behind > 500 && behind_ours == 0);
}

/// The map as text: one character for each 2 m, x up, y left; the vehicle is in the middle.
fn drawing(layer: &Layer) -> String {
    let grid = radial_grid(layer);
    let line = |i: i32| {
        let cell = |j: i32| {
            let (x, y) = (2.0 * i as f32 + 0.5, 2.0 * j as f32 + 0.5);
            let class = grid.cell(x, y).map_or(0, |cell| classes(layer)[cell]);
            if (i, j) == (0, 0) { 'V' } else { [' ', '.', '~', '#'][usize::from(class)] }
        };
        (-20..=20).rev().map(cell).collect::<String>().trim_end().to_owned()
    };
    (-20..=20).rev().map(line).collect::<Vec<_>>().join("\n")
}

#[test]
fn the_maps_of_the_four_scenes_equal_the_snapshots() {
    for (name, scene) in [
        ("flat", scenes::flat()),
        ("slopes", scenes::slopes_with_obstacles()),
        ("canopy", scenes::fenced_road_under_canopy()),
        ("overhang", scenes::fenced_road_with_low_overhang()),
    ] {
        insta::assert_snapshot!(format!("drivability_{name}"), drawing(&drivability(&simulate(scene).sweep, 360)));
    }
}

#[test]
fn the_thesis_whole_comes_near_its_table_in_the_simulated_scenes() {
    let paper = DrivabilityConfig { variant: DrivabilityVariant::Paper, ..DrivabilityConfig::default() };
    let seeded = thesis_with_own_seeds();
    for scene in scenes::of_the_thesis() {
        let (name, paper_share) = (scene.name, scene.paper_share.unwrap());
        let scan = simulate(scene);
        let own = score(&scan, &drivability(&scan.sweep, 360), DrivabilityClass::Drivable.value());
        for (form, config) in [("paper", &paper), ("paper but for the seed", &seeded)] {
            let mut map = Drivability::new(config);
            let mut layer = map.layer();
            map.make(&scan.sweep, &Context::default(), &mut layer);
            let found = score(&scan, &layer, DrivabilityClass::Drivable.value());
            println!("{name}, {form}: {found:.4?}");
            assert!((found.share - paper_share / 100.0).abs() < 0.15, "{name}: {found:?}");
            // Other than with our seeds and gaps, ground shows through the holes of a fence.
            assert!(found.recall <= own.recall && found.precision > 0.97, "{name}: {found:?}");
        }
    }
}

#[test]
fn a_raised_bed_whose_edge_lies_in_the_blind_zone_is_not_reached() {
    // The first ring of a VLP-16 meets the ground 7 m away; the kerbs are 4 m away on both sides.
    let across = Profile::through(&[(-4.0, 0.5), (-4.0, 0.0), (4.0, 0.0), (4.0, 0.5)]);
    for (across, expected) in [(across, false), (Profile::default(), true)] {
        let world = Arc::new(World::on(Ground { across, reflectivity: 15, ..Ground::default() }));
        let config = ScannerConfig { model: Model::Vlp16, ..ScannerConfig::default() };
        let scan = simulate_with(config, Scene { world, ..scenes::flat() });
        let shared = shared(&scan.sweep);
        let context = shared.context();
        assert!(context.is_reached(10.0, 0.0) && context.is_reached(-10.0, 0.0), "the road");
        for (x, y) in [(0.0, 8.0), (0.0, -8.0), (4.0, 9.0), (-4.0, -9.0)] {
            assert_eq!(context.is_reached(x, y), expected, "({x}, {y})");
        }
    }
}
