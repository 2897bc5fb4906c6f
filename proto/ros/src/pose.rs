//! Poses: `nav_msgs/msg/Odometry`, `geometry_msgs/msg/PoseStamped`, `geometry_msgs/msg/PoseArray`,
//! `tf2_msgs/msg/TFMessage`.
//!
//! In: the bytes of a message. Out: rigid transforms, each with the two frames it joins. A quaternion whose length is
//! within 0.001 of 1 is normalised; any other is refused, such as the zeros of an unset message.

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
    /// Linear velocity in the child's frame, m/s.
    pub linear_mps: [f64; 3],
    /// Angular velocity in the child's frame, rad/s.
    pub angular_rps: [f64; 3],
}

impl<'a> Odometry<'a> {
    /// Reads a message.
    ///
    /// # Errors
    /// [`MessageError`] as of [`Reader`]; [`MessageError::Value`] if a number is not finite or a quaternion is not of
    /// length 1.
    pub fn new(message: &'a [u8]) -> Result<Self, MessageError> {
        let mut reader = Reader::new(message)?;
        let header = reader.header()?;
        let child_frame_id = reader.text("child_frame_id")?;
        let parent_from_child = pose(&mut reader, "pose.pose")?;
        reader.f64s::<36>("pose.covariance")?;
        let linear_mps = finite(reader.f64s("twist.twist.linear")?, "twist.twist.linear")?;
        let angular_rps = finite(reader.f64s("twist.twist.angular")?, "twist.twist.angular")?;
        reader.f64s::<36>("twist.covariance")?;
        let transform = StampedTransform { header, child_frame_id, parent_from_child };
        Ok(Self { transform, linear_mps, angular_rps })
    }

    /// Encodes the message, little-endian, with covariances of 0.
    pub fn to_cdr(&self) -> Vec<u8> {
        let mut writer = Writer::default();
        writer.header(&self.transform.header).text(self.transform.child_frame_id);
        write_pose(&mut writer, &self.transform.parent_from_child).f64s(&[0.0; 36]);
        writer.f64s(&self.linear_mps).f64s(&self.angular_rps).f64s(&[0.0; 36]);
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

/// Reads a `tf2_msgs/msg/TFMessage`.
///
/// # Errors
/// As [`Odometry::new`]; [`MessageError::Value`] also if there are more than 4096 transforms.
pub fn tf_message(message: &[u8]) -> Result<Vec<StampedTransform<'_>>, MessageError> {
    let mut reader = Reader::new(message)?;
    let count = reader.count("transforms", TRANSFORM_LENGTH)?;
    if count > TRANSFORMS_MAX {
        return Err(MessageError::value("transforms", count, "up to 4096 transforms"));
    }
    let transform = |_| {
        let header = reader.header()?;
        let child_frame_id = reader.text("transforms[].child_frame_id")?;
        Ok(StampedTransform { header, child_frame_id, parent_from_child: pose(&mut reader, "transforms[].transform")? })
    };
    (0..count).map(transform).collect()
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

/// Reads a `geometry_msgs/Pose` or `Transform`: position, then quaternion x y z w.
fn pose(reader: &mut Reader, what: &'static str) -> Result<Isometry3<f64>, MessageError> {
    let [x, y, z] = finite(reader.f64s(what)?, what)?;
    let [i, j, k, w] = reader.f64s(what)?;
    let quaternion = Quaternion::new(w, i, j, k);
    // A range contains no NaN.
    if !(0.999..=1.001).contains(&quaternion.norm()) {
        return Err(MessageError::value(what, format!("quaternion {i} {j} {k} {w}"), "a unit quaternion"));
    }
    Ok(Isometry3::from_parts(Translation3::new(x, y, z), UnitQuaternion::from_quaternion(quaternion)))
}

pub(crate) fn write_pose<'a>(writer: &'a mut Writer, pose: &Isometry3<f64>) -> &'a mut Writer {
    // nalgebra stores both in the order of the message: x y z, and x y z w.
    writer.f64s(pose.translation.vector.as_slice()).f64s(pose.rotation.coords.as_slice())
}

fn finite<const N: usize>(values: [f64; N], what: &'static str) -> Result<[f64; N], MessageError> {
    match values.iter().all(|value| value.is_finite()) {
        true => Ok(values),
        false => Err(MessageError::value(what, format!("{values:?}"), "finite numbers")),
    }
}
