//! The wire contract of Clearway. Pure: bytes in, values out.
//!
//! [`v1`] holds the generated protobuf and gRPC types, [`DESCRIPTORS`] their descriptor set (for reflection and for
//! the schemas in recordings), [`codec`] the cells of a channel to bytes and back, [`grid`] where cells lie, [`map`] a
//! whole map's bytes to checked values, [`delta`] a layer as what changed, [`by_class`] a channel as what is otherwise than
//! its class says, [`region`] the part of a layer about a place, [`packed`] a scan's lists of numbers to bytes and back,
//! [`safe_points`] a layer's points.

mod bits;
pub mod by_class;
mod changes;
pub mod codec;
mod decode;
pub mod delta;
pub mod grid;
pub mod legend;
pub mod map;
pub mod packed;
mod parts;
pub mod region;
mod rows;
pub mod safe_points;

/// Generated from `clearway/v1/*.proto`.
#[allow(missing_docs, clippy::all, rustdoc::broken_intra_doc_links)]
pub mod v1 {
    tonic::include_proto!("clearway.v1");
}

/// The encoded `FileDescriptorSet` of `clearway/v1/*.proto`, imports included.
pub const DESCRIPTORS: &[u8] = include_bytes!(concat!(env!("OUT_DIR"), "/clearway.v1.bin"));
