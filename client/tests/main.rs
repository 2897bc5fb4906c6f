//! Tests of the client library, with maps of known classes and scripted services.

mod common;
mod footprint;
mod questions;
mod stream;
mod view;
#[cfg(feature = "zenoh")]
mod zenoh;
#[cfg(feature = "zenoh")]
mod zenoh_names;
