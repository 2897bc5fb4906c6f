//! Chooses the topics of a bag to decode: the requested topics, or the sensors and the best poses in the bag.
//!
//! Where the file states a mount and the transform was refused, no mount is guessed: the sensor has the reason.

use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;

use clearway_daemon::ingest::ros::decoder::{PoseSource, RAISED_M, TopicDecoder};
use clearway_journal::reader::RecordingError;
use clearway_ros::frames::local_name;
use clearway_ros::{Frames, Kind};
use nalgebra::{Isometry3, Translation3};

use super::available::{AvailableTopics, EGO_FRAMES, Stamps, Topic, is_ego};

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
    /// The bag does not have a requested topic.
    #[error("{}: --topic {topic}: the file has: {known}", file.display())]
    Topic {
        /// Path of its first file.
        file: PathBuf,
        /// The topic that `--topic` names.
        topic: String,
        /// The topics of the bag, with their types.
        known: String,
    },
}

/// The topic of a sensor.
#[derive(Clone, Debug, PartialEq)]
pub struct SensorTopic {
    /// Name of the topic.
    pub topic: String,
    /// Frame of the topic's messages.
    pub frame_id: String,
    /// The frame of the tf tree that is taken for it: itself, or the only one with its name in another namespace.
    pub placed_frame: String,
    /// The stamp that all first clouds have: the stamps stand still, and the log times are used instead.
    pub still_ns: Option<i64>,
    /// The sensor's pose on the vehicle, from tf; `None` if no chain of transforms gives it, or if its height is
    /// implausible.
    pub ego_from_sensor: Option<Isometry3<f64>>,
    /// Why a transform that states the pose was refused.
    pub refused_mount: Option<String>,
    /// True for a cloud in the vehicle's frame: it is taken to be seen from 2 m over the origin.
    pub is_merged: bool,
}

/// The topics of a file from which a replay makes maps.
#[derive(Clone, Debug)]
pub struct TopicChoice {
    /// The topics of the sensors, by index of the sensor.
    pub sensors: Vec<SensorTopic>,
    /// The source of the ego poses.
    pub pose: Option<PoseSource>,
    /// Name of the vehicle's frame.
    pub ego_frame: String,
    /// The frame of the poses; empty if there are none, or if they name none.
    pub fixed_frame: String,
    /// A description of the choice, for people.
    pub notes: Vec<String>,
    latched: Frames,
}

impl AvailableTopics {
    /// Chooses the topics to decode: of the `requested` topics all sensors, in this order, and the first with poses. If
    /// no requested topic is a sensor, or none has poses, the choice is made here. Sensors: one topic a frame, packets
    /// before points, then the cloud with the most points; a cloud in the vehicle's frame or in a fixed frame has been
    /// merged by another program, and one in the vehicle's frame is used only if there is no other. Poses: an odometry,
    /// else the tf chain from `map`, else from `odom`, else stamped poses; of these the first whose stamps are near the
    /// stamps of the sensors.
    ///
    /// # Errors
    /// [`ChoiceError::Topic`] if the bag does not have a requested topic.
    pub fn choose(&self, requested: &[String], sensors_max: usize) -> Result<TopicChoice, ChoiceError> {
        for topic in requested {
            if !self.topics.contains_key(topic) {
                let known = self.topics.iter().map(|(topic, of)| format!("{topic} ({})", of.kind));
                let known = known.collect::<Vec<_>>().join(", ");
                return Err(ChoiceError::Topic { file: self.file.clone(), topic: topic.clone(), known });
            }
        }
        let kind = |topic: &String| self.topics[topic].kind;
        let ego_frame = self.ego_frame();
        let mut sensors: Vec<&String> = requested.iter().filter(|topic| kind(topic).is_sensor()).collect();
        let is_requested = !sensors.is_empty();
        if !is_requested {
            sensors = self.best_sensors();
        }
        sensors.truncate(sensors_max);
        let pose = requested.iter().find(|topic| matches!(kind(topic), Kind::Odometry | Kind::PoseStamped));
        let pose = pose.map(|topic| PoseSource::Topic(topic.clone())).or_else(|| self.best_pose(&sensors, &ego_frame));
        let mut sensors: Vec<SensorTopic> =
            sensors.into_iter().map(|topic| self.sensor_topic(topic, &ego_frame)).collect();
        if !is_requested && sensors.iter().all(|sensor| sensor.ego_from_sensor.is_none()) {
            // A replay can use one sensor without extrinsics: the sensor with packets or most points, whichever sent
            // first.
            let shown = |sensor: &SensorTopic| {
                let found = &self.topics[&sensor.topic];
                (found.kind == Kind::VelodyneScan, found.points)
            };
            sensors.sort_by_key(|sensor| std::cmp::Reverse(shown(sensor)));
        }
        let notes = self.describe(&sensors, pose.as_ref(), &ego_frame);
        let fixed_frame = match &pose {
            Some(PoseSource::Topic(topic)) => self.topics[topic].fixed_frame.clone(),
            Some(PoseSource::Frames { fixed }) => Some(fixed.clone()),
            None => None,
        };
        let fixed_frame = fixed_frame.unwrap_or_default();
        Ok(TopicChoice { sensors, pose, ego_frame, fixed_frame, notes, latched: self.latched.clone() })
    }

    /// The vehicle's frame: the frame of the tf tree to which the frame of a sensor is joined; without tf the child
    /// frame of the first odometry, else `base_link`.
    pub(super) fn ego_frame(&self) -> String {
        let names = self.frames.names();
        let candidates: Vec<&str> = EGO_FRAMES
            .into_iter()
            .flat_map(|ego| names.get(ego).into_iter().chain(names.iter().filter(move |name| local_name(name) == ego)))
            .copied()
            .collect();
        let is_joined = |ego: &&&str| {
            let mut frames =
                self.topics.values().filter(|of| of.kind.is_sensor()).filter_map(|of| of.frame_id.as_ref());
            frames.any(|frame| self.frames.a_from_b(ego, frame).is_some())
        };
        let found = candidates.iter().find(is_joined).or(candidates.first());
        let of_odometry = || {
            let odometries = self.topics.values().filter(|of| of.kind == Kind::Odometry);
            odometries.min_by_key(|of| of.order)?.frame_id.as_deref().filter(|frame| !frame.is_empty())
        };
        found.copied().or_else(of_odometry).unwrap_or("base_link").to_owned()
    }

    fn sensor_topic(&self, topic: &str, ego_frame: &str) -> SensorTopic {
        let found = &self.topics[topic];
        let frame_id = found.frame_id.clone().unwrap_or_default();
        let placed_frame = self.placed_frame(&frame_id).to_owned();
        let still_ns = found.stamps.still_ns();
        let is_merged = is_ego(&frame_id);
        let ego_from_sensor = if is_merged {
            Some(Translation3::new(0.0, 0.0, RAISED_M).into())
        } else {
            let of_tf = self.frames.a_from_b(ego_frame, &placed_frame);
            of_tf.filter(|pose| HEIGHTS_M.contains(&pose.translation.z))
        };
        let refused_mount = self.refused_mount(&frame_id).filter(|_| ego_from_sensor.is_none());
        SensorTopic {
            topic: topic.to_owned(),
            frame_id,
            placed_frame,
            still_ns,
            ego_from_sensor,
            refused_mount,
            is_merged,
        }
    }

    /// The frame of the tf tree that stands for this frame: some drivers leave out the namespace of their vehicle.
    fn placed_frame<'a>(&'a self, frame: &'a str) -> &'a str {
        let names = self.frames.names();
        let mut namesakes = names.iter().filter(|name| !frame.is_empty() && local_name(name) == local_name(frame));
        match (names.contains(frame), namesakes.next(), namesakes.next()) {
            (false, Some(only), None) => only,
            _ => frame,
        }
    }

    pub(super) fn best_sensors(&self) -> Vec<&String> {
        let mut best: BTreeMap<&str, (&String, &Topic)> = BTreeMap::new();
        for (topic, found) in self.topics.iter().filter(|(_, found)| found.kind.is_sensor()) {
            let frame = found.frame_id.as_deref().unwrap_or_default();
            if is_fixed(frame) {
                continue;
            }
            let rank = |of: &Topic| (of.kind == Kind::VelodyneScan, of.points, usize::MAX - of.order);
            let best_of_frame = best.entry(frame).or_insert((topic, found));
            if rank(found) > rank(best_of_frame.1) {
                *best_of_frame = (topic, found);
            }
        }
        if best.keys().any(|frame| !is_ego(frame)) {
            best.retain(|frame, _| !is_ego(frame));
        }
        let mut best: Vec<_> = best.into_values().collect();
        best.sort_by_key(|(_, found)| found.order);
        best.into_iter().map(|(topic, _)| topic).collect()
    }

    pub(super) fn best_pose(&self, sensors: &[&String], ego_frame: &str) -> Option<PoseSource> {
        let topics_of = |kind: Kind| {
            let mut topics: Vec<_> = self.topics.iter().filter(|(_, found)| found.kind == kind).collect();
            topics.sort_by_key(|(_, found)| found.order);
            topics.into_iter()
        };
        let odometries = topics_of(Kind::Odometry).filter(|(_, found)| self.is_joined(found, ego_frame));
        // A fixed frame with or without a namespace.
        let fixed = FIXED_FRAMES.into_iter().filter_map(|fixed| {
            let is_above = |name: &&str| local_name(name) == fixed && self.frames.a_from_b(name, ego_frame).is_some();
            self.frames.names().into_iter().find(is_above)
        });
        let of_topic = |(topic, _): (&String, &Topic)| PoseSource::Topic(topic.clone());
        let of_frame = |fixed: &str| PoseSource::Frames { fixed: fixed.to_owned() };
        let stamped = topics_of(Kind::PoseStamped).map(of_topic);
        let all: Vec<_> = odometries.map(of_topic).chain(fixed.map(of_frame)).chain(stamped).collect();
        let is_near = |pose: &&PoseSource| {
            let stamps = match pose {
                PoseSource::Topic(topic) => Some(&self.topics[topic].stamps),
                PoseSource::Frames { .. } => self.stamps_above(ego_frame),
            };
            let is_near = |of: &Stamps| of.still_ns().is_some() || stamps.and_then(|own| own.ahead_ns(of)) == Some(0);
            sensors.iter().any(|topic| is_near(&self.topics[*topic].stamps))
        };
        all.iter().find(is_near).or(all.first()).cloned()
    }

    /// True if the child frame of an odometry is the vehicle's or is joined to it. An empty one is the vehicle's.
    fn is_joined(&self, odometry: &Topic, ego_frame: &str) -> bool {
        let is_joined = |frame: &str| frame.is_empty() || self.frames.a_from_b(frame, ego_frame).is_some();
        odometry.frame_id.as_deref().is_some_and(is_joined)
    }

    fn describe(&self, sensors: &[SensorTopic], pose: Option<&PoseSource>, ego_frame: &str) -> Vec<String> {
        let mut notes = Vec::new();
        let mut used: BTreeSet<&str> = BTreeSet::new();
        for sensor in sensors {
            let SensorTopic { topic, frame_id, placed_frame, still_ns, ego_from_sensor, refused_mount, is_merged } =
                sensor;
            used.insert(topic);
            let found = &self.topics[topic];
            notes.push(match (ego_from_sensor, refused_mount, &found.refused) {
                (_, _, Some((_, first))) if found.frame_id.is_none() => {
                    format!("{topic} is read, but none of its first messages can be: {first}")
                }
                (Some(_), ..) if *is_merged => format!(
                    "{topic} is used; its frame {frame_id} is the vehicle's, so another program has moved its points: \
                     rays are taken to begin {RAISED_M} m over the origin and are approximate"
                ),
                (Some(_), ..) if placed_frame != frame_id => {
                    format!("{topic} is used; tf places {placed_frame}, which is taken for its frame {frame_id}")
                }
                (Some(_), ..) => format!("{topic} is used; tf places its frame {frame_id}"),
                (None, Some(refused), _) => {
                    format!("{topic} is read; the transform that places its frame {frame_id} was refused: {refused}")
                }
                _ => format!("{topic} is used; tf does not place its frame {frame_id} 0.1 to 20 m over {ego_frame}"),
            });
            notes.extend(still_ns.map(|ns| {
                format!("{topic}: all stamps of its first messages are {ns} ns, so its log times are used as stamps")
            }));
        }
        match pose {
            Some(PoseSource::Topic(topic)) => {
                used.insert(topic);
                let is_unnamed = self.topics[topic].kind == Kind::Odometry
                    && self.topics[topic].frame_id.as_ref().is_some_and(String::is_empty);
                let taken = if is_unnamed { "; its child_frame_id is empty and taken as this frame" } else { "" };
                notes.push(format!("poses of {ego_frame} are read from {topic}{taken}"));
            }
            Some(PoseSource::Frames { fixed }) => {
                notes.push(format!("poses of {ego_frame} are read from tf, in {fixed}"))
            }
            None if sensors.is_empty() => {}
            None => notes.push(format!(
                "no poses are read: an Odometry, a PoseStamped, or tf from map or odom to {ego_frame} gives them"
            )),
        }
        notes.extend(
            self.contradicted
                .iter()
                .map(|frame| format!("static transforms place {frame} in different ways; the last of them is used")),
        );
        let unused =
            |(topic, found): &(&String, &Topic)| !used.contains(topic.as_str()) && found.kind != Kind::TfMessage;
        let unused = self.topics.iter().filter(unused);
        notes.extend(unused.map(|(topic, found)| {
            let why = self.why_unused(found, sensors, ego_frame);
            format!("{topic} ({}) is not used: {why}", found.kind)
        }));
        notes
    }

    fn why_unused(&self, found: &Topic, sensors: &[SensorTopic], ego_frame: &str) -> String {
        let frame = found.frame_id.as_deref().unwrap_or_default();
        match (found.kind, &found.refused) {
            (_, Some((_, first))) if found.frame_id.is_none() => {
                format!("none of its first messages can be read: {first}")
            }
            (kind, _) if kind.is_sensor() && sensors.iter().any(|sensor| sensor.frame_id == frame) => {
                format!("another topic has the frame {frame} and shows more")
            }
            (kind, _) if kind.is_sensor() && is_ego(frame) => {
                format!("its frame {frame} is the vehicle's, so it was merged from other sensors; --topic uses it")
            }
            (kind, _) if kind.is_sensor() && is_fixed(frame) => {
                format!(
                    "its frame {frame} does not move with the vehicle, so a localisation has moved its points: record \
                     the driver's own cloud"
                )
            }
            (kind, _) if kind.is_sensor() => match self.refused_mount(frame) {
                Some(fault) => format!("the transform that places its frame {frame} was refused: {fault}"),
                None if self.frames.a_from_b(ego_frame, self.placed_frame(frame)).is_some() => {
                    format!("tf places its frame {frame}, and other topics were chosen; --topic chooses it")
                }
                None => format!("tf does not place its frame {frame}; --topic with --extrinsics uses it"),
            },
            (Kind::Odometry, _) if !self.is_joined(found, ego_frame) => {
                format!("no transform joins its child frame {frame} to {ego_frame}")
            }
            _ => {
                let of_sensors = sensors.iter().map(|sensor| &self.topics[&sensor.topic].stamps);
                let ahead_ns = of_sensors.filter_map(|of| found.stamps.ahead_ns(of)).min_by_key(|ns| ns.unsigned_abs());
                match (ahead_ns.unwrap_or(0), ahead_ns.unwrap_or(0).unsigned_abs() as f64 * 1e-9) {
                    (0, _) => "poses come from another topic".to_owned(),
                    (1.., apart_s) => format!("its stamps are {apart_s:.1} s ahead of the stamps of the scans"),
                    (_, apart_s) => format!("its stamps are {apart_s:.1} s behind the stamps of the scans"),
                }
            }
        }
    }
}

fn is_fixed(frame: &str) -> bool {
    FIXED_FRAMES.contains(&local_name(frame))
}

impl TopicChoice {
    /// The decoder of the chosen topics. It has the static transforms from the start, so that they also apply to
    /// earlier messages.
    pub fn decoder(&self) -> TopicDecoder {
        let sensors = self.sensors.iter().zip(0..).map(|(sensor, index)| (sensor.topic.clone(), index)).collect();
        let merged = self.sensors.iter().filter(|sensor| sensor.is_merged).map(|sensor| sensor.topic.clone());
        let still = self.sensors.iter().filter(|sensor| sensor.still_ns.is_some()).map(|sensor| sensor.topic.clone());
        let frames = self.sensors.iter().map(|sensor| (sensor.topic.clone(), sensor.frame_id.clone()));
        TopicDecoder::new(sensors, self.pose.clone(), &self.ego_frame, self.latched.clone())
            .posed_in(&self.fixed_frame)
            .lowering(merged.collect())
            .stamping(still.collect())
            .expecting(frames.collect())
    }
}
