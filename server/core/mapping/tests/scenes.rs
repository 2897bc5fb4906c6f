//! The thesis' four scenes in the simulator: shares beside its table, precision and recall against the simulator's
//! truth, and the baseline failing where the thesis says it fails.
//!
//! How a cell's truth is voted: each point of the sweep within the grid and under the overhang cut-off votes in its
//! cell. A point more than 0.3 m over the true ground makes the cell an obstacle. Otherwise the truth at the points'
//! places is counted and the most frequent class wins; the truth is a raster of 0.2 m, so ground seen within a raster
//! cell that something stands in counts as `Tight`: either answer is right. Precision is the share of the cells called
//! drivable that are not forbidden (obstacle, steep, unreachable); recall the share of the drivable cells called so.

mod common;

use clearway_mapping::config::{DrivabilityConfig, HeightDifferenceConfig};
use clearway_mapping::layer::drivability::Drivability;
use clearway_mapping::layer::drivability::class::DrivabilityClass;
use clearway_mapping::layer::height_difference::HeightDifference;
use clearway_mapping::layer::height_difference::class::HeightDifferenceClass;
use clearway_mapping::layer::radial_grid::RadialGrid;
use clearway_mapping::layer::{Context, Layer, LayerMaker};
use clearway_mapping::sensor::sweep::{Mount, Sweep};
use clearway_sim::ground::{Ground, Profile};
use clearway_sim::scanner::ScannerConfig;
use clearway_sim::scenes::{self, Scene};
use clearway_sim::truth::{Truth, TruthGrid};
use clearway_sim::vehicle::SimulatedVehicle;
use clearway_sim::world::World;
use common::*;
use std::sync::Arc;

/// A turn of a standing simulated vehicle: its points and the truth about them.
struct Turn {
    sweep: Sweep,
    truth: TruthGrid,
}

fn turn(scene: Scene) -> Turn {
    let config = ScannerConfig::default();
    let mount = Mount { ego_from_sensor: config.ego_from_sensor, range_m_min: 2.0 };
    let turn = SimulatedVehicle::new(scene, config).turn(1);
    let mut sweep = Sweep::default();
    sweep.set_revolution(&turn.revolution, &mount);
    Turn { sweep, truth: turn.truth }
}

fn drivability(sweep: &Sweep, columns: u16) -> Layer {
    let mut map = Drivability::new(&DrivabilityConfig { columns, ..DrivabilityConfig::default() });
    let mut layer = map.layer();
    map.make(sweep, &Context::default(), &mut layer);
    layer
}

fn height_difference(sweep: &Sweep) -> Layer {
    let mut map = HeightDifference::new(&HeightDifferenceConfig::default());
    let mut layer = map.layer();
    map.make(sweep, &Context::default(), &mut layer);
    layer
}

/// The voted truth of every cell; `None` where no point voted.
fn voted(turn: &Turn, layer: &Layer) -> Vec<Option<Truth>> {
    const CLASSES: [Truth; 4] = [Truth::Unreachable, Truth::Steep, Truth::Tight, Truth::Drivable];
    let (rows, columns) = size(layer);
    let grid = RadialGrid::new(benches(layer).to_vec(), columns as u16);
    let mut votes = vec![([0u32; 4], false); rows * columns];
    for ((&x, &y), &z) in turn.sweep.x.iter().zip(&turn.sweep.y).zip(&turn.sweep.z) {
        let (Some(cell), Some(ground)) = (grid.cell(x, y), turn.truth.height_at(x.into(), y.into())) else { continue };
        if z > 2.5 {
            continue;
        }
        let class = match turn.truth.class_at(x.into(), y.into()) {
            Truth::Obstacle | Truth::Outside => Truth::Tight,
            class => class,
        };
        votes[cell].0[CLASSES.iter().position(|c| *c == class).unwrap()] += 1;
        votes[cell].1 |= z - ground > 0.3;
    }
    let verdict = |(counts, high): &([u32; 4], bool)| {
        if *high {
            return Some(Truth::Obstacle);
        }
        let most = (0..4).max_by_key(|i| (counts[*i], 4 - i)).unwrap();
        (counts[most] > 0).then_some(CLASSES[most])
    };
    votes.iter().map(verdict).collect()
}

#[derive(Debug)]
struct Score {
    share: f64,
    precision: f64,
    recall: f64,
    /// Cells called drivable, by the forbidden class they are.
    wrong: Vec<(Truth, usize)>,
}

fn score(turn: &Turn, layer: &Layer, drivable: u8) -> Score {
    let truth = voted(turn, layer);
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

/// What holds, by scene and columns: least precision and recall. Targets: 99.9 % and 98 %.
///
/// Short of the target is the precision on slopes, by 0.1 to 0.3 %: cells on the rim of a ditch or a retaining step,
/// most of whose points lie on the face while the highest, the only one the thesis keeps, lies on the level ground.
fn promised(scene: &str) -> (f64, f64) {
    match scene {
        "slopes with obstacles" => (0.996, 0.985),
        _ => (0.9999, 0.998),
    }
}

#[test]
fn the_four_scenes_of_the_thesis_come_out_as_the_simulator_knows_them() {
    println!("scene                         columns   paper %  share %  precision %  recall %  wrong");
    for scene in scenes::of_the_thesis() {
        let (name, paper) = (scene.name, scene.paper_share.unwrap());
        let turn = turn(scene);
        for columns in [360, 180, 90] {
            let score = score(&turn, &drivability(&turn.sweep, columns), DrivabilityClass::Drivable.value());
            let percent = [score.share, score.precision, score.recall].map(|share| 100.0 * share);
            let [share, precision, recall] = percent;
            println!(
                "{name:<30} {:>4}°  {paper:>8.2}  {share:>7.2}  {precision:>11.3}  {recall:>8.3}  {:?}",
                360 / columns,
                score.wrong
            );
            let (precision, recall) = promised(name);
            assert!(score.precision >= precision, "{name}, {columns} columns: {score:?}");
            assert!(score.recall >= recall, "{name}, {columns} columns: {score:?}");
            // Behind closed fences, under what hangs too low, in objects: not one cell.
            assert_eq!(wrong(&score, Truth::Unreachable), 0, "{name}, {columns} columns");
            assert_eq!(wrong(&score, Truth::Obstacle), 0, "{name}, {columns} columns");
        }
    }
}

#[test]
fn the_overhang_takes_a_third_of_the_map_as_in_the_thesis() {
    let share = |scene| figure(&drivability(&turn(scene).sweep, 360), "drivable_share");
    let (open, closed) = (share(scenes::fenced_road_under_canopy()), share(scenes::fenced_road_with_low_overhang()));
    println!("{open:.4} without, {closed:.4} with the overhang; the thesis has 0.783 and 0.370");
    assert!(closed < open - 0.2);
}

#[test]
fn the_baseline_fails_where_the_thesis_says_it_fails() {
    // On an upward slope of 10 %, 16 % at its steepest: a row is metres deep there, and the road within it rises by
    // more than the threshold.
    let ground = Ground { along: Profile::default().ramp(14.0, 40.0, 26.0 * 0.1), ..Ground::default() };
    let slope = turn(Scene { world: Arc::new(World::on(ground)), ..scenes::flat() });
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

    // Under the canopy it calls the road an obstacle, behind the fence it calls ground drivable.
    // An HDL-64E looks up by 2 degrees at most, so the branches hang 30 m ahead, 2.6 m over the road, where it sees
    // them.
    let scene = scenes::fenced_road_under_canopy();
    let world = World::clone(&scene.world).canopy(29.7, 3.4, 4.0, 2.6);
    let canopy = turn(Scene { world: Arc::new(world), ..scene });
    let (ours, theirs) = (drivability(&canopy.sweep, 360), height_difference(&canopy.sweep));
    let truth = voted(&canopy, &theirs);
    let count = |layer: &Layer, class: u8, is: Truth| {
        classes(layer).iter().zip(&truth).filter(|(c, t)| **c == class && **t == Some(is)).count()
    };
    let under = count(&theirs, HeightDifferenceClass::Obstacle.value(), Truth::Drivable);
    let under_ours = count(&ours, DrivabilityClass::Obstacle.value(), Truth::Drivable);
    println!("canopy: drivable cells called obstacle: drivability {under_ours}, height_difference {under}");
    assert!(under >= 20 && under_ours == 0);
    let behind = count(&theirs, HeightDifferenceClass::Drivable.value(), Truth::Unreachable);
    let behind_ours = count(&ours, DrivabilityClass::Drivable.value(), Truth::Unreachable);
    println!("behind the fence: cells called drivable: drivability {behind_ours}, height_difference {behind}");
    assert!(behind > 500 && behind_ours == 0);
}

/// The map as a driver would draw it: one character each 2 m, x up, y left; the vehicle at the middle.
fn drawing(layer: &Layer) -> String {
    let (_, columns) = size(layer);
    let grid = RadialGrid::new(benches(layer).to_vec(), columns as u16);
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
fn the_scenes_look_as_they_did() {
    for (name, scene) in [
        ("flat", scenes::flat()),
        ("slopes", scenes::slopes_with_obstacles()),
        ("canopy", scenes::fenced_road_under_canopy()),
        ("overhang", scenes::fenced_road_with_low_overhang()),
    ] {
        insta::assert_snapshot!(format!("drivability_{name}"), drawing(&drivability(&turn(scene).sweep, 360)));
    }
}
