//! Recordings -> whether each of their maps is the map of its events, or what a change made of them.
//!
//! | file | in -> out |
//! |---|---|
//! | [`files`] | paths and patterns of the command line, a shard -> files |
//! | [`checked`] | files -> the result of each, several at a time |
//! | `same_drive` | two recordings -> whether they are of one drive |
//! | [`table`] | results -> text |
//! | [`report`] | results -> JSON, JUnit XML |

pub mod checked;
pub mod files;
pub mod report;
mod same_drive;
pub mod table;
