//! Several sensors on one vehicle give one map, whatever one of them does. No sensor holds the maps back, and the map
//! names each sensor that does not contribute.

mod declared;
mod equal_stamps;
mod reference;
mod rotating;
mod scans;

use bytes::Bytes;
use clearway_lidar::calibration::Calibration;
use clearway_lidar::model::Model;
use clearway_mapping::config::{BodyConfig, Extrinsics, FusionConfig, SensorConfig, VehicleConfig};
use clearway_mapping::error::EventError;
use clearway_mapping::event::{Body, EgoPose, Event, Scan};
use clearway_mapping::ledger::Ledger;
use clearway_mapping::map::{Contribution, Map};
use clearway_mapping::pipeline::Pipeline;
use clearway_mapping::sensor::motion::Compensation;
use clearway_sim::scanner::ScannerConfig;
use clearway_sim::scenes;
use clearway_sim::vehicle::SimulatedVehicle;
use nalgebra::{Isometry3, Vector3};

use crate::common;

const MS: i64 = 1_000_000;

fn at(x_m: f64, y_m: f64, z_m: f64, yaw_deg: f64) -> Extrinsics {
    Extrinsics { x_m, y_m, z_m, roll_deg: 0.0, pitch_deg: 0.0, yaw_deg }
}

/// A vehicle with a sensor on the roof and one on each side.
fn config() -> VehicleConfig {
    let scanning = |name: &str, extrinsics| SensorConfig { range_m_min: 0.0, ..SensorConfig::new(name, extrinsics) };
    let roof = SensorConfig { model: Some(Model::Vlp16), ..scanning("top", at(0.0, 0.0, 1.9, 0.0)) };
    VehicleConfig::new(
        "car",
        vec![roof, scanning("left", at(0.0, 1.0, 1.0, 90.0)), scanning("right", at(0.0, -1.0, 1.0, -90.0))],
    )
}

fn pipeline(config: &VehicleConfig) -> Pipeline {
    Pipeline::new(config, vec![None; config.sensors.len()]).unwrap()
}

fn event(source: u16, arrival_ns: i64, body: Body) -> Event {
    Event { sequence: 0, arrival_ns, source, body }
}

/// A scan with a point ahead of the sensor at each of these distances, `z_m` above it.
fn ahead(stamp_ns: i64, distances_m: &[f32], z_m: f32) -> Scan {
    let points = distances_m.len();
    Scan {
        stamp_ns,
        x: distances_m.to_vec(),
        y: vec![0.25; points],
        z: vec![z_m; points],
        intensity: vec![0.5; points],
        ..Scan::default()
    }
}

/// A scan of sensor `source` that arrives when it ends, with points on the ground 5 and 6 m ahead.
fn scan(source: u16, stamp_ns: i64) -> Event {
    let z_m = if source == 0 { -1.9 } else { -1.0 };
    event(source, stamp_ns, Body::Scan(ahead(stamp_ns, &[5.0, 6.0], z_m)))
}

fn step(pipeline: &mut Pipeline, event: &Event) -> Option<Map> {
    pipeline.step(event).unwrap().cloned()
}

fn contributions(map: &Map) -> Vec<(Contribution, Option<i64>)> {
    map.sensors.iter().map(|sensor| (sensor.contribution, sensor.age_ms.map(|ms| ms.round() as i64))).collect()
}

fn balanced(ledger: &Ledger) -> bool {
    ledger.received == ledger.decoded + ledger.telemetry + ledger.refused.values().sum::<u64>()
}

#[test]
fn the_reference_sensors_scan_makes_the_map_and_the_others_contribute() {
    let mut pipeline = pipeline(&config());
    assert_eq!(step(&mut pipeline, &scan(1, 10 * MS)), None);
    assert_eq!(step(&mut pipeline, &scan(1, 60 * MS)), None);
    let map = step(&mut pipeline, &scan(0, 100 * MS)).unwrap();
    assert_eq!((map.source, map.capture_start_ns, map.capture_end_ns), (0, 60 * MS, 100 * MS));
    assert_eq!(
        contributions(&map),
        [(Contribution::Ok, Some(0)), (Contribution::Ok, Some(40)), (Contribution::Silent, None)]
    );
    assert_eq!(map.sensors.iter().map(|sensor| sensor.returns).collect::<Vec<_>>(), [2, 2, 0]);
    assert_eq!(map.sensors[1].completeness, 1.0, "a scan that covers less than 360 degrees is complete");
    let sweep = pipeline.newest_sweep();
    // The left sensor points to the left: 5 m ahead of it is 6 m to the left of the ego origin.
    assert_eq!(sweep.x.len(), 4);
    assert!((sweep.y[2] - 6.0).abs() < 1e-5 && (sweep.x[2] + 0.25).abs() < 1e-5 && sweep.z[2].abs() < 1e-5);
}

#[test]
fn a_sensor_that_stops_is_left_out_after_the_deadline() {
    let mut pipeline = pipeline(&config());
    step(&mut pipeline, &scan(1, 10 * MS));
    let made: Vec<_> = (1..5).map(|n| step(&mut pipeline, &scan(0, n * 100 * MS)).unwrap()).collect();
    let left: Vec<_> = made.iter().map(|map| contributions(map)[1]).collect();
    assert_eq!(
        left,
        [
            (Contribution::Ok, Some(90)),
            (Contribution::Ok, Some(190)),
            (Contribution::Silent, Some(290)),
            (Contribution::Silent, Some(390))
        ]
    );
    assert_eq!(made[2].sensors[1].returns, 0, "no point of the sensor is in the map");
    assert_eq!(pipeline.newest_sweep().x.len(), 2);
}

#[test]
fn another_sensor_replaces_a_reference_sensor_that_stops() {
    let mut pipeline = pipeline(&config());
    let mut made = Vec::new();
    for n in 1..20 {
        // The reference sensor is silent from 250 ms to 1250 ms; the others go on.
        let stamp_ns = n * 100 * MS;
        if !(3..=12).contains(&n) {
            made.extend(step(&mut pipeline, &scan(0, stamp_ns)));
        }
        for source in [1, 2] {
            made.extend(step(&mut pipeline, &scan(source, stamp_ns + i64::from(source) * MS)));
        }
    }
    let gaps: Vec<i64> = made.windows(2).map(|pair| pair[1].completed_ns - pair[0].completed_ns).collect();
    assert!(gaps.iter().all(|gap_ns| *gap_ns <= 301 * MS), "at most the deadline and one scan: {gaps:?}");
    let sources: Vec<u16> = made.iter().map(|map| map.source).collect();
    assert_eq!(sources[..3], [0, 0, 1], "the next sensor in order is the source");
    let back = made.iter().find(|map| map.capture_end_ns == 1300 * MS).unwrap();
    assert_eq!(back.source, 0);
    assert!(made.iter().filter(|map| map.capture_end_ns > 1300 * MS).all(|map| map.source == 0));
    let alone = made.iter().find(|map| map.source == 1 && map.capture_end_ns > 500 * MS).unwrap();
    assert_eq!(contributions(alone)[0].0, Contribution::Silent);
    // One scan makes each map: ten scans of the reference sensor are missing, and at most one scan replaces each.
    assert!((17..=19).contains(&made.len()), "{}", made.len());
}

#[test]
fn the_rows_of_radial_maps_are_those_of_the_reference_sensor() {
    let mut coarse = config();
    // For this sensor alone the ground is two rows.
    coarse.sensors[1].elevations_deg = vec![-10.0, -5.0];
    let rows = |pipeline: &mut Pipeline, event: &Event| {
        let map = step(pipeline, event)?;
        Some((map.source, common::ring_benches(&map.layers[0]).to_vec()))
    };
    let mut alone = pipeline(&coarse);
    assert_eq!(rows(&mut alone, &scan(1, 10 * MS)), None);
    assert_eq!(rows(&mut alone, &scan(1, 300 * MS)).map(|(source, rows)| (source, rows.len())), Some((1, 2)));
    let mut pipeline = pipeline(&coarse);
    let (_, reference_rows) = rows(&mut pipeline, &scan(0, 100 * MS)).unwrap();
    assert!(reference_rows.len() > 4);
    let replaced = (1..6).find_map(|n| rows(&mut pipeline, &scan(1, (n + 1) * 100 * MS)));
    assert_eq!(replaced, Some((1, reference_rows)));
}

#[test]
fn a_reference_sensor_whose_clock_is_wrong_is_replaced() {
    for (name, off_ns, contribution) in [
        ("lags", -700 * MS, Contribution::Late),
        ("jumps ahead", 3_600_000 * MS, Contribution::Ahead),
        ("jumps back", -3_600_000 * MS, Contribution::Late),
    ] {
        let mut pipeline = pipeline(&config());
        let start_ns = 1_700_000_000_000 * MS;
        let mut made = Vec::new();
        for n in 0..12 {
            let stamp_ns = start_ns + n * 100 * MS;
            made.extend(step(&mut pipeline, &scan(1, stamp_ns - MS)));
            let off_ns = if n < 4 { 0 } else { off_ns };
            let reference = event(0, stamp_ns, Body::Scan(ahead(stamp_ns + off_ns, &[5.0], -1.9)));
            // A stamp before the newest one is refused until the deadline has passed.
            made.extend(pipeline.step(&reference).ok().flatten().cloned());
        }
        let gaps = made.windows(2).map(|pair| pair[1].completed_ns - pair[0].completed_ns);
        assert!(gaps.max().unwrap() <= 300 * MS, "{name}");
        let last = made.last().unwrap();
        assert_eq!(last.source, 1, "{name}");
        assert_eq!(last.sensors[0].contribution, contribution, "{name}");
        let age_ms = last.sensors[0].age_ms.unwrap();
        assert!((f64::from(age_ms) + off_ns as f64 / MS as f64 - 99.0).abs() < 1.0, "{name}: {age_ms}");
        assert!(made.windows(2).all(|pair| pair[0].capture_end_ns < pair[1].capture_end_ns), "{name}: the stamps rise");
    }
}

#[test]
fn a_sensor_that_replaces_the_reference_makes_no_map_older_than_the_newest() {
    let mut pipeline = pipeline(&config());
    assert!(step(&mut pipeline, &scan(0, 1_000 * MS)).is_some());
    // The reference sensor stops; the scans of the other one arrive 320 ms after their ends.
    let late = |stamp_ms: i64| {
        let scan = event(1, (stamp_ms + 320) * MS, Body::Scan(ahead(stamp_ms * MS, &[5.0], -1.0)));
        step(&mut pipeline, &scan).map(|map| map.capture_end_ns / MS)
    };
    assert_eq!([980, 1_000, 1_020].map(late), [None, None, Some(1_020)]);
}

#[test]
fn scans_with_older_stamps_are_accepted_after_the_deadline() {
    let mut pipeline = pipeline(&config());
    step(&mut pipeline, &scan(1, 5_000 * MS));
    let restarted = |arrival_ms: i64| event(1, arrival_ms * MS, Body::Scan(ahead(arrival_ms, &[5.0], -1.0)));
    let refused = pipeline.step(&restarted(5_100)).unwrap_err();
    assert_eq!(refused, EventError::Stamp { stamp_ns: 5_100, newest_ns: 5_000 * MS });
    pipeline.step(&restarted(5_300)).unwrap();
    pipeline.step(&restarted(5_400)).unwrap();
    // A repeated scan is always refused.
    let again = event(1, 9_000 * MS, restarted(5_400).body);
    assert_eq!(pipeline.step(&again).unwrap_err().reason(), "stamp");
    assert_eq!(pipeline.sensors()[1].ledger.refused, [("stamp", 2)].into());
}

#[test]
fn a_host_clock_set_back_does_not_hold_back_the_maps_of_another_sensor() {
    let mut pipeline = pipeline(&config());
    let hour_ns = 3_600_000 * MS;
    assert!((0..5).all(|n| step(&mut pipeline, &scan(0, hour_ns + n * 100 * MS)).is_some()));
    // The reference sensor stops as the clock is set; stamps and arrivals of the other one agree.
    let made = (0..10).filter_map(|n| step(&mut pipeline, &scan(1, n * 100 * MS))).count();
    assert!((6..=9).contains(&made), "{made} maps in 1 s: none until the deadline, then one a scan");
}

#[test]
fn a_fast_reference_sensor_makes_one_map_a_period() {
    let fusion = FusionConfig { period_ms: 100, ..FusionConfig::default() };
    let mut pipeline = pipeline(&VehicleConfig { fusion, ..config() });
    // 50 Hz with 2 ms of jitter.
    let stamps = (1..51).map(|n: i64| n * 20 * MS + (n * 7 % 5 - 2) * MS);
    let made: Vec<Map> = stamps.filter_map(|stamp_ns| step(&mut pipeline, &scan(0, stamp_ns))).collect();
    assert!((10..=11).contains(&made.len()), "{}", made.len());
}

#[test]
fn the_configured_reference_sensor_makes_the_maps() {
    let mut config = config();
    config.fusion.reference_sensor = "right".into();
    let mut pipeline = pipeline(&config);
    assert_eq!(step(&mut pipeline, &scan(0, 10 * MS)), None);
    assert_eq!(step(&mut pipeline, &scan(2, 20 * MS)).unwrap().source, 2);
}

#[test]
fn older_scans_are_propagated_to_the_maps_stamp_by_poses_or_speed() {
    const SECOND: i64 = 1000 * MS;
    let pose = |ms: i64, x: f64| {
        let map_from_ego = Isometry3::new(Vector3::new(x, 0.0, 0.0), Vector3::zeros());
        event(0, SECOND + ms * MS, Body::EgoPose(EgoPose { stamp_ns: SECOND + ms * MS, map_from_ego, speed_mps: 20.0 }))
    };
    let post_x = |pipeline: &mut Pipeline| {
        // A post at x = 10 m in the world, 5 m to the left. The left sensor sees it at 40 ms, from x = 0.8 m.
        let post = Scan {
            x: vec![4.0],
            y: vec![-9.2],
            z: vec![0.0],
            intensity: vec![0.0],
            ..ahead(SECOND + 40 * MS, &[], 0.0)
        };
        pipeline.step(&event(1, SECOND + 40 * MS, Body::Scan(post))).unwrap();
        let map = step(pipeline, &scan(0, SECOND + 100 * MS)).unwrap();
        (map.compensation, pipeline.newest_sweep().x[2])
    };
    let mut driven = pipeline(&config());
    for n in 0..=12 {
        step(&mut driven, &pose(n * 10, 0.2 * n as f64));
    }
    let (_, x) = post_x(&mut driven);
    assert!((x - 8.0).abs() < 1e-4, "10 m minus the 2 m driven: {x}");
    let mut with_speed = pipeline(&config());
    step(&mut with_speed, &pose(-900, 0.0));
    let (_, x) = post_x(&mut with_speed);
    assert!((x - 8.0).abs() < 1e-4, "at 20 m/s for 60 ms: {x}");
    let (compensation, x) = post_x(&mut pipeline(&config()));
    assert_eq!(compensation, Compensation::None);
    assert!((x - 9.2).abs() < 1e-4, "without motion the point stays: {x}");
}

/// Datagrams of the sensor of a standing simulated vehicle, for `until_ms` milliseconds.
fn velodyne(model: Model, height_m: f64, until_ms: i64) -> Vec<Event> {
    let ego_from_sensor = Isometry3::translation(0.0, 0.0, height_m);
    let vehicle = SimulatedVehicle::new(scenes::flat(), ScannerConfig { model, ego_from_sensor, ..Default::default() });
    let until_ns = vehicle.start_ns() + until_ms * MS;
    let datagrams = vehicle.take_while(|datagram| datagram.stamp_ns < until_ns);
    datagrams.map(|datagram| event(0, datagram.stamp_ns, Body::Datagram(Bytes::from(datagram.payload)))).collect()
}
