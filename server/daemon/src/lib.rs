//! What runs on a vehicle, around Clearway's core: everything with a clock, socket, thread, file or log. The core is
//! `clearway-lidar` and `clearway-mapping`.
//!
//! The files, in the order in which a datagram passes them:
//!
//! | file | in -> out |
//! |---|---|
//! | [`config`] | one TOML file -> vehicles, sources, publishers, recorder |
//! | [`ingest`] | datagrams, observations, ROS 2 messages -> numbered events on one queue a vehicle |
//! | [`engine`] | events -> journal, step of the pipeline, encoded maps, of the layers that readers want |
//! | [`viewer`] | map -> pictures, clouds and grids of viewers: the page, Foxglove, ROS 2 |
//! | [`fleet`] | announcements of other servers -> their vehicles, and where they are served |
//! | [`publish`] | newest map -> gRPC, zenoh, ROS 2, Foxglove, page |
//! | [`record`] | events and maps -> MCAP file |
//! | [`replay_control`] | requests of clients -> commands for a replay; the state of the replay -> clients |
//! | `store` | finished recordings -> a folder or a bucket, with an index; a search -> recordings |
//! | [`status`] | ledger, rates and latency of each vehicle |
//! | [`run`] | starts and stops all of these |
//! | [`traces`] | the hops of each map -> spans of a trace, to a collector |
//!
//! At the ground, used by all: [`base`] and `zenoh_session`.

pub mod base;
pub mod config;
pub mod engine;
pub mod fleet;
pub mod ingest;
pub mod publish;
pub mod record;
pub mod replay_control;
pub mod run;
pub mod status;
#[cfg(feature = "store")]
pub mod store;
pub mod traces;
pub mod viewer;
#[cfg(feature = "zenoh")]
pub mod zenoh_session;
