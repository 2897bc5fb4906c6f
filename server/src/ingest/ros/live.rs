//! ROS 2 messages in rmw_zenoh's key space -> the door, with no bridge between.
//!
//! rmw_zenoh publishes a topic under `<domain>/<topic>/<type>/<hash>`, the type as DDS spells it, the payload CDR. Any
//! hash is taken (Humble writes none, and a type that has changed shape is refused by its bytes). The attachment
//! carries sequence, stamp and publisher: a number missing from a publisher's row is a message lost on the way, and
//! counted; where the attachment is older, newer or absent nothing can be told of losses, and the message is taken all
//! the same.

use std::collections::{BTreeMap, VecDeque};
use std::sync::{Arc, Mutex};

use clearway_mapping::event::Cause;
use clearway_ros::{Frames, Kind};
use zenoh::Session;
use zenoh::pubsub::Subscriber;
use zenoh::sample::Sample;
use zenoh_ext::{AdvancedSubscriber, AdvancedSubscriberBuilderExt, HistoryConfig};

use crate::ingest::queue::EventQueue;
use crate::sync::locked;
use super::{Intake, PoseFrom};
use crate::config::Ros;
use crate::zenoh_session::ZenohError;

/// Publishers whose sequences are followed; more are taken, but not followed.
const PUBLISHERS_MAX: usize = 256;
/// Most messages believed to be missing at once: a sequence is a peer's word.
const MISSING_MAX: u64 = 1000;

/// What a vehicle listens to.
#[derive(Default)]
pub struct LiveTopics {
    topics: Vec<Subscriber<()>>,
    latched: Vec<AdvancedSubscriber<()>>,
}

impl LiveTopics {
    /// Ends listening; after this no message enters, and the door is let go.
    pub async fn stop(self) {
        for subscriber in self.topics {
            if let Err(error) = subscriber.undeclare().await {
                tracing::warn!(%error, "ros: subscriber");
            }
        }
        for subscriber in self.latched {
            if let Err(error) = subscriber.undeclare().await {
                tracing::warn!(%error, "ros: subscriber");
            }
        }
    }
}

/// Where the messages of a vehicle's topics meet.
struct Ear {
    intake: Intake,
    door: EventQueue,
    /// Newest sequence by publisher.
    sequences: BTreeMap<[u8; 16], i64>,
}

/// Listens to the configured topics; `sensors` are the vehicle's, by index.
///
/// # Errors
/// [`ZenohError`] with what zenoh says.
pub async fn subscribe<'a>(
    session: &Session,
    ros: &Ros,
    sensors: impl Iterator<Item = &'a String>,
    door: EventQueue,
) -> Result<LiveTopics, ZenohError> {
    let of = |(name, index): (&String, u16)| ros.sensors.get(name).map(|topic| (topic.clone(), index));
    let sensors: BTreeMap<String, u16> = sensors.zip(0..).filter_map(of).collect();
    let pose = match (ros.pose.as_str(), ros.fixed_frame.as_str()) {
        ("", "") => None,
        ("", fixed) => Some(PoseFrom::Frames { fixed: fixed.to_owned() }),
        (topic, _) => Some(PoseFrom::Topic(topic.to_owned())),
    };
    let pose_topic = (!ros.pose.is_empty()).then(|| ros.pose.clone());
    let topics: Vec<String> = sensors.keys().cloned().chain(pose_topic).chain([ros.tf.clone()]).collect();
    let intake = Intake::new(sensors, pose, &ros.ego_frame, Frames::default());
    let ear = Arc::new(Mutex::new(Ear { intake, door, sequences: BTreeMap::new() }));
    let mut listener = LiveTopics::default();
    for topic in topics.into_iter().filter(|topic| !topic.is_empty()) {
        let (key, ear) = (key(ros.domain, &topic), ear.clone());
        let subscriber = session.declare_subscriber(key.clone());
        let subscriber = subscriber.callback(move |sample| locked(&ear).hear(&topic, &sample));
        listener.topics.push(subscriber.await.map_err(ZenohError::of(format!("subscriber {key}")))?);
    }
    if !ros.tf_static.is_empty() {
        // Latched: what was said before we came is asked for.
        let (key, topic) = (key(ros.domain, &ros.tf_static), ros.tf_static.clone());
        let subscriber = session.declare_subscriber(key.clone());
        let subscriber = subscriber.callback(move |sample| locked(&ear).hear(&topic, &sample));
        let subscriber = subscriber.history(HistoryConfig::default().detect_late_publishers());
        listener.latched.push(subscriber.await.map_err(ZenohError::of(format!("subscriber {key}")))?);
    }
    Ok(listener)
}

fn key(domain: u32, topic: &str) -> String {
    format!("{domain}/{}/*/*", topic.trim_matches('/'))
}

impl Ear {
    /// Takes one sample, or counts why not. Never waits for the engine.
    fn hear(&mut self, topic: &str, sample: &Sample) {
        let missing = sample.attachment().map_or(0, |attachment| self.missing(&attachment.to_bytes()));
        self.door.record_drop(self.intake.source(topic), Cause::Queue, missing);
        let name = sample.key_expr().as_str().rsplit('/').nth(1).unwrap_or_default();
        let Some(kind) = Kind::from_name(name) else {
            tracing::info!(topic, name, "ros: not a type that is read");
            return self.refuse(topic, "ros_type");
        };
        let bytes = sample.payload().to_bytes().into_owned().into();
        let mut readings = VecDeque::new();
        if let Err(refused) = self.intake.take(topic, kind, 0, &bytes, &mut readings) {
            tracing::info!(topic, %refused, "ros: refused");
            return self.refuse(topic, refused.reason());
        }
        for reading in readings {
            if self.door.push(reading.source, reading.body).is_err() {
                return;
            }
        }
    }

    fn refuse(&self, topic: &str, reason: &'static str) {
        self.door.drops().record_refused_messages(self.intake.source(topic), reason, 1);
    }

    /// How many messages of its publisher are missing before this one.
    fn missing(&mut self, attachment: &[u8]) -> u64 {
        let Some((sequence, publisher)) = attachment_of(attachment) else { return 0 };
        if self.sequences.len() >= PUBLISHERS_MAX && !self.sequences.contains_key(&publisher) {
            return 0;
        }
        let before = self.sequences.insert(publisher, sequence).unwrap_or(sequence);
        u64::try_from(sequence.saturating_sub(before).saturating_sub(1)).map_or(0, |missing| missing.min(MISSING_MAX))
    }
}

/// Sequence and publisher of rmw_zenoh's attachment: i64, i64, a length of 16, the publisher.
fn attachment_of(bytes: &[u8]) -> Option<(i64, [u8; 16])> {
    let (sequence, rest) = bytes.split_first_chunk::<8>()?;
    let (_stamp, rest) = rest.split_first_chunk::<8>()?;
    let publisher = rest.strip_prefix(&[16])?.try_into().ok()?;
    Some((i64::from_le_bytes(*sequence), publisher))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_attachment_is_read_whole_or_not_at_all() {
        let mut bytes = [&7_i64.to_le_bytes()[..], &9_i64.to_le_bytes(), &[16], &[3; 16]].concat();
        assert_eq!(attachment_of(&bytes), Some((7, [3; 16])));
        for end in 0..bytes.len() {
            assert_eq!(attachment_of(&bytes[..end]), None);
        }
        bytes.push(0);
        assert_eq!(attachment_of(&bytes), None);
    }

    #[test]
    fn a_topic_has_rmw_zenohs_key() {
        assert_eq!(key(7, "/sensing/top/points"), "7/sensing/top/points/*/*");
    }
}
