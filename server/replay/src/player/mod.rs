//! Steps engines with recorded readings in one thread: in recorded time, at a rate, with pauses, steps and jumps.
//!
//! | file | in -> out |
//! |---|---|
//! | [`timeline`] | files of one or several vehicles -> readings in the order of recorded time |
//! | [`faults`] | readings -> the same drive with lost sensors, packets, poses that jump |
//! | [`clock`] | recorded time -> when an event is due, and how far its stamps move |
//! | [`snapshots`] | vehicles at some moments -> the last one before another moment |
//! | [`outcome`] | how a replay ended, or why it cannot go on |
//! | [`vehicle`] | one vehicle: its engine and its queue |
//! | [`play`] | readings, commands -> stepped engines |
//!
//! A jump goes back to a copy of the pipelines and applies every event from there to the requested moment without
//! publishing, so its maps equal the maps of a replay without jumps, with all that they remember.

pub mod clock;
pub mod faults;
pub mod outcome;
pub mod play;
pub mod snapshots;
pub mod timeline;
pub mod vehicle;
