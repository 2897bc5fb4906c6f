//! Why a demo ended, and why it drew no picture.

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
    /// The simulated car could not send datagrams.
    #[error("the simulated car: {0}")]
    Vehicle(#[from] std::io::Error),
    /// The simulated car could not send scans, poses or roads.
    #[error("the simulated car: {0}")]
    Observation(#[from] clearway_client::ClientError),
}

/// The newest map could not be drawn, or its picture not written. The demo goes on.
#[derive(Debug, thiserror::Error)]
#[error("picture {}: {reason}", file.display())]
pub struct PictureError {
    /// The file.
    pub file: PathBuf,
    /// The cause.
    pub reason: String,
}
