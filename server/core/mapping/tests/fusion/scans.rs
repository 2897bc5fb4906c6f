//! Scan events: motion compensation of their points, which scans are refused, and what defines the rows of radial maps.

use super::*;
use crate::common;

#[test]
fn each_point_of_a_scan_is_moved_from_its_own_time() {
    let mut pipeline = pipeline(&config());
    for n in 0..=10 {
        let map_from_ego = Isometry3::new(Vector3::new(0.15 * f64::from(n), 0.0, 0.0), Vector3::zeros());
        let pose = EgoPose { stamp_ns: i64::from(n) * 10 * MS, map_from_ego, speed_mps: 15.0 };
        step(&mut pipeline, &event(0, pose.stamp_ns, Body::EgoPose(pose.clone())));
    }
    // A wall 30 m ahead in the world; its points have random times while the vehicle drives 1.5 m towards it.
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
        refusal(scan)
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

/// The error for a scan of the reference sensor.
fn refusal(scan: Scan) -> String {
    let mut pipeline = pipeline(&config());
    let refused = pipeline.step(&event(0, 1, Body::Scan(scan))).unwrap_err();
    assert!(balanced(pipeline.ledger()) && pipeline.ledger().refused[refused.reason()] == 1);
    refused.to_string()
}

#[test]
fn rows_come_from_the_configured_elevations_or_from_the_rings_of_the_scan() {
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
    assert_eq!(common::ring_benches(&measured.layers[0]).len(), 8);
    assert!(common::figure(&measured.layers[0], "drivable_share") > 0.95);
    assert_eq!(map(Vec::new(), ground(true)).layers, measured.layers, "the order of the points has no effect");
    let configured = map(elevations_deg, Scan { ring: Vec::new(), ..ground(false) });
    for (a, b) in common::benches(&configured.layers[0]).iter().zip(common::benches(&measured.layers[0])) {
        assert!((a - b).abs() < 1e-2, "{a} {b}");
    }
    let by_order = map(Vec::new(), Scan { ring: Vec::new(), ..ground(true) });
    // The maps that need rings for their roughness differ.
    assert_eq!(by_order.layers[..2], measured.layers[..2], "points that are stored ring by ring show the rings");
    // Points in no order, at elevations without clusters.
    let order = |i: usize| i * 1979 % (720 * 8);
    let pick = |axis: &[f32]| (0..axis.len()).map(|i| axis[order(i)]).collect::<Vec<f32>>();
    let ringed = ground(false);
    let z = pick(&ringed.z).iter().zip(0..).map(|(z, i)| z + (i * 13 % 97) as f32 * 0.005).collect();
    let (x, y) = (pick(&ringed.x), pick(&ringed.y));
    let without_rows = map(Vec::new(), Scan { x, y, z, ring: Vec::new(), ..ringed });
    for layer in &without_rows.layers[..2] {
        let rows = common::benches(layer);
        assert!(rows.windows(2).all(|pair| (pair[1] - pair[0] - 1.0).abs() < 1e-3), "rows of 1 m: {rows:?}");
        assert!(common::classes(layer).iter().any(|class| *class != 0), "{}", layer.name);
    }
    // If the reference sensor has no rings, a sensor that has rings gives the rows.
    let mut two = config();
    two.sensors[0].model = None;
    let mut pipeline = pipeline(&two);
    step(&mut pipeline, &event(1, MS, Body::Scan(ground(false))));
    let fused = step(&mut pipeline, &scan(0, 2 * MS)).unwrap();
    assert!(common::classes(&fused.layers[0]).iter().any(|class| *class != 0));
}
