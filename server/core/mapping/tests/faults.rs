//! Maps with faults of the network and with a dirty window.

use bytes::Bytes;
use clearway_lidar::BlockedSector;
use clearway_lidar::calibration::Calibration;
use clearway_lidar::model::{Model, ReturnMode};
use clearway_mapping::config::{Extrinsics, MapsConfig, SensorConfig, TimeConfig, VehicleConfig};
use clearway_mapping::event::{Body, Event};
use clearway_mapping::layer::{Cells, Geometry, Layer};
use clearway_mapping::map::Map;
use clearway_mapping::pipeline::Pipeline;
use clearway_sim::impair::{Faults, Impaired};
use clearway_sim::noise::{mixed, uniform};
use clearway_sim::scanner::ScannerConfig;
use clearway_sim::scenes;
use clearway_sim::vehicle::{Datagram, Kind, SimulatedVehicle};

fn config(model: Model) -> VehicleConfig {
    let extrinsics = Extrinsics { x_m: 0.0, y_m: 0.0, z_m: 1.9, roll_deg: 0.0, pitch_deg: 0.0, yaw_deg: 0.0 };
    let sensor = SensorConfig {
        name: "top".into(),
        model: Some(model),
        rpm: None,
        calibration: None,
        cut_azimuth_deg: 180.0,
        blind_deg: Vec::new(),
        gps_late_days_max: 1.0,
        range_m_min: 2.0,
        elevations_deg: Vec::new(),
        range_noise_m: None,
        extrinsics,
    };
    VehicleConfig {
        time: TimeConfig::default(),
        name: "car-1".into(),
        sensors: vec![sensor],
        fusion: Default::default(),
        body: None,
        maps: MapsConfig::default(),
    }
}

fn pipeline(model: Model) -> Pipeline {
    Pipeline::new(&config(model), vec![None]).unwrap()
}

fn datagrams(model: Model, revolutions: f64, with_telemetry: bool) -> Vec<Datagram> {
    let config = ScannerConfig { model, return_mode: ReturnMode::Strongest, ..ScannerConfig::default() };
    let vehicle = SimulatedVehicle::new(scenes::flat(), config);
    let end_ns = vehicle.start_ns() + (revolutions * 1e8) as i64;
    let sent = vehicle.filter(|datagram| with_telemetry || datagram.kind == Kind::Data);
    sent.take_while(|datagram| datagram.stamp_ns < end_ns).collect()
}

/// Applies a datagram and returns the map that it completes, if it completes one.
fn step(pipeline: &mut Pipeline, datagram: Datagram) -> Option<Map> {
    let body = Body::Datagram(Bytes::from(datagram.payload));
    let event = Event { sequence: 0, arrival_ns: datagram.stamp_ns, source: 0, body };
    pipeline.step(&event).ok().flatten().cloned()
}

#[test]
fn copies_and_reordering_of_packets_change_no_map() {
    let streams = [Model::Vlp16, Model::Hdl32e, Model::Hdl64eS2].map(|model| (model, datagrams(model, 3.2, false)));
    let maps = |model: Model, datagrams: &mut dyn Iterator<Item = Datagram>| {
        let mut pipeline = pipeline(model);
        let maps: Vec<Map> = datagrams.filter_map(|datagram| step(&mut pipeline, datagram)).collect();
        let maps: Vec<Map> = maps.into_iter().map(|map| Map { completed_ns: 0, ..map }).collect();
        (maps, pipeline.ledger().clone())
    };
    let expected = streams.each_ref().map(|(model, sent)| maps(*model, &mut sent.iter().cloned()).0);
    assert!(expected.iter().all(|maps| maps.len() == 3));
    for seed in 0..100 {
        let of = seed as usize % streams.len();
        let (model, sent) = &streams[of];
        let duplicate = uniform(mixed(seed)) * 0.5;
        let faults = Faults { duplicate, reorder: 1 + (mixed(seed ^ 1) % 32) as u32, seed, ..Faults::default() };
        let mut network = Impaired::new(sent.iter().cloned(), faults);
        let (made, ledger) = maps(*model, &mut network);
        let counts = network.counts();
        assert!(made == expected[of], "{model:?} {faults:?}");
        assert_eq!(ledger.received, counts.arrived, "{faults:?}");
        assert_eq!(ledger.refused.get("duplicate").copied().unwrap_or(0), counts.duplicated, "{faults:?}");
        assert_eq!(ledger.received, ledger.decoded + ledger.refused.values().sum::<u64>(), "{faults:?}");
    }
}

#[test]
fn the_ledger_is_exact_for_any_fault_of_the_network() {
    let streams = [Model::Vlp16, Model::Hdl32e].map(|model| (model, datagrams(model, 4.0, true)));
    for seed in 0..100 {
        let share = |what: u64, most: f64| uniform(mixed(seed ^ what << 8)) * most;
        let (model, sent) = &streams[seed as usize % streams.len()];
        let faults = Faults {
            loss: share(1, 0.3),
            burst: share(2, 0.01),
            burst_packets: 200,
            duplicate: share(3, 0.5),
            reorder: share(4, 64.0) as u32,
            truncate: share(5, 0.02),
            flip: share(6, 0.05),
            delay_ns: share(7, 5e6) as i64,
            seed,
        };
        let mut pipeline = pipeline(*model);
        let mut network = Impaired::new(sent.iter().cloned(), faults);
        let maps: Vec<Map> = network.by_ref().filter_map(|datagram| step(&mut pipeline, datagram)).collect();
        let (ledger, counts) = (pipeline.ledger(), network.counts());
        assert_eq!(ledger.received, counts.arrived, "{faults:?}");
        let refused: u64 = ledger.refused.values().sum();
        assert_eq!(ledger.received, ledger.decoded + ledger.telemetry + refused, "{faults:?} {ledger:?}");
        assert!(ledger.refused.get("length").copied().unwrap_or(0) <= counts.truncated, "{faults:?} {ledger:?}");
        assert!(maps.windows(2).all(|pair| pair[0].capture_end_ns <= pair[1].capture_start_ns), "{faults:?}");
    }
}

#[test]
fn a_packet_that_does_not_fit_the_model_found_later_counts_as_refused() {
    let mut config = config(Model::Vlp16);
    config.sensors[0].model = None;
    let mut pipeline = Pipeline::new(&config, vec![None]).unwrap();
    let stray = datagrams(Model::Hdl32e, 0.01, false).into_iter().take(1);
    for datagram in stray.chain(datagrams(Model::Vlp16, 0.1, false)) {
        step(&mut pipeline, datagram);
    }
    let ledger = pipeline.ledger();
    assert_eq!((ledger.refused.get("model"), ledger.received), (Some(&1), ledger.decoded + 1));
}

/// Covers the window between two encoder angles, degrees: each return there gets the distance that `cover` gives, or is
/// removed if that is 0.
fn covered(
    model: Model,
    mut datagram: Datagram,
    [from_deg, to_deg]: [u16; 2],
    cover: impl Fn(usize) -> u16,
) -> Datagram {
    let (spec, calibration) = (model.spec(), Calibration::factory(model));
    let dark = f64::from(from_deg)..f64::from(to_deg);
    for block in datagram.payload[..1200].chunks_exact_mut(100) {
        let azimuth_deg = f64::from(u16::from_le_bytes([block[2], block[3]])) / 100.0;
        let first = spec.first_laser(u16::from_le_bytes([block[0], block[1]])).unwrap();
        for (index, distance) in block[4..].chunks_exact_mut(3).enumerate() {
            let laser = &calibration.lasers[(first + index) % spec.lasers];
            // An HDL-64E's lasers look up to 9 degrees to the side of its encoder angle.
            if dark.contains(&(azimuth_deg - laser.rot_correction.to_degrees()).rem_euclid(360.0)) {
                distance[..2].copy_from_slice(&cover(index).to_le_bytes());
            }
        }
    }
    datagram
}

/// Middle of a cell, ego frame, metres.
fn middle(geometry: &Geometry, cell: usize) -> (f64, f64) {
    match geometry {
        Geometry::Radial { row_radius_m, columns, .. } => {
            let (row, column) = (cell / usize::from(*columns), cell % usize::from(*columns));
            let inner = if row == 0 { 0.0 } else { f64::from(row_radius_m[row - 1]) };
            let (r, angle) =
                ((inner + f64::from(row_radius_m[row])) / 2.0, (column as f64 + 0.5) / f64::from(*columns));
            let (sin, cos) = (angle * std::f64::consts::TAU).sin_cos();
            (r * cos, r * sin)
        }
        Geometry::Cartesian { origin_x_m, origin_y_m, width, cell_m, .. } => {
            let (ix, iy) = (cell % *width as usize, cell / *width as usize);
            let at = |origin: &f64, i: usize| origin + (i as f64 + 0.5) * f64::from(*cell_m);
            (at(origin_x_m, ix), at(origin_y_m, iy))
        }
    }
}

/// Number of cells at least 2 m inside a sector of encoder angles, and how many of them are known. `occupancy` has a
/// class of its own for cells that no ray reaches, and keeps cells occupied for some maps: neither counts as known now.
fn inside(layer: &Layer, (from_deg, to_deg): (f64, f64)) -> (usize, usize) {
    let Cells::U8(classes) = &layer.channels[0].cells else { panic!("{}: a class is a byte", layer.name) };
    let far_inside = |cell: &usize| {
        let (x, y) = middle(&layer.geometry, *cell);
        // Velodyne's angle is clockwise from above.
        let (r, angle) = (x.hypot(y), (-y).atan2(x).to_degrees().rem_euclid(360.0));
        let beside = (angle - from_deg).min(to_deg - angle).to_radians();
        beside > 0.0 && r * beside.sin() > 2.0
    };
    let cells: Vec<usize> = (0..classes.len()).filter(far_inside).collect();
    let unseen = ["unknown", "out_of_range", "occupied"];
    let known = |cell: &&usize| !unseen.contains(&layer.legend[usize::from(classes[**cell])].name);
    (cells.len(), cells.iter().filter(known).count())
}

#[test]
fn a_covered_sector_is_reported_and_unknown_in_every_map() {
    let (from_deg, to_deg) = (30, 110);
    let dark_deg = (f64::from(from_deg), f64::from(to_deg));
    // No return; dirt that reflects at the least distance a sensor reports; both, laser by laser.
    let covers: [fn(usize) -> u16; 3] = [|_| 0, |index| 250 + index as u16, |index| [0, 300][index % 2]];
    for model in [Model::Vlp16, Model::Hdl64eS2] {
        for cover in covers {
            let mut pipeline = pipeline(model);
            let mut revolutions = Vec::new();
            let sent = datagrams(model, 12.2, false);
            let dirty_ns = sent[0].stamp_ns + 800_000_000;
            for datagram in sent {
                let datagram = if datagram.stamp_ns >= dirty_ns {
                    covered(model, datagram, [from_deg, to_deg], cover)
                } else {
                    datagram
                };
                if let Some(map) = step(&mut pipeline, datagram) {
                    revolutions.push((map, pipeline.newest_revolution().unwrap().blocked.clone()));
                }
            }
            // The first revolution is partial, and the window is covered in the middle of another one.
            let clean = revolutions.iter().filter(|(map, _)| map.capture_end_ns < dirty_ns).count();
            assert!(revolutions[..clean].iter().all(|(_, blocked)| blocked.is_empty()), "{model:?}");
            let (map, blocked) = &revolutions[clean + 1];
            let [BlockedSector { from_deg: from, to_deg: to }] = blocked.sectors[..] else {
                panic!("{model:?}: {blocked:?}")
            };
            assert!(from.abs_diff(from_deg) <= 1 && to.abs_diff(to_deg) <= 1, "{model:?}: {blocked:?}");
            for (layer, before) in map.layers.iter().zip(&revolutions[clean - 1].0.layers) {
                let (cells, known_before) = inside(before, dark_deg);
                assert!(known_before * 50 > cells, "{model:?} {}: {known_before} of {cells}", layer.name);
                let (cells, known) = inside(layer, dark_deg);
                assert_eq!(known, 0, "{model:?} {}: of {cells}", layer.name);
            }
        }
    }
}
