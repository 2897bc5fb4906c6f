//! The subcommands of `clearway`, and what they share.
//!
//! Exit codes: 0 success, 1 failure, 2 wrong usage.

mod arguments;
mod connect;
#[cfg(feature = "sim")]
pub mod demo;
pub mod evaluate;
mod export;
mod get;
mod info;
mod ingest;
mod network;
mod npy;
pub mod replay;
mod run;
mod send;
mod sensor_json;
mod vehicles;
mod watch;

pub use run::main;

use connect::{Server, block_on, progress_bar, say};
use sensor_json as document;
