use std::f64::consts::{FRAC_1_SQRT_2, FRAC_PI_2};

use clearway_proto::limits::{PLAN_BYTES_MAX, PLAN_POINTS_MAX};
use clearway_proto::plan::{PlanError, check, footprint_at_end, lines, over};
use clearway_proto::v1::{Plan, PlanFrame, PlanGoal, Pose};
use prost::Message;

const NOW_NS: i64 = 1_700_000_000_000_000_000;

/// 10 m straight ahead and 2 m to the left.
fn plan() -> Plan {
    Plan {
        stamp_ns: NOW_NS,
        frame: PlanFrame::Ego.into(),
        x: vec![0.0, 10.0, 10.0],
        y: vec![0.0, 0.0, 2.0],
        footprint_m: vec![1.0, 0.5, -1.0, 0.5, -1.0, -0.5, 1.0, -0.5],
        goal: Some(PlanGoal { x: 20.0, y: 2.0 }),
        ..Plan::default()
    }
}

fn rounded(numbers: &[f64]) -> Vec<f64> {
    numbers.iter().map(|number| (number * 1e6).round() / 1e6 + 0.0).collect()
}

#[test]
fn a_plan_that_cannot_be_drawn_is_refused_with_its_value() {
    assert_eq!(check(&plan(), NOW_NS), Ok(()));
    let long = Plan { x: vec![1.0; PLAN_POINTS_MAX], y: vec![1.0; PLAN_POINTS_MAX], ..plan() };
    let long = Plan { heading_rad: vec![1.0; PLAN_POINTS_MAX], footprint_m: vec![1.0; 128], ..long };
    assert_eq!(check(&long, NOW_NS), Ok(()));
    assert!(long.encoded_len() < PLAN_BYTES_MAX);
    let longer = vec![1.0; PLAN_POINTS_MAX + 1];
    let pose = |qw, x| Some(Pose { qw, x, ..Pose::default() });
    for (wrong, text) in [
        (Plan { frame: 0, ..plan() }, "frame 0: PLAN_FRAME_EGO (1) and PLAN_FRAME_MAP (2) are allowed"),
        (Plan { frame: 7, ..plan() }, "frame 7: "),
        (Plan { x: vec![], y: vec![], ..plan() }, "path of 0 points: 1 to 4096 are allowed"),
        (Plan { x: longer.clone(), y: longer, ..plan() }, "path of 4097 points"),
        (Plan { y: vec![1.0], ..plan() }, "y of 1 numbers: one for each of the 3 points is allowed"),
        (Plan { heading_rad: vec![1.0], ..plan() }, "heading_rad of 1 numbers"),
        (Plan { footprint_m: vec![1.0; 7], ..plan() }, "footprint_m of 7 numbers"),
        (Plan { footprint_m: vec![1.0; 4], ..plan() }, "footprint_m of 4 numbers"),
        (Plan { y: vec![0.0, 1.0, f64::NAN], ..plan() }, "y[2] is NaN: finite numbers up to 1e9 are allowed"),
        (Plan { x: vec![0.0, 1e30, 2.0], ..plan() }, "x[1] is 1000000000000000000000000000000: finite numbers up to"),
        (Plan { goal: Some(PlanGoal { x: 0.0, y: f64::INFINITY }), ..plan() }, "goal[1] is inf"),
        (Plan { map_from_ego: pose(1.0, f64::NAN), ..plan() }, "map_from_ego[0] is NaN"),
        (Plan { map_from_ego: pose(0.0, 1.0), ..plan() }, "map_from_ego with a quaternion of length 0"),
        (Plan { planner: "p".repeat(65), ..plan() }, "planner of 65 bytes: up to 64 are allowed"),
        (Plan { text: "t".repeat(257), ..plan() }, "text of 257 bytes"),
    ] {
        let error = check(&wrong, NOW_NS).unwrap_err().to_string();
        assert!(error.starts_with(text), "{error}");
    }
    let ahead = PlanError::StampAhead { stamp_ns: NOW_NS, ahead_ns: 10_000_000_001 };
    assert_eq!(check(&plan(), NOW_NS - 10_000_000_001), Err(ahead));
}

#[test]
fn a_plan_moves_into_the_ego_frame_of_a_later_map() {
    // The vehicle stood at (100, 50) and looked along y; it has driven 4 m.
    let turned = |y| Pose { x: 100.0, y, qz: FRAC_1_SQRT_2, qw: FRAC_1_SQRT_2, ..Pose::default() };
    let sent = Plan { map_from_ego: Some(turned(50.0)), ..plan() };
    let later = over(&sent, NOW_NS + 100_000_000, Some(&turned(54.0))).unwrap();
    assert_eq!((rounded(&later.x), rounded(&later.y)), (vec![-4.0, 6.0, 6.0], vec![0.0, 0.0, 2.0]));
    assert_eq!(rounded(&later.heading_rad), rounded(&[0.0, FRAC_PI_2, FRAC_PI_2]));
    assert_eq!(rounded(&[later.goal.unwrap().x, later.goal.unwrap().y]), [16.0, 2.0]);
    let fixed = Plan { frame: PlanFrame::Map.into(), x: vec![100.0, 98.0], y: vec![60.0, 60.0], ..plan() };
    let later = over(&fixed, NOW_NS, Some(&turned(54.0))).unwrap();
    assert_eq!((rounded(&later.x), rounded(&later.y)), (vec![6.0, 6.0], vec![0.0, 2.0]));
    assert_eq!(later.frame(), PlanFrame::Ego);
    assert_eq!(over(&fixed, NOW_NS, None), None, "without a pose of the map it has no place");
    // Without a pose of its own it stays as it was sent.
    assert_eq!(over(&plan(), NOW_NS + 1, Some(&turned(54.0))).unwrap().x, plan().x);
}

#[test]
fn a_plan_is_drawn_over_maps_within_two_seconds_of_its_stamp() {
    let at = |after_ms: i64| over(&plan(), NOW_NS + after_ms * 1_000_000, None).is_some();
    assert_eq!([-2001, -2000, 0, 2000, 2001].map(at), [false, true, true, true, false]);
    assert_eq!(over(&Plan { stamp_ns: i64::MIN, ..plan() }, i64::MAX, None), None);
}

#[test]
fn the_footprint_stands_at_the_end_of_the_path_along_it() {
    let corners = footprint_at_end(&plan());
    assert_eq!(rounded(corners.as_flattened()), [9.5, 3.0, 9.5, 1.0, 10.5, 1.0, 10.5, 3.0]);
    // Two of the path, four of the footprint, two of the cross.
    assert_eq!(lines(&plan()).len(), 8);
    assert!(lines(&plan()).iter().all(|[from, to]| from != to));
    assert!(footprint_at_end(&Plan { footprint_m: vec![], ..plan() }).is_empty());
}
