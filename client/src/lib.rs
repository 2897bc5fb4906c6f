//! What a planner uses: the newest map with its age, and what lies at a point in metres; and what a vehicle uses to
//! send its scans, poses and roads.
//!
//! ```no_run
//! use clearway_client::{Client, Subscription, now_ns};
//!
//! # async fn plan() -> Result<(), clearway_client::ClientError> {
//! let client = Client::connect("localhost:50051").await?;
//! let mut maps = client.subscribe(Subscription { layers: vec!["drivability".into()], ..Default::default() }).await?;
//! loop {
//!     let update = maps.next().await?;
//!     if update.map.is_stale(now_ns()) {
//!         continue;
//!     }
//!     let (_, class) = update.map.layer("drivability")?.class_at(12.0, -1.5);
//!     println!("12 m ahead, 1.5 m to the right: {class}; {} maps skipped", update.skipped);
//! }
//! # }
//! ```
//!
//! | file | in -> out |
//! |---|---|
//! | `freshness` | two clocks -> how old a map is at least |
//! | [`view`] | bytes -> [`MapView`]: decoded once, cheap to clone, with its age |
//! | [`footprint`] | a map, a rectangle or a point -> whether it is free, the nearest obstacle |
//! | [`stream`] | updates -> the newest map in a slot, skips counted |
//! | [`grpc`] | a server's address -> [`Client`] |
//! | [`observation`] | scans, poses, roads, packets -> [`Observation`] |
//! | [`ingest`] | observations -> the server, and what became of them |
//! | `zenoh` | a router's endpoint -> `ZenohClient` (feature `zenoh`); its `tap`: one key -> the newest map |

pub mod footprint;
mod freshness;
pub mod grpc;
pub mod ingest;
pub mod observation;
pub mod stream;
pub mod view;
#[cfg(feature = "zenoh")]
pub mod zenoh;

pub use clearway_proto::map::{Channel, Layer};
pub use clearway_proto::{codec, grid, v1};

pub use footprint::{Footprint, Obstacle};
pub use freshness::now_ns;
pub use grpc::{Client, Subscription, Tls};
pub use ingest::Ingester;
pub use observation::{Observation, Refusal};
pub use stream::{MapStream, Sight, Update};
pub use view::MapView;
#[cfg(feature = "zenoh")]
pub use zenoh::ZenohClient;

use clearway_proto::map::MapError;

/// Why there is no map.
#[derive(Clone, Debug, thiserror::Error)]
pub enum ClientError {
    /// An address that is none.
    #[error(
        "server address {address:?}: {reason}; HOST:PORT or http://HOST:PORT is allowed, such as localhost:50051, and https://HOST:PORT with certificates"
    )]
    Address {
        /// As given.
        address: String,
        /// What is wrong with it.
        reason: String,
    },
    /// Nobody answers there.
    #[error("no clearway server answers at {address}: {reason}")]
    Unreachable {
        /// As dialled.
        address: String,
        /// What the transport says.
        reason: String,
    },
    /// The server said no, with its reason.
    #[error("{address}: {reason} ({code})")]
    Refused {
        /// As dialled.
        address: String,
        /// What the server says.
        reason: String,
        /// The gRPC code, such as `NotFound`.
        code: String,
    },
    /// The server has not told what became of what was sent.
    #[error("{address} has acknowledged {acknowledged} of {sent} observations, and then nothing for 10 s")]
    Silent {
        /// As dialled.
        address: String,
        /// How many were sent.
        sent: u64,
        /// How many of them were acknowledged.
        acknowledged: u64,
    },
    /// The stream of maps or observations is over.
    #[error("{address} has ended the stream")]
    Ended {
        /// As dialled.
        address: String,
    },
    /// A map that is not right.
    #[error("refused a map: {0}")]
    Map(#[from] MapError),
    /// The map has no such layer.
    #[error("no layer {layer:?}; the map has {}", present.join(", "))]
    NoLayer {
        /// As asked for.
        layer: String,
        /// What there is.
        present: Vec<String>,
    },
    /// What zenoh says.
    #[error("zenoh, {what}: {reason}")]
    Zenoh {
        /// What was tried.
        what: String,
        /// What zenoh says.
        reason: String,
    },
}

/// The README's code, compiled.
#[cfg(doctest)]
#[doc = include_str!("../../README.md")]
struct Readme;
