//! The shell around Clearway's core: doors, engines, publishers, recorder, replay. All clocks, sockets, threads and
//! logs of the house are in here.
//!
//! The files, in the order a datagram meets them:
//!
//! | file | in -> out |
//! |---|---|
//! | [`config`] | one TOML -> what is served where, recorded, and which vehicles there are |
//! | [`ingest`] | datagrams, observations, ROS 2 messages, files -> numbered events on one queue a vehicle: the door |
//! | [`demand`] | readers -> which layers are to be made |
//! | [`engine`] | events -> journal, step, encoded maps |
//! | [`wire`] | map -> bytes, once; event <-> the journal's bytes |
//! | [`cuts`] | those bytes -> a region of them, a delta, once |
//! | [`publish`] | newest map -> gRPC, zenoh, ROS 2, Foxglove, page |
//! | [`record`] | every event and every map -> MCAP |
//! | [`recording`] | MCAP -> events and maps |
//! | [`replay`] | files -> maps, as live |
//! | [`clouds`] | revolutions -> PCD files |
//! | [`verify`] | recording -> are these the maps of these events? |
//! | [`evaluate`] | labelled scans, simulated scenes -> how right each map is |
//! | [`demo`] | a simulated vehicle against the whole of it |
//! | [`status`] | ledger, rates, latency of each vehicle |
//! | [`server`] | all of it, put together |

pub mod cli;
pub mod config;
pub mod encode;
pub mod engine;
pub mod ingest;
pub mod publish;
pub mod record;
pub mod server;
pub mod status;
pub mod subscriptions;
