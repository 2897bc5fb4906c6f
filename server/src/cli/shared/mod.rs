//! What several subcommands share.
//!
//! | file | in -> out |
//! |---|---|
//! | `configuration` | options -> a configuration, extrinsics |
//! | `model` | the name of a sensor model -> the model |
//! | `output` | text -> stdout; runtime, signals, errors of usage |
//! | `logs` | events of the log -> lines on stderr |
//! | `progress` | the length of an input -> a bar on stderr |
//! | `exit` | the exit codes |

pub(super) mod configuration;
pub(super) mod exit;
pub(super) mod logs;
pub(super) mod model;
pub(super) mod output;
#[cfg(feature = "tools")]
pub(super) mod progress;

pub(super) use clearway_daemon::base::files;
