//! Rotating sensors: self filter, half a revolution, two sensors at once, steps of the host's clock.

use super::*;

#[test]
fn the_self_filter_removes_returns_and_counts_them_by_sensor() {
    let mut config = config();
    config.body = Some(BodyConfig { x_m_min: -1.0, x_m_max: 3.5, y_m_min: -0.95, y_m_max: 0.95, z_m_max: 1.6 });
    let mut pipeline = pipeline(&config);
    // The left sensor returns a point on the vehicle, one on the ground, and one on the other side of the vehicle.
    let left = Scan {
        x: vec![-0.5, 5.0, -8.0],
        y: vec![0.0; 3],
        z: vec![0.0, -1.0, -0.5],
        intensity: vec![0.0; 3],
        ..ahead(10 * MS, &[], 0.0)
    };
    pipeline.step(&event(1, 10 * MS, Body::Scan(left))).unwrap();
    let map = step(&mut pipeline, &scan(0, 20 * MS)).unwrap();
    assert_eq!(map.sensors[1].returns, 3, "removed returns count as returns");
    assert_eq!(pipeline.newest_sweep().x.len(), 1, "the returns of the reference sensor lie behind the bonnet");
    let sensors = pipeline.sensors();
    let removed: Vec<_> = sensors.iter().map(|s| (s.ledger.own_body, s.ledger.through_body)).collect();
    assert_eq!(removed, [(0, 2), (1, 1), (0, 0)]);
    assert_eq!((pipeline.ledger().own_body, pipeline.ledger().through_body), (1, 3));

    // A rotating sensor over a flat street: the returns behind the box are removed, and all others stay.
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
    assert!(ledger.through_body > 1000, "rays to the ground in front of the bonnet cross the roof: {ledger:?}");
    assert!(boxed.x.len() < open.x.len() && boxed.deviation.len() == boxed.x.len());
    assert_eq!(boxed.returns, open.returns);
}

#[test]
fn half_a_field_of_view_is_complete_and_half_a_lost_revolution_is_not() {
    let events = velodyne(Model::Vlp16, 1.9, 2000);
    let lost_ns = events[0].arrival_ns + 1000 * MS..events[0].arrival_ns + 1100 * MS;
    let is_ahead = |event: &Event| match &event.body {
        Body::Datagram(packet) if packet.len() == 1206 => {
            !(9_000..27_000).contains(&u16::from_le_bytes([packet[2], packet[3]]))
        }
        _ => true,
    };
    let made = |keep: &dyn Fn(&Event) -> bool| -> Vec<(f32, Contribution)> {
        let mut pipeline = pipeline(&config());
        let maps = events.iter().filter(|event| keep(event)).filter_map(|event| step(&mut pipeline, event));
        maps.map(|map| (map.sensors[0].completeness, map.sensors[0].contribution)).collect()
    };
    let half = made(&is_ahead);
    assert!(
        half.len() > 15
            && half[5..].iter().all(|(share, contribution)| *share > 0.98 && *contribution == Contribution::Ok),
        "{half:?}"
    );
    let once = made(&|event| is_ahead(event) || !lost_ns.contains(&event.arrival_ns));
    let partial: Vec<f32> = once
        .iter()
        .filter(|(_, contribution)| *contribution == Contribution::Partial)
        .map(|(share, _)| *share)
        .collect();
    let lost: f32 = partial[1..].iter().map(|share| 1.0 - share).sum();
    assert!((0.45..0.55).contains(&lost), "after the first partial revolution half a revolution is missing: {once:?}");
}

#[test]
fn two_rotating_sensors_have_a_decoder_and_a_ledger_each() {
    let mut config = config();
    let low = SensorConfig { model: Some(Model::Hdl32e), ..SensorConfig::new("low", at(0.0, 0.0, 1.5, 0.0)) };
    config.sensors = vec![config.sensors[0].clone(), low, config.sensors[1].clone()];
    // The lower sensor has more lasers, and would be chosen.
    config.fusion.reference_sensor = "top".into();
    let reference = velodyne(Model::Vlp16, 1.9, 430);
    let low = velodyne(Model::Hdl32e, 1.5, 430).into_iter().map(|event| Event { source: 1, ..event });
    let mut events: Vec<Event> = reference.iter().cloned().chain(low).collect();
    events.extend((0..8).map(|n| scan(2, reference[0].arrival_ns + 7 * MS + n * 50 * MS)));
    events.sort_by_key(|event| (event.arrival_ns, event.source));
    let run = |events: &[Event]| {
        let mut pipeline = pipeline(&config);
        let made: Vec<Map> = events.iter().filter_map(|event| step(&mut pipeline, event)).collect();
        (made, pipeline)
    };
    let (made, pipeline) = run(&events);
    assert!(made.len() >= 3 && made.iter().all(|map| map.source == 0));
    let last = made.last().unwrap();
    let contributing: Vec<_> = last.sensors.iter().map(|s| (s.model, s.contribution, s.packets > 0)).collect();
    assert_eq!(
        contributing,
        [("vlp16", Contribution::Ok, true), ("hdl32e", Contribution::Ok, true), ("scan", Contribution::Ok, false)]
    );
    assert_eq!(last.sensors[0].packets_expected, last.sensors[0].packets);
    let (sensors, sum) = (pipeline.sensors(), pipeline.ledger());
    assert!(sensors.iter().all(|sensor| balanced(&sensor.ledger)) && balanced(sum));
    assert_eq!(sensors.iter().map(|sensor| sensor.ledger.received).sum::<u64>(), sum.received);
    assert_eq!(sum.received, events.len() as u64);
    assert_eq!(run(&events).0, made, "the same events give the same maps");

    // Without events of other sensors the maps are the maps of a vehicle with one sensor.
    let only: Vec<_> = run(&reference).0;
    let mut single =
        Pipeline::new(&VehicleConfig { sensors: vec![config.sensors[0].clone()], ..config.clone() }, vec![None])
            .unwrap();
    let expected: Vec<_> = reference.iter().filter_map(|event| step(&mut single, event)).collect();
    assert_eq!(only.len(), expected.len());
    for (only, expected) in only.iter().zip(&expected) {
        assert_eq!((&only.layers, only.capture_end_ns), (&expected.layers, expected.capture_end_ns));
    }

    // The order of the other sensors' events between two maps has no effect.
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
fn a_step_of_the_host_clock_holds_no_map_back() {
    for step_ns in [-3_600_000 * MS, 3_600_000 * MS] {
        let mut pipeline = pipeline(&config());
        let mut made = 0;
        for n in 0..40i64 {
            let stamp_ns = 1_700_000_000_000 * MS + n * 50 * MS;
            let arrival_ns = stamp_ns + if n < 10 { 0 } else { step_ns };
            // The reference sensor stops a second after the step.
            if n < 30 && n % 2 == 0 {
                made += usize::from(step(&mut pipeline, &event(0, arrival_ns, scan(0, stamp_ns).body)).is_some());
            }
            made += usize::from(step(&mut pipeline, &event(1, arrival_ns, scan(1, stamp_ns).body)).is_some());
        }
        assert!((17..=24).contains(&made), "{step_ns}: {made} maps in 2 s");
    }
}

#[test]
fn a_revolution_that_ends_after_a_silence_makes_no_map_older_than_the_last() {
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
                let step_ns = if event.arrival_ns < silent.end { 0 } else { host_ns };
                step(&mut pipeline, &Event { arrival_ns: event.arrival_ns + step_ns, ..event.clone() })
            })
            .map(|map| map.capture_end_ns)
            .collect();
        assert!(made.len() > 12 && made.is_sorted_by(|before, after| before < after), "{host_ns}: {made:?}");
    }
}
