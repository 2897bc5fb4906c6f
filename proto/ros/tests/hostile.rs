//! Damaged and malicious messages are refused with the member that is wrong; the corpus of the fuzzer is replayed.

use clearway_ros::cdr::{Header, Writer};
use clearway_ros::point_cloud2::Field;
use clearway_ros::pose::{Odometry, StampedTransform, pose_stamped, tf_message, tf_message_to_cdr};
use clearway_ros::velodyne_scan::VelodyneScan;
use clearway_ros::{MessageError, PointCloud2, Points};
use nalgebra::{Isometry3, Quaternion};
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

/// A cloud of two points after a change, as its error text, or the number of its points and the refused parts.
fn read(change: impl FnOnce(&mut PointCloud2)) -> String {
    let field = |(index, name): (usize, &'static str)| Field { name, offset: 4 * index as u32, datatype: 7, count: 1 };
    let fields = ["x", "y", "z", "intensity", "time", "ring"].into_iter().enumerate().map(field).collect();
    let data: Vec<u8> = [0.0_f32, 0.1]
        .iter()
        .flat_map(|time| {
            [1.0, 2.0, 3.0, 4.0, *time].iter().flat_map(|v| v.to_le_bytes()).chain([7, 0, 0, 0]).collect::<Vec<_>>()
        })
        .collect();
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
    read.map_or_else(
        |error| error.to_string(),
        |points| {
            let refused = points.refused.iter().map(|part| format!("; {} {}", part.count, part.fault));
            format!("{} points{}", points.x.len(), refused.collect::<String>())
        },
    )
}

#[test]
fn x_y_and_z_suffice_and_a_wrong_layout_of_them_is_refused() {
    let claim = |claimed: u32| move |cloud: &mut PointCloud2| cloud.width = claimed;
    let cases = [
        (read(|_| {}), "2 points"),
        (read(claim(0)), "0 points"),
        (read(claim(u32::MAX)), "data = 48 bytes for 1 x 4294967295 points"),
        (read(|c| (c.width, c.row_step, c.height) = (0xAAA_AAAA, u32::MAX, u32::MAX)), "data = 48 bytes for"),
        (read(|c| c.height = 2), "data = 48 bytes for 2 x 2 points: allowed: row_step a row"),
        (read(|c| c.row_step = 0), "2 points"),
        (read(|c| (c.height, c.width, c.row_step) = (2, 1, 0)), "2 points"),
        (read(|c| c.point_step = 0), "point_step = 0: allowed: at least 1"),
        (read(|c| c.fields[2].offset = u32::MAX), "fields[] = z (offset 4294967295"),
        (read(|c| c.fields[2].count = 2), "fields[] = z (offset 8, datatype 7, count 2): allowed: count 1"),
        (read(|c| c.fields[2].datatype = 6), "fields[] = z (offset 8, datatype 6, count 1): allowed: float32"),
        (read(|c| c.fields[0].datatype = 0), "fields[] = x (offset 0, datatype 0, count 1): allowed: datatypes"),
        (read(|c| c.fields[3].name = "x"), "fields[] = x (offset 0, datatype 7, count 1): allowed: float32 or"),
        (read(|c| c.fields[0].name = "X"), "fields = X y z intensity time ring: allowed: x y z"),
        (read(|c| c.fields[1].offset = 2), "fields[] = y (offset 2, datatype 7, count 1): allowed: fields that do not"),
        (read(|c| c.fields.extend(vec![c.fields[0]; 251])), "fields = 257: allowed: up to 256 fields"),
    ];
    for (text, expected) in cases {
        assert!(text.starts_with(expected), "{text:?} does not start with {expected:?}");
    }
}

#[test]
fn a_wrong_optional_field_is_left_out_with_the_reason() {
    let cases = [
        (read(|c| c.point_step = 23), "ring (offset 20, datatype 6, count 1): allowed: fields that end within"),
        (read(|c| c.fields[3].offset = 10), "intensity (offset 10, datatype 7, count 1): allowed: fields that do not"),
        (read(|c| c.fields[5].datatype = 7), "ring = 0.000000000000000000000000000000"),
        (read(|c| c.fields[5].datatype = 11), "ring (offset 20, datatype 11, count 1): allowed: datatypes 1 to 10"),
        (read(|c| c.fields[4].count = 3), "time (offset 16, datatype 7, count 3): allowed: count 1"),
    ];
    for (text, expected) in cases {
        let read = text.strip_prefix("2 points; 1 ").map(|fault| fault.trim_start_matches("fields[] = "));
        assert!(read.is_some_and(|fault| fault.starts_with(expected)), "{text:?} does not have {expected:?}");
    }
    assert_eq!(read(|c| c.fields[5].datatype = 5), "2 points");
    assert_eq!(read(|c| c.fields[5].count = 0), "2 points");
}

/// A cloud of so many points with one field beside their positions, whose numbers are as a driver writes them.
fn with_field(points: u32, name: &'static str, datatype: u8, number: impl Fn(u32) -> Vec<u8>) -> Points {
    let field = |name, offset, datatype| Field { name, offset, datatype, count: 1 };
    let fields = vec![field("x", 0, 7), field("y", 4, 7), field("z", 8, 7), field(name, 12, datatype)];
    let position = [1.0_f32, 2.0, 0.5].map(f32::to_le_bytes).concat();
    let data: Vec<u8> = (0..points)
        .flat_map(|point| {
            let mut bytes = position.clone();
            bytes.extend(number(point));
            bytes.resize(20, 0);
            bytes
        })
        .collect();
    let header = Header { stamp_ns: HEADER_NS, frame_id: "top" };
    let (height, width, point_step, row_step) = (1, points, 20, 0);
    let cloud = PointCloud2 {
        header,
        height,
        width,
        fields,
        big_endian: false,
        point_step,
        row_step,
        data: &data,
        dense: false,
    };
    Points::from_cloud(&cloud).unwrap()
}

const HEADER_NS: i64 = 1_700_000_000_500_000_000;

/// The bytes of the time of a point.
type TimeBytes = Box<dyn Fn(u32) -> Vec<u8>>;

#[test]
fn the_unit_and_the_origin_of_times_are_found_from_their_values() {
    // 20,000 points in 0.1 s.
    let us = |point: u32| u64::from(5 * point);
    let epoch_us = move |point: u32| HEADER_NS as u64 / 1000 + us(point);
    let cases: [(&str, u8, TimeBytes); 11] = [
        ("float32 s", 7, Box::new(move |p| (us(p) as f32 * 1e-6).to_le_bytes().to_vec())),
        ("float32 ms", 7, Box::new(move |p| (us(p) as f32 * 1e-3).to_le_bytes().to_vec())),
        ("float32 us", 7, Box::new(move |p| (us(p) as f32).to_le_bytes().to_vec())),
        ("float32 ns", 7, Box::new(move |p| (us(p) as f32 * 1e3).to_le_bytes().to_vec())),
        ("uint32 ns", 6, Box::new(move |p| (us(p) as u32 * 1000).to_le_bytes().to_vec())),
        ("uint32 us", 6, Box::new(move |p| (us(p) as u32).to_le_bytes().to_vec())),
        ("float64 s since the epoch", 8, Box::new(move |p| (epoch_us(p) as f64 * 1e-6).to_le_bytes().to_vec())),
        ("float64 ms since the epoch", 8, Box::new(move |p| (epoch_us(p) as f64 * 1e-3).to_le_bytes().to_vec())),
        ("float64 ns since the epoch", 8, Box::new(move |p| (epoch_us(p) as f64 * 1e3).to_le_bytes().to_vec())),
        ("uint64 ns since the epoch", 10, Box::new(move |p| (epoch_us(p) * 1000).to_le_bytes().to_vec())),
        ("int64 us since the epoch", 9, Box::new(move |p| epoch_us(p).to_le_bytes().to_vec())),
    ];
    for (kind, datatype, number) in cases {
        let points = with_field(20_000, "timestamp", datatype, number);
        assert_eq!((points.x.len(), points.refused.as_slice()), (20_000, &[][..]), "{kind}");
        let (end_ns, first_ns) = (points.stamp_ns - HEADER_NS, i64::from(points.offset_ns[0]));
        assert!((end_ns - 99_995_000).abs() < 2_000 && (first_ns + 99_995_000).abs() < 2_000, "{kind}: {end_ns}");
    }
}

#[test]
fn a_few_wrong_times_or_rings_cost_their_points_and_many_the_field() {
    let times = |wrong: u32| {
        with_field(200, "t", 6, move |p| if p < wrong { 3_604_361_924 } else { 500_000 * p }.to_le_bytes().to_vec())
    };
    let rings = |wrong: u32| {
        with_field(200, "ring", 7, move |p| if p < wrong { 0.5 } else { (p % 16) as f32 }.to_le_bytes().to_vec())
    };
    let shown = |points: Points| {
        let parts: Vec<_> = points.refused.iter().map(|part| (part.what, part.count)).collect();
        (points.x.len(), points.offset_ns.len(), points.ring.len(), parts)
    };
    assert_eq!(shown(times(5)), (195, 195, 0, vec![("points", 5)]));
    assert_eq!(shown(times(50)), (200, 0, 0, vec![("field", 1)]));
    assert_eq!(shown(rings(5)), (195, 0, 195, vec![("points", 5)]));
    assert_eq!(shown(rings(50)), (200, 0, 0, vec![("field", 1)]));
    // Equal times say nothing of the motion during the scan, and neither do times of another clock.
    assert_eq!(shown(with_field(200, "t", 6, |_| vec![0; 4])), (200, 0, 0, vec![("field", 1)]));
    let boot = with_field(200, "timestamp", 8, |p| (37.0 + f64::from(p) * 1e-4).to_le_bytes().to_vec());
    assert_eq!((boot.stamp_ns, shown(boot)), (HEADER_NS, (200, 0, 0, vec![("field", 1)])));
}

#[test]
fn a_wrong_packet_or_transform_costs_no_other() {
    let packets: Vec<_> = [5, 2_000_000_000, 6].map(|ns| (1, ns, vec![7; 1206])).into();
    let bytes = crate::velodyne_scan::message("velodyne", &packets);
    let read: Vec<bool> = VelodyneScan::new(&bytes).unwrap().packets().map(|packet| packet.is_ok()).collect();
    assert_eq!(read, [true, false, true]);

    let transform = |child_frame_id, w: f64| {
        let mut pose = Isometry3::identity();
        *pose.rotation.as_mut_unchecked() = Quaternion::new(w, 0.0, 0.0, 0.0);
        StampedTransform { header: Header { stamp_ns: 1, frame_id: "odom" }, child_frame_id, parent_from_child: pose }
    };
    let sent = [transform("gnss", 0.0), transform("base_link", 1.004), transform("odom", 1.0), transform("", 1.0)];
    let bytes = tf_message_to_cdr(&sent);
    let read = tf_message(&bytes).unwrap();
    let refused: Vec<_> = read.refused.iter().map(|of| of.child_frame_id).collect();
    assert_eq!((read.transforms.len(), read.transforms[0].child_frame_id), (1, "base_link"));
    assert_eq!(read.transforms[0].parent_from_child, Isometry3::identity(), "normalised");
    assert_eq!(refused, ["gnss", "odom", ""]);
    assert!(
        read.refused[0].fault.to_string().contains("quaternion 0 0 0 0 of frame gnss"),
        "{}",
        read.refused[0].fault
    );
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

/// The head of a cloud for the fuzz target, and two points of zeros and ones.
fn layout(fields: &[[u8; 4]], [height, point_step, flags]: [u8; 3]) -> Vec<u8> {
    let mut bytes = vec![fields.len() as u8, height, point_step, flags];
    bytes.extend(fields.as_flattened());
    bytes.extend((0..8 * usize::from(point_step)).map(|at| [0, 0, 128, 63][at % 4]));
    bytes
}

#[test]
fn no_seed_of_the_corpora_causes_a_panic() {
    let corpus = |target| [env!("CARGO_MANIFEST_DIR"), "fuzz", "corpus", target].iter().collect::<std::path::PathBuf>();
    let xyz = [[0, 0, 7, 1], [1, 4, 7, 1], [2, 8, 7, 1]];
    let wide = [[0, 0, 8, 1], [1, 8, 8, 1], [2, 16, 8, 1]];
    let layouts = [
        ("velodyne", layout(&[&xyz[..], &[[3, 12, 7, 1], [4, 16, 4, 1], [6, 18, 7, 1]]].concat(), [1, 22, 0])),
        (
            "ouster",
            layout(&[&xyz[..], &[[3, 16, 7, 1], [5, 20, 6, 1], [9, 24, 4, 1], [4, 26, 2, 1]]].concat(), [2, 48, 1]),
        ),
        ("big_endian", layout(&[&xyz[..], &[[7, 12, 8, 1], [4, 20, 7, 1]]].concat(), [4, 24, 6])),
        ("wide", layout(&[&wide[..], &[[10, 24, 10, 0], [7, 32, 9, 1]]].concat(), [1, 40, 0])),
        ("beyond", layout(&[&xyz[..], &[[3, 255, 7, 1], [4, 2, 8, 9], [5, 12, 77, 1]]].concat(), [0, 13, 7])),
    ];
    if std::env::var_os("CLEARWAY_BLESS").is_some() {
        ["message", "cloud"].iter().for_each(|target| std::fs::create_dir_all(corpus(target)).unwrap());
        NAMES.iter().for_each(|name| std::fs::write(corpus("message").join(name), golden(name)).unwrap());
        layouts.iter().for_each(|(name, bytes)| std::fs::write(corpus("cloud").join(name), bytes).unwrap());
    }
    for (target, run, seeds_min) in
        [("message", entries::message as fn(&[u8]), NAMES.len()), ("cloud", entries::cloud, layouts.len())]
    {
        let seeds = std::fs::read_dir(corpus(target)).unwrap().map(|seed| std::fs::read(seed.unwrap().path()).unwrap());
        assert!(seeds.inspect(|seed| run(seed)).count() >= seeds_min, "{target}");
    }
}
