//! Real HDL-64E scans: the labelled SemanticKITTI frame against its labels.

#![cfg_attr(not(clearway_data), allow(unused))]

use clearway_mapping::config::{DrivabilityConfig, DrivabilityVariant, Passage, PlaneTest, Seed};
use clearway_mapping::layer::drivability::Drivability;
use clearway_mapping::layer::drivability::class::DrivabilityClass;
use clearway_mapping::layer::{Context, Layer, LayerMaker};
use clearway_mapping::sensor::sweep::Sweep;

use crate::common::labels::*;
use crate::common::*;

const UNKNOWN: u8 = DrivabilityClass::Unknown.value();
const DRIVABLE: u8 = DrivabilityClass::Drivable.value();

/// The labels of the frame, by cell.
struct Labelled {
    /// True for cells with road or lane marking, and without an obstacle.
    road: Vec<bool>,
    /// True for cells with an obstacle: a point that is not ground, 0.3 to 2.5 m over the ground around it.
    obstacle: Vec<bool>,
    /// True for ground without an obstacle that is connected to the blind zone by such cells, across empty rows.
    reachable: Vec<bool>,
}

fn by_cell(sweep: &Sweep, labels: &[u32], layer: &Layer) -> Labelled {
    let (rows, columns) = size(layer);
    let grid = radial_grid(layer);
    let cells = rows * columns;
    let TruthByCell { road, free, obstacle } = truth_by_cell(sweep, labels, cells, |x, y| grid.cell(x, y));

    let known = |cell: &usize| classes(layer)[*cell] != UNKNOWN;
    let mut reachable = vec![false; cells];
    let mut waiting = Vec::new();
    for column in 0..columns {
        let innermost = (0..rows).take_while(|row| grid.row_span_m(*row).0 < 7.0).map(|row| row * columns + column);
        waiting.extend(innermost.into_iter().find(known).filter(|cell| free[*cell]));
    }
    while let Some(cell) = waiting.pop() {
        if std::mem::replace(&mut reachable[cell], true) {
            continue;
        }
        let (row, column) = (cell / columns, cell % columns);
        let outward = (1..=3).map(|step| cell + step * columns).take_while(|c| *c < cells).find(known);
        let inward = (1..=3).take_while(|step| *step <= row).map(|step| cell - step * columns).find(known);
        let sideways = [1, columns - 1].map(|step| Some(row * columns + (column + step) % columns));
        let next = [outward, inward].into_iter().chain(sideways).flatten();
        waiting.extend(next.filter(|next| free[*next] && !reachable[*next]));
    }
    Labelled { road, obstacle, reachable }
}

/// Heights over the local ground, or over the plane under the vehicle as in the thesis.
enum Over {
    Ground,
    Plane,
}

fn shares(config: &DrivabilityConfig, over: Over) -> [f64; 3] {
    let (sweep, labels) = labelled_frame();
    let mut map = Drivability::new(config);
    let mut layer = map.layer();
    match over {
        Over::Ground => map.make(&sweep, &shared(&sweep).context(), &mut layer),
        Over::Plane => map.make(&sweep, &Context::default(), &mut layer),
    }
    let truth = by_cell(&sweep, &labels, &layer);
    let drivable: Vec<bool> = classes(&layer).iter().map(|class| *class == DRIVABLE).collect();
    let free = share(&drivable, |cell| !truth.obstacle[cell]);
    let road = share(&truth.road, |cell| drivable[cell]);
    let reachable = share(&truth.reachable, |cell| drivable[cell]);
    println!(
        "{:>3} columns, {} bridged, close_gaps {:<5}: share {:.4}; of drivable cells free of obstacles {:.3} %; \
         drivable of road {:.2} %, of reachable ground {:.2} %",
        config.columns,
        config.bridge_rows,
        config.close_gaps,
        figure(&layer, "drivable_share"),
        100.0 * free,
        100.0 * road,
        100.0 * reachable
    );
    [free, road, reachable]
}

#[test]
#[cfg_attr(not(clearway_data), ignore = "needs the recorded drives: set CLEARWAY_DATA")]
fn the_labelled_frame_reaches_its_targets() {
    let [free, road, reachable] = shares(&DrivabilityConfig::default(), Over::Ground);
    assert!(free >= 0.9995, "{free}");
    assert!(road >= 0.99, "{road}");
    assert!(reachable >= 0.95, "{reachable}");
}

#[test]
#[cfg_attr(not(clearway_data), ignore = "needs the recorded drives: set CLEARWAY_DATA")]
fn each_step_of_the_thesis_has_its_price_on_the_labelled_frame() {
    let own = DrivabilityConfig::default();
    let whole_boundary = DrivabilityConfig { plane_test: PlaneTest::WholeBoundary, ..own.clone() };
    let thesis = thesis_with_own_seeds();
    assert_eq!((own.seed, thesis.seed), (Seed::BlindZone, Seed::BlindZone));
    let [.., reachable] = shares(&own, Over::Plane);
    let [.., of_boundaries] = shares(&whole_boundary, Over::Plane);
    let [free, road, of_thesis] = shares(&thesis, Over::Plane);
    assert!(of_boundaries <= reachable && of_thesis <= reachable, "{reachable} {of_boundaries} {of_thesis}");
    assert!(free > 0.99 && road > 0.5, "{free} {road}");
}

#[test]
#[cfg_attr(not(clearway_data), ignore = "needs the recorded drives: set CLEARWAY_DATA")]
fn wider_columns_and_the_criteria_of_the_thesis_stay_useful() {
    let own = DrivabilityConfig::default();
    let thesis = DrivabilityConfig {
        bridge_rows: 0,
        close_gaps: false,
        step_m_max: 0.5,
        passage: Passage::BetweenSegments,
        ..own.clone()
    };
    // The thesis whole starts at cell (0, 0), under the vehicle.
    let paper = DrivabilityConfig { variant: DrivabilityVariant::Paper, ..own.clone() };
    let mut map = Drivability::new(&paper);
    let mut layer = map.layer();
    map.make(&labelled_frame().0, &Context::default(), &mut layer);
    assert!(figure(&layer, "drivable_share") > 0.2, "{}", figure(&layer, "drivable_share"));
    let configs = [
        (DrivabilityConfig { columns: 180, ..own.clone() }, Over::Ground),
        (DrivabilityConfig { columns: 90, ..own.clone() }, Over::Ground),
        (thesis.clone(), Over::Plane),
        (DrivabilityConfig { offset_m: 0.0, ..thesis }, Over::Plane),
    ];
    for (config, over) in configs {
        let [free, road, reachable] = shares(&config, over);
        assert!(free >= 0.997 && road >= 0.97 && reachable >= 0.95, "{config:?}");
    }
}
