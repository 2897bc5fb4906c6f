//! Encoded maps -> pictures, and messages of viewers. The encoding itself is `clearway_journal::encode`.
//!
//! | file | in -> out |
//! |---|---|
//! | [`palette`] | a value or an id -> its colour |
//! | [`picture`] | a layer -> PNG |
//! | `legend`, `font` | classes and colours -> the strip under a picture; a letter -> its dots |
//! | [`viewer`] | a decoded map -> ROS 2 and Foxglove messages |

mod font;
mod legend;
mod palette;
pub mod picture;
pub mod viewer;
