//! What the fuzzer, and `cargo test` with its corpora, do with a file's bytes. Nothing here may panic.

use clearway_lidar::calibration::unit_table::UnitTable;
use clearway_lidar::capture::Capture;
use clearway_lidar::telemetry::Telemetry;
use clearway_lidar::{Calibration, Model, Sensor, SensorConfig};

/// A stream: a byte that names the model or none, then datagrams of 1206 bytes.
pub fn packet(bytes: &[u8]) {
    let Some((first, datagrams)) = bytes.split_first() else { return };
    let model = Model::ALL.get(usize::from(*first)).copied();
    let mut sensor = Sensor::new(SensorConfig { model, ..SensorConfig::default() });
    for (index, datagram) in datagrams.chunks(1206).enumerate() {
        let before = sensor.status();
        match sensor.push(datagram, index as i64 * 500_000).map(|turn| turn.map(|turn| turn.points().count())) {
            Ok(_) => {}
            Err(refusal) => {
                assert_eq!(sensor.status(), before, "{refusal}");
            }
        }
    }
    if let Some(turn) = sensor.finish() {
        assert_eq!(turn.echoes[0].range_m.len(), turn.firings.len() * turn.lasers);
        assert_eq!(turn.points().count(), turn.returns());
    }
    let mut table = UnitTable::default();
    datagrams.chunks_exact(2).for_each(|pair| drop(table.push((pair[0], pair[1]))));
}

/// One telemetry datagram: the bytes, cut or padded to its length.
pub fn telemetry(bytes: &[u8]) {
    let mut datagram = bytes.to_vec();
    drop(Telemetry::new(&datagram));
    datagram.resize(512, 0);
    drop(Telemetry::new(&datagram));
}

/// A capture file.
pub fn capture(bytes: &[u8]) {
    if let Ok(capture) = Capture::new(bytes) {
        capture.for_each(drop);
    }
}

/// A calibration text; one that is read comes back as it was.
pub fn calibration(bytes: &[u8]) {
    let Ok(text) = std::str::from_utf8(bytes) else { return };
    if let Ok(calibration) = Calibration::load_str(text) {
        assert_eq!(Calibration::load_str(&calibration.to_yaml()), Ok(calibration));
    }
}
