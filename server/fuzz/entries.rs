//! The fuzz targets: bytes of a client or of a file, through the server to the maps. No target may panic. `cargo test`
//! runs them with the files of their corpora.

use std::io::Cursor;
use std::path::Path;

use bytes::{Buf, Bytes};
use clearway_daemon::config::Config;
use clearway_daemon::ingest::observation::{Limits, decode};
use clearway_daemon::ingest::queue::Reading;
use clearway_daemon::record::run_config;
use clearway_journal::encode::{event_from_bytes, event_to_proto};
use clearway_journal::reader::{RecordedMessage, RecordingReader};
use clearway_lidar::model::Model;
use clearway_mapping::event::Event;
use clearway_mapping::pipeline::Pipeline;
use clearway_proto::v1;
use clearway_replay::files::Readings;
use clearway_replay::files::mcap::McapOptions;
use prost::Message;

/// Decodes the bytes as an encoded observation.
pub fn observation(bytes: &[u8]) {
    let Ok(observation) = v1::Observation::decode(Bytes::copy_from_slice(bytes)) else { return };
    let Ok(bodies) = decode(observation, &Limits::from_points_max(1000)) else { return };
    let mut pipeline = pipeline();
    for (sequence, (captured_ns, body)) in (0..).zip(bodies) {
        step(&mut pipeline, &Event { sequence, arrival_ns: captured_ns.unwrap_or_default(), source: 0, body });
    }
}

/// Encoded events, each after its length.
pub fn event(bytes: &[u8]) {
    let mut rest = Bytes::copy_from_slice(bytes);
    let mut pipeline = pipeline();
    while let Ok(length) = prost::decode_length_delimiter(&mut rest) {
        let Ok(event) = event_from_bytes(rest.split_to(length.min(rest.remaining()))) else { continue };
        let written = event_to_proto(&event).encode_to_vec();
        let read = event_from_bytes(written.clone().into()).expect("an encoded event");
        assert_eq!(event_to_proto(&read).encode_to_vec(), written, "an event is encoded as it was decoded");
        step(&mut pipeline, &event);
    }
}

/// The bytes of an MCAP file.
pub fn recording(bytes: &[u8]) {
    let Ok(mut recording) = RecordingReader::from_source(Path::new("any.mcap"), Cursor::new(bytes.to_vec())) else {
        return;
    };
    drop(run_config(&recording));
    let mut pipeline = pipeline();
    for message in &mut recording {
        if let Ok(RecordedMessage::Event { event, .. }) = message {
            step(&mut pipeline, &event);
        }
    }
    assert!(recording.next().is_none() && recording.bytes_read() <= bytes.len() as u64);
}

/// The bytes of a ROS 2 bag in sqlite.
pub fn bag(bytes: &[u8]) {
    let folder = tempfile::tempdir().expect("a folder for the bag");
    let file = folder.path().join("bag.db3");
    std::fs::write(&file, bytes).expect("a bag");
    let options = McapOptions { sensors_max: 1, ..McapOptions::default() };
    let Ok(mut readings) = Readings::open(&[file], options) else { return };
    let mut pipeline = pipeline();
    for (sequence, reading) in (0..).zip(readings.by_ref().map_while(Result::ok)) {
        let Reading { arrival_ns, source, body } = reading;
        step(&mut pipeline, &Event { sequence, arrival_ns, source, body });
    }
    assert!(readings.next().is_none());
    let left = std::fs::read_dir(folder.path()).expect("the folder of the bag").count();
    assert_eq!(left, 1, "nothing is left beside the bag");
}

fn pipeline() -> Pipeline {
    let mut vehicle = Config::of_one_vehicle("car", "top").vehicles.remove(0);
    vehicle.maps.speed.enabled = true;
    vehicle.maps.safe_path.enabled = true;
    vehicle.sensors[0].model = Some(Model::Hdl32e);
    Pipeline::new(&vehicle.core(), vec![None]).expect("the defaults are valid")
}

fn step(pipeline: &mut Pipeline, event: &Event) {
    // The core may refuse the event.
    let _ = pipeline.step(event);
    let ledger = pipeline.ledger();
    assert_eq!(ledger.received, ledger.decoded + ledger.telemetry + ledger.refused.values().sum::<u64>());
    assert!(ledger.refused_sum() <= ledger.received);
}
