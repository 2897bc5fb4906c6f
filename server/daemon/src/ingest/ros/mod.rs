//! ROS 2 messages of chosen topics -> readings, from an MCAP file or live.
//!
//! | file | in -> out |
//! |---|---|
//! | [`decoder`] | messages of the chosen topics -> readings |
//! | `live` | topics of a running ROS 2 system over zenoh -> event queue |

pub mod decoder;
#[cfg(feature = "zenoh")]
pub mod live;
