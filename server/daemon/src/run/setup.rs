//! The parameters of a server, and the errors of its start and its end.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use crate::base::held_sockets::HeldSockets;
use crate::config::{Calibrations, Certificates, Config};
use crate::engine::Observer;
use crate::ingest::udp;
use crate::record::writer::{IncompleteRecordingError, RecordError};
use crate::replay_control::ReplayHandle;

/// The parameters of a server.
#[derive(Default)]
pub struct Setup {
    /// The configuration, checked.
    pub config: Config,
    /// The calibration tables of all sensors, as [`Config::calibrations`] returns them.
    pub calibrations: Calibrations,
    /// The certificates, as [`Config::certificates`] returns them; without them all listeners are plain text.
    pub certificates: Option<Certificates>,
    /// Identifies this run in maps and recordings; a random number if absent.
    pub boot_id: Option<u64>,
    /// True if the events come from files: then a full recorder queue delays them, so that nothing is lost.
    pub from_files: bool,
    /// Comment lines before the recorded configuration.
    pub config_comments: Vec<String>,
    /// Further metadata of the recording, by name.
    pub metadata: BTreeMap<String, String>,
    /// Is called after each revolution of the first vehicle.
    pub observer: Option<Observer>,
    /// True if the caller steps the engines ([`Running::stepped`](super::Running::stepped)); else each has a thread.
    pub is_stepped: bool,
    /// Sockets that a service manager holds; their services use them and bind none.
    pub held_sockets: HeldSockets,
    /// Controls the replay; offered to clients if the server has one.
    pub replay: Option<ReplayHandle>,
}

/// What to do about a port that another program has; nothing if none has.
fn in_use(is_in_use: bool) -> &'static str {
    let advice = ": another program has the port, perhaps another clearway; `--set` with this key names another one, \
                  and `--any-port` of `replay --serve` and `demo` takes free ones";
    if is_in_use { advice } else { "" }
}

/// A server did not start.
#[derive(Debug, thiserror::Error)]
pub enum StartError {
    /// The configuration of a vehicle is invalid.
    #[error(transparent)]
    Vehicle(#[from] clearway_mapping::config::ConfigValueError),
    /// The recording cannot be created.
    #[error(transparent)]
    Record(#[from] RecordError),
    /// Addresses cannot be listened on.
    #[error("{}{}", .refused.join("; "), in_use(*.is_in_use))]
    Listen {
        /// The key of each address, the address, and the system's reason.
        refused: Vec<String>,
        /// True if another program listens on one of them.
        is_in_use: bool,
    },
    /// The certificates are invalid.
    #[error("grpc.tls: {0}; a PEM certificate (chain), its PEM private key and PEM CA certificates are allowed")]
    Certificates(String),
    /// A vehicle's sockets cannot be bound.
    #[error("vehicle {vehicle}: {source}{}", in_use(source.source.kind() == std::io::ErrorKind::AddrInUse))]
    Udp {
        /// Name of the vehicle.
        vehicle: Arc<str>,
        /// The address and the system's reason.
        source: udp::BindError,
    },
    /// The threads that read the sockets cannot be started.
    #[error("no thread for a udp socket: {0}")]
    UdpThread(std::io::Error),
    /// The thread of an engine cannot be started.
    #[error("vehicle {vehicle}: no thread for its engine: {source}")]
    Thread {
        /// Name of the vehicle.
        vehicle: Arc<str>,
        /// Error of the operating system.
        source: std::io::Error,
    },
    /// The zenoh session cannot be opened, or a key cannot be declared on it.
    #[cfg(feature = "zenoh")]
    #[error(transparent)]
    Zenoh(#[from] crate::zenoh_session::ZenohError),
    /// The configuration enables zenoh, but the program was built without it.
    #[error("zenoh.enabled = true: this clearway was built without the feature zenoh; allowed: false")]
    NoZenoh,
    /// The address of the collector cannot be used.
    #[error("traces.endpoint: {0}")]
    Traces(#[from] opentelemetry_otlp::ExporterBuildError),
    /// The configuration names a store, but the program was built without it.
    #[error("store.url: this clearway was built without the feature store; an empty text is allowed")]
    NoStore,
}

/// A server ended, but not as it should have.
#[derive(Debug, thiserror::Error)]
pub enum ShutdownError {
    /// The thread of an engine panicked.
    #[error("the engine of vehicle {0} panicked")]
    Engine(Arc<str>),
    /// A part of the server did not end in time.
    #[error("not ended after {} ms: {waiting_for} did not end", .limit.as_millis())]
    Deadline {
        /// The part for which the shutdown waited.
        waiting_for: &'static str,
        /// Longest time of a shutdown.
        limit: Duration,
    },
    /// The recording is incomplete.
    #[error(transparent)]
    Recording(#[from] IncompleteRecordingError),
    /// The task that waits for engines and recorder failed.
    #[error("the end of engines and recorder is unknown: {0}")]
    Task(#[from] tokio::task::JoinError),
}

/// Comments of a configuration as its first lines. A comment may quote a name of the input, and ends with its line, so
/// that control characters are escaped.
pub(super) fn comment_lines(comments: &[String]) -> String {
    let shown = |c: char| if c.is_control() { c.escape_default().to_string() } else { c.to_string() };
    let line = |comment: &String| format!("# {}\n", comment.chars().map(shown).collect::<String>());
    comments.iter().map(line).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_udp_port_that_another_program_has_is_named_with_its_key_and_what_to_do() {
        let source = std::io::ErrorKind::AddrInUse.into();
        let (at, key) = ("127.0.0.1:2368".parse().unwrap(), "vehicle.udp.data");
        let source = udp::BindError { vehicle: 0, key, at, source };
        let text = StartError::Udp { vehicle: "car".into(), source }.to_string();
        assert!(text.starts_with("vehicle car: vehicle.udp.data = 127.0.0.1:2368: "), "{text}");
        assert!(text.contains("another program has the port"), "{text}");
    }

    #[test]
    fn a_comment_that_quotes_line_breaks_stays_one_comment() {
        let comment = "of velo\r\n[grpc]\nenabled = false\t\u{85}".to_owned();
        assert_eq!(comment_lines(&[comment]), "# of velo\\r\\n[grpc]\\nenabled = false\\t\\u{85}\n");
    }
}
