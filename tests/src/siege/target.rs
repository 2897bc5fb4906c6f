//! The server under attack, and one attack.

use std::net::SocketAddr;

use futures::future::BoxFuture;

/// Where the server under attack listens.
#[derive(Clone, Debug)]
pub struct Target {
    /// gRPC.
    pub grpc: SocketAddr,
    /// The page.
    pub page: SocketAddr,
    /// Datagrams of the sensor.
    pub udp: SocketAddr,
    /// zenoh, such as `tcp/127.0.0.1:7447`.
    pub zenoh: String,
}

/// One attack: it runs until it is dropped, and returns early only if the server cannot be reached at all.
#[derive(Clone)]
pub struct Attack {
    /// What it does, in a few words.
    pub name: &'static str,
    /// Runs it.
    pub run: fn(Target) -> BoxFuture<'static, ()>,
}
