//! Maps and events -> bytes, and events from bytes.
//!
//! | file | in -> out |
//! |---|---|
//! | [`map`] | map -> header chunk and layer chunks, once |
//! | [`payload_cache`] | an encoded map -> a region of it, a delta of it, once for all readers that need the same |
//! | [`event`] | event <-> the journal's bytes; observations -> event bodies |
//! | [`palette`] | a value or an id -> its colour |
//! | [`picture`] | a layer -> PNG |
//! | `legend`, `font` | classes and colours -> the strip under a picture; a letter -> its dots |
//! | [`viewer`] | a decoded map -> ROS 2 and Foxglove messages |

pub mod event;
mod font;
mod legend;
pub mod map;
mod palette;
pub mod payload_cache;
pub mod picture;
pub mod viewer;

pub use event::{EventDecodeError, event_from_bytes, event_to_proto};
pub(crate) use event::{ego_pose_from_proto, road_from_proto, scan_from_proto, sensor_from_proto};
#[cfg(test)]
pub(crate) use map::meaning;
pub(crate) use map::sensor;
pub use map::{EncodedMap, Replayed, as_served, as_served_with};
