//! The one command `clearway`. What runs on a vehicle is `clearway-daemon`.
//!
//! | folder | in -> out |
//! |---|---|
//! | [`cli`] | the command line -> a subcommand: a file each |
//! | `arguments` | options that several subcommands share -> values |
//! | `terminal` | text, progress, log, errors of usage -> stdout, stderr, an exit code |
//! | `process` | runtime, signals, stdin, the service manager |
//! | `connect` | the address of a server -> a client, its maps |
//! | `ingest` | files -> observations that a server gets |
//! | `info` | a file or a folder -> its description |
//! | `verify` | recordings -> whether their maps are the maps of their events |
//! | `vehicles` | the state of vehicles -> a table |

mod arguments;
pub mod cli;
mod connect;
mod info;
mod ingest;
mod process;
mod terminal;
mod vehicles;
mod verify;
