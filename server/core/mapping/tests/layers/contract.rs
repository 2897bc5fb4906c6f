//! What every layer guarantees, checked for each of them.

use clearway_lidar::model::Model;
use clearway_mapping::config::{
    DrivabilityConfig, HeightDifferenceConfig, OccupancyConfig, SafePathConfig, SpeedConfig, TerrainConfig, Variant,
};
use clearway_mapping::layer::drivability::Drivability;
use clearway_mapping::layer::height_difference::HeightDifference;
use clearway_mapping::layer::occupancy::Occupancy;
use clearway_mapping::layer::safe_path::SafePath;
use clearway_mapping::layer::safe_path::class::SafePathClass;
use clearway_mapping::layer::speed::Speed;
use clearway_mapping::layer::terrain::Terrain;
use clearway_mapping::layer::{Cells, Context, Layer, LayerMaker, Meaning, SafePoint};
use clearway_mapping::sensor::sweep::Sweep;

use crate::common::*;

/// Safe paths, and the drivability they are made from.
#[derive(Clone)]
struct SafePathFromDrivability {
    drivability: Drivability,
    safe_path: SafePath,
}

impl LayerMaker for SafePathFromDrivability {
    fn layer(&self) -> Layer {
        self.safe_path.layer()
    }

    fn make(&mut self, sweep: &Sweep, context: &Context<'_>, layer: &mut Layer) {
        let mut earlier = [self.drivability.layer()];
        self.drivability.make(sweep, context, &mut earlier[0]);
        self.safe_path.make(sweep, &Context { earlier: &earlier, ..*context }, layer);
    }
}

/// The occupancy of one scan.
#[derive(Clone)]
struct OccupancyOfOneScan(Occupancy);

impl LayerMaker for OccupancyOfOneScan {
    fn layer(&self) -> Layer {
        self.0.layer()
    }

    fn make(&mut self, sweep: &Sweep, context: &Context<'_>, layer: &mut Layer) {
        self.0.integrate(&rays(sweep));
        self.0.make(sweep, context, layer);
    }
}

/// Share of the known cells that are drivable or passable; `None` for layers without such a metric.
fn share(layer: &Layer) -> Option<f64> {
    let named = |(name, _): &&(&str, f64)| ["drivable_share", "passable_share"].contains(name);
    layer.metrics.iter().find(named).map(|(_, share)| *share)
}

fn makers() -> Vec<Box<dyn LayerMaker>> {
    let mut makers: Vec<Box<dyn LayerMaker>> = Vec::new();
    for columns in [360, 180, 90] {
        let drivability = DrivabilityConfig { columns, ..DrivabilityConfig::default() };
        makers.push(Box::new(Drivability::new(&drivability)));
        makers.push(Box::new(Drivability::new(&DrivabilityConfig { bridge_rows: 0, ..drivability })));
        makers.push(Box::new(HeightDifference::new(&HeightDifferenceConfig { columns, ..Default::default() })));
    }
    for form in [Variant::Grounded, Variant::Paper, Variant::Grid] {
        makers.push(Box::new(Terrain::new(&TerrainConfig { variant: form, planes: true, ..TerrainConfig::default() })));
    }
    makers.push(Box::new(Speed::new(&SpeedConfig::default())));
    let drivability = Drivability::new(&DrivabilityConfig::default());
    makers.push(Box::new(OccupancyOfOneScan(Occupancy::new(&OccupancyConfig::default()))));
    makers
        .push(Box::new(SafePathFromDrivability { drivability, safe_path: SafePath::new(&SafePathConfig::default()) }));
    makers
}

fn make(maker: &mut dyn LayerMaker, sweep: &Sweep) -> Layer {
    let mut layer = maker.layer();
    maker.make(sweep, &shared(sweep).context(), &mut layer);
    layer
}

fn every_cell_is_written(layer: &Layer) {
    let (rows, columns) = size(layer);
    for channel in &layer.channels {
        assert_eq!(values(layer, channel.name).len(), rows * columns, "{} {}", layer.name, channel.name);
    }
}

#[test]
fn an_empty_sweep_gives_a_whole_map_of_unknown_cells() {
    for mut maker in makers() {
        for sweep in [Sweep::default(), empty(Model::Hdl64eS2), empty(Model::Vlp16)] {
            let layer = make(maker.as_mut(), &sweep);
            every_cell_is_written(&layer);
            for channel in &layer.channels {
                let written = values(&layer, channel.name);
                assert!(written.iter().all(|v| *v == channel.unknown), "{} {}", layer.name, channel.name);
            }
            assert_eq!(share(&layer).unwrap_or(0.0), 0.0);
            assert_eq!(layer.points, []);
        }
    }
}

#[test]
fn level_ground_is_drivable_wherever_a_point_fell() {
    for model in [Model::Hdl64eS2, Model::Hdl32e, Model::Vlp16, Model::Vls128] {
        let sweep = cast(model, plain);
        for mut maker in makers() {
            let layer = make(maker.as_mut(), &sweep);
            every_cell_is_written(&layer);
            assert_eq!(share(&layer).unwrap_or(1.0), 1.0, "{model:?} {}", layer.name);
        }
    }
}

#[test]
fn a_wall_is_an_obstacle_in_every_layer() {
    let sweep = cast(Model::Hdl64eS2, court);
    for mut maker in makers() {
        let layer = make(maker.as_mut(), &sweep);
        // A wall at the edge of a cell may be in the cell before or behind it if the layer resamples another grid.
        let class = |x| layer.legend[usize::from(classes(&layer)[cell_at(&layer, x, 0.01).unwrap()])];
        let stands = |x: &f32| class(*x).meaning == Meaning::Occupied;
        assert!([14.76, 15.01, 15.26].iter().any(stands), "{} straight ahead, 15 m", layer.name);
    }
}

#[test]
fn a_difference_of_height_is_an_obstacle_exactly_if_it_is_above_the_limit() {
    let config = HeightDifferenceConfig { difference_m_max: 0.5, ..Default::default() };
    for (height_m, expected) in [(0.49, "drivable"), (0.5, "drivable"), (0.51, "obstacle")] {
        let mut sweep = empty(Model::Hdl64eS2);
        [0.0, height_m].into_iter().for_each(|z| add(&mut sweep, [10.0, 0.1, z]));
        let layer = make(&mut HeightDifference::new(&config), &sweep);
        assert_eq!(class_name(&layer, cell_at(&layer, 10.0, 0.1).unwrap()), expected, "{height_m} m");
    }
}

#[test]
fn the_same_sweep_gives_the_same_bytes() {
    let sweep = cast(Model::Hdl64eS2, court);
    for mut maker in makers() {
        assert_eq!(make(maker.as_mut(), &sweep), make(maker.as_mut(), &sweep));
    }
}

#[test]
fn the_order_of_the_points_has_no_effect() {
    let mut sweep = cast(Model::Hdl64eS2, court);
    // Points of one cell with equal heights, so that ties occur.
    for k in 0..200 {
        let angle = k as f32 * 0.031;
        add(&mut sweep, [9.0 * angle.cos(), 9.0 * angle.sin(), 0.5]);
        add(&mut sweep, [9.01 * angle.cos(), 9.01 * angle.sin(), 0.5]);
    }
    for mut maker in makers() {
        let layer = make(maker.as_mut(), &sweep);
        for seed in 1..4 {
            assert_eq!(make(maker.as_mut(), &shuffled(&sweep, seed)), layer, "seed {seed}");
        }
    }
}

/// A channel's values; path counts as free, because lines two cells wide are thinned from one end.
fn ends_of_paths_aside(layer: &Layer, name: &str) -> Vec<i32> {
    let is_path =
        |value: i32| layer.name == "safe_path" && name == "class" && value == i32::from(SafePathClass::Path.value());
    values(layer, name)
        .into_iter()
        .map(|v| if is_path(v) { i32::from(SafePathClass::Free.value()) } else { v })
        .collect()
}

#[test]
fn a_world_rotated_by_90_degrees_gives_a_rotated_layer() {
    let sweep = off_borders(&cast(Model::Hdl64eS2, court));
    // The paper's division cuts along x first; the other variants of `terrain` are invariant.
    let paper = TerrainConfig { variant: Variant::Paper, ..TerrainConfig::default() };
    let paper = make(&mut Terrain::new(&paper), &sweep);
    for mut maker in makers() {
        let (layer, quarter) = (make(maker.as_mut(), &sweep), make(maker.as_mut(), &rotated(&sweep)));
        let (_, columns) = size(&layer);
        if layer.name == "terrain" && classes(&layer) == classes(&paper) {
            continue;
        }
        // A quarter of 90 columns is not a whole number.
        if columns % 4 != 0 {
            continue;
        }
        // Segments are numbered in the order they are found, which begins at column 0; slopes rotate with the world.
        let is_invariant = |name: &str| !matches!(name, "segment" | "slope_x" | "slope_y");
        for channel in layer.channels.iter().filter(|c| is_invariant(c.name)) {
            let [before, after] = [&layer, &quarter].map(|layer| ends_of_paths_aside(layer, channel.name));
            let before = quarter_rotated(&layer, &before);
            for (row, (before, after)) in before.chunks(columns).zip(after.chunks(columns)).enumerate() {
                assert_eq!(before, after, "{} {} row {row}", layer.name, channel.name);
            }
        }
    }
}

#[test]
fn buffers_that_were_used_before_have_no_effect() {
    let sweep = cast(Model::Hdl64eS2, court);
    for mut maker in makers() {
        let fresh = make(maker.as_mut(), &sweep);
        // The maker has made a layer of another sensor's sweep, and the layer contains garbage of another size.
        make(maker.as_mut(), &cast(Model::Vlp16, plain));
        let mut garbage = maker.layer();
        for channel in &mut garbage.channels {
            match &mut channel.cells {
                Cells::U8(cells) => *cells = vec![0xa5; 99_999],
                Cells::I8(cells) => *cells = vec![-3; 7],
                Cells::U16(cells) => *cells = vec![0xa5a5; 99_999],
            }
        }
        garbage.points = vec![SafePoint::default(); 3];
        garbage.planes = vec![[9.0; 3]; 70];
        garbage.metrics = vec![("drivable_share", -1.0), ("left_over", 1.0)];
        maker.make(&sweep, &shared(&sweep).context(), &mut garbage);
        assert_eq!(garbage, fresh);
    }
}
