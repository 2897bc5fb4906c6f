//! One running server: event queues, engines, recorder and publishers of one configuration. They start in an order in
//! which nothing is lost, and stop in the reverse order.
//!
//! | file | in -> out |
//! |---|---|
//! | `setup` | parameters of a server; errors of its start and its end |
//! | `start` | [`Setup`] -> [`Running`] |
//! | `input` | event queue and UDP addresses of one vehicle |
//! | `listeners` | the TCP listeners of a configuration |
//! | `running` | [`Running`], and its shutdown |
//! | `save_rules` | stale maps and lost sensors -> saves of the recording |
//! | `uploads` | finished parts of the recording -> the store |
//! | `over_zenoh` | everything that uses the zenoh session |
//! | `plans_over_zenoh` | plans of planners -> the event queue of their vehicle |
//! | `router` | a router that answers later than at the start -> the session; whether one is connected -> status, log |

mod input;
mod listeners;
#[cfg(feature = "zenoh")]
mod over_zenoh;
#[cfg(feature = "zenoh")]
mod plans_over_zenoh;
#[cfg(feature = "zenoh")]
mod router;
mod running;
mod save_rules;
mod setup;
mod start;
#[cfg(feature = "store")]
mod uploads;

pub use input::VehicleInput;
pub use running::Running;
pub use setup::{Setup, ShutdownError, StartError};
pub use start::Server;
pub use start::random;
