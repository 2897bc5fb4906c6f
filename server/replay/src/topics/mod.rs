//! Topics of a ROS 2 bag.
//!
//! | file | in -> out |
//! |---|---|
//! | [`available`] | MCAP file -> its topics, frames and refused transforms |
//! | [`choice`] | topics of an MCAP file -> the topics to decode |

pub mod available;
pub mod choice;
