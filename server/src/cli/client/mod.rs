//! The subcommands that are clients of a running server.
//!
//! | file | in -> out |
//! |---|---|
//! | `watch`, `get` | a server -> a line for each map; the newest map as a file |
//! | `vehicles` | a server -> its vehicles |
//! | `status`, `top` | a server -> the states of its vehicles, once; of the fleet, live |
//! | `recorder`, `transport` | a request -> the recorder of a server; the replay that it serves |
//! | `fleet` | the vehicles of several servers -> the server of each, in words |
//! | `connection` | options -> a connected client |
//! | `drawing` | a layer -> lines of text |
//! | `screen` | lines of text -> a terminal |

pub(super) mod connection;
mod drawing;
mod fleet;
pub(super) mod get;
pub(super) mod recorder;
mod screen;
pub(super) mod status;
pub(super) mod top;
pub(super) mod transport;
pub(super) mod vehicles;
pub(super) mod watch;
