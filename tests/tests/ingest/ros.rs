//! ROS 2 bags and live topics make the maps that the sensor's own packets make, and bad messages are counted.

use std::fs::File;
use std::io::BufWriter;
use std::path::Path;

use clearway_daemon::config::{Origin, Ros};
use clearway_daemon::record::{run_config, verify};
use clearway_lidar::model::Model;
use clearway_lidar::{Sensor, SensorConfig};
use clearway_mapping::config::Extrinsics;
use clearway_mapping::event::Body;
use clearway_replay::{Mount, ReplayError, ReplayOptions, ReplaySummary, replay};
use clearway_ros::PointCloud2;
use clearway_ros::cdr::Header;
use clearway_ros::point_cloud2::Field;
use clearway_ros::pose::{Odometry, StampedTransform, Twist, tf_message_to_cdr};
use mcap::records::MessageHeader;
use nalgebra::{Isometry3, Vector3};
use zenoh::qos::CongestionControl;

use crate::fixture::{self, readings, until, within};

const CLOUD: &str = "sensor_msgs/msg/PointCloud2";
const ODOMETRY: &str = "nav_msgs/msg/Odometry";
const TF: &str = "tf2_msgs/msg/TFMessage";

/// Topic, type, log time in ns, and bytes.
type Message = (&'static str, &'static str, i64, Vec<u8>);

/// The simulated vehicle's revolutions as velodyne_pointcloud publishes them, each with its stamp in ns.
fn clouds(tenths: i64) -> Vec<(i64, Vec<u8>)> {
    let mut sensor = Sensor::new(SensorConfig { model: Some(Model::Hdl64eS2), ..SensorConfig::default() });
    let mut clouds = Vec::new();
    for reading in readings(tenths) {
        let Body::Datagram(payload) = reading.body else { continue };
        let Ok(Some(revolution)) = sensor.push(&payload, reading.arrival_ns) else { continue };
        let mut data = Vec::new();
        for point in revolution.points() {
            let time = (point.time_ns - revolution.end_ns) as f32 * 1e-9;
            for value in [point.x, point.y, point.z, point.intensity.into()] {
                data.extend(value.to_le_bytes());
            }
            data.extend(point.ring.to_le_bytes());
            data.extend(time.to_le_bytes());
        }
        clouds.push((revolution.end_ns, cloud("velodyne", revolution.end_ns, &data).to_cdr()));
    }
    clouds
}

/// A cloud of points of 22 bytes.
fn cloud<'a>(frame_id: &'a str, stamp_ns: i64, data: &'a [u8]) -> PointCloud2<'a> {
    let fields = [("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("intensity", 12, 7), ("ring", 16, 4), ("time", 18, 7)];
    let field = |(name, offset, datatype)| Field { name, offset, datatype, count: 1 };
    PointCloud2 {
        header: Header { stamp_ns, frame_id },
        height: 1,
        width: (data.len() / 22) as u32,
        fields: fields.into_iter().map(field).collect(),
        big_endian: false,
        point_step: 22,
        row_step: data.len() as u32,
        data,
        dense: true,
    }
}

fn transform<'a>(stamp_ns: i64, parent: &'a str, child: &'a str, [x, y, z]: [f64; 3]) -> StampedTransform<'a> {
    let parent_from_child = Isometry3::new(Vector3::new(x, y, z), Vector3::zeros());
    StampedTransform { header: Header { stamp_ns, frame_id: parent }, child_frame_id: child, parent_from_child }
}

fn odometry(stamp_ns: i64) -> Vec<u8> {
    odometry_in("odom", stamp_ns)
}

fn odometry_in(frame_id: &str, stamp_ns: i64) -> Vec<u8> {
    let transform = transform(stamp_ns, frame_id, "base_link", [7.0, 1.0, 0.0]);
    let twist = Some(Twist { linear_mps: [0.5, 0.0, 0.0], angular_rps: [0.0; 3] });
    Odometry { transform, twist }.to_cdr()
}

fn bag(file: &Path, messages: &[Message]) {
    let mut writer = mcap::Writer::new(BufWriter::new(File::create(file).unwrap())).unwrap();
    for (sequence, (topic, kind, log_ns, bytes)) in messages.iter().enumerate() {
        let schema = writer.add_schema(kind, "ros2msg", b"").unwrap();
        let channel_id = writer.add_channel(schema, topic, "cdr", &Default::default()).unwrap();
        let (log_time, sequence) = (*log_ns as u64, sequence as u32);
        let header = MessageHeader { channel_id, sequence, log_time, publish_time: log_time };
        writer.write_to_known_channel(&header, bytes).unwrap();
    }
    writer.finish().unwrap();
}

/// Messages of three revolutions: odometry, the mount in tf, the clouds, a second cloud of the same sensor, a merged
/// cloud, and a broken one.
fn drive() -> Vec<Message> {
    let revolutions = clouds(4);
    let start_ns = revolutions[0].0;
    let mount = [transform(start_ns, "base_link", "velodyne", [0.0, 0.0, 1.9])];
    let mut messages = vec![
        ("/tf_static", TF, start_ns, tf_message_to_cdr(&mount)),
        ("/obstacles", CLOUD, start_ns, cloud("velodyne", start_ns, &[0; 22]).to_cdr()),
        ("/merged", CLOUD, start_ns, cloud("base_link", start_ns, &[0; 220]).to_cdr()),
    ];
    for (stamp_ns, revolution) in revolutions {
        messages.push(("/odom", ODOMETRY, stamp_ns, odometry(stamp_ns)));
        messages.push(("/velodyne_points", CLOUD, stamp_ns + 1000, revolution));
    }
    let broken = messages.last().unwrap().3[..5000].to_vec();
    messages.push(("/velodyne_points", CLOUD, start_ns + 400_000_000, broken));
    messages
}

async fn replayed(options: ReplayOptions) -> Result<ReplaySummary, ReplayError> {
    within("replay", replay(options)).await
}

fn options(file: &Path) -> ReplayOptions {
    ReplayOptions { files: vec![file.to_owned()], model: Some(Model::Hdl64eS2), ..ReplayOptions::default() }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_bag_of_clouds_odometry_and_tf_is_mapped_recorded_and_verified() {
    let folder = tempfile::tempdir().unwrap();
    let (file, record) = (folder.path().join("bag.mcap"), folder.path().join("maps.mcap"));
    let messages = drive();
    let revolutions = messages.iter().filter(|(topic, ..)| *topic == "/odom").count() as u64;
    bag(&file, &messages);
    let summary = replayed(ReplayOptions { record: Some(record.clone()), ..options(&file) }).await.unwrap();

    let ledger = &summary.snapshot.ledger;
    assert!(revolutions >= 3);
    assert_eq!(
        (summary.snapshot.maps, ledger.decoded, ledger.poses, ledger.poses_refused),
        (revolutions, revolutions, revolutions, 0)
    );
    assert_eq!((ledger.refused["observation"], ledger.received), (1, revolutions + 1));
    assert_eq!(summary.snapshot.sensors[0].ledger.refused["observation"], 1, "the refusal is counted for its sensor");
    assert_eq!(summary.snapshot.observations_refused, [("ros_message", 1)].into());
    assert!(matches!(&summary.mount, Mount::Tf { ego_frame, frame_id }
            if ego_frame == "base_link" && frame_id == "velodyne"));
    assert_eq!(summary.extrinsics, Extrinsics { z_m: 1.9, ..summary.extrinsics });
    assert!(summary.snapshot.drivable_share.unwrap() > 0.3, "{:?}", summary.snapshot.drivable_share);
    let notes = summary.notes.join("\n");
    for said in [
        "/velodyne_points is used; tf places its frame velodyne",
        "poses of base_link are read from /odom",
        "/obstacles (sensor_msgs/msg/PointCloud2) is not used",
        "/merged (sensor_msgs/msg/PointCloud2) is not used",
        "/velodyne_points: 1 message refused, the first: data needs",
    ] {
        assert!(notes.contains(said), "{said:?} is not in {notes}");
    }
    let report = verify(&record).unwrap();
    assert!(report.is_good() && report.maps == revolutions, "{:?}", report.differences);
    let again = replayed(options(&record)).await.unwrap();
    assert_eq!(again.snapshot.ledger, *ledger, "the recording has the refusals too");
    assert_eq!(again.snapshot.sensors[0].ledger, summary.snapshot.sensors[0].ledger);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_bag_of_several_sensors_makes_maps_of_all_that_tf_places() {
    let folder = tempfile::tempdir().unwrap();
    let (file, record) = (folder.path().join("bag.mcap"), folder.path().join("maps.mcap"));
    let mut messages = drive();
    let (revolutions, start_ns) = (clouds(4), messages[0].2);
    let mounts = [
        transform(start_ns, "base_link", "velodyne", [0.0, 0.0, 1.9]),
        transform(start_ns, "base_link", "Lidar/Left", [0.3, 1.0, 1.9]),
    ];
    messages[0].3 = tf_message_to_cdr(&mounts);
    // The second sensor's scans are 10 ms older than the first's; tf does not place the third sensor.
    for (stamp_ns, _) in &revolutions {
        let data = points_of(&revolutions, *stamp_ns);
        let at = messages.iter().position(|m| m.0 == "/velodyne_points" && m.2 == stamp_ns + 1000).unwrap();
        let left = cloud("Lidar/Left", stamp_ns - 10_000_000, &data).to_cdr();
        messages.insert(at, ("/left_points", CLOUD, stamp_ns + 500, left));
        messages.insert(at, ("/lost_points", CLOUD, stamp_ns + 500, cloud("nowhere", *stamp_ns, &data).to_cdr()));
    }
    bag(&file, &messages);
    let summary = replayed(ReplayOptions { record: Some(record.clone()), ..options(&file) }).await.unwrap();
    let (n, snapshot) = (revolutions.len() as u64, &summary.snapshot);
    let sensors = snapshot.sensors.iter().map(|sensor| (sensor.name.as_str(), sensor.ledger.decoded));
    let mut sensors: Vec<_> = sensors.collect();
    sensors.sort_unstable();
    assert_eq!(sensors, [("lidar_left", n), ("velodyne", n)]);
    let notes = summary.notes.join("\n");
    assert!(notes.contains("/lost_points (sensor_msgs/msg/PointCloud2) is not used"), "{notes}");
    let report = verify(&record).unwrap();
    assert!(report.is_good() && report.maps >= n, "{:?}", report.differences);
    let maps = fixture::recorded(&record);
    let header = |bytes: &bytes::Bytes| <clearway_proto::v1::Map as prost::Message>::decode(&bytes[..]).unwrap().header;
    let last = header(maps.last_key_value().unwrap().1).unwrap();
    assert!(last.sensors.len() == 2 && last.sensors.iter().all(|sensor| sensor.returns > 1000), "{:?}", last.sensors);
    // Each sensor has its own mount, and its own end.
    let entries = clearway_journal::reader::RecordingReader::open(&record).unwrap().map(|entry| entry.unwrap());
    let ends = entries.filter_map(|entry| match entry {
        clearway_journal::reader::RecordedMessage::Event { event, .. } if event.body == Body::End => Some(event.source),
        _ => None,
    });
    assert_eq!(ends.collect::<Vec<_>>(), [0, 1]);
    let (config, _) = run_config(&clearway_journal::reader::RecordingReader::open(&record).unwrap()).unwrap();
    let places = config.vehicles[0].sensors.iter().map(|sensor| (sensor.name.as_str(), sensor.extrinsics.y_m));
    assert!(places.clone().any(|place| place == ("lidar_left", 1.0)), "{:?}", places.collect::<Vec<_>>());
}

#[tokio::test(flavor = "multi_thread")]
async fn a_bag_without_mounts_is_mapped_by_the_sensor_that_shows_most() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("bag.mcap");
    let mut messages = drive();
    let start_ns = messages[0].2;
    // In place of tf the first message is a scan of another sensor.
    messages[0] = ("/bumper_points", CLOUD, start_ns - 1000, cloud("bumper", start_ns - 1000, &[0; 2200]).to_cdr());
    bag(&file, &messages);
    let summary = replayed(options(&file)).await.unwrap();
    assert!(summary.notes.join("\n").contains("/velodyne_points is used"), "{:?}", summary.notes);
    assert!((summary.extrinsics.z_m - 1.9).abs() < 0.05, "{:?}", summary.extrinsics);
    assert!(summary.snapshot.maps >= 3 && summary.snapshot.sensors.len() == 1);
}

/// The data of the cloud of this stamp.
fn points_of(revolutions: &[(i64, Vec<u8>)], stamp_ns: i64) -> Vec<u8> {
    let (_, bytes) = revolutions.iter().find(|(of_ns, _)| *of_ns == stamp_ns).unwrap();
    PointCloud2::new(bytes).unwrap().data.to_vec()
}

#[tokio::test(flavor = "multi_thread")]
async fn clouds_make_nearly_the_same_map_as_packets() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("bag.mcap");
    bag(&file, &drive());
    let summary = replayed(options(&file)).await.unwrap();
    let running = fixture::start(fixture::config()).await;
    fixture::feed(&running, readings(4)).await;
    let packets = running.vehicles.0[0].status.snapshot().drivable_share.unwrap();
    running.shutdown().await.unwrap();
    let clouds = summary.snapshot.drivable_share.unwrap();
    assert!((packets - clouds).abs() < 0.02, "{packets} of packets, {clouds} of clouds");
}

#[tokio::test(flavor = "multi_thread")]
async fn replay_reads_the_requested_topics_and_refuses_an_absent_one() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("bag.mcap");
    bag(&file, &drive());
    let with_topics =
        |topics: &[&str]| ReplayOptions { topics: topics.iter().map(|&t| t.into()).collect(), ..options(&file) };
    let summary = replayed(with_topics(&["/merged"])).await.unwrap();
    assert!(
        summary.notes.join("\n").contains("/merged is used; its frame base_link is the vehicle's"),
        "{:?}",
        summary.notes
    );
    assert_eq!(summary.snapshot.ledger.received, 1);
    let error = replayed(with_topics(&["/nowhere"])).await.unwrap_err().to_string();
    assert!(
        error.contains("--topic /nowhere: the file has") && error.contains("/odom (nav_msgs/msg/Odometry)"),
        "{error}"
    );
}

#[tokio::test(flavor = "multi_thread")]
async fn tf_gives_poses_and_speed_without_odometry_in_a_bag_of_two_files() {
    let folder = tempfile::tempdir().unwrap();
    let files = [0, 1].map(|part| folder.path().join(format!("bag_{part}.mcap")));
    let mut messages = drive();
    messages.pop();
    let stamps: Vec<i64> = messages.iter().filter(|m| m.0 == "/odom").map(|m| m.2).collect();
    for message in messages.iter_mut().filter(|m| m.0 == "/odom") {
        let x = (message.2 - stamps[0]) as f64 * 1e-9 * 12.0;
        *message =
            ("/tf", TF, message.2, tf_message_to_cdr(&[transform(message.2, "odom", "base_link", [x, 0.0, 0.0])]));
    }
    // A localisation stamps ahead and seldom: it moves the chain of transforms, and makes no pose itself.
    let ahead = transform(stamps[0] + 500_000_000, "map", "odom", [100.0, 0.0, 0.0]);
    messages.insert(1, ("/tf", TF, stamps[0], tf_message_to_cdr(&[ahead])));
    let (first, second) = messages.split_at(messages.len() - 2);
    bag(&files[0], first);
    bag(&files[1], second);
    let record = folder.path().join("maps.mcap");
    let summary = replayed(ReplayOptions { files: files.to_vec(), record: Some(record.clone()), ..options(&files[0]) })
        .await
        .unwrap();
    let ledger = &summary.snapshot.ledger;
    // The first transform has no speed, so it makes no pose.
    assert_eq!((ledger.poses, ledger.poses_refused), (stamps.len() as u64 - 1, 0));
    assert_eq!(summary.snapshot.maps, stamps.len() as u64);
    assert!(summary.notes.join("\n").contains("poses of base_link are read from tf, in map"), "{:?}", summary.notes);
    for entry in clearway_journal::reader::RecordingReader::open(&record).unwrap() {
        let clearway_journal::reader::RecordedMessage::Event { event, .. } = entry.unwrap() else { continue };
        let Body::EgoPose(pose) = event.body else { continue };
        assert!((pose.speed_mps - 12.0).abs() < 1e-6, "{pose:?}");
        assert!(stamps.contains(&pose.stamp_ns) && pose.map_from_ego.translation.x >= 100.0, "{pose:?}");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn live_topics_of_rmw_zenoh_make_maps_and_bad_messages_are_counted() {
    let mut config = fixture::config();
    config.zenoh.enabled = true;
    config.vehicles[0].udp = None;
    config.vehicles[0].sensors[0].model = Some(Model::Hdl64eS2);
    let sensors = [("top".to_owned(), "/velodyne_points".to_owned())].into();
    config.vehicles[0].ros = Some(Ros { domain: 7, pose: "/odom".into(), sensors, ..Ros::default() });
    config.check(&Origin::file(Path::new("test"))).unwrap();
    let running = fixture::start(config).await;
    let status = running.vehicles.0[0].status.clone();

    let mut peer = zenoh::Config::default();
    let endpoint = running.zenoh.iter().find(|e| e.starts_with("tcp/127.0.0.1")).unwrap();
    peer.insert_json5("mode", "\"client\"").unwrap();
    peer.insert_json5("connect/endpoints", &format!("[{endpoint:?}]")).unwrap();
    peer.insert_json5("scouting/multicast/enabled", "false").unwrap();
    let session = within("zenoh", zenoh::open(peer).into_future()).await.unwrap();
    let attachment = |sequence: i64| [&sequence.to_le_bytes()[..], &9_i64.to_le_bytes(), &[16], &[3; 16]].concat();
    let cloud_key = "7/velodyne_points/sensor_msgs::msg::dds_::PointCloud2_/RIHS01_00";
    let odometry_key = "7/odom/nav_msgs::msg::dds_::Odometry_/TypeHashNotSupported";
    // Reliable, as rmw_zenoh declares it; else zenoh drops messages of several megabytes.
    let publisher = |key| session.declare_publisher(key).congestion_control(CongestionControl::Block);
    let string_key = "7/velodyne_points/std_msgs::msg::dds_::String_/h";
    let [cloud, odom, string] = [cloud_key, odometry_key, string_key].map(publisher);
    let (cloud, odom, string) = (cloud.await.unwrap(), odom.await.unwrap(), string.await.unwrap());
    for publisher in [&cloud, &odom] {
        let matching = publisher.matching_listener().await.unwrap();
        while !publisher.matching_status().await.unwrap().matching() {
            within("the server listens", matching.recv_async()).await.unwrap();
        }
    }
    let revolutions = clouds(4);
    for (sequence, (stamp_ns, revolution)) in (0..).zip(&revolutions) {
        odom.put(odometry(*stamp_ns)).await.unwrap();
        // Two sequence numbers are missing before the last cloud.
        let last = sequence + 1 == revolutions.len() as i64;
        let sequence = if last { sequence + 2 } else { sequence };
        cloud.put(revolution.clone()).attachment(attachment(sequence)).await.unwrap();
    }
    // A message of another type, bytes that are no message, and a pose in another frame than the configured one.
    string.put(vec![0, 1, 0, 0]).await.unwrap();
    odom.put(vec![0, 1, 0, 0, 1]).attachment(vec![1, 2, 3]).await.unwrap();
    odom.put(odometry_in("map", revolutions[0].0)).await.unwrap();
    let n = revolutions.len() as u64;
    until("all is taken or refused", || {
        let snapshot = status.snapshot();
        let ledger = &snapshot.ledger;
        // The newest map is counted after its scan.
        snapshot.maps >= n && ledger.poses == n && ledger.refused.get("observation") == Some(&3)
    })
    .await;
    let snapshot = status.snapshot();
    assert_eq!((snapshot.maps, snapshot.ledger.decoded, snapshot.ledger.lost), (n, n, 2));
    assert_eq!(snapshot.ledger.refused["observation"], 3);
    assert_eq!(snapshot.observations_refused, [("ros_frame", 1), ("ros_message", 1), ("ros_type", 1)].into());
    // The refused odometry belongs to no sensor.
    assert_eq!(snapshot.sensors[0].ledger.refused["observation"], 1);
    assert!(snapshot.drivable_share.unwrap() > 0.3);
    session.close().await.unwrap();
    running.shutdown().await.unwrap();
}
