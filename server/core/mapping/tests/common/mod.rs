//! Sweeps for the tests: rays of a real sensor model cast into simple worlds, and recorded scans.

pub mod labels;
pub mod opencalib;
pub mod street;

use std::sync::Arc;

use clearway_lidar::calibration::Calibration;
use clearway_lidar::model::Model;
use clearway_mapping::config::{DrivabilityConfig, Passage, PlaneTest, ReachConfig};
use clearway_mapping::ground::Ground;
use clearway_mapping::layer::radial_grid::RadialGrid;
use clearway_mapping::layer::{Cells, Context, Geometry, Layer, Rays};
use clearway_mapping::reach::Reach;
use clearway_mapping::sensor::sweep::Sweep;

/// Height of the sensor in all synthetic worlds, metres.
pub const HEIGHT_M: f32 = 1.8;

/// An empty sweep of a sensor 1.8 m over the ground.
pub fn empty(model: Model) -> Sweep {
    Sweep { calibration: Some(Arc::new(Calibration::factory(model))), mount_height_m: HEIGHT_M, ..Sweep::default() }
}

/// Adds one point, ego frame, metres.
pub fn add(sweep: &mut Sweep, [x, y, z]: [f32; 3]) {
    sweep.x.push(x);
    sweep.y.push(y);
    sweep.z.push(z);
    sweep.returns += 1;
}

/// Returns of one revolution of `model`; each ray is followed in steps of a few centimetres until `inside(x, y, z)`.
pub fn cast(model: Model, inside: impl Fn(f32, f32, f32) -> bool) -> Sweep {
    let mut sweep = empty(model);
    let lasers = sweep.calibration.as_ref().unwrap().lasers.clone();
    for step in 0..720 {
        let azimuth = (step as f32 + 0.25) * std::f32::consts::TAU / 720.0;
        for laser in &lasers {
            let (sin, cos) = (laser.vert_correction as f32).sin_cos();
            let at = |range: f32| [range * cos * azimuth.cos(), range * cos * azimuth.sin(), HEIGHT_M + range * sin];
            let mut range = 2.0;
            while range < 80.0 {
                let next = range + 0.02 + 0.002 * range;
                let [x, y, z] = at(next);
                if inside(x, y, z) {
                    // Ten halvings give a tenth of a millimetre.
                    let (mut before, mut after) = (range, next);
                    for _ in 0..10 {
                        let middle = (before + after) / 2.0;
                        let [x, y, z] = at(middle);
                        if inside(x, y, z) { after = middle } else { before = middle }
                    }
                    add(&mut sweep, at(after));
                    break;
                }
                range = next;
            }
        }
    }
    sweep
}

/// The parameters of the UT Austin thesis, but for the cells where segments start: the whole blind zone.
pub fn thesis_with_own_seeds() -> DrivabilityConfig {
    DrivabilityConfig {
        offset_m: 0.0,
        bridge_rows: 0,
        close_gaps: false,
        step_m_max: 0.5,
        grade_max: 0.0,
        plane_test: PlaneTest::WholeBoundary,
        passage: Passage::BetweenSegments,
        ..DrivabilityConfig::default()
    }
}

/// Level ground.
pub fn plain(_x: f32, _y: f32, z: f32) -> bool {
    z <= 0.0
}

/// Level ground with a wall across the road 15 m ahead, closed by walls 8 m to both sides and 20 m behind.
pub fn court(x: f32, y: f32, z: f32) -> bool {
    z <= 0.0
        || (z <= 1.6 && ((15.0..15.3).contains(&x) || (-20.3..-20.0).contains(&x) || (8.0..8.3).contains(&y.abs())))
}

/// The sweep with its points in another order, the same for the same seed.
pub fn shuffled(sweep: &Sweep, seed: u64) -> Sweep {
    let mut order: Vec<usize> = (0..sweep.x.len()).collect();
    let mut state = seed | 1;
    for i in (1..order.len()).rev() {
        state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        order.swap(i, (state >> 33) as usize % (i + 1));
    }
    let pick = |axis: &[f32]| order.iter().map(|i| axis[*i]).collect();
    Sweep { x: pick(&sweep.x), y: pick(&sweep.y), z: pick(&sweep.z), ..sweep.clone() }
}

/// The sweep rotated by 90° counter-clockwise, exactly.
pub fn rotated(sweep: &Sweep) -> Sweep {
    Sweep { x: sweep.y.iter().map(|y| -y).collect(), y: sweep.x.clone(), ..sweep.clone() }
}

/// The sweep without points on a border of square cells of 0.25 m, up to rounding: such a point belongs to the cell
/// behind the border, and after a rotation to the cell before it.
pub fn off_borders(sweep: &Sweep) -> Sweep {
    let kept = |i: &usize| [sweep.x[*i], sweep.y[*i]].iter().all(|v| (v * 4.0 - (v * 4.0).round()).abs() > 1e-4);
    let order: Vec<usize> = (0..sweep.x.len()).filter(kept).collect();
    let pick = |axis: &[f32]| order.iter().map(|i| axis[*i]).collect();
    Sweep { x: pick(&sweep.x), y: pick(&sweep.y), z: pick(&sweep.z), ..sweep.clone() }
}

/// Rows and columns of a layer.
pub fn size(layer: &Layer) -> (usize, usize) {
    match &layer.geometry {
        Geometry::Radial { row_radius_m, columns, .. } => (row_radius_m.len(), usize::from(*columns)),
        Geometry::Cartesian { width, height, .. } => (*height as usize, *width as usize),
    }
}

/// The cell of a layer that contains a position, if there is one.
pub fn cell_at(layer: &Layer, x: f32, y: f32) -> Option<usize> {
    match &layer.geometry {
        Geometry::Radial { .. } => radial_grid(layer).cell(x, y),
        Geometry::Cartesian { origin_x_m, origin_y_m, width, height, cell_m, yaw_rad, .. } => {
            let ((x, y), (sin, cos)) = ((f64::from(x), f64::from(y)), yaw_rad.sin_cos());
            let place = |v: f64, origin: f64| ((v - origin) / f64::from(*cell_m)).floor();
            let (i, j) = (place(x * cos - y * sin, *origin_x_m), place(x * sin + y * cos, *origin_y_m));
            let inside = i >= 0.0 && j >= 0.0 && i < f64::from(*width) && j < f64::from(*height);
            inside.then(|| j as usize * *width as usize + i as usize)
        }
    }
}

/// The values of a channel in a world rotated by 90° counter-clockwise.
pub fn quarter_rotated(layer: &Layer, values: &[i32]) -> Vec<i32> {
    let (rows, columns) = size(layer);
    match &layer.geometry {
        Geometry::Radial { .. } => values
            .chunks(columns)
            .flat_map(|row| {
                let mut row = row.to_vec();
                row.rotate_right(columns / 4);
                row
            })
            .collect(),
        // The value of (ix, iy) moves to (width - 1 - iy, ix).
        Geometry::Cartesian { .. } => {
            assert_eq!(rows, columns, "only a square grid can be rotated by 90°");
            (0..rows * columns).map(|cell| values[(columns - 1 - cell % columns) * columns + cell / columns]).collect()
        }
    }
}

/// The grid of a radial layer.
pub fn radial_grid(layer: &Layer) -> RadialGrid {
    match &layer.geometry {
        Geometry::Radial { centre_m, row_radius_m, columns } => {
            RadialGrid::new(*centre_m, row_radius_m.clone(), *columns)
        }
        Geometry::Cartesian { .. } => panic!("{} is no radial grid", layer.name),
    }
}

/// Outer radii of a layer's rows.
pub fn benches(layer: &Layer) -> &[f32] {
    let Geometry::Radial { row_radius_m, .. } = &layer.geometry else { panic!("{} is no radial grid", layer.name) };
    row_radius_m
}

/// Number of innermost rows that are as deep as the first: the rows before the first ring.
pub fn rows_before_rings(row_radius_m: &[f32]) -> usize {
    let depth_m = row_radius_m[0];
    1 + row_radius_m.windows(2).take_while(|pair| (pair[1] - pair[0] - depth_m).abs() < 1e-3).count()
}

/// Outer radii of the rows of a layer's rings.
pub fn ring_benches(layer: &Layer) -> &[f32] {
    &benches(layer)[rows_before_rings(benches(layer))..]
}

/// Values of the channel `class`.
pub fn classes(layer: &Layer) -> &[u8] {
    match &layer.channels[0].cells {
        Cells::U8(cells) => cells,
        other => panic!("class is u8, not {other:?}"),
    }
}

/// Name of a cell's class.
pub fn class_name(layer: &Layer, cell: usize) -> &'static str {
    layer.legend[usize::from(classes(layer)[cell])].name
}

/// A channel's values, whatever their type.
pub fn values(layer: &Layer, name: &str) -> Vec<i32> {
    match &layer.channels.iter().find(|c| c.name == name).unwrap().cells {
        Cells::U8(cells) => cells.iter().map(|c| i32::from(*c)).collect(),
        Cells::I8(cells) => cells.iter().map(|c| i32::from(*c)).collect(),
        Cells::U16(cells) => cells.iter().map(|c| i32::from(*c)).collect(),
    }
}

/// A figure of the layer.
pub fn figure(layer: &Layer, name: &str) -> f64 {
    layer.metrics.iter().find(|(n, _)| *n == name).unwrap().1
}

/// Path of a recorded drive.
pub fn data(path: &str) -> std::path::PathBuf {
    std::path::Path::new(env!("CLEARWAY_DRIVES")).join(path)
}

/// A KITTI scan, sensor frame.
pub fn kitti(path: &str) -> clearway_mapping::event::Scan {
    clearway_mapping::scan_file::read_bin(&std::fs::read(data(path)).unwrap()).unwrap()
}

/// Datagrams of a capture, up to its end or the first record that is cut off.
pub fn datagrams(path: &str) -> Vec<clearway_lidar::capture::Datagram> {
    let file = std::fs::File::open(data(path)).unwrap();
    clearway_lidar::capture::Capture::new(file).unwrap().map_while(Result::ok).collect()
}

/// The ground of a sweep, and what the vehicle can reach on it.
pub struct Shared {
    ground: Ground,
    reach: Reach,
}

/// Estimates the ground of a sweep, and what the vehicle can reach on it.
pub fn shared(sweep: &Sweep) -> Shared {
    shared_with(sweep, &ReachConfig::default())
}

/// The same for another vehicle.
pub fn shared_with(sweep: &Sweep, config: &ReachConfig) -> Shared {
    let (mut ground, mut reach) = (Ground::new(config.outline()), Reach::new(config));
    ground.estimate(sweep);
    reach.update(sweep, &ground);
    reach.flood();
    Shared { ground, reach }
}

impl Shared {
    /// The context of a map with this ground.
    pub fn context(&self) -> Context<'_> {
        Context { ground: Some(&self.ground), reach: Some(&self.reach), ..Context::default() }
    }
}

/// The rays of one scan on level ground as `integrate()` gets them, from a sensor at the sweep's mount.
pub fn rays(sweep: &Sweep) -> Rays<'_> {
    Rays {
        sensor: 0,
        stamp_ns: 0,
        returns: sweep,
        heights_m: &sweep.z,
        origin_m: [0.0, 0.0, sweep.mount_height_m],
        origin_height_m: sweep.mount_height_m,
        no_returns: &[],
        map_from_ego: None,
        speed_mps: None,
    }
}
