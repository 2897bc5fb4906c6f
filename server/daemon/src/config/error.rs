//! Errors of the configuration, and paths that it names.

use std::fmt;
use std::path::{Path, PathBuf};

/// A value that is not allowed; [`ConfigError::Value`] adds where it was given.
#[derive(Debug, thiserror::Error)]
#[error("{key} = {value}: allowed: {allowed}")]
pub(super) struct ValueError {
    /// Path of the key, such as `grpc.advertise`.
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

    /// The error for a value that was given at `origin`.
    pub fn at(self, origin: &Origin) -> ConfigError {
        let Self { key, value, allowed } = self;
        ConfigError::Value { origin: origin.clone(), key, value, allowed }
    }
}

/// Where a key or a value was given.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Origin {
    /// In the configuration file.
    File {
        /// Path of the configuration file.
        file: PathBuf,
        /// Number of the line, if it is known.
        line: Option<usize>,
    },
    /// In options of the command line or in environment variables, such as `--set grpc.listen=abc`.
    Options(Vec<String>),
}

impl Origin {
    /// The configuration file, at a line that is not known.
    pub fn file(file: &Path) -> Self {
        Self::File { file: file.to_owned(), line: None }
    }
}

impl fmt::Display for Origin {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::File { file, line: None } => write!(f, "configuration {}", file.display()),
            Self::File { file, line: Some(line) } => write!(f, "configuration {}, line {line}", file.display()),
            Self::Options(options) => f.write_str(&options.join(" ")),
        }
    }
}

/// Why a configuration cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    /// The file cannot be read.
    #[error(
        "configuration {}: {source}; `clearway check --default > clearway.toml` writes a file with every key and its \
         default, and `--config FILE` names the file to use",
        file.display()
    )]
    Read {
        /// Path of the configuration file.
        file: PathBuf,
        /// Error of the system.
        source: std::io::Error,
    },
    /// The text is not TOML. The source shows line and column.
    #[error("configuration {}: {source}", file.display())]
    Syntax {
        /// Path of the configuration file.
        file: PathBuf,
        /// Position and reason.
        source: Box<toml::de::Error>,
    },
    /// An override is not `key=value`.
    #[error("{option}: expected KEY=VALUE, such as grpc.listen=\"0.0.0.0:50051\"")]
    Override {
        /// The option or the variable.
        option: String,
    },
    /// The key of an override goes on below a value that is no table.
    #[error("{option}: {key} is not a table, so that it has no keys")]
    NotTable {
        /// The option or the variable.
        option: String,
        /// The key that is no table.
        key: String,
    },
    /// The key of an override names an item of a list that there is not.
    #[error("{option}: there is no {key}; in brackets stands the name of a vehicle or sensor, or its index from 0")]
    NotThere {
        /// The option or the variable.
        option: String,
        /// The key with the name in brackets.
        key: String,
    },
    /// No vehicle has a name that was asked for.
    #[error("configuration {}: there is no vehicle {name}; its vehicles: {known}", file.display())]
    UnknownVehicle {
        /// Path of the configuration file.
        file: PathBuf,
        /// The name that was asked for.
        name: String,
        /// The names of the vehicles, separated by commas.
        known: String,
    },
    /// A table has no such key.
    #[error("{origin}: {key} is not a key; its table has: {known}")]
    UnknownKey {
        /// The file or the options.
        origin: Origin,
        /// Path of the key.
        key: String,
        /// The keys of the table, separated by commas.
        known: String,
    },
    /// A key that has no default is not given.
    #[error("{origin}: {key} is missing, and has no default; `clearway check --default` shows every key")]
    MissingKey {
        /// The file or the options.
        origin: Origin,
        /// Path of the key.
        key: String,
    },
    /// A value is not allowed.
    #[error("{origin}: {key} = {value}: allowed: {allowed}")]
    Value {
        /// The file or the options.
        origin: Origin,
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
        /// Path of the configuration file.
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
