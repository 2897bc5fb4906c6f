//! ROS 2 bags: a fault costs the part that has it, and no map has a pose of another epoch.

use clearway_proto::v1;
use clearway_replay::Mount;
use clearway_ros::point_cloud2::PointCloud2;
use clearway_ros::pose::{Odometry, Twist, tf_message_to_cdr};

use super::scene::*;

/// Positions x of the maps' poses in metres; NaN for a map without a pose.
fn xs(headers: &[v1::Header]) -> Vec<f64> {
    headers.iter().map(|header| header.map_from_ego.as_ref().map_or(f64::NAN, |pose| pose.x)).collect()
}

/// A cloud after a change of its description or of its bytes.
fn changed(stamp_ns: i64, change: impl FnOnce(&mut PointCloud2<'static>)) -> PointCloud2<'static> {
    let mut cloud = velodyne("velodyne", stamp_ns);
    change(&mut cloud);
    cloud
}

fn field(cloud: &mut PointCloud2<'static>, name: &str, change: impl FnOnce(&mut clearway_ros::point_cloud2::Field)) {
    change(cloud.fields.iter_mut().find(|field| field.name == name).unwrap());
}

/// The cloud with another time of each point.
fn timed(stamp_ns: i64, datatype: u8, bytes: impl Fn(&Ray) -> Vec<u8>) -> PointCloud2<'static> {
    let fields = [("x", 7), ("y", 7), ("z", 7), ("ring", 7), ("time", datatype)];
    cloud("velodyne", stamp_ns, &fields, &rays(16), |ray, at, data| {
        at.iter().for_each(|value| data.extend(value.to_le_bytes()));
        data.extend(f32::from(ray.ring).to_le_bytes());
        data.extend(bytes(ray));
    })
}

#[tokio::test(flavor = "multi_thread")]
async fn a_fault_of_a_part_of_a_cloud_costs_that_part_alone() {
    type Make = fn(i64) -> PointCloud2<'static>;
    // What is wrong, the cloud, the compensation, and what the notes say.
    let cases: [(&str, Make, &str, &str); 11] = [
        ("nothing", |ns| velodyne("velodyne", ns), "poses", ""),
        ("row_step 0", |ns| changed(ns, |cloud| cloud.row_step = 0), "poses", ""),
        (
            "a ring of float32 and a time in us",
            |ns| timed(ns, 7, |ray| (ray.after_ns as f32 * 1e-3).to_le_bytes().into()),
            "poses",
            "",
        ),
        (
            "uint64 times since the epoch",
            |ns| timed(ns, 10, move |ray| (ns as u64 + u64::from(ray.after_ns)).to_le_bytes().into()),
            "poses",
            "",
        ),
        (
            "a few wrong times",
            |ns| timed(ns, 6, |ray| if ray.column < 2 { 3_604_361_924 } else { ray.after_ns }.to_le_bytes().into()),
            "poses",
            "points of messages refused",
        ),
        ("ms", |ns| timed(ns, 6, |ray| (ray.after_ns / 1_000_000).to_le_bytes().into()), "poses", ""),
        ("8 bits", |ns| timed(ns, 2, |ray| vec![(ray.after_ns / 1_000_000) as u8]), "none", "32 or 64 bits"),
        ("equal times", |ns| timed(ns, 7, |_| vec![0; 4]), "none", "times that differ"),
        (
            "times of another clock",
            |ns| timed(ns, 8, |ray| (100.0 + f64::from(ray.after_ns) * 1e-9).to_le_bytes().into()),
            "none",
            "within 2 s of header.stamp",
        ),
        (
            "a time of an unknown type",
            |ns| changed(ns, |cloud| field(cloud, "time", |field| field.datatype = 77)),
            "none",
            "datatype 77",
        ),
        (
            "intensity beyond the point",
            |ns| changed(ns, |cloud| field(cloud, "intensity", |field| field.offset = 900)),
            "poses",
            "offset 900",
        ),
    ];
    for (what, make, compensation, note) in cases {
        let (summary, headers) = replayed_bag(drive_of(3, make), &[]).await;
        assert_eq!((headers.len(), summary.snapshot.maps_with_pose), (3, 3), "{what}: {:?}", summary.notes);
        assert!(headers.iter().all(|header| header.compensation == compensation), "{what}: {:?}", headers[0]);
        let span_ns = headers[0].capture_end_ns - headers[0].capture_start_ns;
        let is_revolution = (SCAN_NS * 9 / 10..=SCAN_NS).contains(&span_ns);
        assert!(is_revolution || compensation == "none", "{what}: {span_ns} ns");
        assert!(summary.notes.iter().any(|line| line.contains(note)), "{what}: {:?}", summary.notes);
        let share = summary.snapshot.drivable_share.unwrap();
        assert!(share > 0.9, "{what}: {share} drivable");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn one_bad_transform_costs_no_other_and_no_mount_is_guessed_in_its_place() {
    let mut messages = drive_of(3, |ns| velodyne("velodyne", ns));
    for (_, _, log_ns, bytes) in messages.iter_mut().filter(|(topic, ..)| *topic == "/tf") {
        let x_m = position_m(*log_ns - START_NS);
        let good = transform(*log_ns, "odom", "base_link", [x_m, 0.0, 0.0], LEVEL);
        *bytes = tf_message_to_cdr(&[transform(*log_ns, "base_link", "gnss", [0.0; 3], [0.0; 4]), good]);
    }
    let (summary, headers) = replayed_bag(messages, &[]).await;
    let right = xs(&headers).iter().zip(0..).all(|(x, map)| (x - position_m((map + 1) * SCAN_NS)).abs() < 0.05);
    assert!(right && headers.len() == 3, "{:?}", xs(&headers));
    assert!(summary.notes.iter().any(|note| note.contains("of frame gnss")), "{:?}", summary.notes);

    // Two digits of a quaternion of 90 degrees are normalised, as tf2 does it.
    let with_mount = |quaternion| {
        let mut messages = drive_of(3, |ns| velodyne("velodyne", ns));
        messages[0] = mount("velodyne", quaternion);
        messages
    };
    let (summary, _) = replayed_bag(with_mount([0.0, 0.0, 0.71, 0.71]), &[]).await;
    assert!((summary.extrinsics.yaw_deg - 90.0).abs() < 0.1, "{:?}", summary.extrinsics);

    let (summary, headers) = replayed_bag(with_mount([0.0; 4]), &[]).await;
    assert!(headers.is_empty() && matches!(summary.mount, Mount::Refused { .. }), "{:?}", summary.mount);
}

/// The car's odometry every 20 ms, from a child frame.
fn odometry(child: &'static str, lasts_ns: i64, shift: impl Fn(i64) -> i64) -> Vec<Message> {
    let one = |after_ns: i64| {
        let at_m = [position_m(after_ns), 0.0, 0.0];
        let transform = transform(START_NS + after_ns + shift(after_ns), "odom", child, at_m, LEVEL);
        let twist = Some(Twist { linear_mps: [SPEED_MPS, 0.0, 0.0], angular_rps: [0.0; 3] });
        ("/odom", ODOMETRY, START_NS + after_ns, Odometry { transform, twist }.to_cdr())
    };
    (0..=lasts_ns / 20_000_000).map(|index| one(index * 20_000_000)).collect()
}

#[tokio::test(flavor = "multi_thread")]
async fn when_all_stamps_step_back_no_map_has_a_pose_of_another_epoch() {
    const SCANS: i64 = 14;
    for (source, step_ms, at_ms) in
        ["tf", "odometry"].into_iter().flat_map(|of| [100, 200, 400, 2000, 20_000].map(|ms| (of, ms, 500)))
    {
        let shift = move |after_ns: i64| if after_ns >= at_ms * 1_000_000 { -step_ms * 1_000_000 } else { 0 };
        let mut messages = vec![mount("velodyne", LEVEL)];
        messages.extend(match source {
            "tf" => tf_poses(SCANS * SCAN_NS, shift),
            _ => odometry("base_link", SCANS * SCAN_NS, shift),
        });
        for scan in 0..SCANS {
            let end_ns = (scan + 1) * SCAN_NS;
            let stamp_ns = START_NS + end_ns - SCAN_NS + shift(end_ns - SCAN_NS);
            messages.push(("/points", CLOUD, START_NS + end_ns, velodyne("velodyne", stamp_ns).to_cdr()));
        }
        let (_, headers) = replayed_bag(messages, &[]).await;
        let mut with_pose = 0;
        for header in &headers {
            let Some(pose) = &header.map_from_ego else { continue };
            let driven_m = position_m(header.completed_ns - START_NS);
            assert!((pose.x - driven_m).abs() < 0.1, "{source}, {step_ms} ms: {} m, not {driven_m} m", pose.x);
            with_pose += 1;
        }
        assert!(with_pose >= SCANS - 6, "{source}, {step_ms} ms: {with_pose} of {} maps", headers.len());
    }
}

/// 14 scans with poses from tf, whose stamps are shifted, and log times that are changed.
fn shifted_drive(poses: impl Fn(i64) -> i64, clouds: impl Fn(i64) -> i64, logged: impl Fn(i64) -> i64) -> Vec<Message> {
    let mut messages = tf_poses(14 * SCAN_NS, poses);
    for end_ns in (1..=14).map(|scan| scan * SCAN_NS) {
        let cloud = velodyne("velodyne", START_NS + end_ns - SCAN_NS + clouds(end_ns));
        messages.push(("/points", CLOUD, START_NS + end_ns, cloud.to_cdr()));
    }
    messages.iter_mut().for_each(|(_, _, log_ns, _)| *log_ns = START_NS + logged(*log_ns - START_NS));
    messages.push(mount("velodyne", LEVEL));
    messages
}

#[tokio::test(flavor = "multi_thread")]
async fn when_one_clock_steps_no_map_has_a_pose_of_another_clock() {
    for (of, step_ms) in ["poses", "clouds"].into_iter().flat_map(|of| [-400, -100, 100, 400].map(|ms| (of, ms))) {
        let shift =
            |is_of: bool| move |after_ns: i64| if is_of && after_ns >= 500_000_000 { step_ms * 1_000_000 } else { 0 };
        let (summary, headers) =
            replayed_bag(shifted_drive(shift(of == "poses"), shift(of == "clouds"), |ns| ns), &[]).await;
        let what = format!("{of}, {step_ms} ms: {:?}", xs(&headers));
        for header in &headers {
            let Some(pose) = &header.map_from_ego else { continue };
            let driven_m = position_m(header.completed_ns - START_NS);
            assert!((pose.x - driven_m).abs() < 0.1, "{what}: {} m, not {driven_m} m", pose.x);
        }
        assert!(summary.snapshot.maps_with_pose >= 4 && headers.len() >= 12, "{what}");
        let ahead_s = if of == "poses" { step_ms as f64 } else { -step_ms as f64 } / 1e3;
        let way = if ahead_s > 0.0 { "ahead of" } else { "behind" };
        let said = format!("the stamps of the poses are {:.2} s {way} its stamps since", f64::abs(ahead_s));
        assert!(summary.to_text().contains(&said), "{what}: {}", summary.to_text());
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn the_queue_of_a_recorder_costs_no_map_its_pose() {
    let bursts = |after_ns: i64| (after_ns / 250_000_000 + 1) * 250_000_000 + after_ns % 1000;
    let outage = |after_ns: i64| if (500_000_000..900_000_000).contains(&after_ns) { 900_000_000 } else { after_ns };
    let late = |after_ns: i64| after_ns + if after_ns < 500_000_000 { 0 } else { 150_000_000 };
    for (what, logged) in [("bursts", bursts as fn(i64) -> i64), ("an outage", outage), ("a delay that lasts", late)] {
        let (summary, headers) = replayed_bag(shifted_drive(|_| 0, |_| 0, logged), &[]).await;
        let text = summary.to_text();
        assert!(!text.contains("one clock stepped") && headers.len() >= 10, "{what}: {text}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn poses_and_scans_that_are_logged_late_or_seldom_find_each_other() {
    // Time from one pose to the next, from its stamp to its log time, and by which a cloud is logged later, ms.
    for (period_ms, late_ms, cloud_late_ms) in
        [(20, 300, 0), (20, 900, 0), (500, 0, 0), (500, 300, 0), (1000, 0, 0), (20, 0, 500)]
    {
        let mut messages = drive_of(24, |ns| velodyne("velodyne", ns));
        messages.retain_mut(|(topic, _, log_ns, _)| {
            let after_ns = *log_ns - START_NS;
            *log_ns += if *topic == "/tf" { late_ms } else { cloud_late_ms } * 1_000_000;
            *topic != "/tf" || after_ns % (period_ms * 1_000_000) == 0
        });
        let (summary, headers) = replayed_bag(messages, &[]).await;
        let what = format!("each {period_ms} ms, {late_ms} and {cloud_late_ms} ms late: {:?}", xs(&headers));
        // tf has no speed, and the first pose none before it.
        let least = (24 - period_ms / 100 - 4) as u64;
        assert!(headers.len() == 24 && summary.snapshot.maps_with_pose >= least, "{what}");
        assert!(!summary.to_text().contains("no scan of"), "{what}: {}", summary.to_text());
        for header in headers {
            let Some(pose) = &header.map_from_ego else { continue };
            let driven_m = position_m(header.capture_end_ns - START_NS);
            assert!((pose.x - driven_m).abs() < 0.05, "{what}: {} m, not {driven_m} m", pose.x);
        }
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn the_source_of_poses_is_judged_by_the_maps_that_have_one() {
    let clouds = |frame: &'static str, shift_ns: i64| {
        (0..3).map(move |scan| {
            let stamp_ns = START_NS + scan * SCAN_NS;
            ("/points", CLOUD, stamp_ns + SCAN_NS, velodyne(frame, stamp_ns + shift_ns).to_cdr())
        })
    };
    let placed = |frame| [mount(frame, LEVEL)].into_iter();
    let poses = |child| odometry(child, 3 * SCAN_NS, |_| 0).into_iter();
    let tf = || tf_poses(3 * SCAN_NS, |_| 0).into_iter();
    // What the bag has, the maps with a pose, and what the notes say.
    let of_another_clock = || odometry("base_link", 3 * SCAN_NS, |_| -37_000_000_000).into_iter();
    let cases: [(&str, Vec<Message>, u64, &str); 9] = [
        (
            "no child frame",
            placed("velodyne").chain(poses("")).chain(clouds("velodyne", 0)).collect(),
            3,
            "child_frame_id is empty",
        ),
        (
            "another child frame",
            placed("velodyne").chain(poses("imu")).chain(clouds("velodyne", 0)).collect(),
            0,
            "no transform joins its child frame imu to base_link",
        ),
        (
            "cloud and odometry in body",
            poses("body").chain(clouds("body", 0)).collect(),
            3,
            "poses of body are read from /odom",
        ),
        (
            "TAI",
            placed("velodyne").chain(tf()).chain(clouds("velodyne", 37_000_000_000)).collect(),
            0,
            "37.0 s ahead of the stamps of the poses: one clock is TAI",
        ),
        (
            "an odometry of another clock beside tf",
            placed("velodyne").chain(tf()).chain(of_another_clock()).chain(clouds("velodyne", 0)).collect(),
            3,
            "/odom (nav_msgs/msg/Odometry) is not used: its stamps are 37.0 s behind the stamps of the scans",
        ),
        (
            "an odometry on the topic of the clouds",
            {
                let (_, kind, log_ns, bytes) = odometry("base_link", 0, |_| 0).remove(0);
                let other = ("/points", kind, log_ns, bytes);
                placed("velodyne").chain([other]).chain(tf()).chain(clouds("velodyne", 0)).collect()
            },
            3,
            "/points: 1 message refused, the first: a nav_msgs/msg/Odometry: allowed: PointCloud2",
        ),
        (
            "boot time",
            placed("velodyne").chain(tf()).chain(clouds("velodyne", 50_000_000_000 - START_NS)).collect(),
            0,
            "counts from the start of its device",
        ),
        ("a merged cloud", tf().chain(clouds("base_link", 0)).collect(), 3, "its frame base_link is the vehicle's"),
        (
            "a namespace",
            {
                let mount = transform(START_NS, "robot1/base_link", "robot1/velodyne", [0.0, 0.0, 1.8], LEVEL);
                let pose = |index: i64| {
                    let at_ns = index * 20_000_000;
                    let pose = transform(
                        START_NS + at_ns,
                        "robot1/odom",
                        "robot1/base_link",
                        [position_m(at_ns), 0.0, 0.0],
                        LEVEL,
                    );
                    ("/tf", TF, START_NS + at_ns, tf_message_to_cdr(&[pose]))
                };
                let mount = ("/tf_static", TF, START_NS, tf_message_to_cdr(&[mount]));
                [mount].into_iter().chain((0..16).map(pose)).chain(clouds("robot1/velodyne", 0)).collect()
            },
            3,
            "poses of robot1/base_link are read from tf, in robot1/odom",
        ),
    ];
    for (what, messages, with_pose, note) in cases {
        let (summary, headers) = replayed_bag(messages, &[]).await;
        let maps = (headers.len(), summary.snapshot.maps_with_pose);
        assert_eq!(maps, (3, with_pose), "{what}: {:?}", summary.notes);
        assert!(summary.notes.iter().any(|line| line.contains(note)), "{what}: {:?}", summary.notes);
        assert!(summary.to_text().contains(&format!("{with_pose} of 3 with a pose")), "{}", summary.to_text());
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_sensor_that_sends_empty_clouds_costs_the_others_nothing() {
    let mut messages = drive_of(4, |ns| velodyne("velodyne", ns));
    messages.push(mount("rear", LEVEL));
    for scan in 0..4 {
        let mut empty = velodyne("rear", START_NS + scan * SCAN_NS);
        (empty.width, empty.row_step, empty.data) = (0, 0, &[]);
        messages.push(("/rear/points", CLOUD, START_NS + (scan + 1) * SCAN_NS - 1, empty.to_cdr()));
    }
    let (summary, headers) = replayed_bag(messages, &[]).await;
    assert!(headers.len() == 4 && summary.shows_anything());
    for header in headers {
        let rear = header.sensors.iter().find(|sensor| sensor.name == "rear").unwrap();
        assert_eq!((header.compensation.as_str(), rear.returns), ("poses", 0));
        assert!(["empty", "silent"].contains(&rear.state.as_str()), "{}", rear.state);
        assert!(header.capture_end_ns - header.capture_start_ns <= SCAN_NS, "the rear sensor does not begin the sweep");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_drive_without_a_return_shows_nothing() {
    let empty = |ns| changed(ns, |cloud| (cloud.width, cloud.row_step, cloud.data) = (0, 0, &[]));
    let (summary, headers) = replayed_bag(drive_of(3, empty), &[]).await;
    let why = clearway_replay::summary::why_no_map(&summary.mount, &summary.snapshot);
    assert!(headers.len() == 3 && !summary.shows_anything() && why == "none of 3 revolutions has a return", "{why}");
}

#[tokio::test(flavor = "multi_thread")]
async fn topics_that_are_not_read_are_named_with_what_helps() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("ros1.mcap");
    let cloud = velodyne("velodyne", START_NS).to_cdr();
    write_bag(&file, vec![("/velodyne_points", "sensor_msgs/PointCloud2", START_NS, cloud)], "ros1");
    let options = clearway_replay::ReplayOptions { files: vec![file], ..Default::default() };
    let (summary, _) = replayed(options).await.unwrap();
    let ros1 = "/velodyne_points (sensor_msgs/PointCloud2, 1 messages) is in ROS 1 encoding";
    assert!(summary.notes.iter().any(|note| note.contains(ros1)), "{:?}", summary.notes);

    let others = ["livox_ros_driver2/msg/CustomMsg", "pandar_msgs/msg/PandarScan", "sensor_msgs/msg/LaserScan"];
    let messages = others.map(|kind| ("/lidar", kind, START_NS, vec![0, 1, 0, 0])).into();
    let (summary, headers) = replayed_bag(messages, &[]).await;
    for kind in others {
        assert!(summary.notes.iter().any(|note| note.contains(kind)), "{kind}: {:?}", summary.notes);
    }
    assert_eq!((headers.len(), summary.maps()), (0, 0));
}
