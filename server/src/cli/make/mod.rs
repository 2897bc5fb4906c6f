//! The subcommand that drives a simulated vehicle.

#[cfg(feature = "sim")]
pub mod demo;
