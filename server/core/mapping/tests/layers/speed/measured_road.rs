//! The road that is measured in the sweep, in simulated worlds and on the labelled frame.

use clearway_mapping::layer::speed::measured_road::MeasuredRoad;
use clearway_mapping::sensor::sweep::Mount;
use clearway_sim::scanner::ScannerConfig;
use clearway_sim::scenes;
use clearway_sim::vehicle::SimulatedVehicle;

use super::*;

/// Half the width of the simulated town's street, kerb to kerb, metres.
const TOWN_STREET_HALF_M: f64 = 5.6;

/// A street between kerbs 14 cm high: from 3.2 m to the right to 4.1 m to the left, on a slope of 5 %.
fn street(x: f32, y: f32, z: f32) -> bool {
    let ground = 0.05 * x;
    z <= ground || (z <= ground + 0.14 && !(-3.2..4.1).contains(&y))
}

/// The default parameters, with the road measured.
fn measuring() -> SpeedConfig {
    SpeedConfig { measure_road: true, ..SpeedConfig::default() }
}

#[test]
fn a_road_between_kerbs_is_measured_where_none_is_sent() {
    let sweep = cast(Model::Hdl64eS2, street);
    let mut measured = MeasuredRoad::default();
    assert!(measured.measure(&sweep));
    println!("{:?} {:?}", measured.points_m(), measured.widths_m());
    assert!(measured.points_m().len() >= 6);
    for (point, width_m) in measured.points_m().iter().zip(measured.widths_m()) {
        assert!((width_m - 7.3).abs() <= 0.5 && (point[1] - 0.45).abs() <= 0.3, "{point:?} {width_m}");
    }
    let layer = make(&measuring(), &sweep, &Context::default());
    assert_eq!((figure(&layer, "painting"), figure(&layer, "road_source")), (1.0, 2.0));
    assert!(classes(&layer).iter().filter(|class| **class == ROAD).count() > 200);
    // A sent road replaces it, and the conditions of the route stop it.
    let sent = stored(straight(6.0));
    let layer = make(&measuring(), &sweep, &Context { road: Some(&sent), ..Context::default() });
    assert_eq!(figure(&layer, "road_source"), 1.0);
    let bend =
        route((0..40).map(|i| [12.0 * (f64::from(i) * 0.1).sin(), 12.0 - 12.0 * (f64::from(i) * 0.1).cos()]).collect());
    let layer = make(&measuring(), &sweep, &Context { route: Some(&bend), ..Context::default() });
    assert_eq!((figure(&layer, "road_source"), figure(&layer, "stopped_by_curvature")), (0.0, 1.0));
    let off = SpeedConfig { measure_road: false, ..measuring() };
    assert_eq!(figure(&make(&off, &sweep, &Context::default()), "road_source"), 0.0);
    // The order of the points does not matter.
    let mut again = MeasuredRoad::default();
    again.measure(&shuffled(&sweep, 7));
    assert_eq!((again.points_m(), again.widths_m()), (measured.points_m(), measured.widths_m()));
}

#[test]
fn no_road_is_measured_without_edges_on_both_sides() {
    let one_kerb = |x: f32, y: f32, z: f32| z <= 0.0 || (z <= 0.14 && y > 4.1) || (x > 90.0);
    let posts =
        |x: f32, y: f32, z: f32| z <= 0.0 || (z <= 1.0 && (y.abs() - 4.0).abs() < 0.15 && (x.rem_euclid(5.0)) < 0.3);
    let walls = |_: f32, y: f32, z: f32| z <= 0.0 || (z <= 2.0 && y.abs() > 5.0);
    type World<'a> = &'a dyn Fn(f32, f32, f32) -> bool;
    let worlds: [(&str, World<'_>); 6] = [
        ("plain", &plain),
        ("one kerb", &one_kerb),
        ("posts", &posts),
        ("walls", &walls),
        ("slope", &|x, y, z| z <= 0.1 * x - 0.05 * y),
        ("crest", &|x, _, z| z <= -0.004 * x * x),
    ];
    for (name, world) in worlds {
        let sweep = cast(Model::Hdl64eS2, world);
        let mut measured = MeasuredRoad::default();
        assert!(!measured.measure(&sweep), "{name}: {:?} {:?}", measured.points_m(), measured.widths_m());
        assert_eq!(figure(&make(&measuring(), &sweep, &Context::default()), "road_source"), 0.0, "{name}");
    }
}

#[test]
fn a_street_of_the_simulated_town_is_measured_from_kerb_to_kerb_or_not_at_all() {
    let mount = Mount { ego_from_sensor: ScannerConfig::default().ego_from_sensor, range_m_min: 2.0 };
    let mut measured_stations = Vec::new();
    // Stations of the course, metres; cars that are parked on both sides hide much of the kerbs.
    for station in [20.0, 90.0, 105.0, 185.0, 263.0, 277.0, 345.0, 400.0, 430.0] {
        let mut scene = scenes::town();
        scene.drive.start = station;
        let revolution = SimulatedVehicle::new(scene, ScannerConfig::default()).revolution(1);
        let mut sweep = Sweep::default();
        sweep.set_revolution(&revolution, &mount);
        let mut measured = MeasuredRoad::default();
        if measured.measure(&sweep) {
            println!("{station} m: {:?} {:?}", measured.points_m(), measured.widths_m());
            measured_stations.push(station);
            for (point, width_m) in measured.points_m().iter().zip(measured.widths_m()) {
                assert!((width_m - 2.0 * TOWN_STREET_HALF_M).abs() <= 0.5, "{station} m: {width_m}");
                // The vehicle drives 1.8 m to the right of the middle.
                assert!((point[1] - 1.8).abs() <= 0.4, "{station} m: {point:?}");
            }
        }
    }
    println!("measured at {measured_stations:?} m");
    assert!(measured_stations.contains(&263.0), "{measured_stations:?}");
}

/// The road of the labelled frame, measured, against the points with the label road in it and beside it.
#[test]
#[cfg_attr(not(clearway_data), ignore = "needs the recorded drives: set CLEARWAY_DATA")]
fn the_measured_road_of_the_labelled_frame_is_its_road() {
    let (sweep, labels) = labels::labelled_frame();
    let mut measured = MeasuredRoad::default();
    assert!(measured.measure(&sweep));
    for (point, width_m) in measured.points_m().iter().zip(measured.widths_m()) {
        let in_band =
            |index: &usize| matches!(labels[*index], 40 | 60) && (f64::from(sweep.x[*index]) - point[0]).abs() < 1.0;
        let offsets: Vec<f64> = (0..labels.len()).filter(in_band).map(|index| f64::from(sweep.y[index])).collect();
        let [right, left] =
            [offsets.iter().copied().fold(f64::MAX, f64::min), offsets.iter().copied().fold(f64::MIN, f64::max)];
        println!("{} m ahead: {:.2} wide at {:.2}; labelled {:.2} to {:.2}", point[0], width_m, point[1], right, left);
        assert!((left - right - width_m).abs() < 0.6 && (point[1] - (left + right) / 2.0).abs() < 0.4);
    }
    assert!(measured.points_m().len() >= 4);
}
