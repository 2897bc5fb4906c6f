//! The client library of Clearway. A planner subscribes to maps and gets the newest one with its age, and looks up
//! cells by points in metres. A vehicle sends its scans, poses and roads.
//!
//! ```no_run
//! use clearway_client::{Client, Subscription, now_ns};
//!
//! # async fn plan() -> Result<(), clearway_client::ClientError> {
//! let client = Client::connect("localhost:50051").await?;
//! let mut maps = client.subscribe(Subscription { layers: vec!["freespace".into()], ..Default::default() }).await?;
//! loop {
//!     let update = maps.next().await?;
//!     if update.map.is_stale(now_ns()) {
//!         continue;
//!     }
//!     let (_, class) = update.map.layer("freespace")?.class_at(12.0, -1.5);
//!     println!("12 m ahead, 1.5 m to the right: {class}; {} maps skipped", update.skipped);
//! }
//! # }
//! ```
//!
//! | file | in -> out |
//! |---|---|
//! | `freshness` | two clocks -> least age of a map |
//! | [`view`] | encoded map -> [`MapView`]: decoded once, cheap to clone, with its age |
//! | [`footprint`] | map and area, path or point -> what is free, what blocks it, what is nearest, the clearance |
//! | [`stream`] | updates -> the newest map, with the number of skipped maps |
//! | [`grpc`] | address of a server -> [`Client`] |
//! | [`observation`] | scans, poses, roads, packets -> [`Observation`] |
//! | `signature` | a map on its key and its signature -> whether the expected server published it (feature `zenoh`) |
//! | [`ingest`] | observations -> the server, and their outcomes |
//! | `zenoh` | endpoint of a router -> `ZenohClient` (feature `zenoh`); its `subscription`: one key -> the newest map |
//! | `test` | a recording -> a server that replays it, for tests of planners (feature `test`) |
//! | `error` | why a call failed |

mod error;
pub mod footprint;
mod freshness;
pub mod grpc;
pub mod ingest;
pub mod observation;
#[cfg(feature = "zenoh")]
pub mod signature;
pub mod stream;
#[cfg(feature = "test")]
pub mod test;
pub mod view;
#[cfg(feature = "zenoh")]
pub mod zenoh;

pub use clearway_proto::map::{Channel, Layer, SafePoint};
pub use clearway_proto::plan::PlanError;
pub use clearway_proto::{codec, grid, v1};

pub use error::ClientError;
pub use footprint::clearance::Clearance;
pub use footprint::shape::{Area, Footprint, Outline, Path, ShapeError};
pub use footprint::{Along, Answer, Blocker, Obstacle};
pub use freshness::now_ns;
pub use grpc::{Client, Subscription, Tls};
pub use ingest::Ingester;
pub use observation::{Observation, Refusal};
#[cfg(feature = "zenoh")]
pub use signature::PublicKey;
pub use stream::{MapStream, PassedOver, StreamEvent, Update};
pub use view::{MapView, Staleness};
#[cfg(feature = "zenoh")]
pub use zenoh::ZenohClient;

/// Compiles the code blocks of the README.
#[cfg(doctest)]
#[doc = include_str!("../../README.md")]
struct Readme;

/// Compiles the code blocks of the page on plans.
#[cfg(doctest)]
#[doc = include_str!("../guide/plans.md")]
struct PlansPage;

/// Compiles the code blocks of the page on observations.
#[cfg(doctest)]
#[doc = include_str!("../guide/sending.md")]
struct SendingPage;
