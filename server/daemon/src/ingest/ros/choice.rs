//! Chooses the topics of an MCAP file to decode: the requested topics, or the sensors and the best poses in the file.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use clearway_ros::frames::name;
use clearway_ros::pose::{Odometry, tf_message};
use clearway_ros::velodyne_scan::VelodyneScan;
use clearway_ros::{Frames, Kind, PointCloud2};
use nalgebra::Isometry3;

use super::decoder::{PoseSource, TopicDecoder};
use clearway_journal::reader::{RecordedMessage, RecordingError, RecordingReader};

/// Duration of the start of a file from which its topics are known, in ns. Ours: latched transforms come first, all
/// other messages come often.
const START_NS: i64 = 10_000_000_000;
/// The vehicle's frame: the first of these in the tf tree. REP-120 puts `base_footprint` on the ground.
const EGO_FRAMES: [&str; 2] = ["base_footprint", "base_link"];
/// Plausible heights of a sensor above the ground, in metres. A transform with another height belongs to an ego frame
/// that is not on the ground.
const HEIGHTS_M: std::ops::RangeInclusive<f64> = 0.1..=20.0;
/// Fixed frames, the preferred one first (REP-105).
const FIXED_FRAMES: [&str; 2] = ["map", "odom"];

/// Topics cannot be chosen.
#[derive(Debug, thiserror::Error)]
pub enum ChoiceError {
    /// The file cannot be read.
    #[error(transparent)]
    Recording(#[from] RecordingError),
    /// The file does not have a requested topic.
    #[error("{}: --topic {topic}: the file has, in its first 10 s: {known}", file.display())]
    Topic {
        /// The file.
        file: PathBuf,
        /// The requested topic.
        topic: String,
        /// The topics of the file, with their types.
        known: String,
    },
}

/// The topics of an MCAP file that can be decoded.
#[derive(Clone, Debug, Default)]
pub struct AvailableTopics {
    topics: BTreeMap<String, Topic>,
    /// The newest transforms of all frames.
    frames: Frames,
    /// The static transforms.
    latched: Frames,
}

#[derive(Clone, Debug)]
struct Topic {
    kind: Kind,
    /// Frame of a sensor's points, or child frame of an odometry; of the first readable message.
    frame_id: Option<String>,
    points: u64,
    /// Index of the topic in the order of their first messages.
    order: usize,
}

/// The topic of a sensor.
#[derive(Clone, Debug, PartialEq)]
pub struct SensorTopic {
    /// The topic.
    pub topic: String,
    /// The frame of its messages.
    pub frame_id: String,
    /// The sensor's pose on the vehicle, from tf; `None` if no chain of transforms gives it, or if its height is
    /// implausible.
    pub ego_from_sensor: Option<Isometry3<f64>>,
}

/// The chosen topics.
#[derive(Clone, Debug)]
pub struct TopicChoice {
    /// The topics of the sensors, by index of the sensor.
    pub sensors: Vec<SensorTopic>,
    /// The source of the ego poses.
    pub pose: Option<PoseSource>,
    /// The vehicle's frame.
    pub ego_frame: String,
    /// A description of the choice, for people.
    pub notes: Vec<String>,
    latched: Frames,
}

impl AvailableTopics {
    /// Reads the topics from the first 10 s of a file.
    ///
    /// # Errors
    /// [`RecordingError`] if the file cannot be read or is damaged there.
    pub fn from_file(file: &Path) -> Result<Self, RecordingError> {
        let mut available = Self::default();
        let mut first_ns = None;
        for message in RecordingReader::open(file)? {
            let RecordedMessage::Ros { topic, kind, log_ns, bytes } = message? else { continue };
            if log_ns.saturating_sub(*first_ns.get_or_insert(log_ns)) > START_NS {
                break;
            }
            available.insert(topic, kind, &bytes);
        }
        Ok(available)
    }

    fn insert(&mut self, topic: String, kind: Kind, bytes: &[u8]) {
        let (order, are_static) = (self.topics.len(), topic.ends_with("tf_static"));
        let found = self.topics.entry(topic).or_insert(Topic { kind, frame_id: None, points: 0, order });
        // An unreadable message is counted and reported when it is decoded.
        match kind {
            Kind::TfMessage => {
                for transform in tf_message(bytes).unwrap_or_default() {
                    self.frames.insert(&transform);
                    if are_static {
                        self.latched.insert(&transform);
                    }
                }
            }
            _ if found.frame_id.is_some() => {}
            Kind::PointCloud2 => {
                if let Ok(cloud) = PointCloud2::new(bytes) {
                    found.frame_id = Some(name(cloud.header.frame_id).to_owned());
                    found.points = u64::from(cloud.width) * u64::from(cloud.height);
                }
            }
            Kind::VelodyneScan => {
                found.frame_id = VelodyneScan::new(bytes).ok().map(|scan| name(scan.header.frame_id).to_owned());
            }
            Kind::Odometry => {
                found.frame_id = Odometry::new(bytes).ok().map(|o| name(o.transform.child_frame_id).to_owned());
            }
            Kind::PoseStamped => {}
        }
    }

    /// Chooses the topics to decode: of the `requested` topics all sensors, in this order, and the first with poses. If
    /// no requested topic is a sensor, or none has poses, the choice is made here. Sensors: one topic a frame, packets
    /// before points, then the cloud with the most points; a cloud in the vehicle's frame or in a fixed frame is left
    /// out, because another program has merged it. Poses: an odometry, else the tf chain from `map`, else from `odom`,
    /// else stamped poses.
    ///
    /// # Errors
    /// [`ChoiceError::Topic`] if the file does not have a requested topic.
    pub fn choose(&self, file: &Path, requested: &[String], sensors_max: usize) -> Result<TopicChoice, ChoiceError> {
        for topic in requested {
            if !self.topics.contains_key(topic) {
                let known = self.topics.iter().map(|(topic, of)| format!("{topic} ({})", of.kind));
                let known = known.collect::<Vec<_>>().join(", ");
                return Err(ChoiceError::Topic { file: file.to_owned(), topic: topic.clone(), known });
            }
        }
        let kind = |topic: &String| self.topics[topic].kind;
        let ego_frame = EGO_FRAMES.into_iter().find(|frame| self.frames.contains(frame)).unwrap_or("base_link");
        let mut sensors: Vec<&String> = requested.iter().filter(|topic| kind(topic).is_sensor()).collect();
        if sensors.is_empty() {
            sensors = self.best_sensors(ego_frame);
        }
        sensors.truncate(sensors_max);
        let pose = requested.iter().find(|topic| matches!(kind(topic), Kind::Odometry | Kind::PoseStamped));
        let pose = pose.map(|topic| PoseSource::Topic(topic.clone())).or_else(|| self.best_pose(ego_frame));
        let sensor_topic = |topic: &&String| {
            let frame_id = self.topics[*topic].frame_id.clone().unwrap_or_default();
            let ego_from_sensor = self.frames.a_from_b(ego_frame, &frame_id);
            let ego_from_sensor = ego_from_sensor.filter(|pose| HEIGHTS_M.contains(&pose.translation.z));
            SensorTopic { topic: (*topic).clone(), frame_id, ego_from_sensor }
        };
        let is_requested = requested.iter().any(|topic| kind(topic).is_sensor());
        let mut sensors: Vec<SensorTopic> = sensors.iter().map(sensor_topic).collect();
        if !is_requested && sensors.iter().all(|sensor| sensor.ego_from_sensor.is_none()) {
            // A replay can use one sensor that is not placed: the one that shows most, whichever sent first.
            let shown = |sensor: &SensorTopic| {
                let found = &self.topics[&sensor.topic];
                (found.kind == Kind::VelodyneScan, found.points)
            };
            sensors.sort_by_key(|sensor| std::cmp::Reverse(shown(sensor)));
        }
        let notes = self.describe(&sensors, pose.as_ref(), ego_frame);
        Ok(TopicChoice { sensors, pose, ego_frame: ego_frame.to_owned(), notes, latched: self.latched.clone() })
    }

    fn best_sensors(&self, ego_frame: &str) -> Vec<&String> {
        let is_merged =
            |frame: &str| frame == ego_frame || EGO_FRAMES.contains(&frame) || FIXED_FRAMES.contains(&frame);
        let mut best: BTreeMap<&str, (&String, &Topic)> = BTreeMap::new();
        for (topic, found) in self.topics.iter().filter(|(_, found)| found.kind.is_sensor()) {
            let frame = found.frame_id.as_deref().unwrap_or_default();
            if is_merged(frame) {
                continue;
            }
            let rank = |of: &Topic| (of.kind == Kind::VelodyneScan, of.points, usize::MAX - of.order);
            let best_of_frame = best.entry(frame).or_insert((topic, found));
            if rank(found) > rank(best_of_frame.1) {
                *best_of_frame = (topic, found);
            }
        }
        let mut best: Vec<_> = best.into_values().collect();
        best.sort_by_key(|(_, found)| found.order);
        best.into_iter().map(|(topic, _)| topic).collect()
    }

    fn best_pose(&self, ego_frame: &str) -> Option<PoseSource> {
        let first = |kind: Kind, fits: &dyn Fn(&Topic) -> bool| {
            let of_kind = self.topics.iter().filter(|(_, found)| found.kind == kind && fits(found));
            of_kind.min_by_key(|(_, found)| found.order).map(|(topic, _)| PoseSource::Topic(topic.clone()))
        };
        let is_joined = |found: &Topic| {
            found.frame_id.as_deref().is_some_and(|frame| self.frames.a_from_b(frame, ego_frame).is_some())
        };
        let mut fixed = FIXED_FRAMES.into_iter().filter(|fixed| self.frames.a_from_b(fixed, ego_frame).is_some());
        first(Kind::Odometry, &is_joined)
            .or_else(|| fixed.next().map(|fixed| PoseSource::Frames { fixed: fixed.to_owned() }))
            .or_else(|| first(Kind::PoseStamped, &|_| true))
    }

    fn describe(&self, sensors: &[SensorTopic], pose: Option<&PoseSource>, ego_frame: &str) -> Vec<String> {
        let mut notes = Vec::new();
        let mut used: BTreeSet<&str> = BTreeSet::new();
        for SensorTopic { topic, frame_id, ego_from_sensor } in sensors {
            used.insert(topic);
            notes.push(match ego_from_sensor {
                Some(_) => format!("{topic} is used; tf places its frame {frame_id}"),
                None => format!("{topic} is used; tf does not place its frame {frame_id} 0.1 to 20 m over {ego_frame}"),
            });
        }
        match pose {
            Some(PoseSource::Topic(topic)) => {
                used.insert(topic);
                notes.push(format!("{topic} is used for poses of {ego_frame}"));
            }
            Some(PoseSource::Frames { fixed }) => {
                notes.push(format!("tf is used for poses of {ego_frame} in {fixed}"));
            }
            None if sensors.is_empty() => {}
            None => notes.push("the file has no poses".into()),
        }
        let unused =
            |(topic, found): &(&String, &Topic)| !used.contains(topic.as_str()) && found.kind != Kind::TfMessage;
        let unused = self.topics.iter().filter(unused);
        notes.extend(unused.map(|(topic, found)| format!("{topic} ({}) is not used", found.kind)));
        notes
    }
}

impl TopicChoice {
    /// The decoder of the chosen topics. It has the static transforms from the start, so that they also apply to
    /// earlier messages.
    pub fn decoder(&self) -> TopicDecoder {
        let sensors = self.sensors.iter().zip(0..).map(|(sensor, index)| (sensor.topic.clone(), index)).collect();
        TopicDecoder::new(sensors, self.pose.clone(), &self.ego_frame, self.latched.clone())
    }
}
