//! Time to make each layer from one sweep of an HDL-64E on one thread, with points per second.
//!
//! The sweep is KITTI's first scan if the recorded drives are there, else a simulated revolution.

use clearway_lidar::calibration::Calibration;
use clearway_lidar::model::Model;
use clearway_mapping::config::{
    DrivabilityConfig, HeightDifferenceConfig, MotionConfig, OccupancyConfig, OccupancyVariant, SafePathConfig,
    SpeedConfig, TerrainConfig, Variant,
};
use clearway_mapping::event::{EgoPose, Road, RoadFrame, RoadPurpose, Scan};
use clearway_mapping::layer::drivability::Drivability;
use clearway_mapping::layer::height_difference::HeightDifference;
use clearway_mapping::layer::occupancy::Occupancy;
use clearway_mapping::layer::safe_path::SafePath;
use clearway_mapping::layer::speed::Speed;
use clearway_mapping::layer::speed::measured_road::MeasuredRoad;
use clearway_mapping::layer::terrain::Terrain;
use clearway_mapping::layer::{Context, LayerMaker, Rays};
use clearway_mapping::road::StoredRoad;
use clearway_mapping::sensor::distance_series::DistanceSeries;
use clearway_mapping::sensor::motion::{EgoTrajectory, Motion};
use clearway_mapping::sensor::ring_series::RingSeries;
use clearway_mapping::sensor::sweep::{Mount, Sweep};
use clearway_sim::scanner::ScannerConfig;
use clearway_sim::vehicle::SimulatedVehicle;
use divan::Bencher;
use divan::counter::ItemsCount;
use std::sync::Arc;

fn main() {
    divan::main();
}

fn mount(height_m: f64) -> Mount {
    Mount { ego_from_sensor: nalgebra::Isometry3::translation(0.0, 0.0, height_m), range_m_min: 2.0 }
}

/// KITTI's first scan: x, y, z and intensity of each point.
fn kitti() -> Option<Scan> {
    let bytes = std::fs::read(concat!(env!("CLEARWAY_DRIVES"), "/kitti/patchwork-plusplus/000000.bin")).ok()?;
    let mut scan = Scan::default();
    for point in bytes.chunks_exact(16) {
        let value = |i: usize| f32::from_le_bytes([point[4 * i], point[4 * i + 1], point[4 * i + 2], point[4 * i + 3]]);
        scan.x.push(value(0));
        scan.y.push(value(1));
        scan.z.push(value(2));
        scan.intensity.push(value(3));
    }
    Some(scan)
}

fn sweep() -> Sweep {
    let mut sweep = Sweep::default();
    match kitti() {
        Some(scan) => {
            sweep.set_scan(&scan, &Arc::new(Calibration::factory(Model::Hdl64eS2)), &mount(1.73));
        }
        None => sweep.set_revolution(&revolution(), &mount(1.9)),
    }
    sweep
}

fn revolution() -> clearway_lidar::revolution::Revolution {
    SimulatedVehicle::new(clearway_sim::scenes::town(), ScannerConfig::default()).revolution(1)
}

#[divan::bench(args = [360, 180, 90])]
fn drivability(bencher: Bencher, columns: u16) {
    let sweep = sweep();
    let mut map = Drivability::new(&DrivabilityConfig { columns, ..DrivabilityConfig::default() });
    let mut layer = map.layer();
    bencher.counter(ItemsCount::new(sweep.x.len())).bench_local(|| map.make(&sweep, &Context::default(), &mut layer));
}

#[divan::bench]
fn height_difference(bencher: Bencher) {
    let sweep = sweep();
    let mut map = HeightDifference::new(&HeightDifferenceConfig::default());
    let mut layer = map.layer();
    bencher.counter(ItemsCount::new(sweep.x.len())).bench_local(|| map.make(&sweep, &Context::default(), &mut layer));
}

#[divan::bench]
fn sweep_of_a_revolution(bencher: Bencher) {
    let revolution = revolution();
    let mount = mount(1.9);
    let mut sweep = Sweep::default();
    let slots = revolution.echoes[0].range_m.len();
    bencher.counter(ItemsCount::new(slots)).bench_local(|| sweep.set_revolution(&revolution, &mount));
}

/// The distance series of a scan with rings: a simulated revolution as a client sends it.
#[divan::bench]
fn deviations_of_a_scan(bencher: Bencher) {
    let scan = Scan::from(&revolution());
    let mut series = RingSeries::default();
    bencher.counter(ItemsCount::new(scan.x.len())).bench_local(|| divan::black_box(series.deviations(&scan).len()));
}

/// Measures the road ahead in a sweep.
#[divan::bench]
fn road_measured_in_the_sweep(bencher: Bencher) {
    let sweep = sweep();
    let mut road = MeasuredRoad::default();
    bencher.counter(ItemsCount::new(sweep.x.len())).bench_local(|| divan::black_box(road.measure(&sweep)));
}

/// The same with a pose each 10 ms: it includes the motion and the transform of each firing.
#[divan::bench]
fn sweep_of_a_moving_revolution(bencher: Bencher) {
    let revolution = revolution();
    let mount = mount(1.9);
    let mut motion = Motion::new(&MotionConfig::default());
    for step in 0..=20 {
        let seconds = f64::from(step) * 0.01;
        let map_from_ego = nalgebra::Isometry3::new(
            nalgebra::vector![15.0 * seconds, 0.0, 0.0],
            nalgebra::vector![0.0, 0.0, 0.3 * seconds],
        );
        let stamp_ns = revolution.end_ns + i64::from(step - 15) * 10_000_000;
        motion.push_pose(&EgoPose { stamp_ns, map_from_ego, speed_mps: 15.0 }, 0);
    }
    let (mut sweep, mut moved) = (Sweep::default(), EgoTrajectory::default());
    let slots = revolution.echoes[0].range_m.len();
    bencher.counter(ItemsCount::new(slots)).bench_local(|| {
        motion.follow_revolution(&revolution, &mut moved);
        sweep.set_moving_revolution(&revolution, &mount, &moved.end_from_ego, None);
    });
}

#[divan::bench(args = [Variant::Grounded, Variant::Paper, Variant::Grid])]
fn terrain(bencher: Bencher, variant: Variant) {
    let sweep = sweep();
    let mut map = Terrain::new(&TerrainConfig { variant, ..TerrainConfig::default() });
    let mut layer = map.layer();
    bencher.counter(ItemsCount::new(sweep.x.len())).bench_local(|| map.make(&sweep, &Context::default(), &mut layer));
}

/// The same with roughness, from a simulated revolution, which has distance series.
#[divan::bench]
fn terrain_with_roughness(bencher: Bencher) {
    let (revolution, mount) = (revolution(), mount(1.9));
    let mut sweep = Sweep::default();
    sweep.set_revolution(&revolution, &mount);
    sweep.set_deviations(&revolution, &mut DistanceSeries::default(), 0.02);
    let mut map = Terrain::new(&TerrainConfig::default());
    let mut layer = map.layer();
    bencher.counter(ItemsCount::new(sweep.x.len())).bench_local(|| map.make(&sweep, &Context::default(), &mut layer));
}

#[divan::bench]
fn deviations_of_a_revolution(bencher: Bencher) {
    let revolution = revolution();
    let (mut sweep, mut series) = (Sweep::default(), DistanceSeries::default());
    sweep.set_revolution(&revolution, &mount(1.9));
    let slots = revolution.echoes[0].range_m.len();
    bencher.counter(ItemsCount::new(slots)).bench_local(|| sweep.set_deviations(&revolution, &mut series, 0.02));
}

/// With a road of 20 points, 6 m wide.
#[divan::bench]
fn speed(bencher: Bencher) {
    let sweep = sweep();
    let road = Road {
        stamp_ns: 0,
        purpose: RoadPurpose::Paint,
        frame: RoadFrame::Ego,
        points: (0..20).map(|i| [2.0 * f64::from(i), 0.05 * f64::from(i * i)]).collect(),
        widths_m: vec![6.0; 20],
        orientations: Vec::new(),
        speed_limits_mps: Vec::new(),
    };
    let taken = StoredRoad { road, map_from_ego: None };
    let mut map = Speed::new(&SpeedConfig::default());
    let mut layer = map.layer();
    let context = Context { road: Some(&taken), ..Context::default() };
    bencher.counter(ItemsCount::new(sweep.x.len())).bench_local(|| map.make(&sweep, &context, &mut layer));
}

#[divan::bench]
fn safe_path(bencher: Bencher) {
    let sweep = sweep();
    let mut drivability = Drivability::new(&DrivabilityConfig::default());
    let mut earlier = [drivability.layer()];
    drivability.make(&sweep, &Context::default(), &mut earlier[0]);
    let mut map = SafePath::new(&SafePathConfig::default());
    let mut layer = map.layer();
    let context = Context { earlier: &earlier, ..Context::default() };
    bencher.counter(ItemsCount::new(sweep.x.len())).bench_local(|| map.make(&sweep, &context, &mut layer));
}

/// Integrates one revolution of an HDL-64E, and makes the layer.
#[divan::bench(args = [OccupancyVariant::Polar, OccupancyVariant::Paper])]
fn occupancy_of_a_turn(bencher: Bencher, variant: OccupancyVariant) {
    let sweep = sweep();
    let mut map = Occupancy::new(&OccupancyConfig { variant, ..OccupancyConfig::default() });
    let mut layer = map.layer();
    bencher.counter(ItemsCount::new(sweep.x.len())).bench_local(|| {
        let origin_m = [0.0, 0.0, sweep.mount_height_m];
        let returns = &sweep;
        let (map_from_ego, speed_mps) = (Some(nalgebra::Isometry3::identity()), Some(0.0));
        map.integrate(&Rays {
            sensor: 0,
            stamp_ns: 0,
            returns,
            heights_m: &returns.z,
            origin_m,
            origin_height_m: origin_m[2],
            no_returns: &[],
            map_from_ego,
            speed_mps,
        });
        map.make(&sweep, &Context::default(), &mut layer);
    });
}
