//! The memory that a map takes once the buffers have their sizes.

use clearway_lidar::model::Model;
use clearway_mapping::config::{Extrinsics, SensorConfig, VehicleConfig};
use clearway_mapping::event::{Body, EgoPose, Event, Scan};
use clearway_mapping::pipeline::Pipeline;
use clearway_sim::scanner::ScannerConfig;
use clearway_sim::scenes;
use clearway_sim::vehicle::SimulatedVehicle;

/// Number of allocations that one map may need: the list of sensors in its header, and the buffer of the sort in the
/// check of the mount, which keeps equal heights in their order, because the sum of their weights is rounded by it.
const MAP_MAX: u64 = 2;
/// The same of a moving vehicle: a safe point more than in any map before takes memory for its links.
const DRIVE_MAP_MAX: u64 = 300;
/// Number of allocations that one datagram of telemetry may need: the fields of its sentence.
const TELEMETRY_MAX: u64 = 6;
const PERIOD_NS: i64 = 100_000_000;

fn pipeline() -> Pipeline {
    let extrinsics = Extrinsics { x_m: 0.0, y_m: 0.0, z_m: 1.9, roll_deg: 0.0, pitch_deg: 0.0, yaw_deg: 0.0 };
    let sensor = SensorConfig { model: Some(Model::Hdl64eS2), ..SensorConfig::new("top", extrinsics) };
    Pipeline::new(&VehicleConfig::new("car", vec![sensor]), vec![None]).unwrap()
}

/// Allocations of a step, and whether it made a map.
fn step(pipeline: &mut Pipeline, event: &Event) -> (u64, bool) {
    let mut made = false;
    let info = allocation_counter::measure(|| made = pipeline.step(event).unwrap().is_some());
    (info.count_total, made)
}

#[test]
fn the_maps_of_the_same_scan_need_few_allocations_once_their_buffers_are_there() {
    let vehicle = SimulatedVehicle::new(scenes::town(), ScannerConfig::default());
    let revolution = vehicle.revolution(1);
    let scan = Scan::from(&revolution);
    let mut pipeline = pipeline();
    for number in 0..12 {
        let stamp_ns = revolution.end_ns + i64::from(number) * PERIOD_NS;
        let event = |body| Event { sequence: 0, arrival_ns: stamp_ns, source: 0, body };
        let map_from_ego = nalgebra::Isometry3::identity();
        step(&mut pipeline, &event(Body::EgoPose(EgoPose { stamp_ns, map_from_ego, speed_mps: 0.0 })));
        let (allocations, made) = step(&mut pipeline, &event(Body::Scan(Scan { stamp_ns, ..scan.clone() })));
        assert!(made);
        // In the first maps the buffers get their sizes.
        assert!(number < 6 || allocations <= MAP_MAX, "map {number}: {allocations} allocations");
    }
}

#[test]
fn packets_need_no_allocations_and_the_maps_of_a_drive_few() {
    let vehicle = SimulatedVehicle::new(scenes::town(), ScannerConfig::default());
    let (mut pipeline, start_ns) = (pipeline(), vehicle.start_ns());
    let (mut maps, mut packets, mut without) = (0, 0, 0);
    for datagram in vehicle.take_while(|datagram| datagram.stamp_ns < start_ns + 8 * PERIOD_NS) {
        let is_packet = datagram.kind == clearway_sim::vehicle::Kind::Data;
        let event = Event {
            sequence: 0,
            arrival_ns: datagram.stamp_ns,
            source: 0,
            body: Body::Datagram(datagram.payload.into()),
        };
        let (allocations, made) = step(&mut pipeline, &event);
        maps += u64::from(made);
        match (made, is_packet) {
            (true, _) => assert!(maps < 5 || allocations <= DRIVE_MAP_MAX, "map {maps}: {allocations} allocations"),
            (false, false) => assert!(allocations <= TELEMETRY_MAX, "telemetry: {allocations} allocations"),
            (false, true) => (packets, without) = (packets + 1, without + u64::from(allocations == 0)),
        }
    }
    assert!(maps >= 6, "{maps} maps");
    assert!(without * 100 >= packets * 95, "{without} of {packets} packets without an allocation");
}
