//! Connections that are held open without a request.

use std::io;
use std::net::SocketAddr;

use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;

use super::http2;

/// What a connection sends before it is silent.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Opening {
    /// No byte is sent.
    Nothing,
    /// The first byte of the HTTP/2 preface.
    OneByte,
    /// Half the head of an HTTP/1 request.
    HalfHead,
    /// A whole HTTP/1 request, after which the connection is kept alive.
    KeepAlive,
    /// The HTTP/2 preface and empty settings; pings stay without an answer.
    Http2Preface,
    /// The first bytes of a TLS handshake.
    HalfHandshake,
}

/// All openings, in the order of the enum.
pub const OPENINGS: [Opening; 6] = [
    Opening::Nothing,
    Opening::OneByte,
    Opening::HalfHead,
    Opening::KeepAlive,
    Opening::Http2Preface,
    Opening::HalfHandshake,
];

impl Opening {
    fn bytes(self) -> Vec<u8> {
        match self {
            Self::Nothing => Vec::new(),
            Self::OneByte => b"P".to_vec(),
            Self::HalfHead => b"GET / HTTP/1.1\r\nHost: localhost\r\n".to_vec(),
            Self::KeepAlive => b"GET /healthz HTTP/1.1\r\nHost: localhost\r\n\r\n".to_vec(),
            Self::Http2Preface => http2::opening(65_535),
            Self::HalfHandshake => b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03".to_vec(),
        }
    }
}

/// Opens `count` connections that send this opening and then nothing more. They are closed when they are dropped.
///
/// # Errors
/// If the system of this process has no free file handle or port; connections that the server refuses are left out.
pub async fn hold(address: SocketAddr, count: usize, opening: Opening) -> io::Result<Vec<TcpStream>> {
    let mut held = Vec::with_capacity(count);
    for _ in 0..count {
        match TcpStream::connect(address).await {
            Ok(mut stream) => {
                // The server may have closed it already.
                let _ = stream.write_all(&opening.bytes()).await;
                held.push(stream);
            }
            Err(error) if error.kind() == io::ErrorKind::ConnectionRefused => {}
            Err(error) if error.kind() == io::ErrorKind::ConnectionReset => {}
            Err(error) => return Err(error),
        }
    }
    Ok(held)
}

/// Waits until the server has closed the connection; returns the number of bytes that it sent before.
pub async fn closed(stream: &mut TcpStream) -> usize {
    let (mut bytes, mut buffer) = (0, [0; 4096]);
    loop {
        match stream.read(&mut buffer).await {
            Ok(0) | Err(_) => return bytes,
            Ok(count) => bytes += count,
        }
    }
}
