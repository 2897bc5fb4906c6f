//! What the fuzzer does with the bytes of a file, and `cargo test` with its corpus. Nothing here may panic.

use clearway_ros::cdr::Header;
use clearway_ros::point_cloud2::Field;
use clearway_ros::pose::{Odometry, pose_stamped, tf_message};
use clearway_ros::velodyne_scan::VelodyneScan;
use clearway_ros::{Frames, PointCloud2, Points};

/// Reads the bytes as each kind of message.
pub fn message(bytes: &[u8]) {
    if let Ok(cloud) = PointCloud2::new(bytes) {
        let written = cloud.to_cdr();
        let points = Points::from_cloud(&cloud);
        assert_eq!(PointCloud2::new(&written), Ok(cloud));
        if let Ok(points) = points {
            check(&points, bytes.len());
        }
    }
    if let Ok(scan) = VelodyneScan::new(bytes) {
        scan.packets().for_each(drop);
    }
    drop(Odometry::new(bytes));
    drop(pose_stamped(bytes));
    let mut frames = Frames::default();
    for transform in tf_message(bytes).unwrap_or_default().transforms {
        frames.insert(&transform);
        frames.a_from_b("base_link", transform.child_frame_id);
    }
}

/// Reads a cloud with any layout: the head says its fields, steps and shape, the rest of the bytes are its points.
pub fn cloud(bytes: &[u8]) {
    const NAMES: [&str; 12] =
        ["x", "y", "z", "intensity", "ring", "t", "time", "timestamp", "line", "reflectivity", "channel", "tag"];
    let Some((&[fields, height, point_step, flags], rest)) = bytes.split_first_chunk() else { return };
    let Some((described, data)) = rest.split_at_checked(4 * usize::from(fields)) else { return };
    let field = |of: &[u8]| Field {
        name: NAMES[usize::from(of[0]) % NAMES.len()],
        offset: of[1].into(),
        datatype: of[2],
        count: of[3].into(),
    };
    let row = data.len() / usize::from(height.max(1));
    let (width, row_step) = (row / usize::from(point_step.max(1)), if flags & 1 == 0 { row } else { data.len() });
    let cloud = PointCloud2 {
        header: Header { stamp_ns: 1_700_000_000_000_000_000, frame_id: "top" },
        height: height.into(),
        width: width as u32,
        fields: described.chunks_exact(4).map(field).collect(),
        big_endian: flags & 2 != 0,
        point_step: point_step.into(),
        row_step: if flags & 4 == 0 { row_step as u32 } else { 0 },
        data,
        dense: false,
    };
    message(&cloud.to_cdr());
}

/// Checks what holds for the points of any message.
fn check(points: &Points, bytes: usize) {
    let n = points.x.len();
    assert!(n <= bytes && [points.y.len(), points.z.len(), points.intensity.len()] == [n; 3]);
    assert!([0, n].contains(&points.ring.len()) && [0, n].contains(&points.offset_ns.len()));
    assert!(points.intensity.iter().all(|value| (0.0..=1.0).contains(value)));
    assert!(points.offset_ns.iter().all(|offset| *offset <= 0));
}
