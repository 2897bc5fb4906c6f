//! What the fuzzer, and `cargo test` with its corpus, do with bytes that somebody sends. Nothing here may panic.

use bytes::Bytes;
use clearway_mapping::event::Event;
use clearway_mapping::pipeline::Pipeline;
use clearway_proto::v1;
use clearway_server::config::Config;
use clearway_server::ingest::observation::{Limits, bodies};
use prost::Message;

/// One observation, as far as the maps.
pub fn observation(bytes: &[u8]) {
    let Ok(observation) = v1::Observation::decode(Bytes::copy_from_slice(bytes)) else { return };
    let Ok(bodies) = bodies(observation, &Limits::of_points(1000)) else { return };
    let mut vehicle = Config::of_one_vehicle("car", "top").vehicles.remove(0);
    vehicle.maps.speed.enabled = true;
    vehicle.maps.safe_path.enabled = true;
    vehicle.sensors[0].model = Some(clearway_lidar::model::Model::Hdl32e);
    let mut pipeline = Pipeline::new(&vehicle.core(), vec![None]).expect("the defaults are allowed");
    for (sequence, (captured_ns, body)) in (0..).zip(bodies) {
        let arrival_ns = captured_ns.unwrap_or_default();
        // A refusal is as good as a map.
        let _ = pipeline.step(&Event { sequence, arrival_ns, source: 0, body });
    }
    let ledger = pipeline.ledger();
    assert_eq!(ledger.received, ledger.decoded + ledger.telemetry + ledger.refused.values().sum::<u64>());
}
