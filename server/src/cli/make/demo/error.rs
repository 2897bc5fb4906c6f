//! Why a demo ended, and why it drew no picture.

use std::path::PathBuf;

use clearway_daemon::run::StartError;

/// What to do about a port that was free when the demo looked and in use when its server started, as happens to two
/// demos that start at once; else nothing.
fn hint(error: &StartError) -> &'static str {
    match error {
        StartError::Listen { source, .. } if source.kind() == std::io::ErrorKind::AddrInUse => {
            "; another program took this port just now: start the demo again, or with --any-port"
        }
        _ => "",
    }
}

/// The errors that end a demo.
#[derive(Debug, thiserror::Error)]
pub enum DemoError {
    /// The server did not start.
    #[error("{}{}", .0, hint(.0))]
    Start(StartError),
    /// The server did not shut down as it should.
    #[error(transparent)]
    End(#[from] clearway_daemon::run::ShutdownError),
    /// The simulated car could not send datagrams.
    #[error("the simulated car: {0}")]
    Vehicle(#[from] std::io::Error),
    /// The simulated car could not send scans, poses or roads.
    #[error("the simulated car: {0}")]
    Observation(#[from] clearway_client::ClientError),
}

impl From<StartError> for DemoError {
    fn from(error: StartError) -> Self {
        Self::Start(error)
    }
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_port_that_was_taken_meanwhile_is_named_with_what_to_do() {
        let error = |kind| {
            let at = "127.0.0.1:50051".parse().unwrap();
            DemoError::from(StartError::Listen { what: "grpc", at, source: std::io::Error::from(kind) }).to_string()
        };
        let taken = error(std::io::ErrorKind::AddrInUse);
        assert!(taken.starts_with("grpc.listen 127.0.0.1:50051: ") && taken.ends_with("with --any-port"), "{taken}");
        assert!(!error(std::io::ErrorKind::PermissionDenied).contains("--any-port"));
    }
}
