//! The entry points of the fuzzers, which `cargo test` also runs with the corpora. None of them may panic.

use clearway_lidar::calibration::status_table::StatusTable;
use clearway_lidar::capture::Capture;
use clearway_lidar::telemetry::Telemetry;
use clearway_lidar::{Calibration, Model, Sensor, SensorConfig};

/// Decodes a stream: a byte that is the index of the model, or none, then datagrams of 1206 bytes.
pub fn packet(bytes: &[u8]) {
    let Some((first, datagrams)) = bytes.split_first() else { return };
    let model = Model::ALL.get(usize::from(*first)).copied();
    let mut sensor = Sensor::new(SensorConfig { model, ..SensorConfig::default() });
    for (index, datagram) in datagrams.chunks(1206).enumerate() {
        let before = sensor.status();
        match sensor
            .push(datagram, index as i64 * 500_000)
            .map(|revolution| revolution.map(|revolution| revolution.points().count()))
        {
            Ok(_) => {}
            Err(error) => {
                assert_eq!(sensor.status(), before, "{error}");
            }
        }
    }
    if let Some(revolution) = sensor.finish() {
        assert_eq!(revolution.echoes[0].range_m.len(), revolution.firings.len() * revolution.lasers);
        assert_eq!(revolution.points().count(), revolution.returns());
    }
    let mut table = StatusTable::default();
    datagrams.chunks_exact(2).for_each(|pair| drop(table.push((pair[0], pair[1]))));
}

/// Parses the bytes as telemetry, and again cut or padded to its length.
pub fn telemetry(bytes: &[u8]) {
    let mut datagram = bytes.to_vec();
    drop(Telemetry::new(&datagram));
    datagram.resize(512, 0);
    drop(Telemetry::new(&datagram));
}

/// Reads a capture file.
pub fn capture(bytes: &[u8]) {
    if let Ok(capture) = Capture::new(bytes) {
        capture.for_each(drop);
    }
}

/// Reads a calibration text. If it is valid, it is written and read again.
pub fn calibration(bytes: &[u8]) {
    let Ok(text) = std::str::from_utf8(bytes) else { return };
    if let Ok(calibration) = Calibration::load_str(text) {
        assert_eq!(Calibration::load_str(&calibration.to_yaml()), Ok(calibration));
    }
}
