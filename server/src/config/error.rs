//! Errors of the configuration, and paths that it names.

use std::path::{Path, PathBuf};

/// A value that is not allowed; [`ConfigError::Value`] adds the file.
#[derive(Debug, thiserror::Error)]
#[error("{key} = {value}: allowed: {allowed}")]
pub(super) struct ValueError {
    /// Path of the key, such as `grpc.connections_max`.
    pub key: String,
    /// The value that was found.
    pub value: String,
    /// The values that are allowed.
    pub allowed: String,
}

impl ValueError {
    pub fn new(key: impl Into<String>, value: impl ToString, allowed: impl Into<String>) -> Self {
        Self { key: key.into(), value: value.to_string(), allowed: allowed.into() }
    }
}

/// Why a configuration cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    /// The file cannot be read.
    #[error("configuration {}: {source}", file.display())]
    Read {
        /// The configuration file.
        file: PathBuf,
        /// Error of the system.
        source: std::io::Error,
    },
    /// The text is not TOML, or has an unknown key or a value of the wrong type. The source shows line and column.
    #[error("configuration {}: {source}", file.display())]
    Parse {
        /// The configuration file.
        file: PathBuf,
        /// Position and reason.
        source: Box<toml::de::Error>,
    },
    /// An override is not `key=value`.
    #[error("--set {text}: expected KEY=VALUE, such as grpc.listen=\"0.0.0.0:50051\"")]
    Override {
        /// The override.
        text: String,
    },
    /// A value is not allowed.
    #[error("configuration {}: {key} = {value}: allowed: {allowed}", file.display())]
    Value {
        /// The configuration file.
        file: PathBuf,
        /// Path of the key.
        key: String,
        /// The value that was found.
        value: String,
        /// The values that are allowed.
        allowed: String,
    },
    /// A file that the configuration names (a calibration, a certificate) cannot be used.
    #[error("configuration {}: {key} = {}: {reason}", file.display(), named.display())]
    File {
        /// The configuration file.
        file: PathBuf,
        /// Path of the key.
        key: String,
        /// The file that the key names.
        named: PathBuf,
        /// Why it cannot be used, and what is allowed.
        reason: String,
    },
}

/// A path that stands in the configuration `file`, relative to the working directory.
pub(super) fn beside(file: &Path, path: &Path) -> PathBuf {
    file.parent().unwrap_or(Path::new("")).join(path)
}
