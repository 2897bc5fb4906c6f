//! The status of each vehicle, for gRPC, zenoh, the page, `/metrics` and the command line.
//!
//! | file | in -> out |
//! |---|---|
//! | [`vehicle`] | counts of engine, queue, recorder and readers -> one snapshot |
//! | [`transports`] | readers that come, go and skip maps -> counts by transport |
//! | [`window`], [`histogram`] | maps and packet counts -> rates, loss and latency of the last 10 s; buckets of times |
//! | [`network`] | hung listeners, absent routers, ends of certificates, times of the link -> problems in words |
//! | [`health`] | what is known at one time -> ok, warn or error, with reasons |
//! | [`history`] | a row each second and each change of the state -> the last ten minutes |
//! | [`assess`] | the status of a vehicle -> its state, again and again |
//! | `message` | a snapshot and a state -> message, JSON |
//! | `json` | a vehicle's and a sensor's state and counts -> JSON |
//! | `notices` | changes of the sensors -> the log, each once |
//! | `reasons` | the reasons for which metrics exist before they occur |
//! | `text_format` | metrics -> Prometheus' text format |
//! | `process` | `/proc` -> memory, files and time of this process |
//! | `metrics` | the status of all vehicles, listeners and process -> metrics |

pub mod assess;
pub mod health;
pub mod histogram;
pub mod history;
mod json;
mod message;
mod metrics;
pub mod network;
mod notices;
pub mod process;
mod reasons;
mod text_format;
pub mod transports;
pub mod vehicle;
pub mod window;

pub use assess::{state_changed, watch_states};
pub use health::State;
pub use json::{recorder_json, run_text, sensor_json, vehicle_json};
pub use metrics::{ListenerCounts, prometheus};
pub use text_format::CONTENT_TYPE;
pub use transports::{Reader, Transport};
pub(crate) use vehicle::MadeMap;
pub use vehicle::{Snapshot, VehicleStatus};
