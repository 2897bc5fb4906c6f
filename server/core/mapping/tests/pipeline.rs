//! The pipeline: what it counts, what it refuses, and that the same events give the same maps.

use bytes::Bytes;
use clearway_lidar::model::Model;
use clearway_mapping::config::{BodyConfig, ConfigValueError, Extrinsics, MapsConfig, SensorConfig, VehicleConfig};
use clearway_mapping::error::EventError;
use clearway_mapping::event::{Body, Cause, EgoPose, Event, Scan};
use clearway_mapping::layer::Cells;
use clearway_mapping::map::Map;
use clearway_mapping::pipeline::Pipeline;
use clearway_mapping::sensor::deviation::STEPS;
use clearway_sim::scanner::ScannerConfig;
use clearway_sim::scenes;
use clearway_sim::vehicle::SimulatedVehicle;
use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion};

use crate::common;

fn config(model: Option<Model>) -> VehicleConfig {
    let level = Extrinsics { x_m: 0.0, y_m: 0.0, z_m: 1.9, roll_deg: 0.0, pitch_deg: 0.0, yaw_deg: 0.0 };
    VehicleConfig::new("car-1", vec![SensorConfig { model, ..SensorConfig::new("top", level) }])
}

fn pipeline(model: Option<Model>) -> Pipeline {
    Pipeline::new(&config(model), vec![None]).unwrap()
}

fn event(sequence: u64, body: Body) -> Event {
    Event { sequence, arrival_ns: 1_000 + sequence as i64, source: 0, body }
}

/// Datagrams of a standing simulated vehicle: a little more than two revolutions.
fn drive() -> Vec<Event> {
    let vehicle = SimulatedVehicle::new(scenes::flat(), ScannerConfig { model: Model::Vlp16, ..Default::default() });
    let until_ns = vehicle.start_ns() + 260_000_000;
    let datagrams = vehicle.take_while(|datagram| datagram.stamp_ns < until_ns);
    let event = |(sequence, datagram): (usize, clearway_sim::vehicle::Datagram)| Event {
        sequence: sequence as u64,
        arrival_ns: datagram.stamp_ns,
        source: 0,
        body: Body::Datagram(Bytes::from(datagram.payload)),
    };
    datagrams.enumerate().map(event).collect()
}

fn maps(pipeline: &mut Pipeline, events: &[Event]) -> Vec<Map> {
    events.iter().filter_map(|event| pipeline.step(event).ok().flatten().cloned()).collect()
}

fn scan(stamp_ns: i64) -> Scan {
    let angle = |i: i32| i as f32 * 0.01;
    let ring = |i: i32| 5.0 + 0.2 * (i / 628) as f32;
    Scan {
        stamp_ns,
        x: (0..6280).map(|i| ring(i) * angle(i).cos()).collect(),
        y: (0..6280).map(|i| ring(i) * angle(i).sin()).collect(),
        z: vec![-1.9; 6280],
        intensity: vec![0.5; 6280],
        ..Scan::default()
    }
}

#[test]
fn a_pose_of_the_future_blocks_others_for_no_longer_than_the_deadline() {
    const MS: i64 = 1_000_000;
    let mut pipeline = pipeline(Some(Model::Vlp16));
    let mut pose = |arrival_ms: i64, stamp_ms: i64| {
        let map_from_ego = Isometry3::translation(1.0, 2.0, 0.0);
        let body = Body::EgoPose(EgoPose { stamp_ns: stamp_ms * MS, map_from_ego, speed_mps: 3.0 });
        pipeline.step(&Event { sequence: 0, arrival_ns: arrival_ms * MS, source: 0, body }).map(|_| ())
    };
    let year_ms = 31_536_000_000;
    pose(10_000, 10_000).unwrap();
    pose(10_010, 10_010 + year_ms).unwrap();
    for arrival_ms in (10_020..=10_210).step_by(10) {
        assert!(matches!(pose(arrival_ms, arrival_ms), Err(EventError::Stamp { .. })), "{arrival_ms}");
    }
    for arrival_ms in (10_220..10_400).step_by(10) {
        pose(arrival_ms, arrival_ms).unwrap();
    }
    assert!(pose(10_400, 10_300).is_err(), "an older pose is still refused");
}

#[test]
fn a_step_of_the_host_clock_changes_no_map_of_a_sensor_on_gps_time() {
    const HOUR_NS: i64 = 3_600_000_000_000;
    let run = |step_ns: i64| {
        let mut events = drive();
        let middle = events.len() / 2;
        events[middle..].iter_mut().for_each(|event| event.arrival_ns += step_ns);
        maps(&mut pipeline(Some(Model::Vlp16)), &events)
    };
    let steady = run(0);
    for step_ns in [HOUR_NS, -HOUR_NS] {
        let mut stepped = run(step_ns);
        let last = stepped.last().unwrap();
        assert_eq!((last.sensors[0].clock, last.sensors[0].clock_offset_ms), ("gps", step_ns / 1_000_000));
        for (map, steady) in stepped.iter_mut().zip(&steady) {
            map.completed_ns = steady.completed_ns;
            map.sensors[0].clock_offset_ms = steady.sensors[0].clock_offset_ms;
        }
        assert!(stepped == steady, "{step_ns}");
    }
}

#[test]
fn each_revolution_gives_a_map_and_the_end_gives_a_partial_one() {
    let events = drive();
    let mut pipeline = pipeline(Some(Model::Vlp16));
    assert!(pipeline.newest_revolution().is_none());
    assert_eq!(pipeline.sensors()[0].mount, None, "no ground was seen");
    let mut made = maps(&mut pipeline, &events);
    assert!(pipeline.sensors()[0].mount.is_some());
    let end = Event { sequence: events.len() as u64, arrival_ns: 7, source: 0, body: Body::End };
    made.push(pipeline.step(&end).unwrap().unwrap().clone());
    assert_eq!(pipeline.step(&end), Ok(None), "no revolution is unfinished");

    assert_eq!(made.iter().map(|map| map.sequence).collect::<Vec<_>>(), [0, 1, 2, 3][..made.len()]);
    assert!(made.len() >= 3, "{} maps", made.len());
    let whole = &made[1];
    assert_eq!(whole.sensors[0].partial, "");
    assert_eq!(whole.sensors[0].model, "vlp16");
    assert_eq!(whole.sensors[0].completeness, 1.0);
    // The device time is UTC, as the telemetry states, and the datagrams arrive without delay.
    assert_eq!((whole.sensors[0].clock, whole.sensors[0].clock_offset_ms), ("gps", 0));
    assert!((whole.sensors[0].rpm - 600.0).abs() < 5.0);
    assert!(whole.capture_end_ns - whole.capture_start_ns > 95_000_000);
    assert!(whole.completed_ns >= whole.capture_end_ns);
    let names: Vec<&str> = whole.layers.iter().map(|layer| layer.name).collect();
    assert_eq!(names, ["drivability", "height_difference", "terrain", "occupancy", "speed", "safe_path", "freespace"]);
    assert!(common::figure(&whole.layers[0], "drivable_share") > 0.95);
    assert_eq!(made.last().unwrap().sensors[0].partial, "end");
    assert_eq!(made.last().unwrap().completed_ns, 7);
    assert_eq!(pipeline.newest_revolution().unwrap().end_ns, made.last().unwrap().capture_end_ns);
    let status = &pipeline.sensors()[0];
    assert_eq!((status.name.as_str(), status.status.model), ("top", Some(Model::Vlp16)));
}

#[test]
fn the_same_events_give_the_same_maps() {
    let events = drive();
    let first = maps(&mut pipeline(None), &events);
    assert!(!first.is_empty());
    assert_eq!(maps(&mut pipeline(None), &events), first);
}

#[test]
fn the_ledger_is_exact_and_a_refused_datagram_changes_no_map() {
    let clean = drive();
    let expected = maps(&mut pipeline(Some(Model::Vlp16)), &clean);
    let mut pipeline = pipeline(Some(Model::Vlp16));
    let mut made = Vec::new();
    let (mut data, mut telemetry) = (0, 0);
    for (index, event) in clean.iter().enumerate() {
        if index % 10 == 0 {
            let short = Event { body: Body::Datagram(Bytes::from(vec![0; index % 1000])), ..event.clone() };
            let rejected = pipeline.step(&short).unwrap_err();
            assert_eq!(rejected.reason(), "length", "{rejected}");
            for body in [event.body.clone(), Body::End] {
                let unknown = Event { source: 3, body, ..event.clone() };
                let rejected = pipeline.step(&unknown).unwrap_err();
                assert_eq!(rejected, EventError::Source { source_index: 3, sensors: 1 });
            }
            assert_eq!(
                pipeline.step(&Event { body: Body::Lost { cause: Cause::Queue, count: 2 }, ..event.clone() }),
                Ok(None)
            );
        }
        let Body::Datagram(payload) = &event.body else { unreachable!() };
        if payload.len() == 512 {
            telemetry += 1
        } else {
            data += 1
        }
        made.extend(pipeline.step(event).unwrap().cloned());
    }
    let bad = clean.len().div_ceil(10) as u64;
    let ledger = pipeline.ledger();
    assert_eq!(ledger.received, clean.len() as u64 + 3 * bad);
    assert_eq!((ledger.decoded, ledger.telemetry), (data, telemetry));
    assert_eq!(ledger.refused, [("length", bad), ("source", 2 * bad)].into());
    assert_eq!(ledger.lost, 2 * bad);
    assert_eq!(ledger.received, ledger.decoded + ledger.telemetry + ledger.refused.values().sum::<u64>());

    assert_eq!(made.len(), expected.len());
    for (made, expected) in made.iter().zip(&expected) {
        assert_eq!(made.layers, expected.layers);
        assert!(made.sensors[0].refused > 0);
    }
}

#[test]
fn the_largest_counts_of_losses_keep_the_ledger_exact() {
    let mut pipeline = pipeline(None);
    let causes = [Cause::Queue, Cause::Kernel, Cause::Sender, Cause::Length, Cause::Observation];
    let lost = causes.iter().cycle().take(15).map(|&cause| Body::Lost { cause, count: u64::MAX });
    for (sequence, body) in (0..).zip(lost.chain([Body::Scan(Scan::default())])) {
        let _ = pipeline.step(&event(sequence, body));
    }
    let ledger = pipeline.ledger();
    assert_eq!(ledger.received, ledger.decoded + ledger.refused.values().sum::<u64>());
    assert!(ledger.received > ledger.lost && ledger.refused_sum() == ledger.received - ledger.decoded, "{ledger:?}");
}

#[test]
fn a_scan_event_makes_a_map_without_a_revolution() {
    let mut pipeline = pipeline(Some(Model::Hdl64eS2));
    let map = pipeline.step(&event(0, Body::Scan(scan(50)))).unwrap().unwrap();
    assert_eq!((map.capture_start_ns, map.capture_end_ns, map.completed_ns), (50, 50, 1_000));
    assert_eq!(map.sensors[0].model, "scan");
    assert_eq!(map.sensors[0].returns, 6280);
    assert!(common::figure(&map.layers[0], "drivable_share") > 0.9);
    assert!(pipeline.newest_revolution().is_none());
}

#[test]
fn points_of_a_scan_that_are_not_positions_are_removed_and_counted() {
    let mut wild = scan(50);
    for (index, value) in [(0, f32::NAN), (1, f32::INFINITY), (2, -f32::INFINITY), (3, 1e9)] {
        wild.x[index] = value;
        wild.z[index + 10] = value;
    }
    let mut pipeline = pipeline(Some(Model::Hdl64eS2));
    let map = pipeline.step(&event(0, Body::Scan(wild))).unwrap().unwrap();
    assert_eq!(map.sensors[0].returns, 6280 - 8);
    assert_eq!(pipeline.ledger().points_dropped, 8);
}

#[test]
fn a_refused_scan_gives_an_error_that_names_the_value() {
    let mut uneven = scan(60);
    uneven.z.pop();
    let mut known = pipeline(Some(Model::Hdl64eS2));
    known.step(&event(0, Body::Scan(scan(50)))).unwrap();
    let rejected = known.step(&event(1, Body::Scan(uneven))).unwrap_err();
    assert_eq!(
        rejected.to_string(),
        "scan with 6280 x, 6280 y, 6279 z and 6280 intensities: the four lengths must be equal"
    );
    let rejected = known.step(&event(2, Body::Scan(scan(50)))).unwrap_err();
    assert_eq!(rejected, EventError::Stamp { stamp_ns: 50, newest_ns: 50 });
    for stamp_ns in [i64::MIN, -1, (1 << 62) + 1, i64::MAX] {
        let rejected = known.step(&event(2, Body::Scan(scan(stamp_ns)))).unwrap_err();
        assert_eq!(rejected, EventError::StampRange { stamp_ns });
    }
    assert_eq!(known.ledger().refused, [("scan_lengths", 1), ("stamp", 1), ("stamp_range", 4)].into());
    assert_eq!((known.ledger().received, known.ledger().decoded), (7, 1));
    let map = known.step(&event(3, Body::Scan(scan(51)))).unwrap().unwrap();
    assert_eq!(map.sequence, 1, "a refused scan uses no sequence number");
}

#[test]
fn a_map_has_the_newest_pose_and_invalid_poses_are_refused() {
    let pose = |stamp_ns, x, speed_mps| {
        let map_from_ego = Isometry3::from_parts(Translation3::new(x, 2.0, 3.0), UnitQuaternion::identity());
        Body::EgoPose(EgoPose { stamp_ns, map_from_ego, speed_mps })
    };
    let mut pipeline = pipeline(Some(Model::Hdl64eS2));
    assert_eq!(pipeline.step(&event(0, Body::Scan(scan(10)))).unwrap().unwrap().map_from_ego, None);
    pipeline.step(&event(1, pose(20, 1.0, 5.0))).unwrap();
    for bad in [pose(30, f64::NAN, 5.0), pose(30, 1.0, f64::INFINITY)] {
        assert_eq!(pipeline.step(&event(2, bad)), Err(EventError::Pose { stamp_ns: 30 }));
    }
    let mut not_unit = EgoPose { stamp_ns: 30, map_from_ego: Isometry3::identity(), speed_mps: 0.0 };
    not_unit.map_from_ego.rotation = UnitQuaternion::new_unchecked(Quaternion::new(0.5, 0.0, 0.0, 0.0));
    assert_eq!(pipeline.step(&event(3, Body::EgoPose(not_unit))), Err(EventError::Pose { stamp_ns: 30 }));
    assert_eq!(pipeline.step(&event(4, pose(20, 9.0, 9.0))), Err(EventError::Stamp { stamp_ns: 20, newest_ns: 20 }));
    let map = pipeline.step(&event(5, Body::Scan(scan(25)))).unwrap().unwrap();
    // 5 ns after the pose at 5 m/s.
    assert!((map.map_from_ego.unwrap().translation.x - 1.0 - 25e-9).abs() < 1e-12);
    assert_eq!(map.speed_mps, Some(5.0));
    let ledger = pipeline.ledger();
    assert_eq!((ledger.poses, ledger.poses_refused, ledger.received), (1, 4, 2));
}

#[test]
fn a_disabled_layer_is_not_made() {
    let mut off = config(Some(Model::Hdl64eS2));
    off.maps = MapsConfig::none();
    off.maps.height_difference.enabled = true;
    let mut pipeline = Pipeline::new(&off, vec![None]).unwrap();
    let map = pipeline.step(&event(0, Body::Scan(scan(10)))).unwrap().unwrap();
    assert_eq!(map.layers.iter().map(|layer| layer.name).collect::<Vec<_>>(), ["height_difference"]);
    off.maps = MapsConfig::none();
    let mut pipeline = Pipeline::new(&off, vec![None]).unwrap();
    assert!(pipeline.step(&event(0, Body::Scan(scan(10)))).unwrap().unwrap().layers.is_empty());
}

/// A change that makes one value of a configuration invalid.
type Change<'a> = &'a dyn Fn(&mut VehicleConfig);

#[test]
fn an_invalid_configuration_names_the_key_the_value_and_what_is_allowed() {
    let refuse = |change: Change| -> ConfigValueError {
        let mut config = config(None);
        change(&mut config);
        let calibrations = vec![None; config.sensors.len()];
        Pipeline::new(&config, calibrations).err().expect("the configuration must be refused")
    };
    let none = refuse(&|c| c.sensors.clear());
    assert_eq!((none.key.as_str(), none.value.as_str()), ("vehicle.sensor", "0 tables"));
    let two = refuse(&|c| c.sensors.push(c.sensors[0].clone()));
    assert_eq!(two.to_string(), "vehicle.sensor[1].name = top: allowed is each sensor its own");
    let name = refuse(&|c| c.name = "Car 1".into());
    assert_eq!(name.to_string(), "vehicle.name = \"Car 1\": allowed is 1 to 64 of the characters a-z, 0-9, - and _");
    let height = refuse(&|c| c.sensors[0].extrinsics.z_m = f64::NAN);
    assert_eq!(height.to_string(), "vehicle.sensor[0].extrinsics.z_m = NaN: allowed is 0.1 to 20");
    let body = |x_m_max, z_m_max| Some(BodyConfig { x_m_min: -1.0, x_m_max, y_m_min: -1.0, y_m_max: 1.0, z_m_max });
    let others: [(&str, Change); 17] = [
        ("vehicle.sensor", &|c| c.sensors = vec![c.sensors[0].clone(); 33]),
        ("vehicle.sensor[0].elevations_deg", &|c| c.sensors[0].elevations_deg = vec![f32::NAN]),
        ("vehicle.fusion.reference_sensor", &|c| c.fusion.reference_sensor = "roof".into()),
        ("vehicle.fusion.deadline_ms", &|c| c.fusion.deadline_ms = 0),
        ("vehicle.body.x_m_max", &|c| c.body = body(-1.0, 1.5)),
        ("vehicle.body.z_m_max", &|c| c.body = body(3.0, f32::NAN)),
        ("vehicle.sensor[0].name", &|c| c.sensors[0].name.clear()),
        ("vehicle.sensor[0].rpm", &|c| c.sensors[0].rpm = Some(0.0)),
        ("vehicle.sensor[0].blind_deg", &|c| c.sensors[0].blind_deg = vec![[10.0, 361.0]]),
        ("vehicle.sensor[0].gps_late_days_max", &|c| c.sensors[0].gps_late_days_max = f64::NAN),
        ("vehicle.sensor[0].cut_azimuth_deg", &|c| c.sensors[0].cut_azimuth_deg = -1.0),
        ("vehicle.sensor[0].range_m_min", &|c| c.sensors[0].range_m_min = f32::INFINITY),
        ("vehicle.sensor[0].extrinsics.x_m", &|c| c.sensors[0].extrinsics.x_m = 1e9),
        ("vehicle.sensor[0].extrinsics.yaw_deg", &|c| c.sensors[0].extrinsics.yaw_deg = f64::INFINITY),
        ("vehicle.maps.valid_ms", &|c| c.maps.valid_ms = 0),
        ("vehicle.maps.drivability.columns", &|c| c.maps.drivability.columns = 0),
        ("vehicle.maps.drivability.range_m_max", &|c| c.maps.drivability.range_m_max = f32::NAN),
    ];
    for (key, change) in others {
        assert_eq!(refuse(change).key, key);
    }
    let mismatch = Pipeline::new(&config(None), Vec::new()).err().unwrap();
    assert_eq!(mismatch.key, "vehicle.sensor");
}

#[test]
#[cfg_attr(not(clearway_data), ignore = "needs the recorded drives: set CLEARWAY_DATA")]
fn recorded_drives_become_maps_with_the_road_drivable() {
    for (path, height, data, telemetry, whole, ahead_m) in [
        ("pcap/rust-lidar-utils/hdl32_example.pcap", 2.165, 876, 100, 4, 20.0),
        ("pcap/opendlv/proxy-velodyne16/sampleShort.pcap", 1.59, 291, 56, 2, 10.0),
    ] {
        let mut config = config(None);
        let extrinsics = &mut config.sensors[0].extrinsics;
        (extrinsics.z_m, extrinsics.pitch_deg, extrinsics.roll_deg) = (height, -1.4, 1.4);
        let mut pipeline = Pipeline::new(&config, vec![None]).unwrap();
        let datagrams = common::datagrams(path);
        let read = datagrams.len() as u64;
        let mut events: Vec<Event> = (0..)
            .zip(datagrams)
            .map(|(sequence, datagram)| Event {
                sequence,
                arrival_ns: datagram.stamp_ns,
                source: 0,
                body: Body::Datagram(datagram.payload.into()),
            })
            .collect();
        events.push(Event {
            sequence: read,
            arrival_ns: events.last().unwrap().arrival_ns,
            source: 0,
            body: Body::End,
        });
        let made = maps(&mut pipeline, &events);
        let ledger = pipeline.ledger();
        println!("{path}: {} maps, {ledger:?}", made.len());
        assert_eq!(ledger.received, read);
        assert_eq!(ledger.decoded + ledger.telemetry, read, "no datagram is refused");
        assert_eq!((ledger.decoded, ledger.telemetry), (data, telemetry));
        assert!(made.iter().filter(|map| map.sensors[0].partial.is_empty()).count() >= whole);
        for map in made.iter().filter(|map| map.sensors[0].partial.is_empty()) {
            let layer = &map.layers[0];
            let (_, columns) = common::size(layer);
            // The cells straight ahead, 2 degrees to either side.
            let lane = (0..).zip(common::benches(layer)).take_while(|(_, bench)| **bench <= ahead_m);
            let cells: Vec<u8> = lane
                .flat_map(|(row, _)| {
                    [0, 1, columns - 2, columns - 1].map(|c| common::classes(layer)[row * columns + c])
                })
                .filter(|class| *class != 0)
                .collect();
            let drivable = cells.iter().filter(|class| **class == 1).count();
            println!(
                "map {}: share {:.3}, lane {drivable}/{}",
                map.sequence,
                common::figure(layer, "drivable_share"),
                cells.len()
            );
            assert!(cells.len() >= 8 && drivable * 10 >= cells.len() * 9);
        }
    }
}

#[test]
fn an_inactive_layer_is_not_made_until_the_next_map_after_its_activation() {
    let all = ["drivability", "height_difference", "terrain", "occupancy", "speed", "safe_path", "freespace"];
    let names = |map: &Map| map.layers.iter().map(|layer| layer.name).collect::<Vec<_>>();
    let (mut all_active, mut some_active) = (pipeline(None), pipeline(None));
    assert_eq!(all_active.layers_made(), all.map(|layer| (layer, 0)));
    // The layers that are activated, and those in the next map: safe_path is made from drivability
    // and occupancy.
    let steps: [(&[&str], &[&str]); 6] = [
        (&[], &[]),
        (&["terrain"], &["terrain"]),
        (&["safe_path", "speed"], &["drivability", "occupancy", "speed", "safe_path"]),
        (&["occupancy"], &["occupancy"]),
        (&[], &[]),
        (&all, &all),
    ];
    for (number, (active, expected_names)) in (1..).zip(steps) {
        let event = event(number, Body::Scan(scan(100_000_000 * number as i64)));
        let expected = all_active.step(&event).unwrap().unwrap();
        some_active.set_active_layers(|layer| active.contains(&layer));
        let map = some_active.step(&event).unwrap().unwrap();
        assert_eq!(names(map), expected_names);
        assert_eq!((map.sequence, &map.sensors), (expected.sequence, &expected.sensors));
        // Occupancy gathers evidence and starts again without it; all other layers are equal, cell by cell.
        for layer in map.layers.iter().filter(|layer| layer.name != "occupancy") {
            let same = expected.layers.iter().find(|other| other.name == layer.name).unwrap();
            assert_eq!(layer, same);
        }
    }
    assert_eq!(all_active.layers_made(), all.map(|layer| (layer, 6)));
    let made: Vec<u64> = some_active.layers_made().iter().map(|(_, made)| *made).collect();
    assert_eq!(made, [2, 1, 2, 3, 2, 2, 1]);
}

/// A scan of five rings on level ground, each range longer or shorter by turns.
fn scan_of_rings(stamp_ns: i64, bump_m: f32) -> Scan {
    let mut scan = Scan { stamp_ns, ..Scan::default() };
    for (ring, radius_m) in [5.0_f32, 6.0, 7.0, 8.0, 9.0].into_iter().enumerate() {
        for step in 0..1800 {
            let (sin, cos) = (step as f32 * 0.2).to_radians().sin_cos();
            let longer = if step % 2 == 0 { 1.0 + bump_m / radius_m } else { 1.0 };
            scan.x.push(radius_m * cos * longer);
            scan.y.push(radius_m * sin * longer);
            scan.z.push(-1.9 * longer);
            scan.intensity.push(0.5);
            scan.ring.push(ring as u16);
        }
    }
    scan
}

#[test]
fn the_deviations_of_all_sensors_stay_in_a_merged_sweep() {
    let at = |x_m| Extrinsics { x_m, y_m: 0.0, z_m: 1.9, roll_deg: 0.0, pitch_deg: 0.0, yaw_deg: 0.0 };
    let rough = SensorConfig { range_noise_m: Some(0.03), ..SensorConfig::new("rear", at(-20.0)) };
    let config = VehicleConfig::new("car-1", vec![SensorConfig::new("top", at(0.0)), rough]);
    let mut pipeline = Pipeline::new(&config, vec![None, None]).unwrap();
    let send = |pipeline: &mut Pipeline, source, stamp_ns, bump_m| {
        let body = Body::Scan(scan_of_rings(stamp_ns, bump_m));
        pipeline.step(&Event { sequence: 0, arrival_ns: stamp_ns, source, body }).unwrap().cloned()
    };
    assert!(send(&mut pipeline, 1, 1_000_000_000, 0.16).is_none(), "the reference sensor makes the maps");
    let map = send(&mut pipeline, 0, 1_000_000_001, 0.0).unwrap();
    let sweep = pipeline.newest_sweep();
    assert_eq!((sweep.x.len(), sweep.deviation.len()), (18_000, 18_000));
    // Deviation and noise of a point, over its range.
    let shares = |point: usize| sweep.deviation[point].steps().unwrap().map(|steps| steps as f32 / STEPS);
    assert!((0..9000).all(|point| shares(point)[0].abs() < 1e-4));
    // The range of the rear sensor, not the distance from the ego origin, divides the deviation and the noise.
    let range_m = 5.0_f32.hypot(1.9);
    assert!((shares(9011)[0].abs() * range_m - 0.08).abs() < 0.02, "{:?}", shares(9011));
    assert!((shares(9011)[1] * range_m - 0.03).abs() < 1e-4 && (shares(11)[1] * range_m - 0.02).abs() < 1e-4);
    let terrain = map.layers.iter().find(|layer| layer.name == "terrain").unwrap();
    let channel = terrain.channels.iter().find(|channel| channel.name == "roughness").unwrap();
    let Cells::U8(raw) = &channel.cells else { panic!("roughness is u8") };
    let known = |columns: std::ops::Range<usize>| {
        let cells = (0..400).flat_map(|row| columns.clone().map(move |column| row * 400 + column));
        let known: Vec<u8> = cells.map(|cell| raw[cell]).filter(|raw| i32::from(*raw) != channel.unknown).collect();
        known
    };
    // The rear sensor alone sees the cells more than 11 m behind the ego origin.
    let (front, rear) = (known(190..250), known(60..150));
    assert!(front.len() > 100 && rear.len() > 100, "{} {}", front.len(), rear.len());
    // In a cell with short or with long ranges alone the deviations do not differ.
    let rough = rear.iter().filter(|raw| **raw > 20).count();
    assert!(front.iter().all(|raw| *raw == 0) && 4 * rough > rear.len(), "{rough} of {} are rough", rear.len());
}

#[test]
fn roughness_is_measured_again_when_terrain_is_activated_again() {
    let events = drive();
    let roughness = |maps: &[Map]| maps.last().unwrap().layers.iter().find(|layer| layer.name == "terrain").cloned();
    let mut late = pipeline(Some(Model::Vlp16));
    late.set_active_layers(|_| false);
    let half = events.len() / 2;
    assert!(maps(&mut late, &events[..half]).iter().all(|map| map.layers.is_empty()));
    late.set_active_layers(|layer| layer == "terrain");
    let made = roughness(&maps(&mut late, &events[half..]));
    let channel = made.as_ref().unwrap().channels.iter().find(|channel| channel.name == "roughness").unwrap();
    let Cells::U8(raw) = &channel.cells else { panic!("roughness is u8") };
    let known = raw.iter().filter(|raw| i32::from(**raw) != channel.unknown).count();
    assert!(known > 300, "{known} cells have a roughness");
    assert_eq!(made, roughness(&maps(&mut pipeline(Some(Model::Vlp16)), &events)));
}
