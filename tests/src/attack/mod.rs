//! Attacks on a running server, for the bench `siege`. Each runs until its time is over, and disturbs one listener.
//!
//! | file | listener |
//! |---|---|
//! | [`h2`] | gRPC: frames of HTTP/2 as no honest client sends them |
//! | [`sockets`] | every TCP listener: silence, single bytes, half headers, many connections |
//! | [`datagrams`] | UDP: floods of datagrams that are no packets, and of packets of another sender |
//! | [`peers`] | zenoh: junk, forged maps, false answers |
//! | [`watch`] | the healthy readers beside the attacks, and the server's memory |

pub mod datagrams;
pub mod h2;
pub mod peers;
pub mod sockets;
pub mod watch;

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
pub struct Attack {
    /// What it does, in a few words.
    pub name: &'static str,
    /// Runs it.
    pub run: fn(Target) -> BoxFuture<'static, ()>,
}

/// Every attack, in the order of the table.
pub fn attacks() -> Vec<Attack> {
    [sockets::ATTACKS, h2::ATTACKS, datagrams::ATTACKS, peers::ATTACKS].concat()
}

impl Clone for Attack {
    fn clone(&self) -> Self {
        Self { name: self.name, run: self.run }
    }
}
