//! Messages written by rosbags are read correctly, and messages written here equal messages of rosbags.

use clearway_ros::cdr::Header;
use clearway_ros::pose::{
    Odometry, StampedTransform, Twist, path_to_cdr, pose_array_to_cdr, pose_stamped, tf_message, tf_message_to_cdr,
};
use clearway_ros::published::diagnostics::{Diagnostic, DiagnosticLevel, diagnostic_array_to_cdr};
use clearway_ros::published::markers::{Lines, marker_array_to_cdr};
use clearway_ros::velodyne_scan::VelodyneScan;
use clearway_ros::{PointCloud2, Points};
use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion};

use crate::{STAMP_NS, golden};

fn points(name: &str) -> Points {
    Points::from_cloud(&PointCloud2::new(&golden(name)).unwrap()).unwrap()
}

#[test]
fn a_cloud_of_the_velodyne_driver_is_read() {
    let read = points("velodyne");
    assert_eq!((read.x, read.y, read.z), (vec![10.0, 12.0], vec![0.0, 1.0], vec![-2.0, 2.0]));
    assert_eq!((read.intensity, read.ring), (vec![0.2, 1.0], vec![0, 15]));
    assert_eq!((read.stamp_ns, read.offset_ns, read.no_returns), (STAMP_NS, vec![-100_000_001, 0], 1));
}

#[test]
fn a_cloud_of_the_ouster_driver_is_read() {
    let read = points("ouster");
    assert_eq!((read.x, read.z), (vec![5.0, 5.0, 6.0], vec![1.0, -1.0, -1.0]));
    assert_eq!((read.ring, read.intensity), (vec![63, 0, 0], vec![0.5, 0.25, 1.0]));
    assert_eq!((read.stamp_ns, read.no_returns), (STAMP_NS + 100_000_000, 1));
    assert_eq!(read.offset_ns, [-100_000_000, -100_000_000, 0]);
}

#[test]
fn a_big_endian_cloud_of_the_hesai_driver_is_read() {
    let read = points("hesai_big_endian");
    assert_eq!((read.x, read.y, read.z), (vec![1.0, 3.0], vec![2.0, 2.0], vec![3.0, -1.0]));
    assert_eq!((read.stamp_ns, read.offset_ns), (STAMP_NS + 125_000_000, vec![-125_000_000, 0]));
    assert_eq!((read.ring, read.intensity), (vec![2, 1], vec![0.0, 100.0 / 255.0]));
}

#[test]
fn a_cloud_of_the_livox_driver_is_read() {
    let read = points("livox");
    assert_eq!((read.x, read.z, read.ring), (vec![1.0, 3.0], vec![3.0, 1.0], vec![1, 0]));
    // A double holds ns since the epoch in steps of 256.
    assert!((read.stamp_ns - STAMP_NS - 62_500_000).abs() <= 128, "{}", read.stamp_ns);
    assert!((read.offset_ns[0] + 62_500_000).abs() <= 256 && read.offset_ns[1] == 0, "{:?}", read.offset_ns);
}

#[test]
fn a_cloud_of_the_nebula_driver_is_read() {
    let read = points("nebula");
    assert_eq!((read.intensity, read.ring), (vec![0.2, 1.0], vec![0, 127]));
    assert_eq!((read.stamp_ns, read.offset_ns), (STAMP_NS + 99_000_000, vec![-99_000_000, 0]));
}

#[test]
fn a_cloud_is_written_as_by_rosbags() {
    for name in ["velodyne", "ouster", "livox", "nebula"] {
        let bytes = golden(name);
        assert_eq!(PointCloud2::new(&bytes).unwrap().to_cdr(), bytes, "{name}");
    }
}

fn golden_pose() -> Isometry3<f64> {
    let rotation = UnitQuaternion::from_quaternion(Quaternion::new(0.8, 0.0, 0.0, 0.6));
    Isometry3::from_parts(Translation3::new(1.0, 2.0, 3.0), rotation)
}

#[test]
fn poses_have_their_frames_and_speeds() {
    let bytes = golden("odometry");
    let odometry = Odometry::new(&bytes).unwrap();
    assert_eq!(odometry.twist, Some(Twist { linear_mps: [15.0, 0.5, 0.0], angular_rps: [0.0, 0.0, 0.25] }));
    let StampedTransform { header, child_frame_id, parent_from_child } = odometry.transform.clone();
    assert_eq!((header.stamp_ns, header.frame_id, child_frame_id), (STAMP_NS, "odom", "base_link"));
    assert_eq!(parent_from_child, golden_pose());
    assert_eq!(Odometry::new(&odometry.to_cdr()), Ok(odometry));

    let bytes = golden("pose_stamped");
    let pose = pose_stamped(&bytes).unwrap();
    assert_eq!((pose.header.frame_id, pose.parent_from_child), ("map", golden_pose()));

    let bytes = golden("tf_message");
    let transforms = tf_message(&bytes).unwrap().transforms;
    let frames: Vec<_> = transforms.iter().map(|t| (t.header.frame_id, t.child_frame_id, t.header.stamp_ns)).collect();
    assert_eq!(frames, [("map", "odom", STAMP_NS), ("odom", "base_link", STAMP_NS - 250_000_000)]);
    assert_eq!(transforms[1].parent_from_child, golden_pose());
    assert_eq!(tf_message_to_cdr(&transforms), bytes);
}

#[test]
fn poses_and_lines_are_written_as_by_rosbags() {
    let header = Header { stamp_ns: STAMP_NS, frame_id: "car/base_link" };
    assert_eq!(pose_array_to_cdr(&header, &[golden_pose(), golden_pose()]), golden("pose_array"));
    let path = Header { stamp_ns: STAMP_NS, frame_id: "map" };
    assert_eq!(path_to_cdr(&path, &[golden_pose(), golden_pose()]), golden("path"));
    let points = vec![[1.0, 2.0, 0.0], [3.0, -4.0, 0.5]];
    let markers = [
        Lines { name: "links", width_m: 0.1, rgba: [1.0, 0.5, 0.25, 1.0], points },
        Lines { name: "radii", width_m: 0.05, rgba: [0.0, 0.0, 1.0, 0.5], points: Vec::new() },
    ];
    assert_eq!(marker_array_to_cdr(&header, 1_500_000_000, &markers), golden("marker_array"));
}

#[test]
fn states_are_written_as_by_rosbags() {
    let header = Header { stamp_ns: STAMP_NS, frame_id: "" };
    let of = |level, vehicle: &str, message: &str, values| {
        let (name, hardware_id) = (format!("clearway: {vehicle}"), vehicle.to_owned());
        Diagnostic { level, name, message: message.to_owned(), hardware_id, values }
    };
    let values = vec![("loss", "0.125".to_owned()), ("maps", "12".to_owned())];
    let states = [
        of(DiagnosticLevel::Error, "car", "no packets from top for 3.1 s", values),
        of(DiagnosticLevel::Ok, "bus", "", Vec::new()),
    ];
    assert_eq!(diagnostic_array_to_cdr(&header, &states), golden("diagnostic_array"));
}

#[test]
fn packets_have_their_stamps() {
    let bytes = golden("velodyne_scan");
    let scan = VelodyneScan::new(&bytes).unwrap();
    assert_eq!((scan.frame_id, scan.count), ("velodyne", 3));
    let packets: Vec<_> = scan.packets().map(Result::unwrap).map(|(stamp_ns, data)| (stamp_ns, data[1205])).collect();
    assert_eq!(packets, [0, 1, 2].map(|i| (1_700_000_000_000_000_000 + i64::from(i), i)));
}
