//! What the fuzzer does with the bytes of a file, and `cargo test` with its corpus. Nothing here may panic.

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

/// Checks what holds for the points of any message.
fn check(points: &Points, bytes: usize) {
    let n = points.x.len();
    assert!(n <= bytes && [points.y.len(), points.z.len(), points.intensity.len()] == [n; 3]);
    assert!([0, n].contains(&points.ring.len()) && [0, n].contains(&points.offset_ns.len()));
    assert!(points.intensity.iter().all(|value| (0.0..=1.0).contains(value)));
    assert!(points.offset_ns.iter().all(|offset| *offset <= 0));
}
