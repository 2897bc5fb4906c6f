//! The recording format: every event and every map of a run in one MCAP file, read, verified, compared and repaired.
//! No socket, no thread, no clock.
//!
//! | file | in -> out |
//! |---|---|
//! | [`encode`] | map -> bytes, once; event <-> bytes of the journal |
//! | [`mcap_file`] | events and maps -> bytes of the MCAP file |
//! | `mcap_records`, `chunk` | the bytes of any MCAP file -> its records, and the parts that cannot be read |
//! | `bag_records` | a ROS 2 bag in sqlite -> the same records |
//! | `file_records` | a file of either kind -> its records |
//! | `header` | metadata and attachments -> what a recording says before its messages |
//! | `message_order` | events and maps -> whether they stand as they were written |
//! | `record_counts` | records -> how many there are, and how many there should be |
//! | `mcap_summary` | the end of an MCAP file -> its schemas, its channels, and the places of its records |
//! | [`channel`] | the topic, schema and encoding of a channel -> the kind of its messages |
//! | [`mcap_reader`] | those records -> the header and the messages |
//! | [`damage`] | a part that cannot be read -> what is lost with it |
//! | [`reader`] | those messages -> events, maps, ROS 2 messages |
//! | [`repair`] | damaged recording -> a whole one with all that can be read |
//! | [`verify`] | recording -> differences between the recorded maps and the maps of the recorded events |
//! | [`compare`] | two sets of maps of one drive -> changed cells, gained and lost free space |
//! | [`counted`], [`file_advice`] | a count -> text for people; an error of a file -> what to do |

// clippy.toml beside Cargo.toml lists what the journal must not use.
#![deny(clippy::disallowed_methods, clippy::disallowed_types)]

#[cfg(feature = "sqlite")]
mod bag_records;
pub mod channel;
mod chunk;
pub mod compare;
pub mod counted;
pub mod damage;
pub mod encode;
pub mod file_advice;
mod file_records;
mod header;
pub mod mcap_file;
pub mod mcap_reader;
mod mcap_records;
mod mcap_summary;
mod message_order;
pub mod reader;
mod record_counts;
pub mod repair;
pub mod verify;

use clearway_lidar::calibration::Calibration;
use clearway_mapping::config::VehicleConfig;
use serde::{Deserialize, Serialize};

/// What a recording holds of the maps. Every recording has all events, from which a replay makes the maps.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum RecordedMaps {
    /// The encoded maps with all their layers.
    #[default]
    Full,
    /// The header and the SHA-256 of each layer: enough to verify that a replay makes the same bytes.
    Digest,
    /// No maps and no digests.
    None,
}

impl RecordedMaps {
    /// The name in the configuration and in the metadata of a recording.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Full => "full",
            Self::Digest => "digest",
            Self::None => "none",
        }
    }
}

/// What makes the maps of one vehicle from its events: a configuration, and a calibration table for each sensor that
/// has one.
#[derive(Clone, Debug)]
pub struct RecordedVehicle {
    /// Configuration of the vehicle's pipeline.
    pub config: VehicleConfig,
    /// The calibration tables, by sensor.
    pub tables: Vec<Option<Calibration>>,
}
