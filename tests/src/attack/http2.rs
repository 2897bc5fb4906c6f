//! Hostile HTTP/2 in plain text, frame by frame: RFC 9113.

use std::io;
use std::net::SocketAddr;

use clearway_proto::v1;
use prost::Message;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;

/// Types of frames.
const DATA: u8 = 0;
const HEADERS: u8 = 1;
const RESET: u8 = 3;
const SETTINGS: u8 = 4;
const PING: u8 = 6;
const WINDOW_UPDATE: u8 = 8;
/// Flags of frames.
const ACKNOWLEDGED: u8 = 1;
const END_HEADERS: u8 = 4;
/// Setting: window of a new stream.
const INITIAL_WINDOW: u16 = 4;
/// The path of the streams of maps.
pub const WATCH: &str = "/clearway.v1.MapService/Watch";
/// The largest window.
pub const WINDOW_MAX: u32 = (1 << 31) - 1;

/// A frame.
pub fn frame(kind: u8, flags: u8, stream: u32, payload: &[u8]) -> Vec<u8> {
    let length = u32::try_from(payload.len()).expect("a short frame").to_be_bytes();
    [&length[1..], &[kind, flags], &stream.to_be_bytes(), payload].concat()
}

/// The preface of a client whose streams have this window; the window of the connection is as large, if it is more than
/// HTTP/2's default.
pub fn opening(stream_window: u32) -> Vec<u8> {
    let settings = [&INITIAL_WINDOW.to_be_bytes()[..], &stream_window.to_be_bytes()].concat();
    let mut bytes = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n".to_vec();
    bytes.extend(frame(SETTINGS, 0, 0, &settings));
    if stream_window > 65_535 {
        bytes.extend(frame(WINDOW_UPDATE, 0, 0, &(stream_window - 65_535).to_be_bytes()));
    }
    bytes
}

/// The head of a gRPC call on a stream with an odd number.
pub fn call(stream: u32, path: &str) -> Vec<u8> {
    let kind = b"application/grpc";
    let length = |text: &[u8]| u8::try_from(text.len()).expect("a short header");
    // POST, http; path, authority, content-type and te as literals without index.
    let mut headers = vec![0x83, 0x86, 0x04, length(path.as_bytes())];
    headers.extend(path.as_bytes());
    headers.extend(b"\x01\x09localhost\x0f\x10");
    headers.push(length(kind));
    headers.extend(kind);
    headers.extend(b"\x00\x02te\x08trailers");
    frame(HEADERS, END_HEADERS, stream, &headers)
}

/// A message of a gRPC call.
pub fn message(stream: u32, message: &impl Message) -> Vec<u8> {
    let encoded = message.encode_to_vec();
    let length = u32::try_from(encoded.len()).expect("a short message").to_be_bytes();
    frame(DATA, 0, stream, &[&[0], &length[..], &encoded].concat())
}

/// A `Watch` of all layers of the only vehicle, by a reader that never acknowledges.
pub fn watch(stream: u32) -> Vec<u8> {
    let first = v1::WatchRequest { selection: Some(v1::Selection::default()), ..Default::default() };
    [call(stream, WATCH), message(stream, &first)].concat()
}

/// The end of a stream by the client.
pub fn reset(stream: u32) -> Vec<u8> {
    frame(RESET, 0, stream, &8_u32.to_be_bytes())
}

/// Opens `connections` connections with `streams` streams of maps each, and the largest windows; nothing is ever read.
///
/// # Errors
/// If the server does not accept a connection; one that it closes afterwards is no error.
pub async fn never_read(address: SocketAddr, connections: usize, streams: u32) -> io::Result<Vec<TcpStream>> {
    let mut held = Vec::new();
    for _ in 0..connections {
        let mut stream = TcpStream::connect(address).await?;
        let mut bytes = opening(WINDOW_MAX);
        (0..streams).for_each(|index| bytes.extend(watch(2 * index + 1)));
        let _ = stream.write_all(&bytes).await;
        held.push(stream);
    }
    Ok(held)
}

/// Opens one stream of maps with a window of `window` bytes, grants no more, and answers every ping and settings frame
/// until the server closes the connection. Returns the number of bytes of maps received.
///
/// # Errors
/// If the server does not accept the connection.
pub async fn answer_pings_only(address: SocketAddr, window: u32) -> io::Result<usize> {
    let mut stream = TcpStream::connect(address).await?;
    stream.write_all(&[opening(window), watch(1)].concat()).await?;
    let mut maps = 0;
    loop {
        let mut head = [0; 9];
        if stream.read_exact(&mut head).await.is_err() {
            return Ok(maps);
        }
        let mut payload = vec![0; u32::from_be_bytes([0, head[0], head[1], head[2]]) as usize];
        if stream.read_exact(&mut payload).await.is_err() {
            return Ok(maps);
        }
        let answer = match (head[3], head[4] & ACKNOWLEDGED) {
            (PING, 0) => frame(PING, ACKNOWLEDGED, 0, &payload),
            (SETTINGS, 0) => frame(SETTINGS, ACKNOWLEDGED, 0, &[]),
            (DATA, _) => {
                maps += payload.len();
                continue;
            }
            _ => continue,
        };
        if stream.write_all(&answer).await.is_err() {
            return Ok(maps);
        }
    }
}
