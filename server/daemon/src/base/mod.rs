//! What every part of the server stands on: the clock, locks, names and files. Nothing here knows a map.
//!
//! | file | in -> out |
//! |---|---|
//! | [`clock`] | the wall clock -> nanoseconds |
//! | `sync` | a mutex -> its value, also after a panic |
//! | `counted` | a count and a noun -> text |
//! | [`directory`] | the name of a vehicle -> what is served for it |
//! | `file_advice` | a path -> an open file, or an error that says what to do |
//! | [`held_sockets`] | sockets that systemd holds -> listeners |

pub mod clock;
pub mod counted;
pub mod directory;
pub mod file_advice;
pub mod held_sockets;
pub mod sync;
