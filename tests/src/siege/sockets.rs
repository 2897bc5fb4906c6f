//! TCP connections that say little: they take places that honest clients need.

use std::net::SocketAddr;
use std::time::Duration;

use futures::FutureExt;
use futures::future::join_all;
use tokio::io::{AsyncReadExt, AsyncWriteExt};

use super::target::{Attack, Target, connect};

/// Connections of one attack at once: as many as a listener of the default configuration allows, and some more.
const CONNECTIONS: usize = 300;
/// Pause before a connection that was cut is opened again.
const AGAIN: Duration = Duration::from_millis(20);

/// The attacks of this file.
pub const ATTACKS: &[Attack] = &[
    Attack { name: "gRPC: 300 silent sockets", run: |target| hold(target.grpc, b"").boxed() },
    Attack { name: "gRPC: 300 sockets with one byte", run: |target| hold(target.grpc, b"P").boxed() },
    Attack { name: "gRPC: connect and hang up", run: |target| hang_up(target.grpc).boxed() },
    Attack {
        name: "page: 300 half headers",
        run: |target| hold(target.page, b"GET / HTTP/1.1\r\nHost: a\r\n").boxed(),
    },
    Attack { name: "page: 300 idle keep-alives", run: |target| hold(target.page, REQUEST).boxed() },
    Attack { name: "page: 300 WebSockets that never read", run: |target| hold(target.page, UPGRADE).boxed() },
    Attack { name: "zenoh: 300 silent sockets", run: |target| hold(zenoh(&target), b"").boxed() },
    Attack { name: "zenoh: 300 half handshakes", run: |target| hold(zenoh(&target), b"\x10\x00\x01").boxed() },
];

const REQUEST: &[u8] = b"GET /healthz HTTP/1.1\r\nHost: localhost\r\n\r\n";
const UPGRADE: &[u8] = b"GET /live HTTP/1.1\r\nHost: localhost\r\nConnection: Upgrade\r\n\
    Upgrade: websocket\r\nSec-WebSocket-Version: 13\r\nSec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n";

fn zenoh(target: &Target) -> SocketAddr {
    target.zenoh.trim_start_matches("tcp/").parse().expect("an address of ours")
}

/// Keeps [`CONNECTIONS`] open, each with these bytes sent and nothing read; opens connections again that are cut.
async fn hold(at: SocketAddr, bytes: &'static [u8]) {
    join_all((0..CONNECTIONS).map(|_| async move {
        loop {
            if let Ok(mut socket) = connect(at).await
                && socket.write_all(bytes).await.is_ok()
            {
                // A peer that never reads notices nothing but an error.
                let _cut = socket.ready(tokio::io::Interest::ERROR).await;
            }
            tokio::time::sleep(AGAIN).await;
        }
    }))
    .await;
}

/// Opens and closes connections as fast as one task can.
async fn hang_up(at: SocketAddr) {
    loop {
        match connect(at).await {
            Ok(mut socket) => _ = socket.read(&mut [0; 1]).now_or_never(),
            Err(_) => tokio::time::sleep(AGAIN).await,
        }
    }
}
