//! Why a demo ended.

use std::path::PathBuf;

use crate::server::StartError;

/// The errors that end a demo.
#[derive(Debug, thiserror::Error)]
pub enum DemoError {
    /// The server did not start.
    #[error(transparent)]
    Start(#[from] StartError),
    /// The server did not shut down as it should.
    #[error(transparent)]
    End(#[from] crate::server::ShutdownError),
    /// The picture could not be drawn or written.
    #[error("picture {}: {reason}", file.display())]
    Picture {
        /// The file.
        file: PathBuf,
        /// The cause.
        reason: String,
    },
    /// The simulated car could not send datagrams.
    #[error("the simulated car: {0}")]
    Vehicle(#[from] std::io::Error),
    /// The simulated car could not send scans, poses or roads.
    #[error("the simulated car: {0}")]
    Observation(#[from] clearway_client::ClientError),
}
