//! Decoded maps -> colours, and messages of viewers. The encoding itself is `clearway_journal::encode`.
//!
//! | file | in -> out |
//! |---|---|
//! | [`palette`] | a value or an id -> its colour |
//! | [`colours`] | a layer -> the colour of each cell |
//! | [`viewer`] | a decoded map -> ROS 2 and Foxglove messages |

pub mod colours;
pub mod palette;
pub mod viewer;
