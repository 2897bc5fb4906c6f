//! Recorded drives through the whole system.

mod determinism;
mod evaluate;
mod replay;
mod transport;
