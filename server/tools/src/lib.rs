//! What never runs on a vehicle: the work of the subcommands that a production build leaves out.
//!
//! | file | in -> out |
//! |---|---|
//! | [`demo`] | a simulated vehicle -> a server of its own, over real UDP |
//! | [`evaluate`] | labelled scans, simulated scenes -> precision and recall of each map |
//! | [`export`] | a recording -> pictures, arrays, documents, files for viewers |
//! | [`init`] | sensors that send, or a capture -> a first configuration |
//! | [`send`], [`network`] | a capture -> datagrams over UDP, through a bad network |
//! | [`simulate`], [`scenes`] | a simulated scene -> a capture, or datagrams over UDP |
//!
//! At the ground: [`picture`], a layer of a map -> a PNG.

pub mod demo;
pub mod evaluate;
pub mod export;
pub mod init;
pub mod network;
pub mod picture;
pub mod scenes;
pub mod send;
pub mod simulate;
