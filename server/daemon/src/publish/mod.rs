//! The newest map of each vehicle -> its readers over gRPC, zenoh, ROS 2 and Foxglove, and on the page.
//!
//! All publishers follow the same latest-value slots and send the same bytes, or what they decode from them. None of
//! them can delay an engine.
//!
//! | file | in -> out |
//! |---|---|
//! | [`served`] | a name -> the status and the newest map of a vehicle |
//! | [`listen`] | a TCP listener -> connections within their limits, requests of clients that may send them |
//! | [`grpc`] | newest map -> gRPC streams, each with its layers, region, rate, deltas and credits |
//! | `zenoh` | newest map -> one key for each layer, a status, a liveliness token |
//! | `zenoh_recorder` | queries of operators -> the recorder |
//! | `announcements` | own vehicles -> other servers; theirs -> the fleet |
//! | `ros` | newest map -> ROS 2 topics in rmw_zenoh's key space |
//! | [`foxglove`] | newest map, points, pose -> Foxglove's WebSocket |
//! | `page_points` | newest points -> a binary frame for the page's view in 3-D |
//! | `page_recorder` | the recorder's buttons on the page, as JSON |
//! | `page_replay` | the state of a replay and requests of the page, as JSON |
//! | `page_live` | selections and acknowledgements of a browser -> maps, status and replay state on its WebSocket |
//! | [`page`] | newest map, status -> the page's WebSocket, `/vehicles`, `/healthz`, `/readyz`, `/metrics` |

#[cfg(feature = "zenoh")]
pub(crate) mod announcements;
pub mod foxglove;
pub mod grpc;
pub mod listen;
pub mod page;
mod page_live;
mod page_points;
mod page_recorder;
mod page_replay;
#[cfg(feature = "zenoh")]
mod ros;
pub mod served;
#[cfg(feature = "zenoh")]
pub mod zenoh;
#[cfg(feature = "zenoh")]
pub(crate) mod zenoh_recorder;

pub use served::{Served, Vehicles};
