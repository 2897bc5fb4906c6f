//! Why a call failed.

use clearway_proto::map::MapError;
use clearway_proto::plan::PlanError;

use crate::footprint::shape::ShapeError;

/// Why a call failed. `address` is the server's or router's address, as the client connected to it.
#[derive(Clone, Debug, thiserror::Error)]
pub enum ClientError {
    /// The text is not an address.
    #[error(
        "server address {address:?}: {reason}; HOST:PORT or http://HOST:PORT is allowed, such as localhost:50051, \
         and https://HOST:PORT with certificates"
    )]
    Address {
        /// The text as given.
        address: String,
        /// Why the address is refused.
        reason: String,
    },
    /// A certificate or a key is invalid, or they do not belong together.
    #[error("certificates for {address}: {reason}")]
    Certificate {
        /// Address of the server or router.
        address: String,
        /// Why the certificate or key is refused.
        reason: String,
    },
    /// No server answers at the address, or the connection failed.
    #[error("no clearway server answers at {address}: {reason}")]
    Unreachable {
        /// Address of the server or router.
        address: String,
        /// Error of the transport.
        reason: String,
    },
    /// The server refused the call.
    #[error("{address}: {reason} ({code})")]
    Refused {
        /// Address of the server or router.
        address: String,
        /// The server's message: what is wrong and what is allowed.
        reason: String,
        /// The gRPC status code, such as `NotFound`.
        code: String,
    },
    /// The server did not report the outcome of observations in time.
    #[error("{address} has acknowledged {acknowledged} of {sent} observations, and then nothing for 10 s")]
    Silent {
        /// Address of the server or router.
        address: String,
        /// Number of observations sent.
        sent: u64,
        /// Number of observations acknowledged.
        acknowledged: u64,
    },
    /// The server ended the stream of maps or observations.
    #[error("{address} has ended the stream")]
    Ended {
        /// Address of the server or router.
        address: String,
    },
    /// The replay that the server serves has reached its end, and its last map was returned. The stream goes on:
    /// further maps come if the replay is set back.
    #[error("{address}: the replay has ended")]
    ReplayEnded {
        /// Address of the server or router.
        address: String,
    },
    /// A received map is invalid.
    #[error("refused a map: {0}")]
    Map(#[from] MapError),
    /// The map does not have the layer.
    #[error("no layer {layer:?}; the map has {}", present.join(", "))]
    NoLayer {
        /// Name of the layer, as requested.
        layer: String,
        /// Names of the layers that the map has.
        present: Vec<String>,
    },
    /// An area, a path or a point of a question cannot be judged.
    #[error(transparent)]
    Shape(#[from] ShapeError),
    /// The plan of a planner cannot be drawn.
    #[error("plan: {0}")]
    Plan(#[from] PlanError),
    /// The question needs square cells.
    #[error("layer {layer:?} has a radial grid; the clearance is computed on square cells alone")]
    NoSquares {
        /// Name of the layer.
        layer: String,
    },
    /// The text is no key that signs maps, or no public key that checks them.
    #[error("key of signed maps: {reason}")]
    SigningKey {
        /// What is wrong with it, and what is allowed.
        reason: String,
    },
    /// A name is none of a vehicle or layer.
    #[error("{what} {name:?}: 1 to 64 of the characters a-z, 0-9, - and _ are allowed")]
    Name {
        /// `vehicle` or `layer`.
        what: &'static str,
        /// The name as given.
        name: String,
    },
    /// A zenoh operation failed.
    #[error("zenoh, {what}: {reason}")]
    Zenoh {
        /// The zenoh operation that failed, as the error names it.
        what: String,
        /// Error of zenoh.
        reason: String,
    },
}
