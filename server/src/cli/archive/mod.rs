//! The subcommand that writes recordings in other formats.

pub(super) mod export;
