//! The subcommands that compare maps with labels, and that write a first configuration.

pub mod evaluate;
pub(super) mod init;
