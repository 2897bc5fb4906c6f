//! Clearway in one process, on loopback: a simulated car sends real UDP datagrams in real time to a server of its own,
//! and with many sensors scans, poses and roads over real gRPC. Once a second the state is reported.
//!
//! | file | in -> out |
//! |---|---|
//! | [`run`] | [`DemoOptions`] -> a server, a car, reports |
//! | [`sensors`] | the choice of sensors, this machine -> the model on the roof |
//! | [`rig`] | scene, sensors -> the vehicle's configuration, datagrams, observations |
//! | `fleet` | sensors, a server -> the cars that drive at it |
//! | [`car`] | rig, clock -> UDP and gRPC in real time |
//! | [`report`] | status -> a line |

pub mod car;
mod fleet;
pub mod report;
pub mod rig;
pub mod run;
pub mod sensors;

pub use run::{DemoEndpoints, DemoOptions, demo};
