//! Events in, maps out: the papers' algorithms as pure functions of the events.
//!
//! | file | in -> out |
//! |---|---|
//! | [`event`] | what enters: datagrams, scans, ego poses, roads, declared sensors, losses |
//! | [`config`] | the configuration of one vehicle: its sensors and maps |
//! | [`pipeline`] | `step(&Event)` -> map; names the hops below in the order of the data |
//! | `event_time` | arrivals of events -> a time that does not run backwards |
//! | `inputs` | event -> what it changes: sensors, motion, roads |
//! | [`sensor`] | one sensor's events -> its newest scan, ego frame at one stamp |
//! | [`road`] | RDDF and RNDF files, road events -> the newest checked roads |
//! | [`ledger`] | every event and its outcome -> counts |
//! | [`error`] | why an event is refused |
//! | `fusion` | the newest scans of all sensors -> the points of one map; the reference sensor |
//! | [`memory`] | the points of earlier maps -> the points that the newest map lacks |
//! | [`ground`] | the points of one map -> height of the local ground, shared by all layers |
//! | [`reach`] | the points of one map and their ground -> obstacles, and what the vehicle can reach |
//! | [`layer`] | the points of one map -> one layer for each of the seven maps |
//! | [`map`] | what a map contains |
//! | `azimuth_columns`, `value_check` | position -> column of azimuth; value of a key -> error |
//! | [`vehicle_outline`] | the vehicle, seen from above |
//! | `wide` | a loop over points -> the same with the widest registers of the processor |
//! | [`scan_file`] | KITTI `.bin`, nuScenes `.pcd.bin`, `.pcd` -> scan |

// The core is pure: server/core/clippy.toml lists what it must not use.
#![deny(clippy::disallowed_methods, clippy::disallowed_types)]

mod azimuth_columns;
pub mod config;
pub mod error;
pub mod event;
mod event_time;
mod fusion;
pub mod ground;
mod inputs;
pub mod layer;
pub mod ledger;
pub mod map;
mod map_ground;
pub mod memory;
pub mod pipeline;
pub mod reach;
pub mod road;
pub mod scan_file;
pub mod sensor;
mod value_check;
pub mod vehicle_outline;
mod wide;
