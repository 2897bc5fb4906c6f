//! Which topics of an MCAP file are taken: those asked for, else the sensors it has and the best poses it has.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use clearway_ros::frames::name;
use clearway_ros::pose::{Odometry, tf_message};
use clearway_ros::velodyne_scan::VelodyneScan;
use clearway_ros::{Frames, Kind, PointCloud2};
use nalgebra::Isometry3;

use super::{Intake, PoseFrom};
use crate::record::reader::{RecordedMessage, RecordingError, RecordingReader};

/// How much of a file is looked at before its topics are chosen: latched transforms come first, everything else often.
const LOOK_NS: i64 = 10_000_000_000;
/// The vehicle's own frame, the first of these that tf knows; REP-105 puts `base_footprint` on the ground (REP-120).
const EGO_FRAMES: [&str; 2] = ["base_footprint", "base_link"];
/// Heights over the ground that a sensor may be mounted at; tf's of another was told in a frame that is not on the
/// ground.
const HEIGHTS_M: std::ops::RangeInclusive<f64> = 0.1..=20.0;
/// Frames that do not move, best first (REP-105).
const FIXED_FRAMES: [&str; 2] = ["map", "odom"];

/// Why topics cannot be chosen.
#[derive(Debug, thiserror::Error)]
pub enum ChoiceError {
    /// The file cannot be read.
    #[error(transparent)]
    Recording(#[from] RecordingError),
    /// A topic that was asked for is not there.
    #[error("{}: --topic {topic}: the file has, in its first 10 s: {known}", file.display())]
    Topic {
        /// The file.
        file: PathBuf,
        /// As it was asked for.
        topic: String,
        /// What could be taken.
        known: String,
    },
}

/// What an MCAP file has to offer.
#[derive(Clone, Debug, Default)]
pub struct Offered {
    topics: BTreeMap<String, Offer>,
    /// All frames, as they lay last.
    frames: Frames,
    /// Those that do not move.
    latched: Frames,
}

#[derive(Clone, Debug)]
struct Offer {
    kind: Kind,
    /// Frame of a sensor's points, or the one an odometry places; of the first message that could be read.
    frame_id: Option<String>,
    points: u64,
    /// Its place among the topics, by first message.
    order: usize,
}

/// A sensor's topic.
#[derive(Clone, Debug, PartialEq)]
pub struct SensorTopic {
    /// The topic.
    pub topic: String,
    /// The frame of what it brings.
    pub frame_id: String,
    /// Where tf puts that frame on the vehicle; `None` where no chain of transforms tells, or tells no possible height.
    pub ego_from_sensor: Option<Isometry3<f64>>,
}

/// What is taken.
#[derive(Clone, Debug)]
pub struct Choice {
    /// By index of the sensor.
    pub sensors: Vec<SensorTopic>,
    /// Where ego poses come from.
    pub pose: Option<PoseFrom>,
    /// The vehicle's own frame.
    pub ego_frame: String,
    /// What was taken and what was left, for people.
    pub notes: Vec<String>,
    latched: Frames,
}

impl Offered {
    /// Looks at the first 10 s of a file.
    ///
    /// # Errors
    /// [`RecordingError`] where it cannot be read.
    pub fn look(file: &Path) -> Result<Self, RecordingError> {
        let mut offered = Self::default();
        let mut first_ns = None;
        for entry in RecordingReader::open(file)? {
            let RecordedMessage::Ros { topic, kind, log_ns, bytes } = entry? else { continue };
            if log_ns.saturating_sub(*first_ns.get_or_insert(log_ns)) > LOOK_NS {
                break;
            }
            offered.see(topic, kind, &bytes);
        }
        Ok(offered)
    }

    fn see(&mut self, topic: String, kind: Kind, bytes: &[u8]) {
        let (order, are_static) = (self.topics.len(), topic.ends_with("tf_static"));
        let offer = self.topics.entry(topic).or_insert(Offer { kind, frame_id: None, points: 0, order });
        // What cannot be read is counted and named when it is taken.
        match kind {
            Kind::TfMessage => {
                for transform in tf_message(bytes).unwrap_or_default() {
                    self.frames.insert(&transform);
                    if are_static {
                        self.latched.insert(&transform);
                    }
                }
            }
            _ if offer.frame_id.is_some() => {}
            Kind::PointCloud2 => {
                if let Ok(cloud) = PointCloud2::new(bytes) {
                    offer.frame_id = Some(name(cloud.header.frame_id).to_owned());
                    offer.points = u64::from(cloud.width) * u64::from(cloud.height);
                }
            }
            Kind::VelodyneScan => {
                offer.frame_id = VelodyneScan::new(bytes).ok().map(|scan| name(scan.header.frame_id).to_owned());
            }
            Kind::Odometry => {
                offer.frame_id = Odometry::new(bytes).ok().map(|o| name(o.transform.child_frame_id).to_owned());
            }
            Kind::PoseStamped => {}
        }
    }

    /// Chooses. Of `wanted` topics the sensors are taken in this order, and of theirs the first with poses; where none
    /// of a sort is named, the choice is made here. Sensors: one topic a frame, packets before points, then the cloud
    /// with most points; clouds in the vehicle's own or a fixed frame have been put together by somebody and are left.
    /// Poses: an odometry, else the tf chain from `map`, else from `odom`, else stamped poses.
    ///
    /// # Errors
    /// [`ChoiceError::Topic`] for a wanted topic that is not there.
    pub fn choose(&self, file: &Path, wanted: &[String], sensors_max: usize) -> Result<Choice, ChoiceError> {
        for topic in wanted {
            if !self.topics.contains_key(topic) {
                let known = self.topics.iter().map(|(topic, offer)| format!("{topic} ({})", offer.kind));
                let known = known.collect::<Vec<_>>().join(", ");
                return Err(ChoiceError::Topic { file: file.to_owned(), topic: topic.clone(), known });
            }
        }
        let ego_frame = EGO_FRAMES.into_iter().find(|frame| self.frames.contains(frame)).unwrap_or("base_link");
        let mut sensors: Vec<&String> = wanted.iter().filter(|topic| self.topics[*topic].kind.is_sensor()).collect();
        if sensors.is_empty() {
            sensors = self.sensors(ego_frame);
        }
        sensors.truncate(sensors_max);
        let pose = wanted.iter().find(|topic| matches!(self.topics[*topic].kind, Kind::Odometry | Kind::PoseStamped));
        let pose = pose.map(|topic| PoseFrom::Topic(topic.clone())).or_else(|| self.pose(ego_frame));
        let place = |topic: &&String| {
            let frame_id = self.topics[*topic].frame_id.clone().unwrap_or_default();
            let ego_from_sensor = self.frames.a_from_b(ego_frame, &frame_id);
            let ego_from_sensor = ego_from_sensor.filter(|placed| HEIGHTS_M.contains(&placed.translation.z));
            SensorTopic { topic: (*topic).clone(), frame_id, ego_from_sensor }
        };
        let sensors = sensors.iter().map(place).collect();
        let notes = self.notes(&sensors, pose.as_ref(), ego_frame);
        Ok(Choice { sensors, pose, ego_frame: ego_frame.to_owned(), notes, latched: self.latched.clone() })
    }

    fn sensors(&self, ego_frame: &str) -> Vec<&String> {
        let put_together =
            |frame: &str| frame == ego_frame || EGO_FRAMES.contains(&frame) || FIXED_FRAMES.contains(&frame);
        let mut best: BTreeMap<&str, (&String, &Offer)> = BTreeMap::new();
        for (topic, offer) in self.topics.iter().filter(|(_, offer)| offer.kind.is_sensor()) {
            let frame = offer.frame_id.as_deref().unwrap_or_default();
            if put_together(frame) {
                continue;
            }
            let rank = |offer: &Offer| (offer.kind == Kind::VelodyneScan, offer.points, usize::MAX - offer.order);
            let held = best.entry(frame).or_insert((topic, offer));
            if rank(offer) > rank(held.1) {
                *held = (topic, offer);
            }
        }
        let mut best: Vec<_> = best.into_values().collect();
        best.sort_by_key(|(_, offer)| offer.order);
        best.into_iter().map(|(topic, _)| topic).collect()
    }

    fn pose(&self, ego_frame: &str) -> Option<PoseFrom> {
        let first = |kind: Kind, fits: &dyn Fn(&Offer) -> bool| {
            let of_kind = self.topics.iter().filter(|(_, offer)| offer.kind == kind && fits(offer));
            of_kind.min_by_key(|(_, offer)| offer.order).map(|(topic, _)| PoseFrom::Topic(topic.clone()))
        };
        let joined = |offer: &Offer| {
            offer.frame_id.as_deref().is_some_and(|frame| self.frames.a_from_b(frame, ego_frame).is_some())
        };
        let mut fixed = FIXED_FRAMES.into_iter().filter(|fixed| self.frames.a_from_b(fixed, ego_frame).is_some());
        first(Kind::Odometry, &joined)
            .or_else(|| fixed.next().map(|fixed| PoseFrom::Frames { fixed: fixed.to_owned() }))
            .or_else(|| first(Kind::PoseStamped, &|_| true))
    }

    fn notes(&self, sensors: &Vec<SensorTopic>, pose: Option<&PoseFrom>, ego_frame: &str) -> Vec<String> {
        let mut notes = Vec::new();
        let mut taken: BTreeSet<&str> = BTreeSet::new();
        for sensor in sensors {
            taken.insert(&sensor.topic);
            notes.push(match sensor.ego_from_sensor {
                Some(_) => format!("{} was taken, its frame {} placed by tf", sensor.topic, sensor.frame_id),
                None => {
                    format!(
                        "{} was taken; tf does not place its frame {} 0.1 to 20 m over {ego_frame}",
                        sensor.topic, sensor.frame_id
                    )
                }
            });
        }
        match pose {
            Some(PoseFrom::Topic(topic)) => {
                taken.insert(topic);
                notes.push(format!("{topic} was taken for poses of {ego_frame}"));
            }
            Some(PoseFrom::Frames { fixed }) => notes.push(format!("tf was taken for poses of {ego_frame} in {fixed}")),
            None if sensors.is_empty() => {}
            None => notes.push("nothing in it tells poses".into()),
        }
        let left = self
            .topics
            .iter()
            .filter(|(topic, offer)| !taken.contains(topic.as_str()) && offer.kind != Kind::TfMessage);
        notes.extend(left.map(|(topic, offer)| format!("{topic} ({}) was left alone", offer.kind)));
        notes
    }
}

impl Choice {
    /// What takes these topics' messages. The transforms that do not move are known from its start: they hold for the
    /// messages before them too.
    pub fn intake(&self) -> Intake {
        let sensors = self.sensors.iter().zip(0..).map(|(sensor, index)| (sensor.topic.clone(), index)).collect();
        Intake::new(sensors, self.pose.clone(), &self.ego_frame, self.latched.clone())
    }
}
