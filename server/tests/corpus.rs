//! The fuzzer's corpus, replayed. It holds only bytes made here; with `CLEARWAY_BLESS=1` they are written anew.

#[path = "../fuzz/entries.rs"]
mod entries;

use std::path::PathBuf;

use clearway_proto::packed::pack;
use clearway_proto::v1;
use prost::Message;
use v1::observation::Body;

fn folder() -> PathBuf {
    [env!("CARGO_MANIFEST_DIR"), "fuzz", "corpus", "observation"].iter().collect()
}

#[test]
fn every_seed_is_taken_or_refused_without_a_panic() {
    if std::env::var_os("CLEARWAY_BLESS").is_some() {
        write_seeds();
    }
    let mut replayed = 0;
    for file in std::fs::read_dir(folder()).unwrap() {
        let bytes = std::fs::read(file.unwrap().path()).unwrap();
        entries::observation(&bytes);
        // And every message that was cut off.
        (0..bytes.len()).step_by(1 + bytes.len() / 64).for_each(|end| entries::observation(&bytes[..end]));
        replayed += 1;
    }
    assert!(replayed >= 12, "{replayed} seeds");
}

fn write_seeds() {
    std::fs::create_dir_all(folder()).unwrap();
    let write = |name: &str, observation: v1::Observation| {
        std::fs::write(folder().join(name), observation.encode_to_vec()).unwrap();
    };
    let of = |body| v1::Observation { number: 1, sensor: "top".into(), body: Some(body), ..Default::default() };
    let ring = |of: &dyn Fn(f32) -> f32| pack(&(0..60_u8).map(|i| of(f32::from(i) * 0.105)).collect::<Vec<f32>>());
    let scan = v1::Scan {
        stamp_ns: 1_700_000_000_000_000_000,
        x: ring(&|angle| 9.0 * angle.cos()),
        y: ring(&|angle| 9.0 * angle.sin()),
        z: ring(&|_| -1.9),
        ..Default::default()
    };
    let full = v1::Scan {
        intensity: ring(&|_| 0.5),
        ring: pack(&[3_u16; 60]),
        offset_ns: pack(&[-5_000_000_i32; 60]),
        no_returns: pack(&[1.0_f32, 0.0, 0.0]),
        ..scan.clone()
    };
    let wild = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, 1e9, -0.0, f32::MIN_POSITIVE];
    let columns = |points: &[u16]| {
        let columns = v1::Columns { offset_ns: pack(&vec![-1_000_000_i32; points.len()]), points: pack(points) };
        v1::Observation { columns: Some(columns), ..of(Body::Scan(scan.clone())) }
    };
    let packets = |lengths: &[u16], payloads: &[u8]| {
        let captured_ns = pack(&vec![i64::MAX; lengths.len()]);
        of(Body::Packets(v1::Packets { captured_ns, lengths: pack(lengths), payloads: payloads.to_vec().into() }))
    };
    let pose =
        |pose: v1::Pose| of(Body::EgoPose(v1::EgoPose { stamp_ns: 7, map_from_ego: Some(pose), speed_mps: 3.0 }));
    let level = v1::Pose { x: 1.0, qw: 1.0, ..Default::default() };
    let road = v1::Road {
        purpose: v1::RoadPurpose::Paint.into(),
        frame: v1::RoadFrame::Ego.into(),
        x: vec![0.0, 10.0, 20.0],
        y: vec![0.0, 0.5, 2.0],
        width: vec![4.0; 3],
        orientations: vec![1.0, 0.0],
        ..Default::default()
    };
    write("scan", of(Body::Scan(scan.clone())));
    write("scan_full", of(Body::Scan(full.clone())));
    write(
        "scan_wild",
        of(Body::Scan(v1::Scan { x: pack(&wild), y: pack(&wild), z: pack(&wild), ..Default::default() })),
    );
    write("scan_lengths", of(Body::Scan(v1::Scan { y: pack(&[1.0_f32]), ..full })));
    write("scan_stamp_least", of(Body::Scan(v1::Scan { stamp_ns: i64::MIN, ..scan.clone() })));
    write("columns", columns(&[20, 0, 40]));
    write("columns_claim", columns(&[u16::MAX; 9]));
    write("packets", packets(&[1206, 512, 3, 0], &[0xff; 1721]));
    write("packets_claim", packets(&[u16::MAX; 3], b"abc"));
    write("pose", pose(level));
    write("pose_wild", pose(v1::Pose { x: f64::NAN, qw: f64::INFINITY, ..level }));
    write("road", of(Body::Road(road.clone())));
    write("road_wild", of(Body::Road(v1::Road { x: vec![f64::NAN; 3], width: vec![-1.0; 2], ..road })));
    write("end", of(Body::End(v1::End {})));
    write("empty", v1::Observation::default());
}
