//! The topic, schema and encoding of a channel -> the kind of its messages.

use clearway_ros::Kind;

/// One channel of an MCAP file.
#[derive(Clone, Debug, PartialEq)]
pub struct Channel {
    /// The topic, such as `/<vehicle>/map/<layer>`.
    pub topic: String,
    /// The name of the schema, such as `clearway.v1.Map`.
    pub schema: String,
    /// The encoding of the messages, such as `cdr` or `ros1`.
    pub encoding: String,
    /// The kind of the messages.
    pub content: Content,
}

/// The kind of the messages of a channel.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Content {
    /// Events of a vehicle's journal.
    Journal {
        /// Name of the vehicle.
        vehicle: String,
    },
    /// Maps of a vehicle, with one layer each.
    Map {
        /// Name of the vehicle.
        vehicle: String,
        /// Name of the layer in each map.
        layer: String,
    },
    /// Digests of a vehicle's maps, with one layer each.
    Digest {
        /// Name of the vehicle.
        vehicle: String,
        /// Name of the layer in each map.
        layer: String,
    },
    /// Keyframes of a vehicle.
    Keyframe {
        /// Name of the vehicle.
        vehicle: String,
    },
    /// Counts of the recorder.
    Counts,
    /// ROS 2 messages in CDR.
    Ros(Kind),
    /// Any channel that is none of these.
    Other,
}

impl Content {
    /// The kind of the messages of a channel, by its topic, the name of its schema, and its encoding.
    pub(super) fn of(topic: &str, schema: &str, encoding: &str) -> Content {
        // A bag that was converted from ROS 1 has the same types in another encoding.
        if let Some(kind) = Kind::from_name(schema).filter(|_| encoding == "cdr") {
            return Content::Ros(kind);
        }
        let parts: Vec<&str> = topic.split('/').collect();
        match (schema, &parts[..]) {
            ("clearway.v1.Event", ["", vehicle, "journal"]) => Content::Journal { vehicle: (*vehicle).into() },
            ("clearway.v1.Map", ["", vehicle, "map", layer]) => {
                Content::Map { vehicle: (*vehicle).into(), layer: (*layer).into() }
            }
            ("clearway.v1.MapDigest", ["", vehicle, "digest", layer]) => {
                Content::Digest { vehicle: (*vehicle).into(), layer: (*layer).into() }
            }
            ("clearway.v1.Keyframe", ["", vehicle, "keyframe"]) => Content::Keyframe { vehicle: (*vehicle).into() },
            ("clearway.v1.RecordingCounts", ["", "recorder", "counts"]) => Content::Counts,
            _ => Content::Other,
        }
    }
}
