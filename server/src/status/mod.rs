//! The status of each vehicle, for gRPC, zenoh, the page, `/metrics` and the command line.
//!
//! | file | in -> out |
//! |---|---|
//! | [`vehicle`] | counts of engine, queue, recorder and readers -> one snapshot, as message or JSON |
//! | `sensor_json` | a sensor's state and counts -> JSON |
//! | `prometheus` | the status of all vehicles -> Prometheus' text format |

mod prometheus;
mod sensor_json;
pub mod vehicle;

pub use prometheus::prometheus;
pub use sensor_json::{ledger_json, sensor_json};
pub use vehicle::{Reader, Snapshot, VehicleStatus};
