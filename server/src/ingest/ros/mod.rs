//! ROS 2 messages of chosen topics -> readings, alike from an MCAP file and live.
//!
//! Scans come in the sensor's frame, which its extrinsics place. Poses come from an odometry, a stamped pose, or the tf
//! chain from a fixed frame down to the vehicle's own; where a message speaks of another frame than the vehicle's, the
//! tf tree carries it over, and a chain that is not there is an error. tf and stamped poses tell no speed: it is the
//! way forward since the pose before, so that the first of them only begins.

use std::collections::{BTreeMap, VecDeque};

use bytes::Bytes;
use clearway_mapping::event::{Body, EgoPose, UNKNOWN_SOURCE, Scan};
use clearway_ros::pose::{Odometry, StampedTransform, pose_stamped, tf_message};
use clearway_ros::velodyne_scan::VelodyneScan;
use clearway_ros::{Frames, Kind, MessageError, PointCloud2, Points};
use nalgebra::{Isometry3, Vector3};

use crate::ingest::queue::Reading;

mod choice;
#[cfg(feature = "zenoh")]
pub mod live;

pub use choice::{Choice, ChoiceError, Offered, SensorTopic};

/// Where ego poses come from.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum PoseFrom {
    /// The odometry or stamped poses of a topic.
    Topic(String),
    /// The tf chain from this frame down to the vehicle's.
    Frames {
        /// The locally fixed frame, such as `map` or `odom`.
        fixed: String,
    },
}

/// Why a message was not taken.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum Refused {
    /// It is not what its type says.
    #[error(transparent)]
    Message(#[from] MessageError),
    /// It is of a type that this topic is not taken for.
    #[error("a {kind}: allowed: {allowed}")]
    Kind {
        /// What it is.
        kind: Kind,
        /// What it may be.
        allowed: &'static str,
    },
    /// Nothing tells how its frame lies to the vehicle's.
    #[error("frame {frame}: no chain of transforms joins it to {ego_frame}")]
    Frame {
        /// The message's.
        frame: String,
        /// The vehicle's.
        ego_frame: String,
    },
    /// More frames than any vehicle has.
    #[error("frame {frame}: up to 4096 frames are kept")]
    Frames {
        /// The one too many.
        frame: String,
    },
}

impl Refused {
    /// The name it is counted by.
    pub fn reason(&self) -> &'static str {
        match self {
            Self::Message(_) => "ros_message",
            Self::Kind { .. } => "ros_kind",
            Self::Frame { .. } => "ros_frame",
            Self::Frames { .. } => "ros_frames",
        }
    }
}

/// The chosen topics of one vehicle, and what their messages have told so far.
#[derive(Clone, Debug)]
pub struct Intake {
    sensors: BTreeMap<String, u16>,
    pose: Option<PoseFrom>,
    ego_frame: String,
    frames: Frames,
    /// Stamp and place of the newest pose without a speed of its own.
    newest: Option<(i64, Isometry3<f64>)>,
    /// How many transforms above the vehicle's frame the nearest one stands that moves.
    moving: usize,
}

impl Intake {
    /// Takes these topics, each for the sensor of this index; `frames` holds what is known before the first message.
    pub fn new(sensors: BTreeMap<String, u16>, pose: Option<PoseFrom>, ego_frame: &str, frames: Frames) -> Self {
        Self { sensors, pose, ego_frame: ego_frame.to_owned(), frames, newest: None, moving: usize::MAX }
    }

    /// Whether messages of this topic are wanted.
    pub fn wants(&self, topic: &str, kind: Kind) -> bool {
        kind == Kind::TfMessage || self.sensors.contains_key(topic) || self.is_pose(topic)
    }

    /// The sensor this topic is taken for; [`UNKNOWN_SOURCE`] for what concerns the whole vehicle.
    pub fn source(&self, topic: &str) -> u16 {
        self.sensors.get(topic).copied().unwrap_or(UNKNOWN_SOURCE)
    }

    fn is_pose(&self, topic: &str) -> bool {
        matches!(&self.pose, Some(PoseFrom::Topic(of)) if of == topic)
    }

    /// Takes one message of a wanted topic; its readings go to the end of `readings`. Packets arrive at their own
    /// stamps, everything else at `arrival_ns`.
    ///
    /// # Errors
    /// [`Refused`]; then nothing of the message was taken.
    pub fn take(
        &mut self,
        topic: &str,
        kind: Kind,
        arrival_ns: i64,
        bytes: &Bytes,
        readings: &mut VecDeque<Reading>,
    ) -> Result<(), Refused> {
        if kind == Kind::TfMessage {
            let pose = self.take_transforms(&tf_message(bytes)?, topic.ends_with("tf_static"))?;
            readings.extend(pose.map(|pose| Reading { arrival_ns, source: 0, body: Body::EgoPose(pose) }));
        } else if let Some(&source) = self.sensors.get(topic) {
            match kind {
                Kind::PointCloud2 => {
                    let scan = scan(Points::from_cloud(&PointCloud2::new(bytes)?)?);
                    readings.push_back(Reading { arrival_ns, source, body: Body::Scan(scan) });
                }
                Kind::VelodyneScan => {
                    let packets = VelodyneScan::new(bytes)?.packets().collect::<Result<Vec<_>, _>>()?;
                    readings.extend(packets.into_iter().map(|(arrival_ns, packet)| {
                        let body = Body::Datagram(bytes.slice_ref(packet));
                        Reading { arrival_ns, source, body }
                    }));
                }
                kind => return Err(Refused::Kind { kind, allowed: "PointCloud2 and VelodyneScan for a sensor" }),
            }
        } else if self.is_pose(topic) {
            let pose = match kind {
                Kind::Odometry => Some(self.of_odometry(&Odometry::new(bytes)?)?),
                Kind::PoseStamped => {
                    let pose = pose_stamped(bytes)?;
                    self.of_two(pose.header.stamp_ns, pose.parent_from_child)
                }
                kind => return Err(Refused::Kind { kind, allowed: "Odometry and PoseStamped for poses" }),
            };
            readings.extend(pose.map(|pose| Reading { arrival_ns, source: 0, body: Body::EgoPose(pose) }));
        }
        Ok(())
    }

    fn of_odometry(&self, odometry: &Odometry) -> Result<EgoPose, Refused> {
        let StampedTransform { header, child_frame_id, parent_from_child } = &odometry.transform;
        let child_from_ego = self
            .frames
            .a_from_b(child_frame_id, &self.ego_frame)
            .ok_or_else(|| Refused::Frame { frame: (*child_frame_id).to_owned(), ego_frame: self.ego_frame.clone() })?;
        // The twist is the child's; a place beside it moves with the turn too.
        let turning = Vector3::from(odometry.angular_rps).cross(&child_from_ego.translation.vector);
        let velocity = child_from_ego.rotation.inverse() * (Vector3::from(odometry.linear_mps) + turning);
        let map_from_ego = parent_from_child * child_from_ego;
        Ok(EgoPose { stamp_ns: header.stamp_ns, map_from_ego, speed_mps: velocity.x })
    }

    /// A pose whose speed is the way forward since the one before; `None` for the first, and for one that is not newer.
    fn of_two(&mut self, stamp_ns: i64, map_from_ego: Isometry3<f64>) -> Option<EgoPose> {
        let before = self.newest.filter(|(before_ns, _)| *before_ns >= stamp_ns);
        if before.is_some() {
            return None;
        }
        let (before_ns, before) = self.newest.replace((stamp_ns, map_from_ego))?;
        let seconds = stamp_ns.abs_diff(before_ns) as f64 * 1e-9;
        let forward_m = (before.inverse() * map_from_ego).translation.x;
        Some(EgoPose { stamp_ns, map_from_ego, speed_mps: forward_m / seconds })
    }

    /// Keeps the transforms; where they move the vehicle, gives its pose. The nearest moving transform above the
    /// vehicle's frame stamps it: those farther up (a localisation's) come seldom, and are stamped ahead by some.
    fn take_transforms(
        &mut self,
        transforms: &[StampedTransform],
        are_static: bool,
    ) -> Result<Option<EgoPose>, Refused> {
        let mut stamp_ns = None;
        for transform in transforms {
            if !self.frames.insert(transform) {
                return Err(Refused::Frames { frame: transform.child_frame_id.to_owned() });
            }
            let steps = self.frames.steps_up(&self.ego_frame, transform.child_frame_id);
            if let Some(steps) = steps.filter(|steps| *steps <= self.moving && !are_static) {
                self.moving = steps;
                stamp_ns = Some(transform.header.stamp_ns);
            }
        }
        let (Some(stamp_ns), Some(PoseFrom::Frames { fixed })) = (stamp_ns, &self.pose) else { return Ok(None) };
        match self.frames.a_from_b(fixed, &self.ego_frame) {
            Some(fixed_from_ego) => Ok(self.of_two(stamp_ns, fixed_from_ego)),
            // The upper part of the chain may still be on its way.
            None => Ok(None),
        }
    }
}

fn scan(points: Points) -> Scan {
    let Points { stamp_ns, x, y, z, intensity, ring, offset_ns, no_returns: _ } = points;
    Scan { stamp_ns, x, y, z, intensity, ring, offset_ns, no_returns: Vec::new() }
}
