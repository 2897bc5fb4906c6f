//! What happens to one sensor: its datagrams and scans become points in the ego frame at one stamp.
//!
//! | file | in -> out |
//! |---|---|
//! | [`pipeline`] | one sensor's events -> its newest scan |
//! | [`rings`] | a scan's rings -> elevations of the lasers that drew them |
//! | [`self_filter`] | returns on or behind the vehicle itself |
//! | [`mount`] | first revolutions -> height, pitch and roll of a sensor nobody measured |
//! | [`motion`] | ego poses, speed + revolution -> where the vehicle was at each firing |
//! | [`sweep`] | revolution or scan + extrinsics -> [`sweep::Sweep`] in the ego frame |
//! | [`distance_series`] | revolution -> how far each range lies from its laser's neighbouring ones |

pub mod distance_series;
pub mod motion;
pub mod mount;
pub(crate) mod pipeline;
pub(crate) mod rings;
pub mod self_filter;
pub mod sweep;
