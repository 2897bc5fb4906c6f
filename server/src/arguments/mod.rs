//! Options that several subcommands share, as clap reads them.

pub mod configuration;
pub mod model;
#[cfg(feature = "tools")]
pub mod pictures;
pub mod values;
