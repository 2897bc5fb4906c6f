//! The topics, frames and refused transforms of a bag, from the start of its files and of each topic.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use clearway_journal::reader::{RecordedMessage, RecordingError, RecordingReader};
use clearway_ros::cdr::Reader;
use clearway_ros::frames::{local_name, name};
use clearway_ros::pose::{Odometry, TfMessage, pose_stamped, tf_message};
use clearway_ros::velodyne_scan::VelodyneScan;
use clearway_ros::{Frames, Kind, MessageError, PointCloud2};
use nalgebra::Isometry3;

/// The vehicle's frame: the first of these in the tf tree, with or without a namespace. REP-120 puts `base_footprint`
/// on the ground.
pub(super) const EGO_FRAMES: [&str; 2] = ["base_footprint", "base_link"];

/// Greatest distance of a scan from a pose that gives the scan a pose, in ns; as the core extrapolates.
pub const NEAR_NS: i64 = 200_000_000;

/// Greatest difference of two static transforms that state one mount, in metres and radians. Ours: they are written
/// with that many digits.
const SAME_MOUNT: f64 = 1e-3;

/// Duration of the start of a bag that is read in any case, in ns. Ours: within it each topic that is there from the
/// start has shown what it is.
const START_NS: i64 = 10_000_000_000;

/// The topics of a bag that can be decoded.
#[derive(Clone, Debug, Default)]
pub struct AvailableTopics {
    /// The first file of the bag.
    pub(super) file: PathBuf,
    pub(super) topics: BTreeMap<String, Topic>,
    /// The newest transforms of all frames.
    pub(super) frames: Frames,
    /// The static transforms (`/tf_static`).
    pub(super) latched: Frames,
    /// Stamps of the other transforms, by child frame.
    moving: BTreeMap<String, Stamps>,
    /// Faults of refused transforms of frames that no other transform places, by child frame; empty for messages of
    /// static transforms that cannot be read at all.
    refused_mounts: BTreeMap<String, String>,
    /// Child frames of static transforms that contradict each other.
    pub(super) contradicted: BTreeSet<String>,
}

#[derive(Clone, Debug)]
pub(super) struct Topic {
    pub kind: Kind,
    /// Frame of a sensor's points, or child frame of an odometry; of the first readable message.
    pub frame_id: Option<String>,
    /// Frame of the poses; of the first readable message.
    pub fixed_frame: Option<String>,
    /// Stamps of the first messages.
    pub stamps: Stamps,
    /// Most points of a message.
    pub points: u64,
    /// Index of the topic in the order of their first messages.
    pub order: usize,
    /// Number of messages that cannot be read, and the fault of the first.
    pub refused: Option<(u64, String)>,
}

impl AvailableTopics {
    /// Reads the topics of the files of a bag: its first 10 s, then of each file as much as is needed until each topic
    /// that has messages there has shown one, tf places a sensor, and poses are found. A file that does not say which
    /// topics it has is read whole.
    ///
    /// # Errors
    /// [`RecordingError`] if the first file cannot be read or is damaged there. A fault of a later file is told when
    /// the replay reads that file.
    pub fn from_files(files: &[PathBuf]) -> Result<Self, RecordingError> {
        let mut available = Self { file: files.first().cloned().unwrap_or_default(), ..Self::default() };
        for (index, file) in files.iter().enumerate() {
            match available.read_file(file, index == 0) {
                Err(error) if index == 0 => return Err(error),
                Ok(()) | Err(_) => {}
            }
        }
        Ok(available)
    }

    fn read_file(&mut self, file: &Path, is_first: bool) -> Result<(), RecordingError> {
        let mut recording = RecordingReader::open(file)?;
        let announced = recording.announced_topics()?;
        let is_known = announced.is_some();
        let mut awaited = announced.unwrap_or_default();
        awaited.retain(|topic| !self.topics.contains_key(topic));
        let (mut is_start, mut first_ns) = (is_first, None);
        for message in recording {
            if !is_start && is_known && awaited.is_empty() && self.is_placed() && self.is_posed() {
                break;
            }
            let RecordedMessage::Ros { topic, kind, log_ns, bytes } = message? else { continue };
            is_start &= log_ns.saturating_sub(*first_ns.get_or_insert(log_ns)) <= START_NS;
            awaited.remove(&topic);
            self.insert(topic, kind, &bytes);
        }
        Ok(())
    }

    /// True if tf joins the frame of a sensor to another frame, or there is no tf.
    fn is_placed(&self) -> bool {
        let names = self.frames.names();
        let is_joined = |found: &Topic| found.frame_id.as_deref().is_some_and(|frame| names.contains(frame));
        let has_tf = self.topics.values().any(|found| found.kind == Kind::TfMessage);
        !has_tf || self.topics.values().any(|found| found.kind.is_sensor() && is_joined(found))
    }

    /// True if the vehicle's poses are found, or nothing moves.
    fn is_posed(&self) -> bool {
        let is_pose = |found: &Topic| matches!(found.kind, Kind::Odometry | Kind::PoseStamped);
        let moves = !self.moving.is_empty() || self.topics.values().any(is_pose);
        !moves || self.best_pose(&self.best_sensors(), &self.ego_frame()).is_some()
    }

    fn insert(&mut self, topic: String, kind: Kind, bytes: &[u8]) {
        let (order, are_static) = (self.topics.len(), topic.ends_with("tf_static"));
        let (frame_id, fixed_frame, stamps) = Default::default();
        let new = Topic { kind, frame_id, fixed_frame, stamps, points: 0, order, refused: None };
        let found = self.topics.entry(topic).or_insert_with(|| new.clone());
        // The messages of the other type are refused.
        if kind.is_sensor() && !found.kind.is_sensor() {
            *found = new;
        }
        let read = match kind {
            Kind::TfMessage => match tf_message(bytes) {
                Ok(message) => return self.insert_transforms(message, are_static),
                Err(fault) => {
                    if are_static {
                        self.refused_mounts.insert(String::new(), fault.to_string());
                    }
                    Err(fault)
                }
            },
            Kind::PointCloud2 => found.read_cloud(bytes),
            Kind::VelodyneScan => VelodyneScan::new(bytes).map(|scan| {
                scan.packets().flatten().take(1).for_each(|(stamp_ns, _)| found.stamps.note(stamp_ns));
                found.frame_id.get_or_insert_with(|| name(scan.frame_id).to_owned());
            }),
            Kind::Odometry => Odometry::new(bytes).map(|Odometry { transform, .. }| {
                found.stamps.note(transform.header.stamp_ns);
                found.frame_id.get_or_insert_with(|| name(transform.child_frame_id).to_owned());
                found.fixed_frame.get_or_insert_with(|| name(transform.header.frame_id).to_owned());
            }),
            Kind::PoseStamped => pose_stamped(bytes).map(|pose| {
                found.stamps.note(pose.header.stamp_ns);
                found.fixed_frame.get_or_insert_with(|| name(pose.header.frame_id).to_owned());
            }),
        };
        if let Err(fault) = read {
            found.refused.get_or_insert_with(|| (0, fault.to_string())).0 += 1;
        }
    }

    fn insert_transforms(&mut self, message: TfMessage, are_static: bool) {
        for transform in &message.transforms {
            self.frames.insert(transform);
            if are_static {
                let (parent, child) = (transform.header.frame_id, transform.child_frame_id);
                let before = self.latched.a_from_b(parent, child);
                let is_same = |before: Isometry3<f64>| {
                    let change = before.inverse() * transform.parent_from_child;
                    change.translation.vector.norm() < SAME_MOUNT && change.rotation.angle() < SAME_MOUNT
                };
                if self.latched.has_parent(child) && !before.is_some_and(is_same) {
                    self.contradicted.insert(name(child).to_owned());
                }
                self.latched.insert(transform);
            } else {
                self.moving
                    .entry(name(transform.child_frame_id).to_owned())
                    .or_default()
                    .note(transform.header.stamp_ns);
            }
            self.refused_mounts.remove(name(transform.child_frame_id));
        }
        for transform in &message.refused {
            let child = name(transform.child_frame_id);
            // The vehicle's frame is placed by its poses, which state no mount.
            if !self.frames.has_parent(child) && (are_static || !is_ego(child)) {
                self.refused_mounts.insert(child.to_owned(), transform.fault.to_string());
            }
        }
    }

    /// The stamps of the poses that tf has of a frame: of the nearest frame up from it that moves.
    pub(super) fn stamps_above(&self, frame: &str) -> Option<&Stamps> {
        let moving =
            self.moving.iter().filter_map(|(child, stamps)| Some((self.frames.steps_up(frame, child)?, stamps)));
        moving.min_by_key(|(steps, _)| *steps).map(|(_, stamps)| stamps)
    }

    /// Why a static transform that may place this frame was refused.
    pub(super) fn refused_mount(&self, frame: &str) -> Option<String> {
        let of_frame = |(child, _): &(&String, &String)| {
            child.is_empty() || self.frames.steps_up(frame, child).is_some() || child.as_str() == frame
        };
        self.refused_mounts.iter().find(of_frame).map(|(_, fault)| fault.clone())
    }
}

/// True for a frame of the vehicle, with or without a namespace.
pub(super) fn is_ego(frame: &str) -> bool {
    EGO_FRAMES.contains(&local_name(frame))
}

/// The stamps of the first messages of a topic.
#[derive(Clone, Debug, Default)]
pub(super) struct Stamps {
    /// The least and the greatest; `None` without messages.
    range_ns: Option<(i64, i64)>,
    count: u64,
}

impl Stamps {
    fn note(&mut self, stamp_ns: i64) {
        let (least_ns, greatest_ns) = self.range_ns.unwrap_or((stamp_ns, stamp_ns));
        self.range_ns = Some((least_ns.min(stamp_ns), greatest_ns.max(stamp_ns)));
        self.count += 1;
    }

    /// The stamp, if several messages have it and none has another.
    pub fn still_ns(&self) -> Option<i64> {
        self.range_ns.filter(|(least_ns, greatest_ns)| self.count > 1 && least_ns == greatest_ns).map(|(ns, _)| ns)
    }

    /// How far the stamps are ahead of others, ns; 0 if some are near, `None` if one has no stamps.
    pub fn ahead_ns(&self, of: &Self) -> Option<i64> {
        let ((least_ns, greatest_ns), (of_least_ns, of_greatest_ns)) = self.range_ns.zip(of.range_ns)?;
        let gap_ns = least_ns.saturating_sub(of_greatest_ns).max(of_least_ns.saturating_sub(greatest_ns));
        Some(if gap_ns > NEAR_NS { least_ns.saturating_sub(of_least_ns) } else { 0 })
    }
}

impl Topic {
    /// The frame is known even if the points cannot be read.
    fn read_cloud(&mut self, bytes: &[u8]) -> Result<(), MessageError> {
        let header = Reader::new(bytes)?.header()?;
        self.stamps.note(header.stamp_ns);
        if self.frame_id.is_none() {
            self.frame_id = Some(name(header.frame_id).to_owned());
        }
        let cloud = PointCloud2::new(bytes)?;
        self.points = self.points.max(u64::from(cloud.width) * u64::from(cloud.height));
        Ok(())
    }
}
