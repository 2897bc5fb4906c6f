//! Poses: `nav_msgs/msg/Odometry`, `geometry_msgs/msg/PoseStamped`, `tf2_msgs/msg/TFMessage`.
//!
//! In: the bytes of a message. Out: rigid transforms, each with the frames it joins. A quaternion within a thousandth
//! of unit length is made one; any other, as the all-zero one of a message nobody filled, is refused.

use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion};

use crate::cdr::{Header, MessageError, Reader, Writer, length};

/// Bytes of a transform, less padding: header 8 + 4 + 1, name 4 + 1, seven numbers.
const TRANSFORM_LENGTH: usize = 74;
/// A robot with more joints is no vehicle.
const TRANSFORMS_MAX: usize = 4096;

/// Where a frame lies in another one at a moment. An odometry's, a stamped pose's (without a child), or one transform
/// of a tf message.
#[derive(Clone, Debug, PartialEq)]
pub struct StampedTransform<'a> {
    /// Stamp and parent frame.
    pub header: Header<'a>,
    /// The frame that is placed; empty for a `PoseStamped`, which does not say.
    pub child_frame_id: &'a str,
    /// Carries points of the child's frame into the parent's.
    pub parent_from_child: Isometry3<f64>,
}

/// `nav_msgs/msg/Odometry`, without the covariances.
#[derive(Clone, Debug, PartialEq)]
pub struct Odometry<'a> {
    /// Where the vehicle was.
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
    /// [`MessageError`].
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

    /// The message, little-endian, its covariances 0.
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
/// [`MessageError`].
pub fn pose_stamped(message: &[u8]) -> Result<StampedTransform<'_>, MessageError> {
    let mut reader = Reader::new(message)?;
    let header = reader.header()?;
    Ok(StampedTransform { header, child_frame_id: "", parent_from_child: pose(&mut reader, "pose")? })
}

/// Reads a `tf2_msgs/msg/TFMessage`.
///
/// # Errors
/// [`MessageError`].
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

/// A `tf2_msgs/msg/TFMessage`, little-endian.
pub fn tf_message_to_cdr(transforms: &[StampedTransform]) -> Vec<u8> {
    let mut writer = Writer::default();
    writer.u32(length(transforms.len()));
    for transform in transforms {
        writer.header(&transform.header).text(transform.child_frame_id);
        write_pose(&mut writer, &transform.parent_from_child);
    }
    writer.finish()
}

/// A `geometry_msgs/Pose` or `Transform`: position, then quaternion x y z w.
fn pose(reader: &mut Reader, what: &'static str) -> Result<Isometry3<f64>, MessageError> {
    let [x, y, z] = finite(reader.f64s(what)?, what)?;
    let [i, j, k, w] = reader.f64s(what)?;
    let quaternion = Quaternion::new(w, i, j, k);
    // NaN is in no range.
    if !(0.999..=1.001).contains(&quaternion.norm()) {
        return Err(MessageError::value(what, format!("quaternion {i} {j} {k} {w}"), "a unit quaternion"));
    }
    Ok(Isometry3::from_parts(Translation3::new(x, y, z), UnitQuaternion::from_quaternion(quaternion)))
}

pub(crate) fn write_pose<'a>(writer: &'a mut Writer, pose: &Isometry3<f64>) -> &'a mut Writer {
    // Both are stored as they are written: x y z, and x y z w.
    writer.f64s(pose.translation.vector.as_slice()).f64s(pose.rotation.coords.as_slice())
}

fn finite<const N: usize>(values: [f64; N], what: &'static str) -> Result<[f64; N], MessageError> {
    match values.iter().all(|value| value.is_finite()) {
        true => Ok(values),
        false => Err(MessageError::value(what, format!("{values:?}"), "finite numbers")),
    }
}
