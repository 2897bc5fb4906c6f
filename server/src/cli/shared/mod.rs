//! What several subcommands share.
//!
//! | file | in -> out |
//! |---|---|
//! | `configuration` | options -> a configuration, extrinsics |
//! | `model` | the name of a sensor model -> the model |
//! | `files` | paths -> open files, or errors that say what to do |
//! | `ground_revolutions` | revolutions -> those from which a mount is estimated |
//! | `output` | text -> stdout; progress bar, runtime, signals, errors of usage |
//! | `logs` | events of the log -> lines on stderr |
//! | `exit` | the exit codes |

pub(super) mod configuration;
pub(super) mod exit;
pub(super) mod files;
pub(super) mod ground_revolutions;
pub(super) mod logs;
pub(super) mod model;
pub(super) mod output;
