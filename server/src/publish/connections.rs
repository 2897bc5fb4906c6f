//! A listener -> connections, so many at once and none that stays silent: what gRPC and the page accept from.
//!
//! A peer that opens connections by the thousand would use up the process' file handles, with which recordings are
//! opened too; one that connects and says nothing would hold its place for ever. Whoever finds no place can be let into
//! a small lobby for a short while, to be told so; beyond it, connections are closed at once: nobody waits behind a
//! thousand idle ones.

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

/// Connections at once that are told that there is no place; more are closed without a word.
const LOBBY_MAX: usize = 16;
/// For a handshake, one call and its answer.
const LOBBY_TIMEOUT: Duration = Duration::from_secs(5);
/// Whoever connects has something to say.
const FIRST_BYTE_TIMEOUT: Duration = Duration::from_secs(10);
/// After an error of the listener itself (no file handle left, say); trying again at once would only burn a core.
const ACCEPT_PAUSE: Duration = Duration::from_millis(200);

/// A listener with a bound on its connections.
#[derive(Debug)]
pub struct Connections {
    listener: TcpListener,
    room: Arc<Semaphore>,
    lobby: Option<Arc<Semaphore>>,
    connections_max: usize,
    first_byte: Duration,
}

/// Where a connection is; requests carry it among their extensions.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Place {
    /// It is served.
    Room,
    /// So many are served already, and that is all there may be: it is told so, and ended.
    Lobby(usize),
}

impl Connections {
    /// Of this listener, with places for so many; the others wait in the kernel.
    pub fn new(listener: TcpListener, connections_max: usize) -> Self {
        let room = Arc::new(Semaphore::new(connections_max));
        Self { listener, room, lobby: None, connections_max, first_byte: FIRST_BYTE_TIMEOUT }
    }

    /// Nobody waits: whoever serves them tells those in the lobby ([`Place::Lobby`]) that there is no place.
    pub fn with_lobby(self) -> Self {
        Self { lobby: Some(Arc::new(Semaphore::new(LOBBY_MAX))), ..self }
    }

    /// As tonic takes them.
    pub fn stream(self) -> impl Stream<Item = io::Result<Connection>> {
        stream::unfold(self, |mut connections| async move { Some((Ok(connections.next().await.0), connections)) })
    }

    /// Waits for a peer, and then for a place for it.
    async fn next(&mut self) -> (Connection, SocketAddr) {
        loop {
            match self.listener.accept().await {
                Ok((stream, peer)) => {
                    // A failure leaves the default, which is slower but right.
                    let _ = stream.set_nodelay(true);
                    if let Some(connection) = self.place(stream).await {
                        return (connection, peer);
                    }
                }
                Err(error) => {
                    tracing::warn!(%error, "accept");
                    tokio::time::sleep(ACCEPT_PAUSE).await;
                }
            }
        }
    }

    /// `None` where there is none, not even in the lobby.
    async fn place(&self, stream: TcpStream) -> Option<Connection> {
        let (permit, place) = match (self.room.clone().try_acquire_owned(), &self.lobby) {
            (Ok(permit), _) => (permit, Place::Room),
            (Err(_), None) => (self.room.clone().acquire_owned().await.ok()?, Place::Room),
            (Err(_), Some(lobby)) => (lobby.clone().try_acquire_owned().ok()?, Place::Lobby(self.connections_max)),
        };
        let limit = if place == Place::Room { self.first_byte } else { LOBBY_TIMEOUT };
        Some(Connection { stream, limit: Some(Box::pin(tokio::time::sleep(limit))), place, _permit: permit })
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
    /// Runs until the first byte; in the lobby, to the end.
    limit: Option<Pin<Box<Sleep>>>,
    place: Place,
    _permit: OwnedSemaphorePermit,
}

impl Connected for Connection {
    type ConnectInfo = Place;

    fn connect_info(&self) -> Place {
        self.place
    }
}

impl AsyncRead for Connection {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        let read = Pin::new(&mut self.stream).poll_read(context, buffer);
        if read.is_ready() && self.place == Place::Room {
            self.limit = None;
        } else if let Some(limit) = &mut self.limit
            && limit.as_mut().poll(context).is_ready()
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
        let mut connections = Connections { first_byte: Duration::from_millis(1), ..Connections::new(listener, 8) };
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
    async fn whoever_finds_no_place_is_let_into_the_lobby_and_each_that_goes_makes_room() {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = listener.local_addr().unwrap();
        let mut connections = Connections::new(listener, 1).with_lobby();
        let _peers = [(); 3].map(|()| std::net::TcpStream::connect(address).unwrap());
        let held = connections.next().await.0;
        assert_eq!(held.connect_info(), Place::Room);
        let told = connections.next().await.0;
        assert_eq!(told.connect_info(), Place::Lobby(1));
        drop(held);
        assert_eq!(connections.next().await.0.connect_info(), Place::Room);
    }

    #[tokio::test]
    async fn the_lobby_is_small_too_and_nobody_stays_in_it() {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = listener.local_addr().unwrap();
        let lobby = Some(Arc::new(Semaphore::new(1)));
        let mut connections = Connections { lobby, ..Connections::new(listener, 0) };
        let mut talker = TcpStream::connect(address).await.unwrap();
        let mut next = TcpStream::connect(address).await.unwrap();
        let mut told = connections.next().await.0;
        told.limit = Some(Box::pin(tokio::time::sleep(Duration::from_millis(1))));
        tokio::select! {
            _ = connections.next() => panic!("no place at all"),
            end = next.read_u8() => assert_eq!(end.unwrap_err().kind(), io::ErrorKind::UnexpectedEof),
        }
        talker.write_all(b"a").await.unwrap();
        told.stream.readable().await.unwrap();
        assert_eq!(told.read_u8().await.unwrap(), b'a');
        assert_eq!(told.read_u8().await.unwrap_err().kind(), io::ErrorKind::TimedOut, "talking does not help");
    }

    #[tokio::test]
    async fn without_a_lobby_the_next_one_waits_for_room() {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = listener.local_addr().unwrap();
        let mut connections = Connections::new(listener, 1);
        let _peers = [(); 2].map(|()| std::net::TcpStream::connect(address).unwrap());
        let held = connections.next().await.0;
        assert_eq!(connections.room.available_permits(), 0);
        drop(held);
        connections.next().await;
    }
}
