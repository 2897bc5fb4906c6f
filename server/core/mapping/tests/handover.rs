//! A pipeline that begins later and takes over from another one: what it makes of the events that follow.

use bytes::Bytes;
use clearway_lidar::model::Model;
use clearway_mapping::config::{Extrinsics, MapsConfig, SensorConfig, TimeConfig, VehicleConfig};
use clearway_mapping::event::{Body, EgoPose, Event, Scan};
use clearway_mapping::pipeline::Pipeline;
use clearway_sim::scanner::ScannerConfig;
use clearway_sim::scenes;
use clearway_sim::vehicle::SimulatedVehicle;

fn config() -> VehicleConfig {
    let extrinsics = Extrinsics { x_m: 0.0, y_m: 0.0, z_m: 1.9, roll_deg: 0.0, pitch_deg: 0.0, yaw_deg: 0.0 };
    let sensor = SensorConfig {
        name: "top".into(),
        model: Some(Model::Vlp16),
        rpm: None,
        calibration: None,
        cut_azimuth_deg: 180.0,
        blind_deg: Vec::new(),
        gps_late_days_max: 1.0,
        range_m_min: 2.0,
        elevations_deg: Vec::new(),
        range_noise_m: None,
        extrinsics,
    };
    let mut maps = MapsConfig::default();
    maps.memory.enabled = true;
    let (sensors, fusion) = (vec![sensor], Default::default());
    VehicleConfig { time: TimeConfig::default(), name: "car".into(), sensors, fusion, body: None, maps }
}

fn pipeline() -> Pipeline {
    Pipeline::new(&config(), vec![None]).unwrap()
}

/// The events of a drive through the town: packets, and a pose each 20 ms.
fn drive(seconds: f64) -> Vec<Event> {
    let scanner = ScannerConfig { model: Model::Vlp16, ..ScannerConfig::default() };
    let vehicle = SimulatedVehicle::new(scenes::town(), scanner);
    let poses = vehicle.clone();
    let (start_ns, mut pose_ns) = (vehicle.start_ns(), vehicle.start_ns());
    let mut events = Vec::new();
    let mut push = |arrival_ns, body| {
        events.push(Event { sequence: events.len() as u64, arrival_ns, source: 0, body });
    };
    for datagram in vehicle.take_while(|datagram| datagram.stamp_ns - start_ns < (seconds * 1e9) as i64) {
        while pose_ns <= datagram.stamp_ns {
            let (map_from_ego, speed_mps) = (poses.pose_at(pose_ns), poses.speed_at(pose_ns));
            push(datagram.stamp_ns, Body::EgoPose(EgoPose { stamp_ns: pose_ns, map_from_ego, speed_mps }));
            pose_ns += 20_000_000;
        }
        push(datagram.stamp_ns, Body::Datagram(Bytes::from(datagram.payload)));
    }
    events
}

#[test]
fn maps_do_not_change_when_a_pipeline_takes_over_that_has_seen_what_layers_remember() {
    let (events, second) = (drive(11.0), 1_000_000_000);
    let start_ns = events[0].arrival_ns;
    let (mut straight, mut later) = (pipeline(), pipeline());
    let (mut has_taken_over, mut compared) = (false, 0);
    for event in &events {
        let made = straight.step(event).unwrap().is_some();
        let after_ns = event.arrival_ns - start_ns;
        if after_ns >= 2 * second {
            later.step(event).unwrap();
        }
        if made && after_ns >= 9 * second {
            if !has_taken_over {
                later.take_over(straight.handover());
                has_taken_over = true;
                continue;
            }
            let [a, b] = [&straight, &later].map(|of| of.newest_map().expect("it was made"));
            // Debug distinguishes all values.
            assert!(format!("{a:?}") == format!("{b:?}"), "map {}", a.sequence);
            compared += 1;
        }
    }
    assert!(compared >= 15, "{compared}");
}

/// A scan of a level plane, and its event.
fn scan(stamp_ns: i64, arrival_ns: i64) -> Event {
    let mut scan = Scan { stamp_ns, ..Scan::default() };
    for i in 0..3600 {
        let (sin, cos) = (i as f32 * 0.01).sin_cos();
        let range_m = 8.0 + (i % 16) as f32;
        scan.x.push(range_m * cos);
        scan.y.push(range_m * sin);
        scan.z.push(-1.9);
        scan.intensity.push(0.3);
        scan.ring.push((i % 16) as u16);
    }
    Event { sequence: 0, arrival_ns, source: 0, body: Body::Scan(scan) }
}

#[test]
fn stamps_do_not_go_back_silently_across_a_handover() {
    let mut arrival_ns = 100_000_000_000;
    // A scan whose stamp goes back is refused until its clock was surely set back.
    let mut step = |pipeline: &mut Pipeline, stamp_ms: i64| {
        arrival_ns += 100_000_000;
        let map = pipeline.step(&scan(stamp_ms * 1_000_000, arrival_ns)).ok().flatten();
        map.map(|map| (map.sequence, map.epoch))
    };
    let (mut own, mut new) = (pipeline(), pipeline());
    assert_eq!([10_000, 10_100].map(|at| step(&mut own, at)), [Some((0, 0)), Some((1, 0))]);
    let set_back = (5_000..7_000).step_by(100).filter_map(|at| step(&mut own, at)).last();
    let (sequence, epoch) = set_back.expect("it is believed in the end");
    assert_eq!(epoch, 1);
    assert_eq!(step(&mut new, 7_000), Some((0, 0)));
    let mut later = new.clone();
    new.take_over(own.handover());
    assert_eq!(step(&mut new, 7_100), Some((sequence + 1, 1)), "the epoch goes on");
    assert_eq!(step(&mut own, 7_200), Some((sequence + 1, 1)));
    later.take_over(own.handover());
    assert_eq!(step(&mut later, 7_100), Some((sequence + 2, 2)), "it is not later than the map before");
}
