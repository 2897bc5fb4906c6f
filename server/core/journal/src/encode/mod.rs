//! Maps and events -> bytes, and events from bytes: the only translation between the core's types and the wire's.
//!
//! | file | in -> out |
//! |---|---|
//! | [`map`] | map -> header chunk and layer chunks, once |
//! | `replayed` | the header of a map -> its header in a replay |
//! | [`payload_cache`] | an encoded map -> a region of it, a delta of it, once for all readers that need the same |
//! | [`event`] | event <-> the journal's bytes; observations -> event bodies |

pub mod event;
pub mod map;
pub mod payload_cache;
mod replayed;

pub use event::{
    EventDecodeError, ego_pose_from_proto, event_from_bytes, event_to_proto, road_from_proto, scan_from_proto,
    sensor_from_proto,
};
pub use map::{EncodedMap, as_served, as_served_with, meaning, sensor};
pub use replayed::{Replayed, lag_ns};
