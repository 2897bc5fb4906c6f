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
    assert_eq!((map.sensors[3].name.as_str(), map.sensors[3].contribution), ("rear", Contribution::Ok));
    assert!((pipeline.newest_sweep().x[2] + 6.0).abs() < 1e-5, "5 m behind the rear sensor");
    assert_eq!(pipeline.sensors().len(), 4);
}
