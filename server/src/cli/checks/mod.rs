//! The subcommands that check maps and configurations.
//!
//! | file | in -> out |
//! |---|---|
//! | `verify` | recordings -> whether each map is the map of its events, or what a change changes in the maps |
//! | [`evaluate`] | labelled scans, simulated scenes -> precision and recall of each map |
//! | `check` | a configuration -> the same with every default |
//! | `init` | sensors that send, or a capture -> a first configuration |

pub(super) mod check;
pub mod evaluate;
pub(super) mod init;
pub(super) mod verify;
