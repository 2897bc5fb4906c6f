//! The subcommands that send sensor data.
//!
//! | file | in -> out |
//! |---|---|
//! | `send` | files -> a server, as datagrams over UDP |
//! | `ingest` | files -> a server, as observations over gRPC or zenoh |
//! | `simulate` | a simulated scene -> a capture, or datagrams over UDP |

pub(super) mod ingest;
pub(super) mod send;
#[cfg(feature = "sim")]
pub(super) mod simulate;
