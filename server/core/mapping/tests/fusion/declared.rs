//! Sensors that are declared by an event.

use super::*;

#[test]
fn a_declared_sensor_is_decoded_with_the_calibration_it_brings() {
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
    // One metre along a ray is at least cos 15 degrees metres on the ground.
    assert!(plain.iter().zip(&tabled).all(|(plain, tabled)| (0.96..1.001).contains(&(tabled - plain))));
}

#[test]
fn an_invalid_declaration_is_refused_and_a_valid_one_adds_a_sensor() {
    let mut pipeline = pipeline(&config());
    let declare = |source: u16, name: &str, extrinsics| {
        event(
            source,
            1,
            Body::Sensor(Box::new(SensorConfig { range_m_min: 0.0, ..SensorConfig::new(name, extrinsics) })),
        )
    };
    let rear = scan(3, 10 * MS);
    assert_eq!(pipeline.step(&rear).unwrap_err(), EventError::Source { source_index: 3, sensors: 3 });
    for (invalid, expected) in [
        (
            declare(32, "rear", at(-1.0, 0.0, 1.0, 180.0)),
            "vehicle.sensor = 32: allowed is an index of no sensor, under 32",
        ),
        (
            declare(0, "rear", at(-1.0, 0.0, 1.0, 180.0)),
            "vehicle.sensor = 0: allowed is an index of no sensor, under 32",
        ),
        (
            declare(3, "left", at(-1.0, 0.0, 1.0, 180.0)),
            "vehicle.sensor[3].name = left: allowed is each sensor its own",
        ),
        (
            declare(3, "rear", at(-1.0, 0.0, f64::NAN, 0.0)),
            "vehicle.sensor[3].extrinsics.z_m = NaN: allowed is 0.1 to 20",
        ),
    ] {
        let refused = pipeline.step(&invalid).unwrap_err();
        assert_eq!((refused.reason(), refused.to_string()), ("sensor", format!("declared sensor: {expected}")));
    }
    let tabled = |text: &str| {
        let plain = SensorConfig::new("rear", at(-1.0, 0.0, 1.0, 180.0));
        let calibration = Some(text.to_owned());
        event(3, 1, Body::Sensor(Box::new(SensorConfig { model: Some(Model::Vlp16), calibration, ..plain })))
    };
    let hdl32e = Calibration::factory(Model::Hdl32e).to_yaml();
    for (text, expected) in [("rear.yaml", "rear.yaml"), (&*hdl32e, "32"), (&" ".repeat(65_537), "65537 bytes")] {
        let refused = pipeline.step(&tabled(text)).unwrap_err();
        let message = refused.to_string();
        assert!(
            refused.reason() == "sensor" && message.contains("[3].calibration") && message.contains(expected),
            "{message}"
        );
    }
    let good = declare(3, "rear", at(-1.0, 0.0, 1.0, 180.0));
    assert_eq!(pipeline.step(&good), Ok(None));
    assert_eq!(pipeline.step(&good), Ok(None), "a repeated declaration changes nothing");
    assert_eq!((pipeline.ledger().sensors, pipeline.ledger().sensors_refused), (2, 7));
    assert_eq!(pipeline.step(&rear), Ok(None));
    let map = step(&mut pipeline, &scan(0, 20 * MS)).unwrap();
    assert_eq!((&*map.sensors[3].name, map.sensors[3].contribution), ("rear", Contribution::Ok));
    assert!((pipeline.newest_sweep().x[2] + 6.0).abs() < 1e-5, "5 m behind the rear sensor");
    assert_eq!(pipeline.sensors().len(), 4);
}

/// Declares a sensor behind the vehicle.
fn declare(source: u16, name: &str) -> Event {
    event(source, 1, Body::Sensor(Box::new(SensorConfig::new(name, at(-1.0, 0.0, 1.0, 180.0)))))
}

fn names(pipeline: &Pipeline) -> Vec<(u16, String)> {
    pipeline.sensors().into_iter().map(|sensor| (sensor.source, sensor.name)).collect()
}

#[test]
fn nothing_is_known_of_a_withdrawn_sensor_and_its_name_and_index_are_free() {
    let mut pipeline = pipeline(&config());
    let configured = names(&pipeline);
    for declaration in [declare(3, "rear"), declare(4, "trailer")] {
        pipeline.step(&declaration).unwrap();
    }
    pipeline.step(&scan(3, 10 * MS)).unwrap();
    pipeline.step(&scan(4, 10 * MS)).unwrap();
    assert_eq!(step(&mut pipeline, &scan(0, 20 * MS)).unwrap().sensors[3].contribution, Contribution::Ok);

    assert_eq!(pipeline.step(&event(3, 21 * MS, Body::Withdrawn)), Ok(None));
    assert_eq!(names(&pipeline), [&configured[..], &[(4, "trailer".into())]].concat());
    for reading in [scan(3, 22 * MS), event(3, 22 * MS, Body::Withdrawn), event(3, 22 * MS, Body::End)] {
        assert_eq!(pipeline.step(&reading), Err(EventError::Source { source_index: 3, sensors: 4 }));
    }
    let map = step(&mut pipeline, &scan(0, 120 * MS)).unwrap();
    let present: Vec<_> = map.present_sensors().map(|sensor| &*sensor.name).collect();
    assert_eq!((present.len(), present.contains(&"rear"), present.contains(&"trailer")), (4, false, true));
    let without = pipeline.newest_sweep().x.len();

    // Another sensor has the name, the index and another place.
    let moved = SensorConfig::new("rear", at(-3.0, 0.0, 1.0, 180.0));
    pipeline.step(&event(3, 121 * MS, Body::Sensor(Box::new(moved)))).unwrap();
    let ledger = pipeline.sensors()[3].ledger.clone();
    assert_eq!((ledger.received, ledger.decoded), (0, 0), "the counts begin again");
    pipeline.step(&scan(3, 210 * MS)).unwrap();
    pipeline.step(&scan(4, 210 * MS)).unwrap();
    let map = step(&mut pipeline, &scan(0, 220 * MS)).unwrap();
    assert_eq!((&*map.sensors[3].name, map.sensors[3].contribution), ("rear", Contribution::Ok));
    assert!(pipeline.newest_sweep().x.len() > without);

    for source in [4, 3] {
        pipeline.step(&event(source, 221 * MS, Body::Withdrawn)).unwrap();
    }
    assert_eq!(names(&pipeline), configured);
    let refused = pipeline.step(&event(2, 222 * MS, Body::Withdrawn)).unwrap_err();
    assert_eq!(
        (refused.reason(), refused.to_string().as_str()),
        ("sensor", "source 2 withdrawn: a declared sensor is allowed, from 3 on")
    );
}

#[test]
fn maps_go_on_when_the_sensor_that_makes_them_is_withdrawn() {
    // The sensor of the configuration looks up, so the declared one is the reference sensor once it has completed a
    // scan.
    let upward = SensorConfig { elevations_deg: Vec::new(), ..SensorConfig::new("side", at(0.0, 0.0, 1.5, 0.0)) };
    let tilted = Extrinsics { roll_deg: 60.0, ..upward.extrinsics };
    let sensors =
        vec![SensorConfig { extrinsics: tilted, ..upward.clone() }, SensorConfig { name: "front".into(), ..upward }];
    let mut pipeline = pipeline(&VehicleConfig { sensors, ..config() });
    pipeline.step(&event(2, 1, Body::Sensor(Box::new(SensorConfig::new("roof", at(0.0, 0.0, 1.9, 0.0)))))).unwrap();
    for packet in velodyne(Model::Vlp16, 1.9, 450) {
        pipeline.step(&Event { source: 2, ..packet }).unwrap();
    }
    assert_eq!(pipeline.reference_sensor(), 2);
    let now_ns = pipeline.newest_map().unwrap().completed_ns + MS;
    let last = step(&mut pipeline, &event(2, now_ns, Body::Withdrawn)).expect("a map of the unfinished revolution");
    assert!(pipeline.reference_sensor() < 2, "{}", pipeline.reference_sensor());
    assert_eq!((last.source, last.sensors[2].partial), (2, "end"));
    let points = u32::try_from(pipeline.newest_sweep().x.len()).unwrap();
    assert!(points > 1000 && points == last.sensors[2].returns, "the points of the newest map stay: {points}");
    assert!(pipeline.newest_map() == Some(&last) && pipeline.newest_revolution().is_none());
    assert!(pipeline.remake_newest_map().is_none());
    let maps = (1..20).filter(|tenth| {
        let late = Event { arrival_ns: now_ns + tenth * 100 * MS, ..scan(0, now_ns + tenth * 100 * MS) };
        pipeline.step(&late).unwrap().is_some()
    });
    assert!(maps.count() > 10);
}
