//! ROS 2 messages of chosen topics -> readings, from an MCAP file or live.
//!
//! | file | in -> out |
//! |---|---|
//! | [`decoder`] | messages of the chosen topics -> readings |
//! | [`choice`] | topics of an MCAP file -> the topics to decode |
//! | `live` | topics of a running ROS 2 system over zenoh -> event queue |

pub mod choice;
pub mod decoder;
#[cfg(feature = "zenoh")]
pub mod live;
