//! The topics, frames and refused transforms of an MCAP file, from its start.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use clearway_ros::cdr::Reader;
use clearway_ros::frames::{local_name, name};
use clearway_ros::pose::{Odometry, TfMessage, tf_message};
use clearway_ros::velodyne_scan::VelodyneScan;
use clearway_ros::{Frames, Kind, MessageError, PointCloud2};

use clearway_journal::reader::{RecordedMessage, RecordingError, RecordingReader};

/// The vehicle's frame: the first of these in the tf tree, with or without a namespace. REP-120 puts `base_footprint`
/// on the ground.
pub(super) const EGO_FRAMES: [&str; 2] = ["base_footprint", "base_link"];

/// Duration of the start of a file from which its topics are known if tf places a sensor there, in ns. Ours: latched
/// transforms come first, all other messages come often.
const START_NS: i64 = 10_000_000_000;

/// The topics of an MCAP file that can be decoded.
#[derive(Clone, Debug, Default)]
pub struct AvailableTopics {
    pub(super) file: PathBuf,
    pub(super) topics: BTreeMap<String, Topic>,
    /// The newest transforms of all frames.
    pub(super) frames: Frames,
    /// The static transforms.
    pub(super) latched: Frames,
    /// Faults of refused transforms of frames that no other transform places, by child frame; empty for messages of
    /// static transforms that cannot be read at all.
    refused_mounts: BTreeMap<String, String>,
}

#[derive(Clone, Debug)]
pub(super) struct Topic {
    pub kind: Kind,
    /// Frame of a sensor's points, or child frame of an odometry; of the first readable message.
    pub frame_id: Option<String>,
    /// Stamps of the first clouds.
    pub stamps: Stamps,
    /// Most points of a message.
    pub points: u64,
    /// Index of the topic in the order of their first messages.
    pub order: usize,
    /// Number of messages that cannot be read, and the fault of the first.
    pub refused: Option<(u64, String)>,
}

impl AvailableTopics {
    /// Reads the topics from the first 10 s of a file; from all of it if tf places no sensor there.
    ///
    /// # Errors
    /// [`RecordingError`] if the file cannot be read or is damaged there.
    pub fn from_file(file: &Path) -> Result<Self, RecordingError> {
        let mut available = Self { file: file.to_owned(), ..Self::default() };
        let mut first_ns = None;
        for message in RecordingReader::open(file)? {
            let RecordedMessage::Ros { topic, kind, log_ns, bytes } = message? else { continue };
            let is_start = log_ns.saturating_sub(*first_ns.get_or_insert(log_ns)) <= START_NS;
            if !is_start && available.has_placed_sensor() {
                break;
            }
            available.insert(topic, kind, &bytes);
        }
        Ok(available)
    }

    /// True if tf joins the frame of a sensor to another frame.
    fn has_placed_sensor(&self) -> bool {
        let mut sensors = self.topics.values().filter(|found| found.kind.is_sensor());
        let names = self.frames.names();
        sensors.any(|found| found.frame_id.as_deref().is_some_and(|frame| names.contains(frame)))
    }

    fn insert(&mut self, topic: String, kind: Kind, bytes: &[u8]) {
        let (order, are_static) = (self.topics.len(), topic.ends_with("tf_static"));
        let new = Topic { kind, frame_id: None, stamps: Stamps::default(), points: 0, order, refused: None };
        let found = self.topics.entry(topic).or_insert(new);
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
            _ if found.frame_id.is_some() => Ok(()),
            Kind::VelodyneScan => {
                VelodyneScan::new(bytes).map(|scan| found.frame_id = Some(name(scan.frame_id).to_owned()))
            }
            Kind::Odometry => {
                let child = |odometry: Odometry| name(odometry.transform.child_frame_id).to_owned();
                Odometry::new(bytes).map(|odometry| found.frame_id = Some(child(odometry)))
            }
            Kind::PoseStamped => Ok(()),
        };
        if let Err(fault) = read {
            found.refused.get_or_insert_with(|| (0, fault.to_string())).0 += 1;
        }
    }

    fn insert_transforms(&mut self, message: TfMessage, are_static: bool) {
        for transform in &message.transforms {
            self.frames.insert(transform);
            if are_static {
                self.latched.insert(transform);
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

/// The header stamps of the first clouds of a topic.
#[derive(Clone, Debug, Default)]
pub(super) struct Stamps {
    pub first_ns: Option<i64>,
    count: u64,
    differ: bool,
}

impl Stamps {
    fn note(&mut self, stamp_ns: i64) {
        self.count += 1;
        self.differ |= *self.first_ns.get_or_insert(stamp_ns) != stamp_ns;
    }

    /// True if several clouds have one stamp.
    pub fn stand_still(&self) -> bool {
        self.count > 1 && !self.differ
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
