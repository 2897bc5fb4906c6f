//! Several sensors on one vehicle: one map of them all, whatever one of them does; nothing held, nothing unnamed.

#[path = "../common/mod.rs"]
mod common;
mod declared;
mod scans;
mod turning;

use bytes::Bytes;
use clearway_lidar::calibration::Calibration;
use clearway_lidar::model::Model;
use clearway_mapping::config::{BodyConfig, Extrinsics, FusionConfig, SensorConfig, VehicleConfig};
use clearway_mapping::error::EventError;
use clearway_mapping::event::{Body, EgoPose, Event, Scan};
use clearway_mapping::map::{Contribution, Map};
use clearway_mapping::sensor::motion::Compensation;
use clearway_mapping::ledger::Ledger;
use clearway_mapping::pipeline::Pipeline;
use clearway_sim::scanner::ScannerConfig;
use clearway_sim::scenes;
use clearway_sim::vehicle::SimulatedVehicle;
use nalgebra::{Isometry3, Vector3};

const MS: i64 = 1_000_000;

fn at(x_m: f64, y_m: f64, z_m: f64, yaw_deg: f64) -> Extrinsics {
    Extrinsics { x_m, y_m, z_m, roll_deg: 0.0, pitch_deg: 0.0, yaw_deg }
}

/// A roof sensor and one on each side.
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

/// Points ahead of the sensor at each of these distances, so high over it.
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

/// A scan of sensor `source` that ends when it arrives, 5 m ahead of it on the ground.
fn scan(source: u16, stamp_ns: i64) -> Event {
    let z_m = if source == 0 { -1.9 } else { -1.0 };
    event(source, stamp_ns, Body::Scan(ahead(stamp_ns, &[5.0, 6.0], z_m)))
}

fn step(pipeline: &mut Pipeline, event: &Event) -> Option<Map> {
    pipeline.step(event).unwrap().cloned()
}

fn parts(map: &Map) -> Vec<(Contribution, Option<i64>)> {
    map.sensors.iter().map(|sensor| (sensor.contribution, sensor.age_ms.map(|ms| ms.round() as i64))).collect()
}

fn balanced(ledger: &Ledger) -> bool {
    ledger.received == ledger.decoded + ledger.telemetry + ledger.refused.values().sum::<u64>()
}

#[test]
fn the_leads_scan_makes_the_map_and_the_others_bring_their_newest() {
    let mut pipeline = pipeline(&config());
    assert_eq!(step(&mut pipeline, &scan(1, 10 * MS)), None);
    assert_eq!(step(&mut pipeline, &scan(1, 60 * MS)), None);
    let map = step(&mut pipeline, &scan(0, 100 * MS)).unwrap();
    assert_eq!((map.source, map.capture_start_ns, map.capture_end_ns), (0, 60 * MS, 100 * MS));
    assert_eq!(parts(&map), [(Contribution::Ok, Some(0)), (Contribution::Ok, Some(40)), (Contribution::Silent, None)]);
    assert_eq!(map.sensors.iter().map(|sensor| sensor.returns).collect::<Vec<_>>(), [2, 2, 0]);
    assert_eq!(map.sensors[1].completeness, 1.0, "a field of view is no loss");
    let sweep = pipeline.newest_sweep();
    // The left one looks to the left: its 5 m ahead are 6 m to the left of the vehicle.
    assert_eq!(sweep.x.len(), 4);
    assert!((sweep.y[2] - 6.0).abs() < 1e-5 && (sweep.x[2] + 0.25).abs() < 1e-5 && sweep.z[2].abs() < 1e-5);
}

#[test]
fn a_sensor_that_stops_is_left_out_after_the_deadline_and_named_with_its_age() {
    let mut pipeline = pipeline(&config());
    step(&mut pipeline, &scan(1, 10 * MS));
    let made: Vec<_> = (1..5).map(|n| step(&mut pipeline, &scan(0, n * 100 * MS)).unwrap()).collect();
    let left: Vec<_> = made.iter().map(|map| parts(map)[1]).collect();
    assert_eq!(
        left,
        [(Contribution::Ok, Some(90)), (Contribution::Ok, Some(190)), (Contribution::Silent, Some(290)), (Contribution::Silent, Some(390))]
    );
    assert_eq!(made[2].sensors[1].returns, 0, "nothing of it is in the map");
    assert_eq!(pipeline.newest_sweep().x.len(), 2);
}

#[test]
fn a_lead_that_stops_never_holds_the_map_and_leads_again_when_it_is_back() {
    let mut pipeline = pipeline(&config());
    let mut made = Vec::new();
    for n in 1..20 {
        // The lead is away from 250 ms to 1250 ms; the others scan on.
        let stamp_ns = n * 100 * MS;
        if !(3..=12).contains(&n) {
            made.extend(step(&mut pipeline, &scan(0, stamp_ns)));
        }
        for source in [1, 2] {
            made.extend(step(&mut pipeline, &scan(source, stamp_ns + i64::from(source) * MS)));
        }
    }
    let away: Vec<i64> = made.windows(2).map(|pair| pair[1].completed_ns - pair[0].completed_ns).collect();
    assert!(away.iter().all(|gap_ns| *gap_ns <= 301 * MS), "deadline and one turn: {away:?}");
    let makers: Vec<u16> = made.iter().map(|map| map.source).collect();
    assert_eq!(makers[..3], [0, 0, 1], "the next in order stands in");
    let back = made.iter().find(|map| map.capture_end_ns == 1300 * MS).unwrap();
    assert_eq!(back.source, 0);
    assert!(made.iter().filter(|map| map.capture_end_ns > 1300 * MS).all(|map| map.source == 0));
    let alone = made.iter().find(|map| map.source == 1 && map.capture_end_ns > 500 * MS).unwrap();
    assert_eq!(parts(alone)[0].0, Contribution::Silent);
    // One sensor's turn makes each map: ten of the lead's are missing, and no two stand in for one of them.
    assert!((17..=19).contains(&made.len()), "{}", made.len());
}

#[test]
fn the_rows_of_radial_maps_stay_the_leads_whoever_makes_the_map() {
    let mut coarse = config();
    // To this one alone all the ground is one row.
    coarse.sensors[1].elevations_deg = vec![-5.0];
    let rows = |pipeline: &mut Pipeline, event: &Event| {
        let map = step(pipeline, event)?;
        Some((map.source, common::benches(&map.layers[0]).to_vec()))
    };
    let mut alone = pipeline(&coarse);
    assert_eq!(rows(&mut alone, &scan(1, 10 * MS)), None);
    assert_eq!(rows(&mut alone, &scan(1, 300 * MS)).map(|(maker, rows)| (maker, rows.len())), Some((1, 1)));
    let mut pipeline = pipeline(&coarse);
    let (_, of_lead) = rows(&mut pipeline, &scan(0, 100 * MS)).unwrap();
    assert!(of_lead.len() > 4);
    let stands_in = (1..6).find_map(|n| rows(&mut pipeline, &scan(1, (n + 1) * 100 * MS)));
    assert_eq!(stands_in, Some((1, of_lead)));
}

#[test]
fn a_lead_that_lags_or_jumps_does_not_lead_and_is_named_with_its_age() {
    for (name, off_ns, part) in [
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
            let lead = event(0, stamp_ns, Body::Scan(ahead(stamp_ns + off_ns, &[5.0], -1.9)));
            // A stamp before the newest one is refused until the deadline has passed: it could be a repeated scan.
            made.extend(pipeline.step(&lead).ok().flatten().cloned());
        }
        let gaps = made.windows(2).map(|pair| pair[1].completed_ns - pair[0].completed_ns);
        assert!(gaps.max().unwrap() <= 300 * MS, "{name}");
        let last = made.last().unwrap();
        assert_eq!(last.source, 1, "{name}");
        assert_eq!(last.sensors[0].contribution, part, "{name}");
        let age_ms = last.sensors[0].age_ms.unwrap();
        assert!((f64::from(age_ms) + off_ns as f64 / MS as f64 - 99.0).abs() < 1.0, "{name}: {age_ms}");
        assert!(made.windows(2).all(|pair| pair[0].capture_end_ns < pair[1].capture_end_ns), "{name}: stamps rise");
    }
}

#[test]
fn a_sensor_that_restarts_with_an_older_clock_is_taken_again_after_the_deadline() {
    let mut pipeline = pipeline(&config());
    step(&mut pipeline, &scan(1, 5_000 * MS));
    let restarted = |arrival_ms: i64| event(1, arrival_ms * MS, Body::Scan(ahead(arrival_ms, &[5.0], -1.0)));
    let refused = pipeline.step(&restarted(5_100)).unwrap_err();
    assert_eq!(refused, EventError::Stamp { stamp_ns: 5_100, newest_ns: 5_000 * MS });
    pipeline.step(&restarted(5_300)).unwrap();
    pipeline.step(&restarted(5_400)).unwrap();
    // The very scan again is refused at any time.
    let again = event(1, 9_000 * MS, restarted(5_400).body);
    assert_eq!(pipeline.step(&again).unwrap_err().reason(), "stamp");
    assert_eq!(pipeline.sensors()[1].ledger.refused, [("stamp", 2)].into());
}

#[test]
fn a_fast_lead_makes_a_map_a_period() {
    let fusion = FusionConfig { period_ms: 100, ..FusionConfig::default() };
    let mut pipeline = pipeline(&VehicleConfig { fusion, ..config() });
    // 50 Hz with 2 ms of jitter.
    let stamps = (1..51).map(|n: i64| n * 20 * MS + (n * 7 % 5 - 2) * MS);
    let made: Vec<Map> = stamps.filter_map(|stamp_ns| step(&mut pipeline, &scan(0, stamp_ns))).collect();
    assert!((10..=11).contains(&made.len()), "{}", made.len());
}

#[test]
fn the_configured_lead_leads() {
    let mut config = config();
    config.fusion.reference_sensor = "right".into();
    let mut pipeline = pipeline(&config);
    assert_eq!(step(&mut pipeline, &scan(0, 10 * MS)), None);
    assert_eq!(step(&mut pipeline, &scan(2, 20 * MS)).unwrap().source, 2);
}

#[test]
fn older_turns_are_carried_to_the_maps_stamp_by_the_poses_or_the_speed() {
    const SECOND: i64 = 1000 * MS;
    let pose = |ms: i64, x: f64| {
        let map_from_ego = Isometry3::new(Vector3::new(x, 0.0, 0.0), Vector3::zeros());
        event(0, SECOND + ms * MS, Body::EgoPose(EgoPose { stamp_ns: SECOND + ms * MS, map_from_ego, speed_mps: 20.0 }))
    };
    let wall = |pipeline: &mut Pipeline| {
        // A post at x = 10 in the world, 5 m to the left: seen by the left one at 40 ms, from x = 0.8.
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
    let (_, x) = wall(&mut driven);
    assert!((x - 8.0).abs() < 1e-4, "10 m less the 2 m driven: {x}");
    let mut told = pipeline(&config());
    step(&mut told, &pose(-900, 0.0));
    let (_, x) = wall(&mut told);
    assert!((x - 8.0).abs() < 1e-4, "at 20 m/s for 60 ms: {x}");
    let (compensation, x) = wall(&mut pipeline(&config()));
    assert_eq!(compensation, Compensation::None);
    assert!((x - 9.2).abs() < 1e-4, "nobody knows: {x}");
}

/// Datagrams of a standing simulated vehicle's sensor, so many milliseconds.
fn velodyne(model: Model, height_m: f64, until_ms: i64) -> Vec<Event> {
    let ego_from_sensor = Isometry3::translation(0.0, 0.0, height_m);
    let vehicle = SimulatedVehicle::new(scenes::flat(), ScannerConfig { model, ego_from_sensor, ..Default::default() });
    let until_ns = vehicle.start_ns() + until_ms * MS;
    let datagrams = vehicle.take_while(|datagram| datagram.stamp_ns < until_ns);
    datagrams.map(|datagram| event(0, datagram.stamp_ns, Body::Datagram(Bytes::from(datagram.payload)))).collect()
}
