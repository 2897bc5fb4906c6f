//! Clearway in one process, on loopback: a simulated car sends real UDP datagrams in real time to a server of its own,
//! and with many sensors scans, poses and roads over real gRPC. Once a second the state is reported.
//!
//! | file | in -> out |
//! |---|---|
//! | [`command`] | command line -> [`Options`], reports -> stdout |
//! | [`run`] | [`Options`] -> a server, a car, reports |
//! | [`sensors`] | the choice of sensors, this machine -> the model on the roof |
//! | [`rig`] | scene, sensors -> the vehicle's configuration, datagrams, observations |
//! | [`car`] | rig, clock -> UDP and gRPC in real time |
//! | [`report`] | status -> a line, or JSON |
//! | [`error`] | why a demo ended |

pub mod car;
pub mod command;
pub mod error;
pub mod report;
pub mod rig;
pub mod run;
pub mod sensors;

pub use error::DemoError;
pub use run::{Endpoints, Options, demo};
