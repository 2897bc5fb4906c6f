//! Topics of a ROS 2 bag -> the sensors of its vehicle, with their mounts.

use std::path::PathBuf;
use std::sync::Arc;

use clearway_daemon::config::Ros;
use clearway_mapping::config::{Extrinsics, SensorConfig};
use nalgebra::Isometry3;

use super::error::ReplayError;
use super::summary::Mount;
use crate::files::FilesError;
use crate::files::mcap::{McapError, McapOptions};
use crate::topics::available::AvailableTopics;
use crate::topics::choice::{SensorTopic, TopicChoice};

/// Height of a sensor above the ego frame's origin until its mount is given or estimated, in metres; ours, about the
/// roof of a car.
const MOUNT_HEIGHT_M: f64 = 2.0;

/// Chooses the topics to read from the files of a ROS bag, and keeps all topics of the bag in `wanted`.
pub(super) fn choice(bag: &[PathBuf], wanted: &mut McapOptions) -> Result<TopicChoice, ReplayError> {
    let available = AvailableTopics::from_files(bag).map_err(McapError::from).map_err(FilesError::from)?;
    let choice = available.choose(&wanted.topics, wanted.sensors_max).map_err(McapError::from);
    wanted.available = Some(Arc::new(available));
    Ok(choice.map_err(FilesError::from)?)
}

/// Keeps the sensors that tf places. If tf places none, keeps the first, whose mount is estimated or given. If the
/// mount `is_given`, the first sensor counts as placed.
pub(super) fn keep_placed(sensors: &mut Vec<SensorTopic>, is_given: bool) {
    let mut number = 0;
    let mut known = |sensor: &SensorTopic| {
        number += 1;
        sensor.ego_from_sensor.is_some() || (number == 1 && is_given)
    };
    match sensors.iter().any(|sensor| sensor.ego_from_sensor.is_some()) {
        true => sensors.retain(&mut known),
        false => sensors.truncate(1),
    }
}

/// The frames of a ROS bag, for what is published of it.
pub(super) fn frames_of(choice: &TopicChoice) -> Ros {
    let (ego_frame, fixed_frame) = (choice.ego_frame.clone(), choice.fixed_frame.clone());
    Ros { ego_frame, fixed_frame, ..Ros::default() }.frames_alone()
}

/// The configuration of each sensor of a ROS bag, and its mount if tf has it. A single sensor is named `top`, several
/// are named after their frames.
pub(super) fn sensors_of(choice: &TopicChoice) -> (Vec<SensorConfig>, Vec<Option<Mount>>) {
    let mut sensors: Vec<SensorConfig> = Vec::new();
    for (index, sensor) in choice.sensors.iter().enumerate() {
        let mut name = name_of_frame(&sensor.frame_id);
        if choice.sensors.len() == 1 {
            name = "top".to_owned();
        } else if sensors.iter().any(|before| before.name == name) {
            name = format!("{name}-{index}");
        }
        // Without a transform the mount is given or estimated later.
        let unknown = || Isometry3::translation(0.0, 0.0, MOUNT_HEIGHT_M);
        let ego_from_sensor = sensor.ego_from_sensor.unwrap_or_else(unknown);
        sensors.push(SensorConfig::new(name, extrinsics_of(&ego_from_sensor)));
    }
    let mount = |sensor: &SensorTopic| {
        let tf = Mount::Tf { ego_frame: choice.ego_frame.clone(), frame_id: sensor.frame_id.clone() };
        sensor.ego_from_sensor.map(|_| tf)
    };
    (sensors, choice.sensors.iter().map(mount).collect())
}

/// A frame's id, with each character that a sensor's name cannot have replaced by `_`.
fn name_of_frame(frame_id: &str) -> String {
    let letter = |c: char| if c.is_ascii_alphanumeric() || c == '-' { c.to_ascii_lowercase() } else { '_' };
    let name: String = frame_id.chars().map(letter).take(48).collect();
    if name.is_empty() { "sensor".to_owned() } else { name }
}

pub(super) fn extrinsics_of(ego_from_sensor: &Isometry3<f64>) -> Extrinsics {
    let (roll, pitch, yaw) = ego_from_sensor.rotation.euler_angles();
    let [x_m, y_m, z_m] = ego_from_sensor.translation.vector.into();
    let [roll_deg, pitch_deg, yaw_deg] = [roll, pitch, yaw].map(f64::to_degrees);
    Extrinsics { x_m, y_m, z_m, roll_deg, pitch_deg, yaw_deg }
}
