//! The simulated sensors: rays, firings, scans, and the datagrams that contain them.

pub mod encode;
pub mod planes;
pub mod raycast;
pub mod scanner;
pub mod telemetry;
