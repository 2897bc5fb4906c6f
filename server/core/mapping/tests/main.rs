//! Tests of the pipeline and its layers, with simulated and recorded scans.

mod common;
mod faults;
mod fusion;
mod handover;
mod inputs;
mod layers;
mod memory;
mod pipeline;
mod recorded;
