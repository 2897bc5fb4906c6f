//! What a bag states of its clouds is believed only if it can be right: frames, stamps, distances.

use clearway_replay::summary::why_no_map;
use clearway_ros::pose::tf_message_to_cdr;

use super::scene::*;

const NO_ROTATION_AT_ALL: [f64; 4] = [0.0; 4];

/// A cloud with each point moved by this much, as a localisation moves it.
fn moved(stamp_ns: i64, [dx, dy, dz]: [f64; 3]) -> Vec<u8> {
    let fields = [("x", 8), ("y", 8), ("z", 8)];
    let cloud = cloud("velodyne", stamp_ns, &fields, &rays(16), |_, [x, y, z], data| {
        let at = [f64::from(x) + dx, f64::from(y) + dy, f64::from(z) + dz];
        at.iter().for_each(|value| data.extend(value.to_le_bytes()));
    });
    cloud.to_cdr()
}

/// A drive of three scans with tf poses and these messages.
fn drive_with(messages: Vec<Message>, cloud: impl Fn(i64, i64) -> Vec<u8>) -> Vec<Message> {
    let clouds = (0..3).map(|scan| {
        let stamp_ns = START_NS + scan * SCAN_NS;
        ("/points", CLOUD, stamp_ns + SCAN_NS, cloud(scan, stamp_ns))
    });
    tf_poses(4 * SCAN_NS, |_| 0).into_iter().chain(messages).chain(clouds).collect()
}

#[tokio::test(flavor = "multi_thread")]
async fn what_a_cloud_states_is_checked_before_it_counts() {
    let placed = || vec![mount("velodyne", LEVEL)];
    let namesake = transform(START_NS, "base_link", "car/velodyne", [0.0, 0.0, 1.8], LEVEL);
    let refused = transform(START_NS, "base_link", "velodyne", [0.0, 0.0, 1.8], NO_ROTATION_AT_ALL);
    let of = |frame: &'static str| move |_: i64, ns| velodyne(frame, ns).to_cdr();
    // What the bag has, its maps, and what is said.
    let cases: [(&str, Vec<Message>, u64, &str); 6] = [
        (
            "UTM",
            drive_with(placed(), |_, ns| moved(ns, [4e5, 4e6, 100.0])),
            0,
            "4019.9 km from the origin of its frame",
        ),
        (
            "ECEF without a mount",
            drive_with(vec![], |_, ns| moved(ns, [4e6, 6e5, 4.8e6])),
            0,
            "6276.9 km from the origin",
        ),
        (
            "two sensors",
            drive_with(placed(), |scan, ns| velodyne(["velodyne", "rear"][scan as usize % 2], ns).to_cdr()),
            2,
            "frame rear: allowed: velodyne",
        ),
        (
            "stamps of 0",
            drive_with(placed(), |_, _| velodyne("velodyne", 0).to_cdr()),
            3,
            "all stamps of its first messages are 0 ns",
        ),
        (
            "a namesake",
            drive_with(vec![("/tf_static", TF, START_NS, tf_message_to_cdr(&[namesake]))], of("velodyne")),
            3,
            "tf places car/velodyne, which is taken for its frame velodyne",
        ),
        (
            "a mount in /tf",
            drive_with(vec![("/tf", TF, START_NS, tf_message_to_cdr(&[refused]))], of("velodyne")),
            0,
            "the transform that places velodyne was refused",
        ),
    ];
    for (what, messages, maps, said) in cases {
        let (summary, headers) = replayed_bag(messages, &[]).await;
        assert_eq!(
            (headers.len() as u64, summary.snapshot.maps_with_pose),
            (maps, maps),
            "{what}: {:?}",
            summary.notes
        );
        let why = why_no_map(&summary.mount, &summary.snapshot);
        let is_said = why.contains(said) || summary.notes.iter().any(|note| note.contains(said));
        assert!(is_said, "{what}: {why}: {:?}", summary.notes);
        for (header, map) in headers.iter().zip(0..) {
            let x_m = header.map_from_ego.as_ref().unwrap().x;
            let expected_m = position_m(SCAN_NS * if what == "two sensors" { 1 + 2 * map } else { 1 + map });
            assert!((x_m - expected_m).abs() < 0.1, "{what}: {x_m} m");
        }
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_sensor_without_returns_is_named() {
    let empty = |stamp_ns| {
        let mut cloud = velodyne("velodyne", stamp_ns);
        (cloud.width, cloud.row_step, cloud.data) = (0, 0, &[]);
        cloud
    };
    let (summary, _) = replayed_bag(drive_of(3, empty), &[]).await;
    assert!(summary.to_text().contains("its scans have no returns"), "{}", summary.to_text());
    let remark = summary.to_json()["sensors"][0]["remarks"][0].as_str().unwrap_or_default().to_owned();
    assert!(remark.contains("no returns"), "{remark}");
}
