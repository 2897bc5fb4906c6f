//! The wire contract of Clearway: `clearway.v1` protobuf, its generated types, and the map codec. Pure: bytes in,
//! values out; no I/O and no clock.
//!
//! | file | in -> out |
//! |---|---|
//! | [`v1`] | generated from `clearway/v1/*.proto`: messages and gRPC services |
//! | [`limits`] | what a decoder accepts before it allocates |
//! | [`packed`] | numbers <-> the packed lists of a scan |
//! | [`cells`] | the raw cells of a channel, typed |
//! | [`codec`] | raw cells <-> `Channel`: payload, encoding, CRC |
//! | [`by_class`] | raw cells and their classes -> `Channel` with a class table |
//! | [`map`] | encoded `Map` -> checked [`map::Map`]; header and layers -> bytes |
//! | [`grid`] | point in the ego frame <-> cell index |
//! | [`legend`] | names, meanings and colours of a layer's classes |
//! | [`safe_points`] | safe points <-> `SafePoints` |
//! | [`plan`] | a planner's `Plan` -> whether it can be drawn; the plan in the ego frame of a map |
//! | [`delta`] | two layers -> the changes between them |
//! | [`region`] | layer and rectangle -> the part of the layer that contains the rectangle |

mod channel;
pub mod delta;
pub mod limits;
pub mod map;
pub mod packed;
pub mod plan;
pub mod region;

pub use channel::{by_class, cells, codec};
pub use map::{grid, legend, safe_points};

/// Generated from `clearway/v1/*.proto`.
#[allow(missing_docs, clippy::all, rustdoc::broken_intra_doc_links)]
pub mod v1 {
    tonic::include_proto!("clearway.v1");
}

/// The encoded `FileDescriptorSet` of `clearway/v1/*.proto`, imports included: for gRPC reflection.
pub const DESCRIPTORS: &[u8] = include_bytes!(concat!(env!("OUT_DIR"), "/clearway.v1.bin"));

/// The encoded `FileDescriptorSet` of `clearway/v1/journal.proto`, imports included, without comments: for the schemas
/// in recordings.
pub const RECORDING_DESCRIPTORS: &[u8] = include_bytes!(concat!(env!("OUT_DIR"), "/recording.bin"));

/// The metadata of `NOT_FOUND` that says at which address, `HOST:PORT`, another server serves the vehicle.
pub const SERVED_AT: &str = "clearway-served-at";
