//! Recordings: every event and every map of a run in one MCAP file.
//!
//! | file | in -> out |
//! |---|---|
//! | [`writer`] | events and maps -> queue -> recorder thread |
//! | [`mcap_file`] | events and maps -> bytes of the MCAP file |
//! | [`mcap_reader`] | any MCAP file -> its header and its messages |
//! | [`reader`] | those messages -> events, maps, ROS 2 messages |
//! | [`verify`] | recording -> differences between the recorded maps and the maps of the recorded events |
//! | [`compare`] | two sets of maps of one drive -> changed cells, gained and lost free space |

mod chunk;
pub mod compare;
pub mod mcap_file;
pub mod mcap_reader;
pub mod reader;
pub mod verify;
pub mod writer;
