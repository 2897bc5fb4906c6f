//! A listener -> connections, so many at once and none that stays silent: what gRPC and the page accept from.
//!
//! A peer that opens connections by the thousand would use up the process' file handles, with which recordings are
//! opened too; one that connects and says nothing would hold its place for ever.

use std::io;
use std::net::SocketAddr;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};
use std::time::Duration;

use futures::{Stream, stream};
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio::time::Sleep;
use tonic::transport::server::Connected;

/// Open at once on one listener; the others wait in the kernel. Two listeners take half of the 1024 handles that a process
/// usually has.
const CONNECTIONS_MAX: usize = 256;
/// Whoever connects has something to say.
const FIRST_BYTE_TIMEOUT: Duration = Duration::from_secs(10);
/// After an error of the listener itself (no file handle left, say); trying again at once would only burn a core.
const ACCEPT_PAUSE: Duration = Duration::from_millis(200);

/// A listener with a bound on its connections.
#[derive(Debug)]
pub struct Connections {
    listener: TcpListener,
    room: Arc<Semaphore>,
    first_byte: Duration,
}

impl Connections {
    /// Of this listener.
    pub fn new(listener: TcpListener) -> Self {
        Self { listener, room: Arc::new(Semaphore::new(CONNECTIONS_MAX)), first_byte: FIRST_BYTE_TIMEOUT }
    }

    /// As tonic takes them.
    pub fn stream(self) -> impl Stream<Item = io::Result<Connection>> {
        stream::unfold(self, |mut connections| async move { Some((Ok(connections.next().await.0), connections)) })
    }

    /// Waits for room, and then for a peer.
    async fn next(&mut self) -> (Connection, SocketAddr) {
        loop {
            let Ok(room) = self.room.clone().acquire_owned().await else {
                // Nobody closes this semaphore.
                std::future::pending::<()>().await;
                continue;
            };
            match self.listener.accept().await {
                Ok((stream, peer)) => {
                    // A failure leaves the default, which is slower but right.
                    let _ = stream.set_nodelay(true);
                    let silence = Some(Box::pin(tokio::time::sleep(self.first_byte)));
                    return (Connection { stream, silence, _room: room }, peer);
                }
                Err(error) => {
                    tracing::warn!(%error, "accept");
                    tokio::time::sleep(ACCEPT_PAUSE).await;
                }
            }
        }
    }
}

impl axum::serve::Listener for Connections {
    type Io = Connection;
    type Addr = SocketAddr;

    async fn accept(&mut self) -> (Connection, SocketAddr) {
        self.next().await
    }

    fn local_addr(&self) -> io::Result<SocketAddr> {
        self.listener.local_addr()
    }
}

/// One accepted connection; its place is free again when it is dropped.
#[derive(Debug)]
pub struct Connection {
    stream: TcpStream,
    /// Runs until the first byte.
    silence: Option<Pin<Box<Sleep>>>,
    _room: OwnedSemaphorePermit,
}

impl Connected for Connection {
    type ConnectInfo = ();

    fn connect_info(&self) {}
}

impl AsyncRead for Connection {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        let read = Pin::new(&mut self.stream).poll_read(context, buffer);
        if read.is_ready() {
            self.silence = None;
        } else if let Some(silence) = &mut self.silence
            && silence.as_mut().poll(context).is_ready()
        {
            return Poll::Ready(Err(io::ErrorKind::TimedOut.into()));
        }
        read
    }
}

impl AsyncWrite for Connection {
    fn poll_write(mut self: Pin<&mut Self>, context: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        Pin::new(&mut self.stream).poll_write(context, bytes)
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_flush(context)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_shutdown(context)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bytes: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        Pin::new(&mut self.stream).poll_write_vectored(context, bytes)
    }

    fn is_write_vectored(&self) -> bool {
        self.stream.is_write_vectored()
    }
}

#[cfg(test)]
mod tests {
    use tokio::io::{AsyncReadExt, AsyncWriteExt};

    use super::*;

    #[tokio::test]
    async fn a_peer_that_says_nothing_is_dropped_and_one_that_speaks_stays() {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = listener.local_addr().unwrap();
        let mut connections = Connections { first_byte: Duration::from_millis(1), ..Connections::new(listener) };
        let _mute = TcpStream::connect(address).await.unwrap();
        let mut mute = connections.next().await.0;
        assert_eq!(mute.read_u8().await.unwrap_err().kind(), io::ErrorKind::TimedOut);

        let mut speaker = TcpStream::connect(address).await.unwrap();
        speaker.write_all(b"a").await.unwrap();
        let mut heard = connections.next().await.0;
        heard.stream.readable().await.unwrap();
        assert_eq!(heard.read_u8().await.unwrap(), b'a');
        // Silent again, and for longer: the limit is for the first byte.
        let pause = tokio::time::timeout(Duration::from_millis(5), heard.read_u8()).await;
        assert!(pause.is_err(), "it waits");
        speaker.write_all(b"b").await.unwrap();
        assert_eq!(heard.read_u8().await.unwrap(), b'b');
    }

    #[tokio::test]
    async fn there_is_room_for_so_many_and_each_that_goes_makes_room() {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = listener.local_addr().unwrap();
        let mut connections = Connections { room: Arc::new(Semaphore::new(1)), ..Connections::new(listener) };
        let _first = TcpStream::connect(address).await.unwrap();
        let _second = TcpStream::connect(address).await.unwrap();
        let held = connections.next().await.0;
        assert_eq!(connections.room.available_permits(), 0);
        drop(held);
        connections.next().await;
    }
}
