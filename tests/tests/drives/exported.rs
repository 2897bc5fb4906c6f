//! An exported bag is a drive again.

use clearway_journal::reader::{RecordedMessage, RecordingReader};
use clearway_replay::ReplayOptions;
use clearway_ros::Kind;
use clearway_ros::pose::Odometry;

use super::scene::*;

#[tokio::test(flavor = "multi_thread")]
async fn a_ros_2_export_replays_with_its_poses_rings_and_times() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    write_bag(&at("bag.mcap"), drive_of(4, |ns| velodyne("velodyne", ns)), "cdr");
    let run = |arguments: &[&str]| {
        let output = clearway_tests::run(folder.path(), "clearway", arguments);
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    };
    run(&["replay", "bag.mcap", "--record", "run.mcap"]);
    run(&["export", "run.mcap", "--format", "ros2", "--out", "exported.mcap"]);
    let frames = |name: &str| {
        let of_odometry = |message| match message {
            RecordedMessage::Ros { kind: Kind::Odometry, bytes, .. } => {
                let odometry = Odometry::new(&bytes).unwrap().transform;
                Some([odometry.header.frame_id, odometry.child_frame_id].map(str::to_owned))
            }
            _ => None,
        };
        let found = RecordingReader::open(&at(name)).unwrap().map(Result::unwrap).find_map(of_odometry);
        found.expect("an odometry")
    };
    assert_eq!(frames("exported.mcap"), ["odom", "base_link"], "as in the tf of the bag");
    let replayed =
        async |name: &str| replayed(ReplayOptions { files: vec![at(name)], ..Default::default() }).await.unwrap();
    let (before, expected) = replayed("bag.mcap").await;
    let (after, headers) = replayed("exported.mcap").await;
    assert_eq!((headers.len(), after.snapshot.maps_with_pose), (4, 4), "{:?}", after.notes);
    assert_eq!(after.snapshot.drivable_share, before.snapshot.drivable_share);
    for (header, expected) in headers.iter().zip(&expected) {
        let x_m = |header: &clearway_proto::v1::Header| header.map_from_ego.as_ref().unwrap().x;
        assert!((x_m(header) - x_m(expected)).abs() < 0.01, "{} m", x_m(header));
        assert_eq!((&header.compensation, header.capture_end_ns), (&expected.compensation, expected.capture_end_ns));
    }
}
