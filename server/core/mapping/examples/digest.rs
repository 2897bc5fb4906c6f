//! A digest of the events and of the maps of a drive: to compare builds, processors and machines with each other.
//!
//! ```sh
//! cd server/core/mapping
//! cargo run --release --example digest -- drive.pcap 000000.bin
//! RUSTFLAGS="-C target-cpu=x86-64-v3" cargo run --release --example digest -- drive.pcap 000000.bin
//! cargo run --config profile.dev.package.clearway-mapping.opt-level=0 --example digest -- drive.pcap 000000.bin
//! ```
//!
//! Each file (a capture, or one scan) is a drive with all layers and memory; between its events come poses of a curve.
//! Without a file it is a second of a simulated town. Equal events must have equal maps.

use std::hash::{DefaultHasher, Hasher};

use bytes::Bytes;
use clearway_lidar::capture::Capture;
use clearway_mapping::config::{Extrinsics, MapsConfig, SensorConfig, TimeConfig, VehicleConfig};
use clearway_mapping::event::{Body, EgoPose, Event};
use clearway_mapping::pipeline::Pipeline;
use clearway_mapping::scan_file;
use clearway_sim::scanner::ScannerConfig;
use clearway_sim::scenes;
use clearway_sim::vehicle::SimulatedVehicle;
use nalgebra::{Isometry3, Vector3};

/// The bodies of a file's events, with the times at which they arrive, in ns.
fn bodies(file: &str) -> Vec<(i64, Body)> {
    let bytes = std::fs::read(file).expect("the file can be read");
    if let Ok(capture) = Capture::new(&bytes[..]) {
        let datagrams = capture.map_while(Result::ok);
        return datagrams.map(|datagram| (datagram.stamp_ns, Body::Datagram(datagram.payload.into()))).collect();
    }
    let (_, mut scan) = scan_file::read(file, &bytes).expect("a capture or a scan");
    scan.stamp_ns = 1_700_000_000_000_000_000;
    vec![(scan.stamp_ns, Body::Scan(scan.into()))]
}

fn simulated() -> Vec<(i64, Body)> {
    let vehicle = SimulatedVehicle::new(scenes::town(), ScannerConfig::default());
    let end_ns = vehicle.start_ns() + 1_000_000_000;
    let datagrams = vehicle.take_while(|datagram| datagram.stamp_ns < end_ns);
    datagrams.map(|datagram| (datagram.stamp_ns, Body::Datagram(Bytes::from(datagram.payload)))).collect()
}

fn pipeline() -> Pipeline {
    let extrinsics = Extrinsics { x_m: 0.5, y_m: -0.1, z_m: 1.9, roll_deg: 0.7, pitch_deg: -1.3, yaw_deg: 2.1 };
    let sensor = SensorConfig {
        name: "top".into(),
        model: None,
        rpm: None,
        calibration: None,
        cut_azimuth_deg: 180.0,
        blind_deg: vec![[170.0, 190.0]],
        gps_late_days_max: 1.0,
        range_m_min: 2.0,
        elevations_deg: Vec::new(),
        range_noise_m: None,
        extrinsics,
    };
    let mut maps = MapsConfig::default();
    (maps.memory.enabled, maps.speed.enabled) = (true, true);
    let (sensors, fusion) = (vec![sensor], Default::default());
    let config = VehicleConfig { time: TimeConfig::default(), name: "car".into(), sensors, fusion, body: None, maps };
    Pipeline::new(&config, vec![None]).expect("the configuration is valid")
}

/// A pose on a curve, at a time after the first event.
fn pose(stamp_ns: i64, seconds: f64) -> Body {
    let rotation = Vector3::new(0.01 * seconds, -0.02 * seconds, 0.3 * seconds);
    let map_from_ego = Isometry3::new(Vector3::new(9.0 * seconds, 1.3 * seconds * seconds, 0.1 * seconds), rotation);
    Body::EgoPose(EgoPose { stamp_ns, map_from_ego, speed_mps: 9.0 })
}

fn main() {
    let files: Vec<String> = std::env::args().skip(1).collect();
    let drives: Vec<_> = match files.is_empty() {
        true => vec![("simulated town".to_owned(), simulated())],
        false => files.into_iter().map(|file| (file.clone(), bodies(&file))).collect(),
    };
    for (name, bodies) in drives {
        let (mut pipeline, mut maps) = (pipeline(), 0);
        let (mut of_events, mut of_maps) = (DefaultHasher::new(), DefaultHasher::new());
        let start_ns = bodies.first().map_or(0, |(at_ns, _)| *at_ns);
        let mut pose_ns = start_ns;
        let mut events = 0;
        let mut step = |arrival_ns, body| {
            let event = Event { sequence: events, arrival_ns, source: 0, body };
            // Debug distinguishes all values.
            of_events.write(format!("{event:?}").as_bytes());
            if let Ok(Some(map)) = pipeline.step(&event) {
                of_maps.write(format!("{map:?}").as_bytes());
                maps += 1;
            }
            events += 1;
        };
        for (at_ns, body) in bodies {
            while pose_ns <= at_ns {
                step(at_ns, pose(pose_ns, (pose_ns - start_ns) as f64 * 1e-9));
                pose_ns += 20_000_000;
            }
            step(at_ns, body);
        }
        step(pose_ns, Body::End);
        println!("{name}: {events} events {:016x}, {maps} maps {:016x}", of_events.finish(), of_maps.finish());
    }
}
