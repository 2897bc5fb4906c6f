//! Hostile HTTP/2 in plain text, frame by frame: RFC 9113.

use std::io;
use std::net::SocketAddr;

use clearway_proto::v1;
use prost::Message;
use tokio::io::AsyncWriteExt;
use tokio::net::TcpStream;

/// Type of a frame: bytes of a stream.
pub const DATA: u8 = 0;
/// Type of a frame: the head of a request.
pub const HEADERS: u8 = 1;
/// Type of a frame: the end of a stream.
pub const RESET: u8 = 3;
/// Type of a frame: settings of the connection.
pub const SETTINGS: u8 = 4;
/// Type of a frame: a question whether the peer is there.
pub const PING: u8 = 6;
/// Type of a frame: more bytes may be sent.
pub const WINDOW_UPDATE: u8 = 8;
/// Type of a frame: the rest of a head.
pub const CONTINUATION: u8 = 9;
/// Flag of a frame of type `PING` or `SETTINGS`: it is an answer.
pub const ACKNOWLEDGED: u8 = 1;
/// Flag of a frame of type `DATA`: the stream ends with it.
pub const END_STREAM: u8 = 1;
/// Flag of a frame of type `HEADERS`: the head ends with it.
pub const END_HEADERS: u8 = 4;
/// Setting: window of a new stream.
const INITIAL_WINDOW: u16 = 4;
/// The path of the streams of maps.
pub const WATCH: &str = "/clearway.v1.MapService/Watch";
/// The largest window that HTTP/2 allows, in bytes.
pub const WINDOW_MAX: u32 = (1 << 31) - 1;

/// The bytes of an HTTP/2 frame.
pub fn frame(kind: u8, flags: u8, stream: u32, payload: &[u8]) -> Vec<u8> {
    let length = u32::try_from(payload.len()).expect("a short frame").to_be_bytes();
    [&length[1..], &[kind, flags], &stream.to_be_bytes(), payload].concat()
}

/// The preface of a client whose streams have this window; the window of the connection is as large, if it is more than
/// HTTP/2's default.
pub fn opening(stream_window: u32) -> Vec<u8> {
    let mut bytes = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n".to_vec();
    bytes.extend(settings(stream_window));
    if stream_window > 65_535 {
        bytes.extend(frame(WINDOW_UPDATE, 0, 0, &(stream_window - 65_535).to_be_bytes()));
    }
    bytes
}

/// The setting of the window of new streams.
pub fn settings(stream_window: u32) -> Vec<u8> {
    frame(SETTINGS, 0, 0, &[&INITIAL_WINDOW.to_be_bytes()[..], &stream_window.to_be_bytes()].concat())
}

/// The head of a gRPC call on a stream with an odd number.
pub fn call(stream: u32, path: &str) -> Vec<u8> {
    frame(HEADERS, END_HEADERS, stream, &header_block(path))
}

/// The header block of a gRPC call, without compression (RFC 7541).
pub fn header_block(path: &str) -> Vec<u8> {
    let kind = b"application/grpc";
    let length = |text: &[u8]| u8::try_from(text.len()).expect("a short header");
    // POST, http; path, authority, content-type and te as literals without index.
    let mut headers = vec![0x83, 0x86, 0x04, length(path.as_bytes())];
    headers.extend(path.as_bytes());
    headers.extend(b"\x01\x09localhost\x0f\x10");
    headers.push(length(kind));
    headers.extend(kind);
    headers.extend(b"\x00\x02te\x08trailers");
    headers
}

/// A message of a gRPC call.
pub fn message(stream: u32, message: &impl Message) -> Vec<u8> {
    let encoded = message.encode_to_vec();
    claimed_message(stream, u32::try_from(encoded.len()).expect("a short message"), &encoded)
}

/// The beginning of a message of a gRPC call that claims this length.
pub fn claimed_message(stream: u32, length: u32, begin: &[u8]) -> Vec<u8> {
    frame(DATA, 0, stream, &[&[0], &length.to_be_bytes()[..], begin].concat())
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
/// If the server does not accept a connection; a connection that it closes afterwards is no error.
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
