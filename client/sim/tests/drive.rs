//! A vehicle's stream of datagrams: rates, order, repeatability, a way that is free to drive.

use clearway_lidar::calibration::Calibration;
use clearway_lidar::model::{Model, ReturnMode};
use clearway_lidar::telemetry::Telemetry;
use clearway_lidar::{CalibrationSource, Sensor, SensorConfig};
use clearway_sim::scanner::ScannerConfig;
use clearway_sim::scenes;
use clearway_sim::truth::{Limits, Truth};
use clearway_sim::vehicle::{Datagram, Kind, SimulatedVehicle};

fn town(config: ScannerConfig) -> SimulatedVehicle {
    SimulatedVehicle::new(scenes::town(), config)
}

fn first_second(vehicle: SimulatedVehicle) -> Vec<Datagram> {
    let start_ns = vehicle.start_ns();
    vehicle.take_while(|datagram| datagram.stamp_ns < start_ns + 1_000_000_000).collect()
}

#[test]
fn each_model_sends_as_many_packets_per_second_as_in_its_manual() {
    for (model, return_mode, expected) in [
        (Model::Hdl64eS2, ReturnMode::Strongest, 3472),
        (Model::Hdl64eS3, ReturnMode::Dual, 5787),
        (Model::Hdl32e, ReturnMode::Strongest, 1808),
        (Model::Vlp16, ReturnMode::Strongest, 753),
        (Model::Vlp16, ReturnMode::Dual, 1507),
    ] {
        let datagrams = first_second(town(ScannerConfig { model, return_mode, ..ScannerConfig::default() }));
        let count = |kind| datagrams.iter().filter(|datagram| datagram.kind == kind).count();
        assert_eq!((count(Kind::Data), count(Kind::Telemetry)), (expected, 100), "{model:?} {return_mode:?}");
    }
}

#[test]
fn datagrams_are_in_order_of_their_stamps_and_have_their_lengths() {
    let datagrams = first_second(town(ScannerConfig::default()));
    assert!(datagrams.windows(2).all(|pair| pair[0].stamp_ns <= pair[1].stamp_ns));
    for datagram in &datagrams {
        assert_eq!(datagram.payload.len(), if datagram.kind == Kind::Data { 1206 } else { 512 });
    }
}

#[test]
fn the_same_seed_sends_the_same_bytes_from_wherever_it_begins() {
    let config = ScannerConfig { model: Model::Vlp16, ..ScannerConfig::default() };
    let late = town(config.clone()).from_revolution(4);
    let packets = |vehicle: SimulatedVehicle| vehicle.filter(|datagram| datagram.kind == Kind::Data);
    let expected: Vec<Datagram> = packets(late).take(50).collect();
    let whole = packets(town(config.clone())).skip_while(|datagram| datagram.stamp_ns < expected[0].stamp_ns);
    assert_eq!(whole.take(50).collect::<Vec<_>>(), expected);
    let other = packets(town(ScannerConfig { seed: 2, ..config }).from_revolution(4)).take(50).collect::<Vec<_>>();
    assert_ne!(other, expected, "another seed, other noise");
}

#[test]
fn telemetry_tells_the_vehicles_time_place_and_speed() {
    let vehicle = town(ScannerConfig { model: Model::Vlp16, ..ScannerConfig::default() });
    let mut last = None;
    for datagram in vehicle.clone().filter(|datagram| datagram.kind == Kind::Telemetry).take(250) {
        let telemetry = Telemetry::new(&datagram.payload).expect("the decoder reads what the encoder writes");
        assert_eq!(i64::from(telemetry.device_us), datagram.stamp_ns / 1000 % 3_600_000_000);
        let fix = telemetry.gprmc.expect("a fix");
        let fix_ns = fix.utc_ns.expect("a time");
        assert!((0..1_000_000_000).contains(&(datagram.stamp_ns - fix_ns)));
        let place = vehicle.pose_at(fix_ns).translation;
        let (latitude, longitude) = vehicle.datum().globe(place.x, place.y);
        // A ten-thousandth of a minute.
        assert!((fix.latitude_deg.unwrap() - latitude).abs() < 1e-6);
        assert!((fix.longitude_deg.unwrap() - longitude).abs() < 1e-6);
        assert!((fix.speed_knots.unwrap() * 1852.0 / 3600.0 - vehicle.speed_at(fix_ns)).abs() < 0.03);
        last = Some(fix_ns);
    }
    assert_eq!(last, Some(vehicle.start_ns() + 2_000_000_000));
}

#[test]
fn the_way_round_the_town_is_free_and_never_ends() {
    let vehicle = town(ScannerConfig::default());
    let limits = Limits::default();
    for second in (0..150).chain([100_000]) {
        let stamp_ns = vehicle.start_ns() + second * 1_000_000_000;
        let truth = vehicle.truth_at(stamp_ns, 8.0, 0.2, &limits);
        // The vehicle's own footprint, 4.4 m by 1.8 m.
        for part in 0..=22 {
            for side in [-0.9, 0.0, 0.9] {
                let class = truth.class_at(-2.2 + 0.2 * f64::from(part), side);
                assert_eq!(class, Truth::Drivable, "after {second} s at part {part}, {side} m beside");
            }
        }
    }
}

#[test]
fn a_turn_comes_with_the_truth_of_its_end() {
    let vehicle = SimulatedVehicle::new(scenes::fenced_road_under_canopy(), ScannerConfig::default());
    let scan = vehicle.true_revolution(0);
    assert_eq!(scan.revolution.partial, None);
    assert_eq!(scan.map_from_ego, vehicle.pose_at(scan.revolution.end_ns));
    assert_eq!(scan.truth.class_at(0.0, 10.0), Truth::Unreachable, "behind the fence");
    assert_eq!(scan.truth.class_at(6.0, 0.0), Truth::Drivable, "under the canopy");
    let ahead = scenes::fenced_road_with_low_overhang();
    let scan = SimulatedVehicle::new(ahead, ScannerConfig::default()).true_revolution(0);
    assert_eq!(scan.truth.class_at(4.0, 0.0), Truth::Overhang, "the overhang");
    assert_eq!(scan.truth.class_at(14.0, 0.0), Truth::Unreachable, "behind the overhang");
    assert_eq!(scan.truth.class_at(-5.0, 0.0), Truth::Drivable, "the way back");
}

#[test]
fn an_hdl_64e_tells_its_own_table_in_its_status_bytes() {
    let mut own = Calibration::factory(Model::Hdl64eS2);
    for laser in &mut own.lasers {
        laser.dist_correction = 0.8 + 0.01 * f64::from(laser.laser_id);
        laser.horiz_offset_correction = if laser.laser_id % 2 == 0 { 0.026 } else { -0.026 };
    }
    let vehicle = town(ScannerConfig { calibration: Some(own.clone()), ..ScannerConfig::default() });
    let mut sensor = Sensor::new(SensorConfig::default());
    let mut calibration = None;
    // The table takes 4,160 packets; it is used from the next revolution on.
    for datagram in vehicle.take(4_160 + 2 * 360 + 200) {
        if let Some(revolution) = sensor.push(&datagram.payload, datagram.stamp_ns).expect("a sound datagram") {
            calibration = Some(revolution.calibration.clone());
        }
    }
    assert_eq!(sensor.status().calibration, CalibrationSource::StatusBytes);
    assert_eq!(
        (sensor.status().model, sensor.status().return_mode),
        (Some(Model::Hdl64eS2), Some(ReturnMode::Strongest))
    );
    for (sent, own) in calibration.expect("a revolution").lasers.iter().zip(&own.lasers) {
        assert!((sent.vert_correction - own.vert_correction).abs() < 0.0051_f64.to_radians());
        assert!((sent.dist_correction - own.dist_correction).abs() < 0.00051);
        assert!((sent.horiz_offset_correction - own.horiz_offset_correction).abs() < 0.00051);
    }
}

#[test]
fn what_the_sensor_sees_is_less_than_what_is_there() {
    let vehicle = SimulatedVehicle::new(scenes::town(), ScannerConfig::default());
    let stamp_ns = vehicle.start_ns();
    let truth = vehicle.truth_at(stamp_ns, 40.0, 0.4, &Limits::default());
    let sees = vehicle.sees(stamp_ns, &truth);
    let (hidden, seen): (Vec<usize>, Vec<usize>) = (0..sees.len()).partition(|&index| !sees[index]);
    assert!(hidden.len() > sees.len() / 4 && seen.len() > sees.len() / 8, "{} of {}", seen.len(), sees.len());
    let near = seen.iter().filter(|&&index| truth.middle(index).0.hypot(truth.middle(index).1) < 1.5).count();
    assert_eq!(near, (0..sees.len()).filter(|&i| truth.middle(i).0.hypot(truth.middle(i).1) < 1.5).count());
}

#[test]
fn a_steered_vehicle_continues_from_its_place_along_the_given_arc() {
    let mut vehicle = town(ScannerConfig { model: Model::Vlp16, ..ScannerConfig::default() });
    vehicle.nth(100);
    for (curvature, speed) in [(0.1, 5.0), (0.0, 8.0), (-0.05, 3.0), (0.0, 0.0)] {
        let scene = vehicle.scene().clone();
        let begins_ns = vehicle.steer(curvature, speed);
        let at = |time_ns: i64| vehicle.scene().drive.at((time_ns - vehicle.start_ns()) as f64 * 1e-9);
        let (before, begins) = (scene.drive.at((begins_ns - vehicle.start_ns()) as f64 * 1e-9), at(begins_ns));
        let gap = (before.0 - begins.0).hypot(before.1 - begins.1) + (before.2 - begins.2).abs();
        assert!(gap < 1e-9, "{before:?}, {begins:?}");
        let later = at(begins_ns + 1_000_000_000);
        assert!((later.2 - begins.2 - curvature * speed).abs() < 1e-9, "{begins:?}, {later:?}");
        assert!((later.0 - begins.0).hypot(later.1 - begins.1) <= speed + 1e-9 && vehicle.speed_at(begins_ns) == speed);
        assert!(vehicle.by_ref().nth(50).expect("no end").stamp_ns > begins_ns);
    }
}
