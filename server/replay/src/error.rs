//! Why a replay fails.

use std::path::{Path, PathBuf};

use clearway_daemon::config::ConfigError;
use clearway_daemon::replay_control::ControlError;
use clearway_daemon::run::{ShutdownError, StartError};
use clearway_journal::reader::RecordingError;

use crate::files::FilesError;
use crate::player::faults::FaultError;
use crate::player::outcome::PlayError;

/// Why a replay failed.
#[derive(Debug, thiserror::Error)]
pub enum ReplayError {
    /// A file cannot be read.
    #[error(transparent)]
    Files(#[from] FilesError),
    /// A recording cannot be used.
    #[error(transparent)]
    Recording(#[from] RecordingError),
    /// The configuration cannot be used.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// An option does not fit the files or the disk.
    #[error("{option}: {reason}")]
    Option {
        /// The option, with its value.
        option: String,
        /// Why it cannot be used, and what is allowed.
        reason: String,
    },
    /// A recording or a configuration does not fit the other files.
    #[error("{}: {reason}", file.display())]
    Mismatch {
        /// The recording or the configuration.
        file: PathBuf,
        /// What differs, and what is allowed.
        reason: String,
    },
    /// The server did not start.
    #[error(transparent)]
    Start(#[from] StartError),
    /// The server did not end in order.
    #[error(transparent)]
    End(#[from] ShutdownError),
    /// The thread of the replay panicked.
    #[error("the thread of the replay has panicked")]
    Player,
    /// The range is not in the files.
    #[error("--{0}")]
    Control(#[from] ControlError),
    /// The files have no events.
    #[error("the files have no events to serve{truncated}")]
    Empty {
        /// The truncated files and their faults, for people; empty without any.
        truncated: String,
    },
    /// A fault is not known.
    #[error(transparent)]
    Fault(#[from] FaultError),
    /// The replay could not go on.
    #[error(transparent)]
    Play(#[from] PlayError),
}

impl ReplayError {
    /// An option with a path that cannot be used.
    pub(super) fn path(option: &str, file: &Path, reason: impl ToString) -> Self {
        Self::Option { option: format!("{option} {}", file.display()), reason: reason.to_string() }
    }

    /// A recording or a configuration that does not fit.
    pub(super) fn mismatch(file: &Path, reason: String) -> Self {
        Self::Mismatch { file: file.to_owned(), reason }
    }
}
