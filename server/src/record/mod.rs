//! Recordings: every event and every map of a run in one MCAP file.
//!
//! | file | in -> out |
//! |---|---|
//! | [`writer`] | events and maps -> MCAP |
//! | [`reader`] | MCAP -> events and maps |
//! | [`verify`] | recording -> are these the maps of these events? |

pub mod reader;
pub mod verify;
pub mod writer;
