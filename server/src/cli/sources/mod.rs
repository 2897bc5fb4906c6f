//! The subcommand that simulates a drive.

#[cfg(feature = "sim")]
pub(super) mod simulate;
