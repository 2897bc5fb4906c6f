//! Decodes the messages of the chosen ROS 2 topics of one vehicle into readings.
//!
//! Scans come in the sensor's frame, and the sensor's extrinsics place them on the vehicle. Ego poses come from an
//! odometry, from stamped poses, or from the tf chain of a fixed frame down to the vehicle's frame. If a message refers
//! to another frame than the vehicle's, the tf tree transforms it; a missing chain is an error. tf, stamped poses and
//! odometries without a finite twist have no speed: it is computed from the forward distance since the pose before, so
//! the first of them, and the first after a step back of the stamps, yields no reading.
//!
//! A fault of a part of a message (a transform, a packet, points, an optional field) costs that part alone.

use std::collections::{BTreeMap, BTreeSet, VecDeque};

use bytes::Bytes;
use clearway_mapping::event::{Body, EgoPose, Scan, UNKNOWN_SOURCE};
use clearway_ros::frames::name;
use clearway_ros::pose::{Odometry, StampedTransform, TfMessage, Twist, pose_stamped, tf_message};
use clearway_ros::velodyne_scan::VelodyneScan;
use clearway_ros::{Frames, Kind, MessageError, PointCloud2, Points, RefusedPart};
use nalgebra::{Isometry3, Vector3};

use crate::ingest::queue::Reading;

/// Height over the ground from which a cloud in the vehicle's frame is taken to be seen, in metres. Ours, about the
/// roof of a car.
pub const RAISED_M: f64 = 2.0;

/// The source of the ego poses.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum PoseSource {
    /// The odometry or the stamped poses of a topic.
    Topic(String),
    /// The tf chain from a fixed frame down to the vehicle's frame.
    Frames {
        /// The locally fixed frame, such as `map` or `odom`.
        fixed: String,
    },
}

/// A ROS 2 message was refused.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum RosMessageError {
    /// The bytes do not decode as the message's type.
    #[error(transparent)]
    Message(#[from] MessageError),
    /// The topic's role does not allow this type.
    #[error("a {kind}: allowed: {allowed}")]
    Kind {
        /// Type of the refused message.
        kind: Kind,
        /// The types that the topic's role allows, in words.
        allowed: &'static str,
    },
    /// A cloud is in another frame than the first clouds of its topic.
    #[error("frame {found}: allowed: {frame}, the frame of the topic's first cloud; record each sensor as a topic")]
    OtherFrame {
        /// The frame of the first clouds.
        frame: String,
        /// The frame of the message.
        found: String,
    },
    /// A pose is in another frame than the vehicle's poses.
    #[error("a pose in frame {found}: allowed: {fixed_frame}, the fixed frame of the vehicle")]
    OtherFixedFrame {
        /// The vehicle's fixed frame.
        fixed_frame: String,
        /// The frame of the message.
        found: String,
    },
    /// No chain of transforms joins the message's frame and the vehicle's.
    #[error("frame {frame}: no chain of transforms joins it to {ego_frame}")]
    Frame {
        /// Frame that the message names.
        frame: String,
        /// Name of the vehicle's frame.
        ego_frame: String,
    },
}

impl RosMessageError {
    /// The key by which the refusal is counted.
    pub fn reason(&self) -> &'static str {
        match self {
            Self::Message(_) => "ros_message",
            Self::Kind { .. } => "ros_kind",
            Self::OtherFrame { .. } | Self::OtherFixedFrame { .. } | Self::Frame { .. } => "ros_frame",
        }
    }
}

/// Decodes the chosen topics of one vehicle; keeps the transforms and the newest pose of the messages so far.
#[derive(Clone, Debug)]
pub struct TopicDecoder {
    /// Index of the sensor by topic.
    sensors: BTreeMap<String, u16>,
    pose: Option<PoseSource>,
    ego_frame: String,
    /// The frame of the poses; empty: any.
    fixed_frame: String,
    frames: Frames,
    /// Stamp and `map_from_ego` of the newest pose without a speed.
    newest: Option<(i64, Isometry3<f64>)>,
    /// Number of transforms between the vehicle's frame and the nearest moving frame above it.
    steps_to_moving: usize,
    /// Topics of clouds in the vehicle's frame.
    lowered: BTreeSet<String>,
    /// Topics of clouds whose stamps stand still.
    still: BTreeSet<String>,
    /// The frame of each topic's clouds, if it is known before.
    cloud_frames: BTreeMap<String, String>,
}

impl TopicDecoder {
    /// A decoder of these topics; `frames` are the transforms that are known before the first message.
    pub fn new(sensors: BTreeMap<String, u16>, pose: Option<PoseSource>, ego_frame: &str, frames: Frames) -> Self {
        let (lowered, still, cloud_frames, fixed_frame) = Default::default();
        let (ego_frame, steps_to_moving) = (ego_frame.to_owned(), usize::MAX);
        Self {
            sensors,
            pose,
            ego_frame,
            fixed_frame,
            frames,
            newest: None,
            steps_to_moving,
            lowered,
            still,
            cloud_frames,
        }
    }

    /// The decoder, with the points of these topics, which are in the vehicle's frame, moved to the frame of a sensor
    /// over its origin.
    pub fn lowering(self, lowered: BTreeSet<String>) -> Self {
        Self { lowered, ..self }
    }

    /// The decoder, with the arrivals of the clouds of these topics as their stamps.
    pub fn stamping(self, still: BTreeSet<String>) -> Self {
        Self { still, ..self }
    }

    /// The decoder, which refuses clouds in other frames than these, by topic: they are of another sensor.
    pub fn expecting(self, cloud_frames: BTreeMap<String, String>) -> Self {
        Self { cloud_frames, ..self }
    }

    /// The decoder, which refuses poses of the topic of poses in another frame than `fixed_frame`; empty: any frame.
    /// Grids are published in this frame, and poses of two frames would jump.
    pub fn posed_in(self, fixed_frame: &str) -> Self {
        Self { fixed_frame: fixed_frame.to_owned(), ..self }
    }

    /// True if messages of this topic and type are decoded.
    pub fn accepts(&self, topic: &str, kind: Kind) -> bool {
        kind == Kind::TfMessage || self.sensors.contains_key(topic) || self.is_pose(topic)
    }

    /// Index of the topic's sensor; [`UNKNOWN_SOURCE`] if the topic concerns the whole vehicle.
    pub fn source(&self, topic: &str) -> u16 {
        self.sensors.get(topic).copied().unwrap_or(UNKNOWN_SOURCE)
    }

    /// The topic of a sensor.
    pub fn topic(&self, source: u16) -> Option<&str> {
        self.sensors.iter().find(|(_, index)| **index == source).map(|(topic, _)| topic.as_str())
    }

    /// True if the poses of the vehicle are decoded.
    pub fn has_poses(&self) -> bool {
        self.pose.is_some()
    }

    fn is_pose(&self, topic: &str) -> bool {
        matches!(&self.pose, Some(PoseSource::Topic(of)) if of == topic)
    }

    /// Decodes one message of an accepted topic and appends its readings to `readings`. Packets arrive at their own
    /// stamps, everything else at `arrival_ns`. Returns the parts of the message that were refused.
    ///
    /// # Errors
    /// [`RosMessageError`] with the fault; then `readings` has no reading of the message.
    pub fn decode(
        &mut self,
        topic: &str,
        kind: Kind,
        arrival_ns: i64,
        bytes: &Bytes,
        readings: &mut VecDeque<Reading>,
    ) -> Result<Vec<RefusedPart>, RosMessageError> {
        let mut refused = Vec::new();
        if kind == Kind::TfMessage {
            let pose = self.insert_transforms(tf_message(bytes)?, topic.ends_with("tf_static"), &mut refused);
            readings.extend(pose.map(|pose| Reading { arrival_ns, source: 0, body: Body::EgoPose(pose) }));
        } else if let Some(&source) = self.sensors.get(topic) {
            match kind {
                Kind::PointCloud2 => {
                    let cloud = PointCloud2::new(bytes)?;
                    let found = name(cloud.header.frame_id);
                    if let Some(frame) = self.cloud_frames.get(topic).filter(|frame| *frame != found) {
                        let (frame, found) = (frame.clone(), found.to_owned());
                        return Err(RosMessageError::OtherFrame { frame, found });
                    }
                    let mut points = Points::from_cloud(&cloud)?;
                    refused = std::mem::take(&mut points.refused);
                    if self.still.contains(topic) {
                        points.stamp_ns = arrival_ns;
                    }
                    if self.lowered.contains(topic) {
                        points.z.iter_mut().for_each(|z| *z -= RAISED_M as f32);
                    }
                    readings.push_back(Reading { arrival_ns, source, body: Body::Scan(scan(points)) });
                }
                Kind::VelodyneScan => {
                    for packet in VelodyneScan::new(bytes)?.packets() {
                        match packet {
                            Ok((arrival_ns, packet)) => {
                                let body = Body::Datagram(bytes.slice_ref(packet));
                                readings.push_back(Reading { arrival_ns, source, body });
                            }
                            Err(fault) => refused.push(RefusedPart { what: "packets", count: 1, fault }),
                        }
                    }
                }
                kind => {
                    return Err(RosMessageError::Kind { kind, allowed: "PointCloud2 and VelodyneScan for a sensor" });
                }
            }
        } else if self.is_pose(topic) {
            let pose = match kind {
                Kind::Odometry => self.pose_of_odometry(&Odometry::new(bytes)?)?,
                Kind::PoseStamped => {
                    let pose = pose_stamped(bytes)?;
                    self.check_fixed_frame(pose.header.frame_id)?;
                    self.pose_with_speed(pose.header.stamp_ns, pose.parent_from_child)
                }
                kind => return Err(RosMessageError::Kind { kind, allowed: "Odometry and PoseStamped for poses" }),
            };
            readings.extend(pose.map(|pose| Reading { arrival_ns, source: 0, body: Body::EgoPose(pose) }));
        }
        Ok(refused)
    }

    fn check_fixed_frame(&self, frame_id: &str) -> Result<(), RosMessageError> {
        if self.fixed_frame.is_empty() || name(frame_id) == self.fixed_frame {
            return Ok(());
        }
        let (fixed_frame, found) = (self.fixed_frame.clone(), frame_id.to_owned());
        Err(RosMessageError::OtherFixedFrame { fixed_frame, found })
    }

    /// An odometry without a child frame describes the vehicle.
    fn pose_of_odometry(&mut self, odometry: &Odometry) -> Result<Option<EgoPose>, RosMessageError> {
        let StampedTransform { header, child_frame_id, parent_from_child } = &odometry.transform;
        self.check_fixed_frame(header.frame_id)?;
        let child_frame_id = if child_frame_id.is_empty() { &self.ego_frame } else { *child_frame_id };
        let child_from_ego = self.frames.a_from_b(child_frame_id, &self.ego_frame).ok_or_else(|| {
            RosMessageError::Frame { frame: child_frame_id.to_owned(), ego_frame: self.ego_frame.clone() }
        })?;
        let map_from_ego = parent_from_child * child_from_ego;
        let Some(Twist { linear_mps, angular_rps }) = odometry.twist else {
            return Ok(self.pose_with_speed(header.stamp_ns, map_from_ego));
        };
        // The twist describes the child frame; while it rotates, a point at a distance from it moves as well.
        let from_rotation = Vector3::from(angular_rps).cross(&child_from_ego.translation.vector);
        let velocity = child_from_ego.rotation.inverse() * (Vector3::from(linear_mps) + from_rotation);
        Ok(Some(EgoPose { stamp_ns: header.stamp_ns, map_from_ego, speed_mps: velocity.x }))
    }

    /// The ego pose with its speed, computed from the forward distance since the pose before. `None` for the first
    /// pose, for a repeated stamp, and if the stamps step back: the poses after the step are computed from this pose,
    /// and the pipeline decides whether an epoch has begun.
    fn pose_with_speed(&mut self, stamp_ns: i64, map_from_ego: Isometry3<f64>) -> Option<EgoPose> {
        if self.newest.is_some_and(|(before_ns, _)| before_ns == stamp_ns) {
            return None;
        }
        let before = self.newest.replace((stamp_ns, map_from_ego));
        let (before_ns, before) = before.filter(|(before_ns, _)| *before_ns < stamp_ns)?;
        let seconds = stamp_ns.abs_diff(before_ns) as f64 * 1e-9;
        let forward_m = (before.inverse() * map_from_ego).translation.x;
        Some(EgoPose { stamp_ns, map_from_ego, speed_mps: forward_m / seconds })
    }

    /// Inserts transforms into the tf tree. Returns the vehicle's pose if they move it. The nearest moving transform
    /// above the vehicle's frame gives the stamp, because transforms farther up (from a localisation) are rare, and
    /// some programs stamp them in advance.
    fn insert_transforms(
        &mut self,
        message: TfMessage,
        are_static: bool,
        refused: &mut Vec<RefusedPart>,
    ) -> Option<EgoPose> {
        let part = |fault| RefusedPart { what: "transforms", count: 1, fault };
        refused.extend(message.refused.into_iter().map(|transform| part(transform.fault)));
        let mut stamp_ns = None;
        for transform in &message.transforms {
            if !self.frames.insert(transform) {
                refused.push(part(MessageError::value("frames", transform.child_frame_id, "up to 4096 frames")));
                continue;
            }
            let steps = self.frames.steps_up(&self.ego_frame, transform.child_frame_id);
            if let Some(steps) = steps.filter(|steps| *steps <= self.steps_to_moving && !are_static) {
                self.steps_to_moving = steps;
                stamp_ns = Some(transform.header.stamp_ns);
            }
        }
        let (stamp_ns, Some(PoseSource::Frames { fixed })) = (stamp_ns?, &self.pose) else { return None };
        // The upper part of the chain may not have arrived yet.
        let fixed_from_ego = self.frames.a_from_b(fixed, &self.ego_frame)?;
        self.pose_with_speed(stamp_ns, fixed_from_ego)
    }
}

fn scan(points: Points) -> Scan {
    let Points { stamp_ns, x, y, z, intensity, ring, offset_ns, no_returns: _, refused: _ } = points;
    Scan { stamp_ns, x, y, z, intensity, ring, offset_ns, no_returns: Vec::new() }
}
