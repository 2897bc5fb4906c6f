//! A small drive: flat ground, a sensor 1.8 m over it, a wall of 1.5 m height and 8 m width 12 m ahead, a car at 5 m/s.

use std::fs::File;
use std::io::BufWriter;
use std::path::Path;

use clearway_journal::mcap_reader::McapReader;
use clearway_mapping::config::Extrinsics;
use clearway_proto::v1;
use clearway_replay::{ReplayError, ReplayOptions, ReplaySummary, replay};
use clearway_ros::cdr::Header;
use clearway_ros::point_cloud2::{Field, PointCloud2};
use clearway_ros::pose::{StampedTransform, tf_message_to_cdr};
use mcap::records::MessageHeader;
use nalgebra::{Isometry3, Quaternion, UnitQuaternion, Vector3};

use crate::fixture;

pub const CLOUD: &str = "sensor_msgs/msg/PointCloud2";
pub const ODOMETRY: &str = "nav_msgs/msg/Odometry";
pub const TF: &str = "tf2_msgs/msg/TFMessage";
/// Time of the first stamp, ns.
pub const START_NS: i64 = 1_700_000_000_000_000_000;
/// Time of a scan, ns.
pub const SCAN_NS: i64 = 100_000_000;
/// Speed of the car, m/s.
pub const SPEED_MPS: f64 = 5.0;
const HEIGHT_M: f32 = 1.8;

/// One ray of a scan.
#[derive(Clone, Copy, Debug)]
pub struct Ray {
    /// Return in the frame of the sensor, metres; `None` without one.
    pub at: Option<[f32; 3]>,
    /// Rank of the laser by elevation, and of the firing in the scan.
    pub ring: u16,
    pub column: u32,
    /// Time after the first firing, ns.
    pub after_ns: u32,
}

/// Number of firings of a scan.
pub const COLUMNS: u32 = 180;

/// The rays of a scan with lasers from 15 degrees below level to 15 above, firing by firing.
pub fn rays(lasers: u16) -> Vec<Ray> {
    let ray = |column: u32, ring: u16| {
        let elevation = (-15.0 + 30.0 * f32::from(ring) / f32::from(lasers - 1)).to_radians();
        let azimuth = (360.0 * column as f32 / COLUMNS as f32).to_radians();
        let way = [elevation.cos() * azimuth.cos(), elevation.cos() * azimuth.sin(), elevation.sin()];
        let ground_m = (way[2] < 0.0).then(|| HEIGHT_M / -way[2]);
        let wall_m = (way[0] > 0.0)
            .then(|| 12.0 / way[0])
            .filter(|range_m| (way[1] * range_m).abs() <= 4.0 && (0.0..=1.5).contains(&(HEIGHT_M + way[2] * range_m)));
        let range_m = wall_m.into_iter().chain(ground_m).reduce(f32::min).filter(|range_m| *range_m < 60.0);
        let after_ns = (SCAN_NS as u32 / COLUMNS) * column;
        Ray { at: range_m.map(|range_m| way.map(|axis| axis * range_m)), ring, column, after_ns }
    };
    (0..COLUMNS).flat_map(|column| (0..lasers).map(move |ring| ray(column, ring))).collect()
}

/// One message of a bag: topic, type, log time in ns, bytes.
pub type Message = (&'static str, &'static str, i64, Vec<u8>);

/// A cloud of one row, whose numbers `write` appends for each return; fields are names with their datatypes.
pub fn cloud(
    frame_id: &str,
    stamp_ns: i64,
    fields: &[(&'static str, u8)],
    rays: &[Ray],
    write: impl Fn(&Ray, [f32; 3], &mut Vec<u8>),
) -> PointCloud2<'static> {
    let size = |datatype: u8| match datatype {
        1 | 2 => 1,
        3 | 4 => 2,
        8..=10 => 8,
        _ => 4,
    };
    let mut offset = 0;
    let mut described = Vec::new();
    for (name, datatype) in fields {
        described.push(Field { name, offset, datatype: *datatype, count: 1 });
        offset += size(*datatype);
    }
    let (mut data, mut width) = (Vec::new(), 0);
    for ray in rays {
        let Some(at) = ray.at else { continue };
        write(ray, at, &mut data);
        width += 1;
    }
    // A test's cloud lives as long as its process.
    let (data, frame_id): (&'static [u8], &'static str) = (data.leak(), frame_id.to_owned().leak());
    let header = Header { stamp_ns, frame_id };
    let (point_step, row_step) = (offset, offset * width);
    PointCloud2 {
        header,
        height: 1,
        width,
        fields: described,
        big_endian: false,
        point_step,
        row_step,
        data,
        dense: true,
    }
}

/// A cloud as velodyne_pointcloud writes it.
pub fn velodyne(frame_id: &str, stamp_ns: i64) -> PointCloud2<'static> {
    let fields = [("x", 7), ("y", 7), ("z", 7), ("intensity", 7), ("ring", 4), ("time", 7)];
    cloud(frame_id, stamp_ns, &fields, &rays(16), |ray, [x, y, z], data| {
        [x, y, z, 20.0].iter().for_each(|value| data.extend(value.to_le_bytes()));
        data.extend(ray.ring.to_le_bytes());
        data.extend((ray.after_ns as f32 * 1e-9).to_le_bytes());
    })
}

/// A transform without a check of its quaternion x y z w.
pub fn transform(
    stamp_ns: i64,
    parent: &'static str,
    child: &'static str,
    [x, y, z]: [f64; 3],
    [i, j, k, w]: [f64; 4],
) -> StampedTransform<'static> {
    let rotation = UnitQuaternion::new_unchecked(Quaternion::new(w, i, j, k));
    let parent_from_child = Isometry3::from_parts(Vector3::new(x, y, z).into(), rotation);
    StampedTransform { header: Header { stamp_ns, frame_id: parent }, child_frame_id: child, parent_from_child }
}

/// A sensor 1.8 m over the origin of the vehicle.
pub const LEVEL_MOUNT: Extrinsics =
    Extrinsics { x_m: 0.0, y_m: 0.0, z_m: 1.8, roll_deg: 0.0, pitch_deg: 0.0, yaw_deg: 0.0 };
/// No rotation: x y z w.
pub const LEVEL: [f64; 4] = [0.0, 0.0, 0.0, 1.0];

/// The static mount of a frame, 1.8 m over `base_link`.
pub fn mount(child: &'static str, quaternion: [f64; 4]) -> Message {
    let mount = transform(START_NS, "base_link", child, [0.0, 0.0, f64::from(HEIGHT_M)], quaternion);
    ("/tf_static", TF, START_NS, tf_message_to_cdr(&[mount]))
}

/// Position of the car along x, metres, at this time after the start.
pub fn position_m(after_ns: i64) -> f64 {
    SPEED_MPS * after_ns as f64 * 1e-9
}

/// The pose of the car every 20 ms for this time, in /tf, with the log time as stamp plus `shift`.
pub fn tf_poses(lasts_ns: i64, shift: impl Fn(i64) -> i64) -> Vec<Message> {
    let pose = |after_ns: i64| {
        let at_m = [position_m(after_ns), 0.0, 0.0];
        let pose = transform(START_NS + after_ns + shift(after_ns), "odom", "base_link", at_m, LEVEL);
        ("/tf", TF, START_NS + after_ns, tf_message_to_cdr(&[pose]))
    };
    (0..=lasts_ns / 20_000_000).map(|index| pose(index * 20_000_000)).collect()
}

/// A drive of `scans` scans of the sensor `velodyne`, each made by `cloud` from its stamp, with mount and tf poses.
pub fn drive_of(scans: i64, cloud: impl Fn(i64) -> PointCloud2<'static>) -> Vec<Message> {
    let mut messages = vec![mount("velodyne", LEVEL)];
    messages.extend(tf_poses(scans * SCAN_NS, |_| 0));
    for scan in 0..scans {
        let end_ns = START_NS + (scan + 1) * SCAN_NS;
        messages.push(("/points", CLOUD, end_ns, cloud(START_NS + scan * SCAN_NS).to_cdr()));
    }
    messages
}

/// Writes the messages in the order of their log times as an MCAP bag.
pub fn write_bag(file: &Path, mut messages: Vec<Message>, encoding: &str) {
    messages.sort_by_key(|(_, _, log_ns, _)| *log_ns);
    let mut writer = mcap::Writer::new(BufWriter::new(File::create(file).unwrap())).unwrap();
    for (sequence, (topic, kind, log_ns, bytes)) in messages.iter().enumerate() {
        let schema = writer.add_schema(kind, "ros2msg", b"").unwrap();
        let channel_id = writer.add_channel(schema, topic, encoding, &Default::default()).unwrap();
        let (log_time, sequence) = (*log_ns as u64, sequence as u32);
        let header = MessageHeader { channel_id, sequence, log_time, publish_time: log_time };
        writer.write_to_known_channel(&header, bytes).unwrap();
    }
    writer.finish().unwrap();
}

/// The summary of a replay and the headers of its maps, in order.
pub async fn replayed(options: ReplayOptions) -> Result<(ReplaySummary, Vec<v1::Header>), ReplayError> {
    let folder = tempfile::tempdir().unwrap();
    let record = folder.path().join("out.mcap");
    let options = ReplayOptions { record: Some(record.clone()), ..options };
    let summary = fixture::within("replay", replay(options)).await?;
    let headers = McapReader::open(&record).unwrap().filter_map(|message| {
        let message = message.unwrap();
        message.map_of().filter(|(_, layer)| *layer == "height_difference")?;
        message.map_header()
    });
    Ok((summary, headers.collect()))
}

/// Replays the messages as a bag.
pub async fn replayed_bag(messages: Vec<Message>, topics: &[&str]) -> (ReplaySummary, Vec<v1::Header>) {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("bag.mcap");
    write_bag(&file, messages, "cdr");
    let topics = topics.iter().map(|topic| (*topic).to_owned()).collect();
    replayed(ReplayOptions { files: vec![file], topics, ..ReplayOptions::default() }).await.unwrap()
}
