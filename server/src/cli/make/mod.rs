//! The subcommands that make maps in this process.
//!
//! | file | in -> out |
//! |---|---|
//! | [`demo`] | a simulated vehicle -> a server of its own, over real UDP |
//! | `serve` | a configuration -> a server that runs until a signal |
//! | [`replay`] | recorded drives -> maps, a recording |
//! | `view` | a recorded drive -> the page over its replay |
//! | `service_manager` | a running server -> what systemd is told |

#[cfg(feature = "sim")]
pub mod demo;
pub mod replay;
pub(super) mod serve;
mod service_manager;
pub(super) mod view;
