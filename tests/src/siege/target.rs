//! The server under attack, and one attack.

use std::net::{Ipv4Addr, SocketAddr};

use futures::future::BoxFuture;
use tokio::net::{TcpSocket, TcpStream};

/// The address that TCP attacks come from: not the address of the honest peers, because limits are by address.
const ATTACKER: Ipv4Addr = Ipv4Addr::new(127, 0, 0, 2);

/// Where the server under attack listens.
#[derive(Clone, Debug)]
pub struct Target {
    /// Address of the gRPC listener.
    pub grpc: SocketAddr,
    /// Address of the page's listener.
    pub page: SocketAddr,
    /// Address of the WebSocket listener for Foxglove.
    pub foxglove: SocketAddr,
    /// Address that receives the sensor's datagrams.
    pub udp: SocketAddr,
    /// zenoh, such as `tcp/127.0.0.1:7447`.
    pub zenoh: String,
}

/// One attack: it runs until it is dropped, and returns early only if the server cannot be reached at all.
#[derive(Clone)]
pub struct Attack {
    /// What it does, in a few words.
    pub name: &'static str,
    /// Runs the attack on a target.
    pub run: fn(Target) -> BoxFuture<'static, ()>,
}

/// A connection of an attacker.
///
/// # Errors
/// As of the socket.
pub async fn connect(at: SocketAddr) -> std::io::Result<TcpStream> {
    let socket = TcpSocket::new_v4()?;
    socket.bind((ATTACKER, 0).into())?;
    socket.connect(at).await
}
