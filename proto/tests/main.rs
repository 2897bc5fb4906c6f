//! Tests of the map codec and of the golden vectors.

mod by_class;
mod codec;
mod common;
mod delta;
mod golden;
mod plan;
