//! Poses: `nav_msgs/msg/Odometry`, `geometry_msgs/msg/PoseStamped`, `geometry_msgs/msg/PoseArray`,
//! `nav_msgs/msg/Path`, `tf2_msgs/msg/TFMessage`.
//!
//! In: the bytes of a message. Out: rigid transforms, each with the two frames it joins. As in tf2, a quaternion whose
//! squared length is within 0.01 of 1 is normalised; any other is refused, such as the zeros of an unset message.

use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion};

use crate::cdr::{Header, MessageError, Reader, Writer, length};

/// Bytes of a transform without padding: header 8 + 4 + 1, name 4 + 1, seven numbers.
const TRANSFORM_LENGTH: usize = 74;
/// Most transforms of a message. Ours; far more than a vehicle has frames.
const TRANSFORMS_MAX: usize = 4096;

/// Pose of a child frame in a parent frame at one time: of an odometry, of a stamped pose (without a child frame), or
/// one transform of a tf message.
#[derive(Clone, Debug, PartialEq)]
pub struct StampedTransform<'a> {
    /// Time and parent frame.
    pub header: Header<'a>,
    /// Child frame; empty for a `PoseStamped`, which does not name it.
    pub child_frame_id: &'a str,
    /// Pose of the child frame in the parent frame; it maps points of the child to the parent.
    pub parent_from_child: Isometry3<f64>,
}

/// `nav_msgs/msg/Odometry`, without the covariances.
#[derive(Clone, Debug, PartialEq)]
pub struct Odometry<'a> {
    /// Pose of the vehicle.
    pub transform: StampedTransform<'a>,
    /// Velocity; `None` if a number of it is not finite.
    pub twist: Option<Twist>,
}

/// A `geometry_msgs/msg/Twist`: linear and angular velocity.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Twist {
    /// Linear velocity in the child's frame, m/s.
    pub linear_mps: [f64; 3],
    /// Angular velocity in the child's frame, rad/s.
    pub angular_rps: [f64; 3],
}

/// The transforms of a `tf2_msgs/msg/TFMessage`.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TfMessage<'a> {
    /// The valid transforms, in the order of the message.
    pub transforms: Vec<StampedTransform<'a>>,
    /// The other transforms: tf2 ignores them too.
    pub refused: Vec<RefusedTransform<'a>>,
}

/// A transform of a `tf2_msgs/msg/TFMessage` that was refused.
#[derive(Clone, Debug, PartialEq)]
pub struct RefusedTransform<'a> {
    /// Child frame of the transform.
    pub child_frame_id: &'a str,
    /// The fault, with the child frame.
    pub fault: MessageError,
}

impl<'a> Odometry<'a> {
    /// Reads a message.
    ///
    /// # Errors
    /// [`MessageError`] as of [`Reader`]; [`MessageError::Value`] if a number of the pose is not finite or its
    /// quaternion is not of length 1.
    pub fn new(message: &'a [u8]) -> Result<Self, MessageError> {
        let mut reader = Reader::new(message)?;
        let header = reader.header()?;
        let child_frame_id = reader.text("child_frame_id")?;
        let parent_from_child = pose(&mut reader, "pose.pose")?;
        reader.f64s::<36>("pose.covariance")?;
        let (linear_mps, angular_rps) = (reader.f64s("twist.twist.linear")?, reader.f64s("twist.twist.angular")?);
        reader.f64s::<36>("twist.covariance")?;
        let transform = StampedTransform { header, child_frame_id, parent_from_child };
        let is_finite = [linear_mps, angular_rps].as_flattened().iter().all(|value| value.is_finite());
        Ok(Self { transform, twist: is_finite.then_some(Twist { linear_mps, angular_rps }) })
    }

    /// Encodes the message, little-endian, with covariances of 0, and NaN for an unknown twist.
    pub fn to_cdr(&self) -> Vec<u8> {
        let mut writer = Writer::default();
        writer.header(&self.transform.header).text(self.transform.child_frame_id);
        write_pose(&mut writer, &self.transform.parent_from_child).f64s(&[0.0; 36]);
        let unknown = Twist { linear_mps: [f64::NAN; 3], angular_rps: [f64::NAN; 3] };
        let Twist { linear_mps, angular_rps } = self.twist.unwrap_or(unknown);
        writer.f64s(&linear_mps).f64s(&angular_rps).f64s(&[0.0; 36]);
        writer.finish()
    }
}

/// Reads a `geometry_msgs/msg/PoseStamped`.
///
/// # Errors
/// As [`Odometry::new`].
pub fn pose_stamped(message: &[u8]) -> Result<StampedTransform<'_>, MessageError> {
    let mut reader = Reader::new(message)?;
    let header = reader.header()?;
    Ok(StampedTransform { header, child_frame_id: "", parent_from_child: pose(&mut reader, "pose")? })
}

/// Reads a `tf2_msgs/msg/TFMessage`. A wrong stamp, quaternion, number or name costs its transform alone, as in tf2.
///
/// # Errors
/// [`MessageError`] as of [`Reader`] if the message does not have the bytes of its transforms;
/// [`MessageError::Value`] if there are more than 4096 of them.
pub fn tf_message(message: &[u8]) -> Result<TfMessage<'_>, MessageError> {
    let mut reader = Reader::new(message)?;
    let count = reader.count("transforms", TRANSFORM_LENGTH)?;
    if count > TRANSFORMS_MAX {
        return Err(MessageError::value("transforms", count, "up to 4096 transforms"));
    }
    let mut read = TfMessage::default();
    for _ in 0..count {
        // All members are read before any is judged, so that the next transform is found.
        let stamp_ns = reader.stamp("transforms[].header.stamp");
        let frame_id = reader.text("transforms[].header.frame_id")?;
        let child_frame_id = reader.text("transforms[].child_frame_id")?;
        let numbers = reader.f64s("transforms[].transform")?;
        let judged = stamp_ns.and_then(|stamp_ns| {
            if child_frame_id.is_empty() || frame_id.is_empty() || child_frame_id == frame_id {
                let shown = format!("{frame_id:?} to {child_frame_id:?}");
                return Err(MessageError::value("transforms[]", shown, "two frames with different names"));
            }
            let parent_from_child = isometry(numbers, "transforms[].transform")?;
            let header = Header { stamp_ns, frame_id };
            Ok(StampedTransform { header, child_frame_id, parent_from_child })
        });
        match judged {
            Ok(transform) => read.transforms.push(transform),
            Err(fault) => {
                let fault = match fault {
                    MessageError::Value { what, value, allowed } => {
                        MessageError::value(what, format!("{value} of frame {child_frame_id}"), allowed)
                    }
                    other => return Err(other),
                };
                read.refused.push(RefusedTransform { child_frame_id, fault });
            }
        }
    }
    Ok(read)
}

/// Encodes a `tf2_msgs/msg/TFMessage`, little-endian.
pub fn tf_message_to_cdr(transforms: &[StampedTransform]) -> Vec<u8> {
    let mut writer = Writer::default();
    writer.u32(length(transforms.len()));
    for transform in transforms {
        writer.header(&transform.header).text(transform.child_frame_id);
        write_pose(&mut writer, &transform.parent_from_child);
    }
    writer.finish()
}

/// Encodes a `geometry_msgs/msg/PoseArray`, little-endian.
pub fn pose_array_to_cdr(header: &Header, poses: &[Isometry3<f64>]) -> Vec<u8> {
    let mut writer = Writer::default();
    writer.header(header).u32(length(poses.len()));
    poses.iter().fold(&mut writer, |writer, pose| write_pose(writer, pose));
    writer.finish()
}

/// Encodes a `nav_msgs/msg/Path`, little-endian; each pose has the header of the path.
pub fn path_to_cdr(header: &Header, poses: &[Isometry3<f64>]) -> Vec<u8> {
    let mut writer = Writer::default();
    writer.header(header).u32(length(poses.len()));
    poses.iter().fold(&mut writer, |writer, pose| write_pose(writer.header(header), pose));
    writer.finish()
}

/// Reads a `geometry_msgs/Pose`, named `what` in errors.
fn pose(reader: &mut Reader, what: &'static str) -> Result<Isometry3<f64>, MessageError> {
    isometry(reader.f64s(what)?, what)
}

/// The rigid transform of a position and a quaternion x y z w.
fn isometry([x, y, z, i, j, k, w]: [f64; 7], what: &'static str) -> Result<Isometry3<f64>, MessageError> {
    if ![x, y, z].iter().all(|value| value.is_finite()) {
        return Err(MessageError::value(what, format!("{:?}", [x, y, z]), "finite numbers"));
    }
    let quaternion = Quaternion::new(w, i, j, k);
    // A range contains no NaN.
    if !(0.99..=1.01).contains(&quaternion.norm_squared()) {
        return Err(MessageError::value(what, format!("quaternion {i} {j} {k} {w}"), "a unit quaternion"));
    }
    Ok(Isometry3::from_parts(Translation3::new(x, y, z), UnitQuaternion::from_quaternion(quaternion)))
}

pub(crate) fn write_pose<'a>(writer: &'a mut Writer, pose: &Isometry3<f64>) -> &'a mut Writer {
    // nalgebra stores both in the order of the message: x y z, and x y z w.
    writer.f64s(pose.translation.vector.as_slice()).f64s(pose.rotation.coords.as_slice())
}
