//! The process: its runtime, its signals, its stdin, its service manager.

mod runtime;
pub mod service_manager;
pub mod stdin;

#[cfg(feature = "tools")]
pub use runtime::stop_flag;
pub use runtime::{block_on, stop_signal};
