//! Topics of a running ROS 2 system with rmw_zenoh -> event queue, without a bridge.
//!
//! rmw_zenoh publishes a topic under `<domain>/<topic>/<type>/<hash>`: the type in DDS spelling, the payload CDR. Any
//! hash is accepted: ROS 2 Humble writes none, and the bytes of a type with another layout are refused when they are
//! decoded. The attachment contains sequence, stamp and publisher. A gap in the sequence of a publisher means lost
//! messages, which are counted. Without a readable attachment losses are not counted, and the message is accepted.

use std::collections::{BTreeMap, VecDeque};
use std::sync::{Arc, Mutex};
use std::time::Instant;

use clearway_mapping::event::Cause;
use clearway_ros::{Frames, Kind, RefusedPart};
use zenoh::Session;
use zenoh::pubsub::Subscriber;
use zenoh::sample::Sample;
use zenoh_ext::{AdvancedSubscriber, AdvancedSubscriberBuilderExt, HistoryConfig};

use super::decoder::{PoseSource, TopicDecoder};
use crate::base::sync::locked;
use crate::config::Ros;
use crate::ingest::queue::{Arrival, EventQueue, LiveReading};
use crate::ingest::sensor_senders::SensorSender;
use crate::zenoh_session::ZenohError;

/// Greatest number of publishers whose sequences are checked; messages of further publishers are accepted unchecked.
const PUBLISHERS_MAX: usize = 256;
/// Greatest number of lost messages that one gap counts, because a peer may send any sequence.
const LOST_MAX: u64 = 1000;

/// The subscriptions of one vehicle.
pub struct LiveTopics {
    vehicle: Arc<str>,
    topics: Vec<Subscriber<()>>,
    latched: Vec<AdvancedSubscriber<()>>,
}

impl LiveTopics {
    /// Ends the subscriptions; no message enters the queue after this.
    pub async fn stop(self) {
        for subscriber in self.topics {
            if let Err(error) = subscriber.undeclare().await {
                tracing::warn!(vehicle = %self.vehicle, %error, "ros: subscriber");
            }
        }
        for subscriber in self.latched {
            if let Err(error) = subscriber.undeclare().await {
                tracing::warn!(vehicle = %self.vehicle, %error, "ros: subscriber");
            }
        }
    }
}

/// Receives the samples of all topics of one vehicle.
struct SampleReceiver {
    vehicle: Arc<str>,
    decoder: TopicDecoder,
    queue: EventQueue,
    /// Newest sequence by publisher.
    sequences: BTreeMap<[u8; 16], i64>,
}

/// Subscribes to the configured topics of `vehicle`; `sensors` are the names of its sensors, by index.
///
/// # Errors
/// [`ZenohError`] if a subscriber cannot be declared.
pub async fn subscribe<'a>(
    session: &Session,
    ros: &Ros,
    vehicle: &str,
    sensors: impl Iterator<Item = &'a String>,
    queue: EventQueue,
) -> Result<LiveTopics, ZenohError> {
    let topic_of = |(name, index): (&String, u16)| ros.sensors.get(name).map(|topic| (topic.clone(), index));
    let sensors: BTreeMap<String, u16> = sensors.zip(0..).filter_map(topic_of).collect();
    let pose = match (ros.pose.as_str(), ros.fixed_frame.as_str()) {
        ("", "") => None,
        ("", fixed) => Some(PoseSource::Frames { fixed: fixed.to_owned() }),
        (topic, _) => Some(PoseSource::Topic(topic.to_owned())),
    };
    let pose_topic = (!ros.pose.is_empty()).then(|| ros.pose.clone());
    let topics: Vec<String> = sensors.keys().cloned().chain(pose_topic).chain([ros.tf.clone()]).collect();
    let decoder = TopicDecoder::new(sensors, pose, &ros.ego_frame, Frames::default()).posed_in(&ros.fixed_frame);
    let receiver =
        Arc::new(Mutex::new(SampleReceiver { vehicle: vehicle.into(), decoder, queue, sequences: BTreeMap::new() }));
    let mut subscribed = LiveTopics { vehicle: vehicle.into(), topics: Vec::new(), latched: Vec::new() };
    for topic in topics.into_iter().filter(|topic| !topic.is_empty()) {
        let (key, receiver) = (key(ros.domain, &topic), receiver.clone());
        let subscriber = session.declare_subscriber(key.clone());
        let subscriber = subscriber.callback(move |sample| locked(&receiver).push(&topic, &sample));
        subscribed.topics.push(subscriber.await.map_err(ZenohError::of(format!("subscriber {key}")))?);
    }
    if !ros.tf.is_empty() {
        // Latched: the subscriber also requests the messages that were published before it came.
        let topic = format!("{}_static", ros.tf);
        let key = key(ros.domain, &topic);
        let subscriber = session.declare_subscriber(key.clone());
        let subscriber = subscriber.callback(move |sample| locked(&receiver).push(&topic, &sample));
        let subscriber = subscriber.history(HistoryConfig::default().detect_late_publishers());
        subscribed.latched.push(subscriber.await.map_err(ZenohError::of(format!("subscriber {key}")))?);
    }
    Ok(subscribed)
}

fn key(domain: u32, topic: &str) -> String {
    format!("{domain}/{}/*/*", topic.trim_matches('/'))
}

impl SampleReceiver {
    /// Decodes one sample and pushes its readings, or counts the refusal. Never waits for the engine.
    fn push(&mut self, topic: &str, sample: &Sample) {
        let numbered = sample.attachment().and_then(|attachment| decode_attachment(&attachment.to_bytes()));
        let lost = numbered.map_or(0, |(sequence, publisher)| self.lost_before(sequence, publisher));
        let name_of = |(_, publisher)| format!("ROS publisher {:032x}", u128::from_be_bytes(publisher));
        let sender = numbered.map(name_of).map(|name| SensorSender::Named(name.into()));
        self.queue.record_drop(self.decoder.source(topic), Cause::Queue, lost);
        let name = sample.key_expr().as_str().rsplit('/').nth(1).unwrap_or_default();
        let Some(kind) = Kind::from_name(name) else {
            tracing::info!(vehicle = %self.vehicle, topic, name, "ros: a type that is not decoded");
            return self.record_refusal(topic, "ros_type");
        };
        let bytes = sample.payload().to_bytes().into_owned().into();
        let mut readings = VecDeque::new();
        match self.decoder.decode(topic, kind, 0, &bytes, &mut readings) {
            Ok(refused) => self.record_refused_parts(topic, &refused),
            Err(error) => {
                tracing::info!(vehicle = %self.vehicle, topic, %error, "ros: refused");
                return self.record_refusal(topic, error.reason());
            }
        }
        let now = Instant::now();
        for reading in readings {
            if let Some(sender) = &sender {
                self.queue.drops().senders.note(reading.source, &reading.body, sender, now);
            }
            if self.queue.push([LiveReading::new(Arrival::Now, reading.source, reading.body)]).is_err() {
                return;
            }
        }
    }

    fn record_refused_parts(&self, topic: &str, refused: &[RefusedPart]) {
        for RefusedPart { what, count, fault } in refused {
            tracing::info!(vehicle = %self.vehicle, topic, what, count, %fault, "ros: a part of a message refused");
            self.queue.drops().record_refused_parts(*count);
        }
    }

    fn record_refusal(&self, topic: &str, reason: &'static str) {
        self.queue.drops().record_refused_messages(self.decoder.source(topic), reason, 1);
    }

    /// Number of messages of the same publisher that were lost before this message.
    fn lost_before(&mut self, sequence: i64, publisher: [u8; 16]) -> u64 {
        if self.sequences.len() >= PUBLISHERS_MAX && !self.sequences.contains_key(&publisher) {
            return 0;
        }
        let before = self.sequences.insert(publisher, sequence).unwrap_or(sequence);
        u64::try_from(sequence.saturating_sub(before).saturating_sub(1)).map_or(0, |lost| lost.min(LOST_MAX))
    }
}

/// Sequence and publisher of rmw_zenoh's attachment, which is: sequence (i64), stamp (i64), the length 16, publisher.
fn decode_attachment(bytes: &[u8]) -> Option<(i64, [u8; 16])> {
    let (sequence, rest) = bytes.split_first_chunk::<8>()?;
    let (_stamp, rest) = rest.split_first_chunk::<8>()?;
    let publisher = rest.strip_prefix(&[16])?.try_into().ok()?;
    Some((i64::from_le_bytes(*sequence), publisher))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_attachment_of_any_other_length_is_not_decoded() {
        let mut bytes = [&7_i64.to_le_bytes()[..], &9_i64.to_le_bytes(), &[16], &[3; 16]].concat();
        assert_eq!(decode_attachment(&bytes), Some((7, [3; 16])));
        for end in 0..bytes.len() {
            assert_eq!(decode_attachment(&bytes[..end]), None);
        }
        bytes.push(0);
        assert_eq!(decode_attachment(&bytes), None);
    }

    #[test]
    fn a_topic_has_the_key_of_rmw_zenoh() {
        assert_eq!(key(7, "/sensing/top/points"), "7/sensing/top/points/*/*");
    }
}
