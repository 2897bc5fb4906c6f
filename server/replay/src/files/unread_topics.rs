//! The channels of a bag that are not read -> lines for people, with what helps.

use clearway_journal::channel::{Channel, Content};
use clearway_ros::Kind;

/// Number of other topics that are named.
const NAMED_MAX: usize = 12;

/// Message types with points or packets of a LIDAR that are not read, by package and name, and what to do.
const LIDAR_TYPES: [(&str, &str); 9] = [
    ("livox_ros_driver2/CustomMsg", "record sensor_msgs/msg/PointCloud2 (xfer_format 0 of the Livox driver)"),
    ("livox_ros_driver/CustomMsg", "record sensor_msgs/msg/PointCloud2 (xfer_format 0 of the Livox driver)"),
    ("pandar_msgs/PandarScan", "replay the bag through the Hesai driver and record its sensor_msgs/msg/PointCloud2"),
    ("hesai_ros_driver/UdpFrame", "replay the bag through the Hesai driver and record its sensor_msgs/msg/PointCloud2"),
    ("nebula_msgs/NebulaPackets", "replay the bag through nebula and record its sensor_msgs/msg/PointCloud2"),
    ("ouster_ros/PacketMsg", "replay the bag through the Ouster driver and record its sensor_msgs/msg/PointCloud2"),
    (
        "ouster_sensor_msgs/PacketMsg",
        "replay the bag through the Ouster driver and record its sensor_msgs/msg/PointCloud2",
    ),
    ("sensor_msgs/LaserScan", "a scan of one plane shows no ground, so no map is made of it"),
    ("sensor_msgs/PointCloud", "convert it to sensor_msgs/msg/PointCloud2"),
];

/// A line for each topic with data of a LIDAR or with a type that would be read in another encoding, and one for all
/// others.
pub(super) fn unread_topics(channels: &[(&Channel, u64)]) -> Vec<String> {
    let (mut notes, mut others) = (Vec::new(), Vec::new());
    for (channel, count) in channels.iter().filter(|(channel, _)| channel.content == Content::Other) {
        let Channel { topic, schema, encoding, .. } = channel;
        let plain = schema.replace("/msg/", "/");
        let advice = LIDAR_TYPES.iter().find(|(name, _)| *name == plain).map(|(_, advice)| *advice);
        if Kind::from_name(schema).is_some() && encoding == "ros1" {
            let advice = "convert the ROS 1 bag with `rosbags-convert` instead";
            notes.push(format!("{topic} ({schema}, {count} messages) is in ROS 1 encoding and is not read: {advice}"));
        } else if Kind::from_name(schema).is_some() {
            notes.push(format!("{topic} ({schema}, {count} messages) is in encoding {encoding:?}; cdr is read"));
        } else if let Some(advice) = advice {
            notes.push(format!("{topic} ({schema}, {count} messages) is not read: {advice}"));
        } else {
            others.push(format!("{topic} ({schema})"));
        }
    }
    if !others.is_empty() {
        let more = others.len().saturating_sub(NAMED_MAX);
        let more = if more == 0 { String::new() } else { format!(" and {more} more; `clearway info` lists them") };
        others.truncate(NAMED_MAX);
        notes.push(format!("not read: {}{more}", others.join(", ")));
    }
    notes
}
