//! What happens to one sensor: its datagrams and scans become points in the ego frame at one stamp.
//!
//! | file | in -> out |
//! |---|---|
//! | `pipeline` | one sensor's events -> its newest scan |
//! | `scan` | the newest scan of one sensor, as fusion and layers read it |
//! | [`motion`] | ego poses, speed + revolution -> how the ego frame moved through it; steps of clocks |
//! | [`self_filter`] | return -> the reason to remove it, if it does not belong to the surroundings |
//! | [`sweep`] | revolution or scan + mount -> [`sweep::Sweep`] in the ego frame |
//! | `transform` | point -> the same point in another frame |
//! | [`deviation`] | deviation of a range -> whole number |
//! | [`distance_series`] | revolution -> how far each range deviates from its laser's neighbouring ranges |
//! | [`ring_series`] | scan with rings -> the same for each of its points |
//! | [`rays`] | revolution -> directions of the rays without a return; what layers read |
//! | `state` | what a map states about a sensor |
//! | `observation`, `config` | a scan, an ego pose; the table `[[vehicle.sensor]]` |
//! | `model_check` | scan, configured model -> error if the scan cannot be one of it |
//! | `rings` | scan -> elevations of the lasers, rings of the points |
//! | [`mount`] | revolutions -> height, pitch and roll of a sensor; scans -> the ground's deviation from its mount |

pub(crate) mod config;
pub mod deviation;
pub mod distance_series;
mod model_check;
pub mod motion;
pub mod mount;
pub(crate) mod observation;
pub(crate) mod pipeline;
pub mod rays;
pub mod ring_series;
pub(crate) mod rings;
pub(crate) mod scan;
pub mod self_filter;
pub(crate) mod state;
pub mod sweep;
mod transform;
