//! Damaged and malicious messages are refused with the member that is wrong; the corpus of the fuzzer is replayed.

use clearway_ros::cdr::{Header, Writer};
use clearway_ros::point_cloud2::Field;
use clearway_ros::pose::{Odometry, pose_stamped, tf_message};
use clearway_ros::{MessageError, PointCloud2, Points};
use proptest::prelude::*;

use crate::{entries, golden};

const NAMES: [&str; 9] = [
    "velodyne",
    "ouster",
    "hesai_big_endian",
    "livox",
    "nebula",
    "odometry",
    "pose_stamped",
    "tf_message",
    "velodyne_scan",
];

#[test]
fn a_message_cut_anywhere_is_refused_as_truncated() {
    let cut = |error: MessageError| assert!(matches!(error, MessageError::Truncated { .. }), "{error}");
    for name in NAMES {
        let bytes = golden(name);
        for end in 0..bytes.len() {
            let bytes = &bytes[..end];
            match name {
                "odometry" => cut(Odometry::new(bytes).unwrap_err()),
                "pose_stamped" => cut(pose_stamped(bytes).unwrap_err()),
                "tf_message" => cut(tf_message(bytes).unwrap_err()),
                "velodyne_scan" => entries::message(bytes),
                _ => cut(PointCloud2::new(bytes).unwrap_err()),
            }
        }
    }
}

/// The error text, or the number of points, of a cloud of two points after a change.
fn refused(change: impl FnOnce(&mut PointCloud2)) -> String {
    let field = |(index, name): (usize, &'static str)| Field { name, offset: 4 * index as u32, datatype: 7, count: 1 };
    let fields = ["x", "y", "z", "intensity", "time", "ring"].into_iter().enumerate().map(field).collect();
    let data: Vec<u8> =
        [1.0_f32, 2.0, 3.0, 4.0, 0.0].iter().flat_map(|v| v.to_le_bytes()).chain([7, 0, 0, 0]).collect();
    let data = data.repeat(2);
    let mut cloud = PointCloud2 {
        header: Header { stamp_ns: 1_700_000_000_000_000_000, frame_id: "top" },
        height: 1,
        width: 2,
        fields,
        big_endian: false,
        point_step: 24,
        row_step: 48,
        data: &data,
        dense: true,
    };
    cloud.fields[5].datatype = 6;
    change(&mut cloud);
    let bytes = cloud.to_cdr();
    let read = PointCloud2::new(&bytes).and_then(|cloud| Points::from_cloud(&cloud));
    read.map_or_else(|error| error.to_string(), |points| format!("{} points", points.x.len()))
}

#[test]
fn wrong_layouts_are_refused_with_what_is_allowed() {
    let claim = |claimed: u32| move |cloud: &mut PointCloud2| cloud.width = claimed;
    let cases = [
        (refused(|_| {}), "2 points"),
        (refused(claim(0)), "0 points"),
        (refused(claim(u32::MAX)), "row_step = 48: allowed: at least width times point_step"),
        (refused(|c| (c.width, c.row_step, c.height) = (0xAAA_AAAA, u32::MAX, u32::MAX)), "data = 48 bytes for"),
        (refused(|c| c.height = 2), "data = 48 bytes for 2 x 2 points: allowed: row_step a row"),
        (refused(|c| c.point_step = 0), "point_step = 0: allowed: at least 1"),
        (
            refused(|c| c.point_step = 23),
            "fields[] = ring (offset 20, datatype 6, count 1): allowed: fields that end within point_step",
        ),
        (refused(|c| c.fields[2].offset = u32::MAX), "fields[] = z (offset 4294967295"),
        (refused(|c| c.fields[2].count = u32::MAX), "fields[] = z (offset 8, datatype 7, count 4294967295)"),
        (refused(|c| c.fields[2].count = 2), "fields[] = z (offset 8, datatype 7, count 2): allowed: float32"),
        (refused(|c| c.fields[2].datatype = 6), "fields[] = z (offset 8, datatype 6, count 1): allowed: float32"),
        (refused(|c| c.fields[0].datatype = 0), "fields[] = x (offset 0, datatype 0, count 1): allowed: float32"),
        (
            refused(|c| c.fields[3].name = "x"),
            "fields[] = x (offset 0, datatype 7, count 1): allowed: float32, float64 (datatypes 7, 8), count 1, once",
        ),
        (refused(|c| c.fields[0].name = "X"), "fields = X y z intensity time ring: allowed: x y z"),
        (
            refused(|c| c.fields[3].offset = 10),
            "fields[] = bytes 8 to 12 and 10 on: allowed: fields that do not overlap",
        ),
        (refused(|c| c.fields[5].datatype = 7), "fields[] = ring (offset 20, datatype 7, count 1): allowed: integers"),
        (refused(|c| c.fields[5].datatype = 5), "2 points"),
        (refused(|c| c.fields[5].offset = 0), "fields[] = bytes 0 to 4 and 0 on"),
        (refused(|c| c.fields[4].datatype = 4), "fields[] = time (offset 16, datatype 4, count 1): allowed: int32"),
        (
            refused(|c| (c.fields[4].offset, c.fields[3].offset) = (12, 16)),
            "time = 4 with header.stamp 1700000000000000000 ns: allowed: ns",
        ),
        (refused(|c| c.fields.extend(vec![c.fields[0]; 251])), "fields = 257: allowed: up to 256 fields"),
    ];
    for (text, expected) in cases {
        assert!(text.starts_with(expected), "{text:?} does not start with {expected:?}");
    }
}

#[test]
fn invalid_texts_encapsulations_stamps_and_rotations_are_refused() {
    let message = |frame: &[u8]| {
        let mut writer = Writer::default();
        writer.stamp(1).u32(frame.len() as u32).bytes(frame);
        pose_stamped(&writer.finish()).unwrap_err().to_string()
    };
    for frame in [&b""[..], b"map", b"m\0p\0", &[0xFF, 0]] {
        assert_eq!(message(frame), "header.frame_id is not UTF-8 ending in its only zero");
    }
    let mut late = golden("pose_stamped");
    late[8..12].copy_from_slice(&1_000_000_000_u32.to_le_bytes());
    assert_eq!(
        pose_stamped(&late).unwrap_err().to_string(),
        "header.stamp = 1700000000 s 1000000000 ns: allowed: up to 999999999 ns"
    );
    let mut other = golden("pose_stamped");
    other[1] = 7;
    assert_eq!(pose_stamped(&other), Err(MessageError::Encapsulation { found: [0, 7] }));
    for (value, expected) in [
        (0.0_f64, "pose = quaternion 0 0 0 0: allowed: a unit quaternion"),
        (f64::NAN, "pose = quaternion NaN NaN NaN NaN"),
    ] {
        let mut bytes = golden("pose_stamped");
        let at = bytes.len() - 32;
        bytes[at..].copy_from_slice(&value.to_le_bytes().repeat(4));
        let shown = pose_stamped(&bytes).unwrap_err().to_string();
        assert!(shown.starts_with(expected), "{shown}");
    }
    let mut greedy = Writer::default();
    greedy.u32(u32::MAX);
    assert_eq!(tf_message(&greedy.finish()).unwrap_err().reason(), "ros_truncated");
}

proptest! {
    #[test]
    fn a_damaged_message_never_panics(
        name in proptest::sample::select(NAMES.to_vec()),
        damage in proptest::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 0..8),
        end in any::<prop::sample::Index>(),
    ) {
        let mut bytes = golden(name);
        for (at, value) in damage {
            let at = at.index(bytes.len());
            bytes[at] = value;
        }
        let whole = bytes.clone();
        bytes.truncate(end.index(bytes.len()) + 1);
        entries::message(&bytes);
        entries::message(&whole);
    }
}

#[test]
fn no_seed_of_the_corpus_causes_a_panic() {
    let corpus: std::path::PathBuf = [env!("CARGO_MANIFEST_DIR"), "fuzz", "corpus", "message"].iter().collect();
    if std::env::var_os("CLEARWAY_BLESS").is_some() {
        std::fs::create_dir_all(&corpus).unwrap();
        NAMES.iter().for_each(|name| std::fs::write(corpus.join(name), golden(name)).unwrap());
    }
    let seeds = std::fs::read_dir(corpus).unwrap().map(|seed| std::fs::read(seed.unwrap().path()).unwrap());
    assert!(seeds.inspect(|seed| entries::message(seed)).count() >= NAMES.len());
}
