//! What every part of the server stands on: the clock, locks, names and files. Nothing here knows a map.
//!
//! | file | in -> out |
//! |---|---|
//! | [`clock`] | the wall clock -> nanoseconds |
//! | `sync` | a mutex -> its value, also after a panic |
//! | [`directory`] | the name of a vehicle -> what is served for it |
//! | [`files`] | a path of the command line -> an open file, or an error that says what to do |
//! | [`held_sockets`] | sockets that systemd holds -> listeners |
//! | `token_bucket` | messages of a client -> whether its rate is within a limit |

pub mod clock;
pub mod directory;
pub mod files;
pub mod held_sockets;
pub mod sync;
pub mod token_bucket;

pub use clearway_journal::{counted, file_advice};
