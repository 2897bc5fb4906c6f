//! Topics of a ROS 2 bag.
//!
//! | file | in -> out |
//! |---|---|
//! | [`available`] | files of a bag -> their topics, frames and refused transforms |
//! | [`choice`] | topics of a bag -> the topics to decode |

pub mod available;
pub mod choice;
