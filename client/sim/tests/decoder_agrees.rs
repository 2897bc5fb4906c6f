//! The law of the encoder: what the decoder makes of the datagrams is the world they were made from.

use clearway_lidar::calibration::Calibration;
use clearway_lidar::model::{Model, ReturnMode};
use clearway_lidar::revolution::Revolution;
use clearway_sim::noise::gaussian;
use clearway_sim::raycast::{Caster, Hit};
use clearway_sim::scanner::ScannerConfig;
use clearway_sim::scenes;
use clearway_sim::vehicle::SimulatedVehicle;
use proptest::prelude::*;

/// A table whose every laser is off in every way, as a real unit's are; in steps that an HDL-64E's status bytes carry.
fn crooked(model: Model, seed: u64) -> Calibration {
    let mut calibration = Calibration::factory(model);
    for laser in &mut calibration.lasers {
        let draw = |what: u64| gaussian(seed << 32 | what << 16 | u64::from(laser.laser_id));
        let angle = |rad: f64| (rad.to_degrees() * 100.0).round().to_radians() / 100.0;
        let length = |m: f64| (m * 1000.0).round() / 1000.0;
        laser.vert_correction = angle(laser.vert_correction + 0.003 * draw(0));
        laser.rot_correction = angle(laser.rot_correction + 0.01 * draw(1));
        laser.dist_correction = length(0.3 * draw(2));
        laser.vert_offset_correction = length(0.1 * draw(3));
        laser.horiz_offset_correction = length(0.03 * draw(4));
    }
    calibration
}

/// The largest differences between a revolution and the world: azimuth (degrees), range (counts), point (degrees at the
/// sensor, quantised range left out), stamp (µs).
#[derive(Debug, Default, PartialEq)]
struct Differences {
    azimuth_deg: f64,
    range_counts: f64,
    point_deg: f64,
    stamp_us: f64,
    returns: usize,
}

fn compare(vehicle: &SimulatedVehicle, revolution: &Revolution) -> Differences {
    let scanner = vehicle.scanner();
    let (config, spec) = (scanner.config(), scanner.spec());
    let (start_ns, period_ns) = (vehicle.start_ns(), i64::from(spec.period_ns(config.return_mode)));
    let mut worst = Differences::default();
    let mut caster: Option<Caster<_>> = None;
    for (number, firing) in revolution.firings.iter().enumerate() {
        let stamp_ns = revolution.start_ns + i64::from(firing.offset_ns);
        let index = (stamp_ns - start_ns + period_ns / 2).div_euclid(period_ns);
        let exact_ns = start_ns + scanner.firing_ns(index);
        worst.stamp_us = worst.stamp_us.max((stamp_ns - exact_ns).abs() as f64 * 1e-3);
        let turned = f64::from(firing.azimuth_rad).to_degrees() - 360.0 * scanner.encoder_share(index);
        worst.azimuth_deg = worst.azimuth_deg.max(((turned + 180.0).rem_euclid(360.0) - 180.0).abs());

        let map_from_sensor = vehicle.pose_at(exact_ns) * config.ego_from_sensor;
        // The same arithmetic as the scanner's: where a ray grazes an edge, the last bit decides.
        let rotation = map_from_sensor.rotation.to_rotation_matrix();
        let (at, time) = (map_from_sensor.translation.vector.into(), (exact_ns - start_ns) as f64 * 1e-9);
        let caster =
            caster.get_or_insert_with(|| Caster::new(vehicle.scene().world.clone(), at, time, config.range_m_max));
        caster.move_to(at, time);
        for laser in 0..revolution.lasers {
            let (origin, direction) = scanner.ray(index, laser);
            let from: [f64; 3] = (map_from_sensor * nalgebra::Point3::from(origin)).coords.into();
            let to: [f64; 3] = (rotation * nalgebra::Vector3::from(direction)).into();
            for (echo, image) in revolution.echoes.iter().enumerate() {
                let slot = number * revolution.lasers + laser;
                let range_m = f64::from(image.range_m[slot]);
                if range_m.is_nan() {
                    assert_eq!(config.model, Model::Hdl64eS1, "every laser fires in every firing");
                    continue;
                }
                let nearest = || caster.cast(from, to, scanner.draw(index, laser));
                let last = caster.cast_behind_leaves(from, to);
                let hit: Option<Hit> = match (config.return_mode, echo) {
                    (ReturnMode::Last, _) => last,
                    // The decoder removes a last echo that is the strongest too.
                    (_, 1) => last.filter(|_| nearest() != last),
                    _ => nearest(),
                };
                let hit = hit.filter(|hit| scanner.reports(laser, hit.range_m));
                assert_eq!(range_m > 0.0, hit.is_some(), "firing {index} laser {laser}: {range_m} m, {hit:?}");
                let Some(hit) = hit else { continue };
                worst.returns += 1;
                let resolution = scanner.calibration().distance_m_per_count;
                worst.range_counts = worst.range_counts.max((range_m - hit.range_m).abs() / resolution);
                let decoded = [image.x[slot], image.y[slot], image.z[slot]];
                let off = (0..3).map(|axis| f64::from(decoded[axis]) - origin[axis] - range_m * direction[axis]);
                let off = off.map(|part| part * part).sum::<f64>().sqrt();
                worst.point_deg = worst.point_deg.max((off / range_m).to_degrees());
                assert_eq!(image.intensity[slot], hit.reflectivity);
            }
        }
    }
    worst
}

fn modes(model: Model) -> Vec<ReturnMode> {
    let mut modes = vec![ReturnMode::Strongest, ReturnMode::Last];
    if model.spec().dual_return {
        modes.push(ReturnMode::Dual);
    }
    modes
}

fn holds(model: Model, return_mode: ReturnMode, rpm: f64, number: i64, seed: u64) {
    let calibration = Some(crooked(model, seed));
    let config = ScannerConfig { model, return_mode, rpm, calibration, seed, ..ScannerConfig::default() }.noiseless();
    let vehicle = SimulatedVehicle::new(scenes::town(), config);
    let revolution = vehicle.revolution(number);
    let worst = compare(&vehicle, &revolution);
    println!("{model:?} {return_mode:?} {rpm:.0} rpm: {} firings, {worst:?}", revolution.firings.len());
    assert_eq!((revolution.model, revolution.echoes.len()), (model, 1 + usize::from(return_mode == ReturnMode::Dual)));
    let firings = model.spec().firings_per_revolution(return_mode, rpm as f32);
    assert!(revolution.firings.len().abs_diff(firings) <= 1, "{} of {firings} firings", revolution.firings.len());
    assert!(worst.range_counts <= 0.51, "half a count, and the decoder's single precision");
    // A block's azimuth is rounded once; the second firing of a 16-laser block is rounded again.
    let rounded = if model.spec().firings_per_block > 1 { 0.0101 } else { 0.0051 };
    assert!(worst.azimuth_deg <= rounded, "{worst:?}");
    // A laser's own rotation is rounded again, and follows from a step from block to block that is rounded too.
    assert!(worst.point_deg <= 0.02, "{worst:?}");
    assert!(worst.stamp_us <= 1.1, "{worst:?}");
    assert!(worst.returns > 5_000, "{worst:?}");
}

#[test]
fn every_model_and_return_mode_decodes_to_the_simulated_points() {
    for model in Model::ALL {
        for return_mode in modes(model) {
            holds(model, return_mode, 600.0, 3, 7);
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig {
        cases: 12,
        max_shrink_iters: 8,
        failure_persistence: None,
        ..ProptestConfig::default()
    })]

    #[test]
    fn any_sensor_at_any_rate_and_place_decodes_to_the_simulated_points(
        model in 0..Model::ALL.len(),
        mode in 0..3_usize,
        rpm in 5..=20_u32,
        number in 0..2_000_i64,
        seed in 0..u64::from(u32::MAX),
    ) {
        let model = Model::ALL[model];
        let modes = modes(model);
        holds(model, modes[mode % modes.len()], 60.0 * f64::from(rpm), number, seed);
    }
}
