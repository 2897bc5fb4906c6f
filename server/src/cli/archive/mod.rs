//! The subcommands that read and keep files.
//!
//! | file | in -> out |
//! |---|---|
//! | `export` | a recording -> pictures, arrays, documents, files for viewers |
//! | `info` | a file -> a description of its contents, and what is wrong with it |
//! | `repair` | a damaged recording -> a recording of all that can be read |
//! | `upload` | a folder of recordings -> a store |
//! | `recordings` | a store and a search -> the recordings that it finds |

pub(super) mod export;
pub(super) mod info;
#[cfg(feature = "store")]
pub(super) mod recordings;
pub(super) mod repair;
#[cfg(feature = "store")]
pub(super) mod upload;
