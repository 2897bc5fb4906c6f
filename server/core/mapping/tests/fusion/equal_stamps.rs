//! Sensors whose scans have equal stamps: they are in one map, whichever of them arrives first.

use super::*;

/// A scan of sensor `source` that arrives `late_ms` after its stamp.
fn late(source: u16, stamp_ms: i64, late_ms: i64) -> Event {
    Event { arrival_ns: (stamp_ms + late_ms) * MS, ..scan(source, stamp_ms * MS) }
}

/// The maps of these events, each with the time of the event that completed it, ms.
fn maps(events: &[Event]) -> Vec<(i64, Map)> {
    let mut pipeline = pipeline(&config());
    let map = |event: &Event| Some((event.arrival_ns / MS, step(&mut pipeline, event)?));
    events.iter().filter_map(map).collect()
}

#[test]
fn scans_with_equal_stamps_are_in_one_map_whichever_arrives_first() {
    for lates in [[0, 5, 8], [0, 8, 5], [5, 0, 8], [8, 5, 0]] {
        let mut events: Vec<Event> =
            (1..8).flat_map(|n| (0..3).map(move |source| late(source, n * 100, lates[usize::from(source)]))).collect();
        events.sort_by_key(|event| event.arrival_ns);
        let made = maps(&events);
        // The periods are known from the second scans on.
        assert_eq!(made.len(), 7, "{lates:?}");
        for (completed_ms, map) in &made[2..] {
            let stamp_ms = map.capture_end_ns / MS;
            let whole = [(Contribution::Ok, Some(0)); 3];
            assert_eq!((map.source, &contributions(map)[..]), (0, &whole[..]), "{lates:?} at {stamp_ms}");
            assert_eq!(*completed_ms, stamp_ms + 8, "{lates:?}: completed by the last of the scans");
            assert_eq!(map.completed_ns, completed_ms * MS);
        }
        assert!(made.windows(2).all(|pair| pair[0].1.capture_end_ns < pair[1].1.capture_end_ns));
        assert_eq!(maps(&events), made, "the same events give the same maps");
    }
}

#[test]
fn stamps_are_equal_within_a_fiftieth_of_the_period() {
    for (apart_ms, waits) in [(1, true), (2, true), (3, false)] {
        let scans = |n: i64| [late(0, n * 100, 0), late(1, n * 100 - apart_ms, apart_ms + 5)];
        let made = maps(&(1..8).flat_map(scans).collect::<Vec<_>>());
        let expected_ms = if waits { 5 } else { 0 };
        assert!(made.len() == 7 && made[2..].iter().all(|(at_ms, map)| at_ms - map.capture_end_ns / MS == expected_ms));
    }
}

#[test]
fn a_map_waits_no_longer_than_a_quarter_of_the_deadline() {
    let pose = |at_ms: i64| {
        let pose = EgoPose { stamp_ns: at_ms * MS, map_from_ego: Isometry3::identity(), speed_mps: 0.0 };
        event(0, at_ms * MS, Body::EgoPose(pose))
    };
    let mut events: Vec<Event> = (1..5).flat_map(|n| [late(0, n * 100, 0), late(1, n * 100, 5)]).collect();
    // The left sensor's scans of 500 ms and later are missing.
    events.extend([late(0, 500, 0), pose(530), pose(550), pose(551), pose(552)]);
    events.extend([late(0, 600, 0), pose(601), late(0, 700, 0), pose(701)]);
    let made = maps(&events);
    let completed: Vec<(i64, i64)> = made.iter().map(|(at_ms, map)| (map.capture_end_ns / MS, *at_ms)).collect();
    assert_eq!(completed[3..], [(400, 405), (500, 551), (600, 600), (700, 700)], "only the first scan is waited for");
    assert_eq!(contributions(&made[4].1)[1], (Contribution::Ok, Some(100)));
}

#[test]
fn a_vehicle_with_one_sensor_never_waits() {
    let mut alone = config();
    alone.sensors.truncate(1);
    let mut pipeline = pipeline(&alone);
    for n in 1..10 {
        let map = step(&mut pipeline, &scan(0, n * 100 * MS)).expect("a map for each scan");
        assert_eq!(map.completed_ns, n * 100 * MS);
    }
}

#[test]
fn a_sensor_that_always_comes_too_late_is_not_waited_for() {
    let mut events: Vec<Event> = (1..8).flat_map(|n| [late(0, n * 100, 0), late(1, n * 100, 60)]).collect();
    events.sort_by_key(|event| event.arrival_ns);
    let made = maps(&events);
    assert!(made.len() == 7 && made.iter().all(|(at_ms, map)| *at_ms == map.capture_end_ns / MS));
}

#[test]
fn scans_that_arrive_at_once_make_a_map_each() {
    let mut events: Vec<Event> = (1..5).flat_map(|n| [late(0, n * 100, 0), late(1, n * 100, 5)]).collect();
    // After a pause of the host two scans of the reference sensor arrive at once, before the scans of the left sensor.
    events.extend([late(0, 500, 105), late(0, 600, 5), late(1, 500, 106), late(1, 600, 6)]);
    events.extend([late(0, 700, 0), late(1, 700, 5), late(0, 800, 0), late(1, 800, 5)]);
    let made = maps(&events);
    let stamps: Vec<i64> = made.iter().map(|(_, map)| map.capture_end_ns / MS).collect();
    assert_eq!(stamps, [100, 200, 300, 400, 500, 600, 700, 800]);
    let two = |map: &Map| map.sensors[..2].iter().all(|sensor| sensor.contribution.is_in_map());
    assert!(made[1..].iter().all(|(_, map)| two(map)));
    for (_, map) in &made[4..] {
        assert_eq!(map.sensors[0].age_ms, Some(0.0), "the map has the points of its own scan");
    }
}

#[test]
fn the_end_of_a_sensor_ends_the_wait_for_it() {
    let events = |ended: u16| {
        let mut events: Vec<Event> = (1..4).flat_map(|n| [late(0, n * 100, 0), late(1, n * 100, 5)]).collect();
        events.extend([late(0, 400, 0), event(ended, 401 * MS, Body::End)]);
        events
    };
    for ended in [0, 1] {
        let made = maps(&events(ended));
        let (at_ms, last) = made.last().unwrap();
        assert_eq!((made.len(), *at_ms, last.capture_end_ns), (4, 401, 400 * MS), "end of sensor {ended}");
    }
    assert_eq!(maps(&events(2)).len(), 3, "the right sensor is not due");
}
