//! Several sensors on one vehicle: one map of them all, whatever one of them does; nothing held, nothing unnamed.

mod common;

use bytes::Bytes;
use clearway_lidar::calibration::Calibration;
use clearway_lidar::model::Model;
use clearway_mapping::config::{BodyConfig, Extrinsics, FusionConfig, SensorConfig, VehicleConfig};
use clearway_mapping::event::{Body, EgoPose, Event, Scan};
use clearway_mapping::map::{Map, Part};
use clearway_mapping::motion::Compensation;
use clearway_mapping::pipeline::{Ledger, Pipeline, Rejected};
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

fn parts(map: &Map) -> Vec<(Part, Option<i64>)> {
    map.sensors.iter().map(|sensor| (sensor.state, sensor.age_ms.map(|ms| ms.round() as i64))).collect()
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
    assert_eq!((map.made_by, map.capture_start_ns, map.capture_end_ns), (0, 60 * MS, 100 * MS));
    assert_eq!(parts(&map), [(Part::Ok, Some(0)), (Part::Ok, Some(40)), (Part::Silent, None)]);
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
        [(Part::Ok, Some(90)), (Part::Ok, Some(190)), (Part::Silent, Some(290)), (Part::Silent, Some(390))]
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
    let makers: Vec<u16> = made.iter().map(|map| map.made_by).collect();
    assert_eq!(makers[..3], [0, 0, 1], "the next in order stands in");
    let back = made.iter().find(|map| map.capture_end_ns == 1300 * MS).unwrap();
    assert_eq!(back.made_by, 0);
    assert!(made.iter().filter(|map| map.capture_end_ns > 1300 * MS).all(|map| map.made_by == 0));
    let alone = made.iter().find(|map| map.made_by == 1 && map.capture_end_ns > 500 * MS).unwrap();
    assert_eq!(parts(alone)[0].0, Part::Silent);
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
        Some((map.made_by, common::benches(&map.layers[0]).to_vec()))
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
        ("lags", -700 * MS, Part::Late),
        ("jumps ahead", 3_600_000 * MS, Part::Ahead),
        ("jumps back", -3_600_000 * MS, Part::Late),
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
        assert_eq!(last.made_by, 1, "{name}");
        assert_eq!(last.sensors[0].state, part, "{name}");
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
    assert_eq!(refused, Rejected::Stamp { stamp_ns: 5_100, newest_ns: 5_000 * MS });
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
    config.fusion.lead = "right".into();
    let mut pipeline = pipeline(&config);
    assert_eq!(step(&mut pipeline, &scan(0, 10 * MS)), None);
    assert_eq!(step(&mut pipeline, &scan(2, 20 * MS)).unwrap().made_by, 2);
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

#[test]
fn a_scans_points_are_moved_from_when_each_was_seen() {
    let mut pipeline = pipeline(&config());
    for n in 0..=10 {
        let map_from_ego = Isometry3::new(Vector3::new(0.15 * f64::from(n), 0.0, 0.0), Vector3::zeros());
        let pose = EgoPose { stamp_ns: i64::from(n) * 10 * MS, map_from_ego, speed_mps: 15.0 };
        step(&mut pipeline, &event(0, pose.stamp_ns, Body::EgoPose(pose.clone())));
    }
    // A wall 30 m ahead in the world, seen in no order at all while the vehicle drives 1.5 m towards it.
    let offsets: Vec<i32> = (0..500).map(|i| -(i * 7919 % 500) * 200_000).collect();
    let seen_at = |offset: &i32| 15.0 * (0.1 + *offset as f32 * 1e-9);
    let wall = Scan {
        x: offsets.iter().map(|offset| 30.0 - seen_at(offset)).collect(),
        y: (0..500).map(|i| 0.02 * (i - 250) as f32).collect(),
        z: vec![-1.0; 500],
        intensity: vec![0.0; 500],
        offset_ns: offsets,
        ..ahead(100 * MS, &[], 0.0)
    };
    let map = step(&mut pipeline, &event(0, 101 * MS, Body::Scan(wall.clone()))).unwrap();
    assert_eq!(map.compensation, Compensation::Poses);
    assert_eq!(map.capture_start_ns, 100 * MS - 99_800_000);
    let sweep = pipeline.newest_sweep();
    assert!(sweep.x.iter().all(|x| (x - 28.5).abs() < 1e-3), "{:?}", &sweep.x[..5]);

    let refused = |change: &dyn Fn(&mut Scan)| {
        let mut scan = Scan { stamp_ns: 300 * MS, ..wall.clone() };
        change(&mut scan);
        super_step(scan)
    };
    assert_eq!(
        refused(&|scan| scan.offset_ns.truncate(3)),
        "scan of 500 points with 3 offset_ns: none or one a point is allowed"
    );
    assert_eq!(
        refused(&|scan| scan.ring = vec![0; 501]),
        "scan of 500 points with 501 ring: none or one a point is allowed"
    );
    assert_eq!(refused(&|scan| scan.offset_ns[9] = 5), "scan with a point 5 ns after its stamp: at most 0 is allowed");
    let direction = refused(&|scan| scan.no_returns = vec![[1.0, 0.0, 0.0], [f32::NAN, 0.0, 1.0]]);
    assert_eq!(direction, "scan with the no-return direction [NaN, 0.0, 1.0]: a unit vector is allowed");
}

/// What the core says to a scan of the lead.
fn super_step(scan: Scan) -> String {
    let mut pipeline = pipeline(&config());
    let refused = pipeline.step(&event(0, 1, Body::Scan(scan))).unwrap_err();
    assert!(balanced(pipeline.ledger()) && pipeline.ledger().refused[refused.reason()] == 1);
    refused.to_string()
}

#[test]
fn rows_come_from_the_configured_elevations_or_the_scans_rings_and_without_either_radial_maps_are_unknown() {
    let ground = |shuffled: bool| {
        let mut order: Vec<usize> = (0..720 * 8).collect();
        if shuffled {
            order.reverse();
        }
        let angle = |i: usize| (i % 720) as f32 * std::f32::consts::TAU / 720.0;
        let radius = |i: usize| 1.9 / (0.05 + 0.03 * (7 - i / 720) as f32);
        let points = |value: &dyn Fn(usize) -> f32| order.iter().map(|i| value(*i)).collect::<Vec<f32>>();
        Scan {
            x: points(&|i| radius(i) * angle(i).cos()),
            y: points(&|i| radius(i) * angle(i).sin()),
            z: points(&|_| -1.9),
            intensity: points(&|_| 0.5),
            ring: order.iter().map(|i| (i / 720) as u16).collect(),
            ..ahead(MS, &[], 0.0)
        }
    };
    let elevations_deg: Vec<f32> = (0..8).map(|ring| -(0.05f32 + 0.03 * ring as f32).atan().to_degrees()).collect();
    let map = |elevations_deg: Vec<f32>, scan: Scan| {
        let sensor = SensorConfig { elevations_deg, ..SensorConfig::new("top", at(0.0, 0.0, 1.9, 0.0)) };
        let mut pipeline = pipeline(&VehicleConfig::new("car", vec![sensor]));
        step(&mut pipeline, &event(0, MS, Body::Scan(scan))).unwrap()
    };
    let measured = map(Vec::new(), ground(false));
    assert_eq!(common::benches(&measured.layers[0]).len(), 8);
    assert!(common::figure(&measured.layers[0], "drivable_share") > 0.95);
    assert_eq!(map(Vec::new(), ground(true)).layers, measured.layers, "whatever the order of the points");
    let configured = map(elevations_deg, Scan { ring: Vec::new(), ..ground(false) });
    for (a, b) in common::benches(&configured.layers[0]).iter().zip(common::benches(&measured.layers[0])) {
        assert!((a - b).abs() < 1e-2, "{a} {b}");
    }
    let nobody = map(Vec::new(), Scan { ring: Vec::new(), ..ground(false) });
    for layer in &nobody.layers[..2] {
        assert!(common::classes(layer).iter().all(|class| *class == 0), "{}", layer.name);
    }
    assert!(
        common::classes(&nobody.layers[2]).iter().any(|class| *class != 0),
        "{} needs no rows",
        nobody.layers[2].name
    );
    // A sensor without rings that leads takes the rows of one that has them.
    let mut two = config();
    two.sensors[0].model = None;
    let mut pipeline = pipeline(&two);
    step(&mut pipeline, &event(1, MS, Body::Scan(ground(false))));
    let fused = step(&mut pipeline, &scan(0, 2 * MS)).unwrap();
    assert!(common::classes(&fused.layers[0]).iter().any(|class| *class != 0));
}

#[test]
fn what_the_vehicle_hides_is_left_out_and_counted_by_sensor() {
    let mut config = config();
    config.body = Some(BodyConfig { x_m_min: -1.0, x_m_max: 3.5, y_m_min: -0.95, y_m_max: 0.95, z_m_max: 1.6 });
    let mut pipeline = pipeline(&config);
    // The left one sees its own door, the ground beside, and through the vehicle to the other side.
    let left = Scan {
        x: vec![-0.5, 5.0, -8.0],
        y: vec![0.0; 3],
        z: vec![0.0, -1.0, -0.5],
        intensity: vec![0.0; 3],
        ..ahead(10 * MS, &[], 0.0)
    };
    pipeline.step(&event(1, 10 * MS, Body::Scan(left))).unwrap();
    let map = step(&mut pipeline, &scan(0, 20 * MS)).unwrap();
    assert_eq!(map.sensors[1].returns, 3, "they are returns all the same");
    assert_eq!(pipeline.newest_sweep().x.len(), 1, "and the bonnet hides the lead's");
    let sensors = pipeline.sensors();
    let hidden: Vec<_> = sensors.iter().map(|s| (s.ledger.own_body, s.ledger.through_body)).collect();
    assert_eq!(hidden, [(0, 2), (1, 1), (0, 0)]);
    assert_eq!((pipeline.ledger().own_body, pipeline.ledger().through_body), (1, 3));

    // A turning sensor over a flat street: what the box hides is gone, the rest is as without a box, series and all.
    let datagrams = velodyne(Model::Vlp16, 1.9, 260);
    let mut alone = VehicleConfig::new("car", vec![SensorConfig { range_m_min: 0.0, ..config.sensors[0].clone() }]);
    let sweep = |config: &VehicleConfig| {
        let mut pipeline = Pipeline::new(config, vec![None]).unwrap();
        let made = datagrams.iter().filter_map(|event| step(&mut pipeline, event)).count();
        assert!(made >= 2);
        (pipeline.newest_sweep().clone(), pipeline.ledger().clone())
    };
    let (open, none) = sweep(&alone);
    alone.body = Some(BodyConfig { x_m_min: -1.0, x_m_max: 3.5, y_m_min: -0.95, y_m_max: 0.95, z_m_max: 1.85 });
    let (boxed, ledger) = sweep(&alone);
    assert_eq!((none.own_body, none.through_body), (0, 0));
    assert!(ledger.through_body > 1000, "the roof hides the ground before the bonnet: {ledger:?}");
    assert!(boxed.x.len() < open.x.len() && boxed.deviation_m.len() == boxed.x.len());
    assert_eq!(boxed.returns, open.returns);
}

/// Datagrams of a standing simulated vehicle's sensor, so many milliseconds.
fn velodyne(model: Model, height_m: f64, until_ms: i64) -> Vec<Event> {
    let ego_from_sensor = Isometry3::translation(0.0, 0.0, height_m);
    let vehicle = SimulatedVehicle::new(scenes::flat(), ScannerConfig { model, ego_from_sensor, ..Default::default() });
    let until_ns = vehicle.start_ns() + until_ms * MS;
    let datagrams = vehicle.take_while(|datagram| datagram.stamp_ns < until_ns);
    datagrams.map(|datagram| event(0, datagram.stamp_ns, Body::Datagram(Bytes::from(datagram.payload)))).collect()
}

#[test]
fn half_a_field_of_view_is_complete_and_half_a_turn_lost_is_not() {
    let events = velodyne(Model::Vlp16, 1.9, 2000);
    let lost_ns = events[0].arrival_ns + 1000 * MS..events[0].arrival_ns + 1100 * MS;
    let is_ahead = |event: &Event| match &event.body {
        Body::Datagram(packet) if packet.len() == 1206 => {
            !(9_000..27_000).contains(&u16::from_le_bytes([packet[2], packet[3]]))
        }
        _ => true,
    };
    let made = |keep: &dyn Fn(&Event) -> bool| -> Vec<(f32, Part)> {
        let mut pipeline = pipeline(&config());
        let maps = events.iter().filter(|event| keep(event)).filter_map(|event| step(&mut pipeline, event));
        maps.map(|map| (map.sensors[0].completeness, map.sensors[0].state)).collect()
    };
    let half = made(&is_ahead);
    assert!(half.len() > 15 && half[5..].iter().all(|(share, part)| *share > 0.98 && *part == Part::Ok), "{half:?}");
    let once = made(&|event| is_ahead(event) || !lost_ns.contains(&event.arrival_ns));
    let partial: Vec<f32> = once.iter().filter(|(_, part)| *part == Part::Partial).map(|(share, _)| *share).collect();
    let lost: f32 = partial[1..].iter().map(|share| 1.0 - share).sum();
    assert!((0.45..0.55).contains(&lost), "the first turn begins somewhere; then half a turn is missing: {once:?}");
}

#[test]
fn two_turning_sensors_have_a_decoder_and_a_ledger_each_and_their_order_between_two_maps_is_free() {
    let mut config = config();
    let low = SensorConfig { model: Some(Model::Hdl32e), ..SensorConfig::new("low", at(0.0, 0.0, 1.5, 0.0)) };
    config.sensors = vec![config.sensors[0].clone(), low, config.sensors[1].clone()];
    let lead = velodyne(Model::Vlp16, 1.9, 430);
    let low = velodyne(Model::Hdl32e, 1.5, 430).into_iter().map(|event| Event { source: 1, ..event });
    let mut events: Vec<Event> = lead.iter().cloned().chain(low).collect();
    events.extend((0..8).map(|n| scan(2, lead[0].arrival_ns + 7 * MS + n * 50 * MS)));
    events.sort_by_key(|event| (event.arrival_ns, event.source));
    let run = |events: &[Event]| {
        let mut pipeline = pipeline(&config);
        let made: Vec<Map> = events.iter().filter_map(|event| step(&mut pipeline, event)).collect();
        (made, pipeline)
    };
    let (made, pipeline) = run(&events);
    assert!(made.len() >= 3 && made.iter().all(|map| map.made_by == 0));
    let last = made.last().unwrap();
    let contributing: Vec<_> = last.sensors.iter().map(|s| (s.model.as_str(), s.state, s.packets > 0)).collect();
    assert_eq!(contributing, [("vlp16", Part::Ok, true), ("hdl32e", Part::Ok, true), ("scan", Part::Ok, false)]);
    assert_eq!(last.sensors[0].packets_expected, last.sensors[0].packets);
    let (sensors, sum) = (pipeline.sensors(), pipeline.ledger());
    assert!(sensors.iter().all(|sensor| balanced(&sensor.ledger)) && balanced(sum));
    assert_eq!(sensors.iter().map(|sensor| sensor.ledger.received).sum::<u64>(), sum.received);
    assert_eq!(sum.received, events.len() as u64);
    assert_eq!(run(&events).0, made, "the same events, the same maps");

    // The lead alone gives the same maps as a vehicle that has no other sensor.
    let only: Vec<_> = run(&lead).0;
    let mut single =
        Pipeline::new(&VehicleConfig { sensors: vec![config.sensors[0].clone()], ..config.clone() }, vec![None])
            .unwrap();
    let expected: Vec<_> = lead.iter().filter_map(|event| step(&mut single, event)).collect();
    assert_eq!(only.len(), expected.len());
    for (only, expected) in only.iter().zip(&expected) {
        assert_eq!((&only.layers, only.capture_end_ns), (&expected.layers, expected.capture_end_ns));
    }

    // Between two of the lead's datagrams the others may come in any order.
    let mut swapped = events.clone();
    for pair in 0..swapped.len() - 1 {
        if swapped[pair].source == 1 && swapped[pair + 1].source == 2 {
            swapped.swap(pair, pair + 1);
        }
    }
    assert_ne!(swapped, events);
    let layers = |made: &[Map]| made.iter().map(|map| map.layers.clone()).collect::<Vec<_>>();
    assert_eq!(layers(&run(&swapped).0), layers(&made));
}

#[test]
fn a_declared_sensor_is_decoded_by_the_table_it_brings() {
    let mut table = Calibration::factory(Model::Vlp16);
    table.lasers.iter_mut().for_each(|laser| laser.dist_correction += 1.0);
    let ranges = |calibration: Option<String>| {
        let mut pipeline = pipeline(&config());
        let declared = SensorConfig { calibration, ..SensorConfig::new("rear", at(0.0, 0.0, 1.9, 0.0)) };
        pipeline.step(&event(3, 1, Body::Sensor(Box::new(declared)))).unwrap();
        for moved in velodyne(Model::Vlp16, 1.9, 450) {
            pipeline.step(&Event { source: 3, ..moved }).unwrap();
        }
        let sweep = pipeline.newest_sweep();
        sweep.x.iter().zip(&sweep.y).map(|(x, y)| x.hypot(*y)).collect::<Vec<_>>()
    };
    let (plain, tabled) = (ranges(None), ranges(Some(table.to_yaml())));
    assert!(plain.len() > 5000 && plain.len() == tabled.len(), "{} {}", plain.len(), tabled.len());
    // A metre along the beam is at least cos 15 degrees of it on the ground.
    assert!(plain.iter().zip(&tabled).all(|(plain, tabled)| (0.96..1.001).contains(&(tabled - plain))));
}

#[test]
fn a_host_clock_that_steps_holds_no_map() {
    for step_ns in [-3_600_000 * MS, 3_600_000 * MS] {
        let mut pipeline = pipeline(&config());
        let mut made = 0;
        for n in 0..40i64 {
            let stamp_ns = 1_700_000_000_000 * MS + n * 50 * MS;
            let arrival_ns = stamp_ns + if n < 10 { 0 } else { step_ns };
            // The lead stops a second after the step.
            if n < 30 && n % 2 == 0 {
                made += usize::from(step(&mut pipeline, &event(0, arrival_ns, scan(0, stamp_ns).body)).is_some());
            }
            made += usize::from(step(&mut pipeline, &event(1, arrival_ns, scan(1, stamp_ns).body)).is_some());
        }
        assert!((17..=24).contains(&made), "{step_ns}: {made} maps in 2 s");
    }
}

#[test]
fn a_turn_that_a_silence_held_back_makes_no_map_older_than_the_last_though_the_host_steps_as_it_ends() {
    let mut events = velodyne(Model::Vlp16, 1.9, 2000);
    let start_ns = events[0].arrival_ns;
    let silent = start_ns + 550 * MS..start_ns + 1300 * MS;
    events.retain(|event| !silent.contains(&event.arrival_ns));
    events.extend((1..20).map(|n| scan(1, start_ns + n * 100 * MS)).filter(|event| event.arrival_ns < silent.end));
    events.sort_by_key(|event| event.arrival_ns);
    for host_ns in [0, 2_000 * MS, 3_600_000 * MS, -2_000 * MS] {
        let mut pipeline = pipeline(&config());
        let made: Vec<i64> = (events.iter())
            .filter_map(|event| {
                let ahead_ns = if event.arrival_ns < silent.end { 0 } else { host_ns };
                step(&mut pipeline, &Event { arrival_ns: event.arrival_ns + ahead_ns, ..event.clone() })
            })
            .map(|map| map.capture_end_ns)
            .collect();
        assert!(made.len() > 12 && made.is_sorted_by(|before, after| before < after), "{host_ns}: {made:?}");
    }
}

#[test]
fn a_sensor_is_declared_by_an_event_and_what_cannot_be_one_is_refused_by_name() {
    let mut pipeline = pipeline(&config());
    let declare = |source: u16, name: &str, extrinsics| {
        event(
            source,
            1,
            Body::Sensor(Box::new(SensorConfig { range_m_min: 0.0, ..SensorConfig::new(name, extrinsics) })),
        )
    };
    let rear = scan(3, 10 * MS);
    assert_eq!(pipeline.step(&rear).unwrap_err(), Rejected::Source { source_index: 3, sensors: 3 });
    for (wrong, said) in [
        (declare(4, "rear", at(-1.0, 0.0, 1.0, 180.0)), "vehicle.sensor = 4: allowed is the next index, under 32"),
        (declare(0, "rear", at(-1.0, 0.0, 1.0, 180.0)), "vehicle.sensor = 0: allowed is the next index, under 32"),
        (
            declare(3, "left", at(-1.0, 0.0, 1.0, 180.0)),
            "vehicle.sensor[3].name = left: allowed is each sensor its own",
        ),
        (
            declare(3, "rear", at(-1.0, 0.0, f64::NAN, 0.0)),
            "vehicle.sensor[3].extrinsics.z_m = NaN: allowed is 0.1 to 20",
        ),
    ] {
        let refused = pipeline.step(&wrong).unwrap_err();
        assert_eq!((refused.reason(), refused.to_string()), ("sensor", format!("declared sensor: {said}")));
    }
    let tabled = |text: &str| {
        let plain = SensorConfig::new("rear", at(-1.0, 0.0, 1.0, 180.0));
        let calibration = Some(text.to_owned());
        event(3, 1, Body::Sensor(Box::new(SensorConfig { model: Some(Model::Vlp16), calibration, ..plain })))
    };
    let hdl32e = Calibration::factory(Model::Hdl32e).to_yaml();
    for (text, said) in [("rear.yaml", "rear.yaml"), (&*hdl32e, "32"), (&" ".repeat(65_537), "65537 bytes")] {
        let refused = pipeline.step(&tabled(text)).unwrap_err();
        let message = refused.to_string();
        assert!(
            refused.reason() == "sensor" && message.contains("[3].calibration") && message.contains(said),
            "{message}"
        );
    }
    let good = declare(3, "rear", at(-1.0, 0.0, 1.0, 180.0));
    assert_eq!(pipeline.step(&good), Ok(None));
    assert_eq!(pipeline.step(&good), Ok(None), "the same again changes nothing");
    assert_eq!((pipeline.ledger().sensors, pipeline.ledger().sensors_refused), (2, 7));
    assert_eq!(pipeline.step(&rear), Ok(None));
    let map = step(&mut pipeline, &scan(0, 20 * MS)).unwrap();
    assert_eq!((map.sensors[3].name.as_str(), map.sensors[3].state), ("rear", Part::Ok));
    assert!((pipeline.newest_sweep().x[2] + 6.0).abs() < 1e-5, "5 m behind the rear");
    assert_eq!(pipeline.sensors().len(), 4);
}
