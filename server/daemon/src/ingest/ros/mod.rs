//! ROS 2 messages of chosen topics -> readings, from an MCAP file or live.
//!
//! | file | in -> out |
//! |---|---|
//! | [`decoder`] | messages of the chosen topics -> readings |
//! | [`available`] | MCAP file -> its topics, frames and refused transforms |
//! | [`choice`] | topics of an MCAP file -> the topics to decode |
//! | `live` | topics of a running ROS 2 system over zenoh -> event queue |

pub mod available;
pub mod choice;
pub mod decoder;
#[cfg(feature = "zenoh")]
pub mod live;
