//! Replays the corpora of the fuzz targets. A corpus has the files that this test writes with `CLEARWAY_BLESS=1`, and
//! the files that a fuzzer derived from them (named by their hash).

#[path = "../fuzz/entries.rs"]
mod entries;

use std::collections::BTreeMap;
use std::io::Cursor;
use std::path::{Path, PathBuf};

use clearway_daemon::config::Config;
use clearway_journal::encode::event_to_proto;
use clearway_journal::reader::{RecordedMessage, RecordingReader};
use clearway_mapping::config::{Extrinsics, SensorConfig};
use clearway_mapping::event::{self as core, Event};
use clearway_proto::packed::pack;
use clearway_proto::v1;
use clearway_ros::cdr::{Header, Writer};
use clearway_ros::pose::{StampedTransform, tf_message_to_cdr};
use mcap::WriteOptions;
use nalgebra::Isometry3;
use prost::Message;
use v1::observation::Body;

fn folder(target: &str) -> PathBuf {
    [env!("CARGO_MANIFEST_DIR"), "fuzz", "corpus", target].iter().collect()
}

fn write(target: &str, name: &str, bytes: &[u8]) {
    std::fs::create_dir_all(folder(target)).unwrap();
    std::fs::write(folder(target).join(name), bytes).unwrap();
}

/// Truncated copies of each file: a sample of the 64 of `CLEARWAY_CAMPAIGN=1`.
const CUTS: usize = 8;

#[test]
fn every_file_of_the_corpora_is_handled_without_a_panic() {
    let cuts = if std::env::var_os("CLEARWAY_CAMPAIGN").is_some() { 64 } else { CUTS };
    if std::env::var_os("CLEARWAY_BLESS").is_some() {
        write_observations();
        write_journals();
        RECORDINGS.iter().for_each(|(name, options)| write("recording", name, &mcap(options())));
        write("recording", "attachment_without_crc", &attachment_without_crc());
        write("recording", "record_beyond_its_chunk", &record_beyond_its_chunk());
        write("bag", "drive", &sqlite_bag("PRAGMA page_size=512;"));
        write("bag", "crashed", &sqlite_bag("PRAGMA page_size=512; PRAGMA journal_mode=WAL;"));
    }
    for (target, run, files_min) in [
        ("observation", entries::observation as fn(&[u8]), 12),
        ("event", entries::event, 3),
        ("recording", entries::recording, 4),
        ("bag", entries::bag, 2),
    ] {
        let mut replayed = 0;
        for file in std::fs::read_dir(folder(target)).unwrap() {
            let bytes = std::fs::read(file.unwrap().path()).unwrap();
            run(&bytes);
            // Truncated files as well.
            (0..bytes.len()).step_by(1 + bytes.len() / cuts).for_each(|end| run(&bytes[..end]));
            replayed += 1;
        }
        assert!(replayed >= files_min, "{target}: {replayed} files");
    }
}

#[test]
fn a_record_that_reaches_beyond_its_chunk_is_damage() {
    let read = messages_of(record_beyond_its_chunk());
    assert_eq!(read[0], "event 0");
    assert!(read[1].contains("damaged in 1 place") && read[1].contains("in the middle of a record"), "{read:?}");
}

#[test]
fn an_attachment_that_ends_before_its_crc_is_damage() {
    let read = messages_of(attachment_without_crc());
    assert!(read[0].contains("in the middle of a record"), "{read:?}");
}

#[test]
fn a_chunk_with_a_wrong_length_is_refused() {
    let whole = mcap(ours());
    let with_length = |at: usize, length: u64| {
        let mut bytes = whole.clone();
        let chunk = chunk_at(&bytes);
        bytes[chunk + at..chunk + at + 8].copy_from_slice(&length.to_le_bytes());
        messages_of(bytes).pop().unwrap()
    };
    // The head of a record has nine bytes; then come the chunk's two stamps and its uncompressed size.
    for (at, length) in [(9 + 16, u64::MAX), (9 + 16, 1), (1, u64::MAX), (1, 1 << 20), (1, 1)] {
        assert!(with_length(at, length).contains("damaged in"), "{at}, {length}: {}", with_length(at, length));
    }
    assert_eq!(messages_of(whole), ["event 0", "event 1", "end"]);
}

/// The events of a recording, then `end`, what is wrong with it, or the error.
fn messages_of(bytes: Vec<u8>) -> Vec<String> {
    let mut recording = match RecordingReader::from_source(Path::new("any.mcap"), Cursor::new(bytes)) {
        Ok(recording) => recording,
        Err(error) => return vec![error.to_string()],
    };
    let mut read = Vec::new();
    for message in &mut recording {
        match message {
            Ok(RecordedMessage::Event { event, .. }) => read.push(format!("event {}", event.sequence)),
            Ok(other) => panic!("{other:?}"),
            Err(error) => return [read, vec![error.to_string()]].concat(),
        }
    }
    read.push(recording.incomplete().unwrap_or_else(|| "end".into()));
    read
}

type Options = fn() -> WriteOptions;
const RECORDINGS: [(&str, Options); 3] =
    [("ours", ours), ("plain_chunk", plain), ("no_chunk", || plain().use_chunks(false))];

fn ours() -> WriteOptions {
    WriteOptions::new().library("").compression(Some(mcap::Compression::Zstd)).compression_threads(0)
}

/// Without checksums, so that a fuzzer can change the contents.
fn plain() -> WriteOptions {
    let options = WriteOptions::new().library("").compression(None);
    options.calculate_chunk_crcs(false).calculate_data_section_crc(false).calculate_summary_section_crc(false)
}

/// A small recording of two events.
fn mcap(options: WriteOptions) -> Vec<u8> {
    let mut bytes = Cursor::new(Vec::new());
    let mut writer = options.create(&mut bytes).unwrap();
    let metadata = BTreeMap::from([("boot_id".to_owned(), "7".to_owned())]);
    writer.write_metadata(&mcap::records::Metadata { name: "clearway".into(), metadata }).unwrap();
    let config = Config::of_one_vehicle("car", "top").to_toml();
    let attachment = mcap::Attachment {
        log_time: 0,
        create_time: 0,
        name: "config.toml".into(),
        media_type: "application/toml".into(),
        data: config.as_bytes().into(),
    };
    writer.attach(&attachment).unwrap();
    let schema = writer.add_schema("clearway.v1.Event", "protobuf", &[]).unwrap();
    let channel_id = writer.add_channel(schema, "/car/journal", "protobuf", &BTreeMap::new()).unwrap();
    for (sequence, event) in (0..).zip(journal().into_iter().take(2)) {
        let header = mcap::records::MessageHeader { channel_id, sequence, log_time: 1, publish_time: 1 };
        writer.write_to_known_channel(&header, &event.encode_to_vec()).unwrap();
    }
    writer.finish().unwrap();
    drop(writer);
    bytes.into_inner()
}

/// The bytes of a small ROS 2 bag: a cloud without points, a mount, a pose, a topic that is not read.
fn sqlite_bag(pragmas: &str) -> Vec<u8> {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("bag.db3");
    let transform = |parent, child| StampedTransform {
        header: Header { stamp_ns: 1_700_000_000_000_000_000, frame_id: parent },
        child_frame_id: child,
        parent_from_child: Isometry3::translation(1.0, 0.0, 1.8),
    };
    let tf = |parent, child| tf_message_to_cdr(&[transform(parent, child)]);
    let mut cloud = Writer::default();
    cloud.header(&Header { stamp_ns: 1_700_000_000_000_000_000, frame_id: "top" }).u32(0).u32(0).u32(0);
    cloud.bytes(&[0]).u32(0).u32(0).u32(0).bytes(&[1]);
    let messages = [
        (1, "/tf_static", "tf2_msgs/msg/TFMessage", tf("base_link", "top")),
        (2, "/tf", "tf2_msgs/msg/TFMessage", tf("odom", "base_link")),
        (3, "/points", "sensor_msgs/msg/PointCloud2", cloud.finish()),
        (4, "/other", "std_msgs/msg/Empty", vec![0, 1, 0, 0]),
    ];
    let bag = rusqlite::Connection::open(&file).unwrap();
    let tables = "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT);
        CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB);";
    bag.execute_batch(&format!("{pragmas}{tables}")).unwrap();
    for (id, topic, kind, bytes) in messages {
        bag.execute("INSERT INTO topics VALUES (?1, ?2, ?3, 'cdr')", (id, topic, kind)).unwrap();
        bag.execute("INSERT INTO messages VALUES (?1, ?1, 1700000000000000000 + ?1, ?2)", (id, bytes)).unwrap();
    }
    drop(bag);
    std::fs::read(file).unwrap()
}

/// Offset of the first record of a kind outside of the chunks.
fn record_at(bytes: &[u8], kind: u8) -> usize {
    let mut at = 8;
    while bytes[at] != kind {
        at += 9 + u64::from_le_bytes(bytes[at + 1..at + 9].try_into().unwrap()) as usize;
    }
    at
}

fn chunk_at(bytes: &[u8]) -> usize {
    record_at(bytes, mcap::records::op::CHUNK)
}

fn record_beyond_its_chunk() -> Vec<u8> {
    let mut bytes = mcap(plain());
    // The second message is the last record of the chunk, and ends with the bytes of its event.
    let event = journal()[1].encode_to_vec();
    let last = bytes.windows(event.len()).rposition(|window| *window == event).unwrap() - 22 - 9;
    assert_eq!(bytes[last], mcap::records::op::MESSAGE);
    bytes[last + 1] += 1;
    bytes
}

fn attachment_without_crc() -> Vec<u8> {
    let mut bytes = mcap(plain());
    let at = record_at(&bytes, mcap::records::op::ATTACHMENT);
    // Two stamps, two empty texts, no data, no CRC.
    bytes.truncate(at + 1);
    bytes.extend(32_u64.to_le_bytes());
    bytes.extend([0; 32]);
    bytes
}

/// A journal with all kinds of events.
fn journal() -> Vec<v1::Event> {
    use v1::event::Body;
    let ring = |of: &dyn Fn(f32) -> f32| pack(&(0..60_u8).map(|i| of(f32::from(i) * 0.105)).collect::<Vec<f32>>());
    let scan = |stamp_ns| {
        let (x, y) = (ring(&|angle| 9.0 * angle.cos()), ring(&|angle| 9.0 * angle.sin()));
        Body::Scan(v1::Scan { stamp_ns, x, y, z: ring(&|_| -1.9), ..Default::default() })
    };
    let pose = v1::Pose { x: 1.0, qw: 1.0, ..Default::default() };
    let mounted = Extrinsics { x_m: 1.0, y_m: 0.0, z_m: 1.9, roll_deg: 0.0, pitch_deg: 0.0, yaw_deg: 0.0 };
    let side = SensorConfig::new("side", mounted);
    let side = Event { sequence: 0, arrival_ns: 0, source: 1, body: core::Body::Sensor(Box::new(side)) };
    let bodies = [
        Body::Lost(3),
        Body::EgoPose(v1::EgoPose { stamp_ns: 100_000_000, map_from_ego: Some(pose), speed_mps: 3.0 }),
        scan(100_000_000),
        event_to_proto(&side).body.unwrap(),
        Body::Datagram(vec![0xff; 1206].into()),
        Body::Datagram(vec![0; 512].into()),
        scan(200_000_000),
        Body::Lost(u64::MAX),
        Body::End(v1::End {}),
    ];
    let event = |(sequence, body)| v1::Event {
        sequence,
        arrival_ns: 100_000_000 + sequence as i64 * 20_000_000,
        source: u32::from(sequence == 3),
        body: Some(body),
        lost_cause: v1::LossCause::Length.into(),
    };
    (0..).zip(bodies).map(event).collect()
}

fn write_journals() {
    let write = |name: &str, events: &[v1::Event]| {
        let stream: Vec<u8> = events.iter().flat_map(Message::encode_length_delimited_to_vec).collect();
        write("event", name, &stream);
    };
    write("all", &journal());
    let lost =
        |cause| v1::Event { body: Some(v1::event::Body::Lost(u64::MAX)), lost_cause: cause % 6, ..Default::default() };
    write("lost_beyond_counting", &(0..12).map(lost).collect::<Vec<_>>());
    let clocks = [i64::MIN, i64::MAX, 0, -1, i64::MIN, 1 << 62].into_iter().cycle();
    let clocks = journal().into_iter().zip(clocks).map(|(event, arrival_ns)| v1::Event { arrival_ns, ..event });
    write("clocks", &clocks.collect::<Vec<_>>());
}

fn write_observations() {
    let write = |name: &str, observation: v1::Observation| {
        write("observation", name, &observation.encode_to_vec());
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
