//! The reference sensor of a vehicle whose configuration names none.

use super::*;

/// Level ground `height_m` under a sensor: 8 rings all around, or in `share` of the directions.
fn around(stamp_ns: i64, height_m: f32, share: f32) -> Scan {
    let angle = |i: usize| (i % 360) as f32 * share * std::f32::consts::TAU / 360.0;
    let radius = |i: usize| height_m / (0.05 + 0.05 * (i / 360) as f32);
    Scan {
        x: (0..8 * 360).map(|i| radius(i) * angle(i).cos()).collect(),
        y: (0..8 * 360).map(|i| radius(i) * angle(i).sin()).collect(),
        z: vec![-height_m; 8 * 360],
        intensity: vec![0.5; 8 * 360],
        ring: (0..8 * 360u16).map(|i| 7 - i / 360).collect(),
        ..ahead(stamp_ns, &[], 0.0)
    }
}

/// A sensor at the bumper that sees a third of the directions, and one on the roof.
fn bumper_and_roof() -> VehicleConfig {
    let sensor =
        |name: &str, x_m, z_m| SensorConfig { range_m_min: 0.0, ..SensorConfig::new(name, at(x_m, 0.0, z_m, 0.0)) };
    VehicleConfig::new("car", vec![sensor("bumper", 3.5, 0.6), sensor("roof", 0.0, 1.9)])
}

fn events(first: u16) -> Vec<Event> {
    let scan = |source: u16, n: i64| {
        let late_ms = if source == first { 10 } else { 20 };
        let stamp_ns = (n * 100 + late_ms) * MS;
        let scan = if source == 0 { around(stamp_ns, 0.6, 0.3) } else { around(stamp_ns, 1.9, 1.0) };
        event(source, stamp_ns, Body::Scan(scan))
    };
    let mut events: Vec<Event> = (0..6).flat_map(|n| [scan(0, n), scan(1, n)]).collect();
    events.sort_by_key(|event| event.arrival_ns);
    events
}

#[test]
fn the_sensor_that_sees_all_around_is_the_reference_whichever_sends_first() {
    for first in [0, 1] {
        let mut pipeline = pipeline(&bumper_and_roof());
        let made: Vec<Map> = events(first).iter().filter_map(|event| step(&mut pipeline, event)).collect();
        assert_eq!(pipeline.reference_sensor(), 1, "{first}");
        let marked: Vec<bool> = pipeline.sensors().iter().map(|sensor| sensor.is_reference).collect();
        assert_eq!(marked, [false, true], "the status of the sensors names it too");
        let chosen = made.iter().skip_while(|map| map.reference_sensor == 0);
        assert!(chosen.clone().count() >= 5, "{first}: chosen when both have completed a scan");
        assert!(chosen.clone().all(|map| (map.source, map.reference_sensor) == (1, 1)), "{first}");
    }
    let mut named = bumper_and_roof();
    named.fusion.reference_sensor = "bumper".into();
    let mut pipeline = pipeline(&named);
    let made: Vec<Map> = events(1).iter().filter_map(|event| step(&mut pipeline, event)).collect();
    assert!(made.len() >= 5 && made.iter().all(|map| (map.source, map.reference_sensor) == (0, 0)));
}

#[test]
fn before_any_scan_the_configured_lasers_and_the_mounts_choose() {
    let chosen = |change: &dyn Fn(&mut VehicleConfig)| {
        let mut config = bumper_and_roof();
        change(&mut config);
        pipeline(&config).reference_sensor()
    };
    assert_eq!(chosen(&|_| ()), 0, "equal sensors: the first");
    assert_eq!(chosen(&|config| config.sensors[1].model = Some(Model::Vlp16)), 1);
    assert_eq!(chosen(&|config| config.sensors[1].elevations_deg = vec![-9.0, -5.0]), 1);
    assert_eq!(chosen(&|config| config.sensors[0].extrinsics.pitch_deg = 40.0), 1);
    let models = |config: &mut VehicleConfig| {
        (config.sensors[0].model, config.sensors[1].model) = (Some(Model::Vls128), Some(Model::Vlp16));
    };
    assert_eq!(chosen(&models), 0, "more lasers");
}

#[test]
fn a_sensor_that_never_sends_does_not_delay_the_choice() {
    let mut pipeline = pipeline(&bumper_and_roof());
    let alone = events(1).into_iter().filter(|event| event.source == 1);
    let made: Vec<Map> = alone.filter_map(|event| step(&mut pipeline, &event)).collect();
    assert_eq!(pipeline.reference_sensor(), 1);
    assert!(made.iter().any(|map| (map.source, map.reference_sensor) == (1, 1)));
}

#[test]
fn a_better_sensor_that_starts_late_becomes_the_reference() {
    let mut pipeline = pipeline(&bumper_and_roof());
    let late = |event: &Event| event.source == 0 || event.arrival_ns > 4 * 100 * MS;
    for event in events(0).iter().filter(|event| late(event)) {
        step(&mut pipeline, event);
        assert_eq!(pipeline.reference_sensor(), usize::from(event.source), "after {} ms", event.arrival_ns / MS);
        if event.source == 1 {
            return;
        }
    }
    panic!("the roof's sensor sends nothing");
}
