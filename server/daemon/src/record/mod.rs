//! Recordings while they are written, and the configuration of a recorded run. The format is `clearway-journal`.
//!
//! | file | in -> out |
//! |---|---|
//! | [`writer`] | events and maps -> queue -> recorder thread |
//! | `run_config` | a recording -> the configuration of its run; verification with it |

mod run_config;
pub mod writer;

pub use run_config::{recorded_config, recorded_vehicles, run_config, verify};
