//! The status of each vehicle, for gRPC, zenoh, the page, `/metrics` and the command line.
//!
//! | file | in -> out |
//! |---|---|
//! | [`vehicle`] | counts of engine, queue, recorder and readers -> one snapshot, as message or JSON |
//! | `json` | a vehicle's and a sensor's state and counts -> JSON |
//! | `notices` | changes of the sensors -> the log, each once |
//! | `prometheus` | the status of all vehicles -> Prometheus' text format |

mod json;
mod notices;
mod prometheus;
pub mod vehicle;

pub use json::{sensor_json, vehicle_json};
pub use prometheus::prometheus;
pub use vehicle::{Reader, Snapshot, VehicleStatus};
