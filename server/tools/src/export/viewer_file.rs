//! A recording -> one MCAP file that viewers open without a plug-in.
//!
//! foxglove: `/<vehicle>/map/<layer>` (`foxglove.Grid`), `/<vehicle>/safe_points` (`foxglove.SceneUpdate`),
//! `/<vehicle>/plan` (the same), `/<vehicle>/points/<sensor>` (`foxglove.PointCloud`) and `/tf`
//! (`foxglove.FrameTransforms`). ros2: `/clearway/<vehicle>/<layer>` (`nav_msgs/msg/OccupancyGrid`) and the layer's
//! other topics ([`ros::topics_of`]), `/clearway/<vehicle>/points/<sensor>` (`sensor_msgs/msg/PointCloud2`),
//! `/clearway/<vehicle>/odometry` (`nav_msgs/msg/Odometry`), `/clearway/<vehicle>/plan` (`nav_msgs/msg/Path`) and `/tf`
//! (`tf2_msgs/msg/TFMessage`), CDR. Messages have the log times of the recording, and the stamp of the capture's or the
//! scan's end. With points the poses of ros2 are the recorded poses with their own stamps, so that a replay of the file
//! has the poses of the drive; without points they are the poses of the maps.

use std::collections::{BTreeMap, HashMap, HashSet};
use std::fs::File;
use std::io::BufWriter;
use std::path::Path;

use anyhow::{Context, Result, ensure};
use clearway_client::{Layer, MapView, v1};
use clearway_daemon::config::Ros;
use clearway_daemon::viewer::frame::isometry;
use clearway_daemon::viewer::raster::Rasters;
use clearway_daemon::viewer::ros::ShownLayer;
use clearway_daemon::viewer::{FrameNames, base_frame, foxglove as messages, ros, safe_paths};
use clearway_mapping::event::EgoPose;
use clearway_ros::published::{ODOMETRY, PATH, POINT_CLOUD2, Published, TF_MESSAGE};
use foxglove::Encode;
use foxglove::messages::FrameTransforms;
use mcap::records::MessageHeader;
use prost::Message as _;
use serde::Deserialize;

use super::plans::plan_of;
use super::scans::{DecodedScan, ScanDecoder, ScanPoints};
use clearway_daemon::base::files;
use clearway_journal::mcap_file::CHUNK_NS;
use clearway_journal::mcap_reader::{Header, Message};

/// Kind of the messages in the file.
#[derive(Clone, Copy, PartialEq, Eq)]
pub enum Dialect {
    /// Foxglove's messages, encoded in protobuf.
    Foxglove,
    /// ROS 2 messages, encoded in CDR.
    Ros2,
}

/// An MCAP file for viewers that is being written.
pub struct ViewerFile {
    dialect: Dialect,
    writer: mcap::Writer<BufWriter<File>>,
    /// Log time of the first message of the chunk.
    chunk_ns: u64,
    /// The id of each topic's channel and the sequence number of its newest message, by topic.
    channels: HashMap<String, (u16, u32)>,
    /// The topic that has a name in ROS 2, by that name.
    ros_names: HashMap<String, String>,
    rasters: BTreeMap<String, Rasters>,
    /// The frames of each vehicle whose input has names for them.
    frames: BTreeMap<String, FrameNames>,
    /// Stamp of the newest map whose pose is written, by vehicle.
    placed: HashMap<String, i64>,
    /// Names of the vehicles whose recorded poses are written.
    with_poses: HashSet<String>,
    /// `None` before the first event.
    decoder: Option<ScanDecoder>,
    with_points: bool,
}

impl ViewerFile {
    /// Creates the file for the maps of a recording with this header.
    ///
    /// # Errors
    /// If the file exists or cannot be written.
    pub fn create(file: &Path, dialect: Dialect, with_points: bool, recording: &Header) -> Result<Self> {
        let open = files::create_new(file)?;
        let profile = if dialect == Dialect::Ros2 { "ros2" } else { "" };
        let options = mcap::WriteOptions::new().profile(profile).compression_threads(0);
        Ok(Self {
            dialect,
            writer: options.create(BufWriter::new(open))?,
            chunk_ns: 0,
            channels: HashMap::new(),
            ros_names: HashMap::new(),
            rasters: BTreeMap::new(),
            frames: frames_of(recording),
            placed: HashMap::new(),
            with_poses: HashSet::new(),
            decoder: None,
            with_points,
        })
    }

    /// Writes the plan of an event; with points, the points of the scan that it completes, or its pose; `header` is the
    /// recording's.
    ///
    /// # Errors
    /// If the event or the header is wrong, or the file cannot be written.
    pub fn write_event(&mut self, message: &Message, header: &Header) -> Result<()> {
        let Some(vehicle) = message.journal_of() else { return Ok(()) };
        if let Some(plan) = plan_of(message) {
            return self.write_plan(vehicle, &plan, message.log_ns);
        }
        if !self.with_points {
            return Ok(());
        }
        let mut decoder = match self.decoder.take() {
            Some(decoder) => decoder,
            None => ScanDecoder::new(header)?,
        };
        if let Some(scan) = decoder.decode(vehicle, &message.data)? {
            self.write_scan(vehicle, &scan, message.log_ns)?;
        }
        self.decoder = Some(decoder);
        if self.dialect == Dialect::Ros2 { self.write_recorded_pose(vehicle, message) } else { Ok(()) }
    }

    /// Writes a layer of a map, and the vehicle's pose if the map is new.
    ///
    /// # Errors
    /// If the file cannot be written.
    pub fn write_map(&mut self, map: &MapView, layer: &Layer, log_ns: u64) -> Result<()> {
        let (vehicle, name) = (map.vehicle(), &layer.name);
        let mut rasters = self.rasters.remove(vehicle).unwrap_or_default();
        let raster = rasters.of(layer);
        match self.dialect {
            Dialect::Foxglove => {
                let grid = messages::grid(map, layer, raster);
                self.write_foxglove(&format!("/{vehicle}/map/{name}"), &grid, log_ns)?;
                if name == safe_paths::LAYER {
                    let scene = messages::safe_paths(map, layer);
                    self.write_foxglove(&format!("/{vehicle}/safe_points"), &scene, log_ns)?;
                }
            }
            Dialect::Ros2 => {
                let frames = self.frames_of(vehicle);
                let shown = ShownLayer { map, layer, raster, frames: &frames, is_fresh: true };
                for topic in ros::topics_of(name) {
                    let Some(message) = (topic.write)(&shown) else { continue };
                    let name = format!("/clearway/{vehicle}/{name}{}", topic.ending);
                    self.write_ros((&name, topic.is_latched), &topic.kind, &message, log_ns)?;
                }
            }
        }
        self.rasters.insert(vehicle.to_owned(), rasters);
        // Each layer of a map is a message of its own, with the header of the map.
        let stamp_ns = map.header().capture_end_ns;
        let is_new = self.placed.insert(vehicle.to_owned(), stamp_ns) != Some(stamp_ns);
        if is_new { self.write_pose(map, log_ns) } else { Ok(()) }
    }

    /// Writes the end of the file.
    ///
    /// # Errors
    /// If the file cannot be written.
    pub fn finish(mut self) -> Result<()> {
        self.writer.finish()?;
        Ok(())
    }

    fn write_pose(&mut self, map: &MapView, log_ns: u64) -> Result<()> {
        match self.dialect {
            Dialect::Foxglove => match messages::transforms(map) {
                Some(transforms) => self.write_foxglove("/tf", &transforms, log_ns),
                None => Ok(()),
            },
            Dialect::Ros2 => {
                let pose = ros::pose_of(map).filter(|_| !self.with_poses.contains(map.vehicle()));
                pose.map_or(Ok(()), |pose| self.write_odometry(map.vehicle(), &pose, log_ns))
            }
        }
    }

    /// Writes the pose of an event, if it is one.
    fn write_recorded_pose(&mut self, vehicle: &str, message: &Message) -> Result<()> {
        let event = v1::Event::decode(&*message.data).with_context(|| format!("journal of {vehicle}"))?;
        let Some(v1::event::Body::EgoPose(pose)) = event.body else { return Ok(()) };
        let Some(map_from_ego) = pose.map_from_ego.as_ref().map(isometry) else { return Ok(()) };
        let pose = EgoPose { stamp_ns: pose.stamp_ns, map_from_ego, speed_mps: pose.speed_mps };
        self.with_poses.insert(vehicle.to_owned());
        self.write_odometry(vehicle, &pose, message.log_ns)
    }

    fn write_plan(&mut self, vehicle: &str, plan: &v1::Plan, log_ns: u64) -> Result<()> {
        match self.dialect {
            Dialect::Foxglove => {
                self.write_foxglove(&format!("/{vehicle}/plan"), &messages::plan(vehicle, plan), log_ns)
            }
            Dialect::Ros2 => {
                let path = ros::path_of(&self.frames_of(vehicle), plan);
                self.write_ros((&format!("/clearway/{vehicle}/plan"), false), &PATH, &path, log_ns)
            }
        }
    }

    fn write_odometry(&mut self, vehicle: &str, pose: &EgoPose, log_ns: u64) -> Result<()> {
        let frames = self.frames_of(vehicle);
        self.write_ros(("/tf", false), &TF_MESSAGE, &ros::tf_of(&frames, pose), log_ns)?;
        let (topic, odometry) = (format!("/clearway/{vehicle}/odometry"), ros::odometry_of(&frames, pose));
        self.write_ros((&topic, false), &ODOMETRY, &odometry, log_ns)
    }

    fn frames_of(&self, vehicle: &str) -> FrameNames {
        self.frames.get(vehicle).cloned().unwrap_or_else(|| FrameNames::new(vehicle, None))
    }

    fn write_scan(&mut self, vehicle: &str, scan: &DecodedScan, log_ns: u64) -> Result<()> {
        let frame = format!("{vehicle}/{}", scan.sensor);
        let (stamp_ns, mount) = (scan.stamp_ns, scan.ego_from_sensor);
        match self.dialect {
            Dialect::Foxglove => {
                let mount = messages::transform(stamp_ns, &base_frame(vehicle), &frame, mount);
                self.write_foxglove("/tf", &FrameTransforms { transforms: vec![mount] }, log_ns)?;
                let cloud = messages::points(stamp_ns, &frame, scan.points.at.iter().copied());
                self.write_foxglove(&format!("/{vehicle}/points/{}", scan.sensor), &cloud, log_ns)
            }
            Dialect::Ros2 => {
                let mount = ros::transform(stamp_ns, &self.frames_of(vehicle).ego, &frame, mount);
                self.write_ros(("/tf", false), &TF_MESSAGE, &mount, log_ns)?;
                let ScanPoints { at, ring, offset_ns } = &scan.points;
                let cloud = ros::points(stamp_ns, &frame, at, ring, offset_ns);
                let topic = format!("/clearway/{vehicle}/points/{}", scan.sensor);
                self.write_ros((&topic, false), &POINT_CLOUD2, &cloud, log_ns)
            }
        }
    }

    fn write_foxglove<T: Encode>(&mut self, topic: &str, message: &T, log_ns: u64) -> Result<()> {
        let mut bytes = Vec::new();
        message.encode(&mut bytes).map_err(|error| anyhow::anyhow!("encode for {topic}: {error}"))?;
        let schema = T::get_schema().context("a Foxglove message has a schema")?;
        let schema = (schema.name.as_str(), schema.encoding.as_str(), &*schema.data);
        self.write((topic, BTreeMap::new()), schema, &T::get_message_encoding(), log_ns, &bytes)
    }

    /// Writes a message of a topic, which is latched or not, under its name in ROS 2 ([`ros_name`]).
    fn write_ros(
        &mut self,
        (topic, is_latched): (&str, bool),
        kind: &Published,
        message: &[u8],
        log_ns: u64,
    ) -> Result<()> {
        let (name, metadata) = (ros_name(topic), ros_metadata(is_latched));
        let first = self.ros_names.entry(name.clone()).or_insert_with(|| topic.to_owned());
        ensure!(first == topic, "{topic} and {first} have one name in ROS 2, {name}: rename a vehicle or sensor");
        self.write((&name, metadata), (&kind.name(), "ros2msg", kind.definition.as_bytes()), "cdr", log_ns, message)
    }

    fn write(
        &mut self,
        (topic, metadata): (&str, BTreeMap<String, String>),
        (schema, schema_encoding, definition): (&str, &str, &[u8]),
        encoding: &str,
        log_time: u64,
        message: &[u8],
    ) -> Result<()> {
        let (channel_id, sequence) = match self.channels.get_mut(topic) {
            Some((channel, sequence)) => {
                *sequence = sequence.wrapping_add(1);
                (*channel, *sequence)
            }
            None => {
                let schema = self.writer.add_schema(schema, schema_encoding, definition)?;
                let channel = self.writer.add_channel(schema, topic, encoding, &metadata)?;
                self.channels.insert(topic.to_owned(), (channel, 0));
                (channel, 0)
            }
        };
        if log_time.abs_diff(self.chunk_ns) >= CHUNK_NS {
            self.writer.flush()?;
            self.chunk_ns = log_time;
        }
        let header = MessageHeader { channel_id, sequence, log_time, publish_time: log_time };
        self.writer.write_to_known_channel(&header, message)?;
        Ok(())
    }
}

/// The part of the recorded configuration that names frames.
#[derive(Deserialize)]
struct RecordedFrames {
    name: String,
    ros: Option<Ros>,
}

/// The frames of the vehicles in a recording's configuration, by vehicle.
fn frames_of(recording: &Header) -> BTreeMap<String, FrameNames> {
    let table = recording.config.as_deref().and_then(|text| text.parse::<toml::Table>().ok()).unwrap_or_default();
    let vehicles = table.get("vehicle").cloned().and_then(|vehicles| vehicles.try_into::<Vec<RecordedFrames>>().ok());
    let named = |RecordedFrames { name, ros }| (FrameNames::new(&name, ros.as_ref()), name);
    vehicles.into_iter().flatten().map(named).map(|(frames, name)| (name, frames)).collect()
}

/// A topic with parts that ROS 2 allows: `_` for what is neither a letter nor a digit, and before a digit at the start.
/// Source: `rmw_validate_full_topic_name` in `rmw/validate_full_topic_name.h`.
fn ros_name(topic: &str) -> String {
    let mut name = String::new();
    for c in topic.chars() {
        if c.is_ascii_digit() && name.ends_with('/') {
            name.push('_');
        }
        name.push(if c == '/' || c.is_ascii_alphanumeric() { c } else { '_' });
    }
    name
}

/// What rosbag2 offers a topic with when it plays the file, as the live topics are offered: reliable, and of maps the
/// newest one for subscribers that come later. The numbers come from `rmw/types.h`, which each version reads.
fn ros_metadata(is_latched: bool) -> BTreeMap<String, String> {
    let (depth, durability) = if is_latched { (1, 1) } else { (100, 2) };
    let unlimited = "{sec: 0, nsec: 0}";
    let profile = format!(
        "- {{history: 1, depth: {depth}, reliability: 1, durability: {durability}, deadline: {unlimited}, lifespan: \
         {unlimited}, liveliness: 1, liveliness_lease_duration: {unlimited}, avoid_ros_namespace_conventions: false}}"
    );
    BTreeMap::from([("offered_qos_profiles".to_owned(), profile)])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_topic_has_a_name_that_ros_2_allows() {
        let named = ["/clearway/my-car/points/front-left", "/clearway/7up/plan", "/tf"].map(ros_name);
        assert_eq!(named, ["/clearway/my_car/points/front_left", "/clearway/_7up/plan", "/tf"]);
    }
}
