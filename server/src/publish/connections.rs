//! A listener -> connections, limited in number and in silence: gRPC and the page accept from it.
//!
//! A peer that opens thousands of connections would use up the file handles of the process, which recordings need too; a
//! peer that connects and sends nothing would keep its connection for ever. A connection over the limit can be accepted
//! for a short time, so that its peer gets an error that says why. Only a few of these are open at once; all others over
//! the limit are closed immediately.

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

/// Most connections over the limit that are open at once to receive an error; others are closed without one. Ours: a
/// small share of the file handles of a process.
const OVER_LIMIT_MAX: usize = 16;
/// Longest time that a connection over the limit stays open: enough for a handshake, one call and its answer.
const OVER_LIMIT_TIMEOUT: Duration = Duration::from_secs(5);
/// Longest time from the connection to its first byte. Ours: every client sends at once.
const FIRST_BYTE_TIMEOUT: Duration = Duration::from_secs(10);
/// Pause after an error of the listener itself, such as no free file handle: to try again at once would only use a core.
const ACCEPT_PAUSE: Duration = Duration::from_millis(200);

/// A listener with a limit on its connections.
#[derive(Debug)]
pub struct Connections {
    listener: TcpListener,
    permits: Arc<Semaphore>,
    over_limit: Option<Arc<Semaphore>>,
    connections_max: usize,
    first_byte: Duration,
}

/// Whether a connection is within the limit; requests carry it in their extensions.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Admission {
    /// The connection is served.
    Served,
    /// The connection is over the limit, which is the number: it gets an error and is closed.
    OverLimit(usize),
}

impl Connections {
    /// Limits a listener to `connections_max` connections; others wait in the kernel.
    pub fn new(listener: TcpListener, connections_max: usize) -> Self {
        let permits = Arc::new(Semaphore::new(connections_max));
        Self { listener, permits, over_limit: None, connections_max, first_byte: FIRST_BYTE_TIMEOUT }
    }

    /// Accepts connections over the limit too, as [`Admission::OverLimit`]; the server must answer them with an error.
    pub fn with_errors_over_limit(self) -> Self {
        Self { over_limit: Some(Arc::new(Semaphore::new(OVER_LIMIT_MAX))), ..self }
    }

    /// The connections as a stream, as tonic needs them.
    pub fn stream(self) -> impl Stream<Item = io::Result<Connection>> {
        stream::unfold(self, |mut connections| async move { Some((Ok(connections.next().await.0), connections)) })
    }

    /// Waits for a peer, and then for a permit.
    async fn next(&mut self) -> (Connection, SocketAddr) {
        loop {
            match self.listener.accept().await {
                Ok((stream, peer)) => {
                    // A failure leaves the default, which is slower but right.
                    let _ = stream.set_nodelay(true);
                    if let Some(connection) = self.admit(stream).await {
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

    /// Admits a connection; `None` if it is over the limit and cannot get an error either.
    async fn admit(&self, stream: TcpStream) -> Option<Connection> {
        let (permit, admission) = match (self.permits.clone().try_acquire_owned(), &self.over_limit) {
            (Ok(permit), _) => (permit, Admission::Served),
            (Err(_), None) => (self.permits.clone().acquire_owned().await.ok()?, Admission::Served),
            (Err(_), Some(over_limit)) => {
                (over_limit.clone().try_acquire_owned().ok()?, Admission::OverLimit(self.connections_max))
            }
        };
        let limit = if admission == Admission::Served { self.first_byte } else { OVER_LIMIT_TIMEOUT };
        Some(Connection { stream, limit: Some(Box::pin(tokio::time::sleep(limit))), admission, _permit: permit })
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

/// One accepted connection; its permit is free again when it is dropped.
#[derive(Debug)]
pub struct Connection {
    stream: TcpStream,
    /// Time limit: until the first byte, or for the whole connection if it is over the limit.
    limit: Option<Pin<Box<Sleep>>>,
    admission: Admission,
    _permit: OwnedSemaphorePermit,
}

impl Connected for Connection {
    type ConnectInfo = Admission;

    fn connect_info(&self) -> Admission {
        self.admission
    }
}

impl AsyncRead for Connection {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        let read = Pin::new(&mut self.stream).poll_read(context, buffer);
        if read.is_ready() && self.admission == Admission::Served {
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
    async fn a_silent_peer_is_dropped_and_one_that_sends_stays() {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = listener.local_addr().unwrap();
        let mut connections = Connections { first_byte: Duration::from_millis(1), ..Connections::new(listener, 8) };
        let _silent = TcpStream::connect(address).await.unwrap();
        let mut silent = connections.next().await.0;
        assert_eq!(silent.read_u8().await.unwrap_err().kind(), io::ErrorKind::TimedOut);

        let mut sender = TcpStream::connect(address).await.unwrap();
        sender.write_all(b"a").await.unwrap();
        let mut received = connections.next().await.0;
        received.stream.readable().await.unwrap();
        assert_eq!(received.read_u8().await.unwrap(), b'a');
        // It is silent again, for longer: the limit is for the first byte only.
        let pause = tokio::time::timeout(Duration::from_millis(5), received.read_u8()).await;
        assert!(pause.is_err(), "it waits");
        sender.write_all(b"b").await.unwrap();
        assert_eq!(received.read_u8().await.unwrap(), b'b');
    }

    #[tokio::test]
    async fn a_connection_over_the_limit_is_admitted_to_get_an_error() {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = listener.local_addr().unwrap();
        let mut connections = Connections::new(listener, 1).with_errors_over_limit();
        let _peers = [(); 3].map(|()| std::net::TcpStream::connect(address).unwrap());
        let held = connections.next().await.0;
        assert_eq!(held.connect_info(), Admission::Served);
        let rejected = connections.next().await.0;
        assert_eq!(rejected.connect_info(), Admission::OverLimit(1));
        drop(held);
        assert_eq!(connections.next().await.0.connect_info(), Admission::Served);
    }

    #[tokio::test]
    async fn connections_over_the_limit_are_few_and_short() {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = listener.local_addr().unwrap();
        let over_limit = Some(Arc::new(Semaphore::new(1)));
        let mut connections = Connections { over_limit, ..Connections::new(listener, 0) };
        let mut sender = TcpStream::connect(address).await.unwrap();
        let mut next = TcpStream::connect(address).await.unwrap();
        let mut rejected = connections.next().await.0;
        rejected.limit = Some(Box::pin(tokio::time::sleep(Duration::from_millis(1))));
        tokio::select! {
            _ = connections.next() => panic!("no connection at all"),
            end = next.read_u8() => assert_eq!(end.unwrap_err().kind(), io::ErrorKind::UnexpectedEof),
        }
        sender.write_all(b"a").await.unwrap();
        rejected.stream.readable().await.unwrap();
        assert_eq!(rejected.read_u8().await.unwrap(), b'a');
        assert_eq!(
            rejected.read_u8().await.unwrap_err().kind(),
            io::ErrorKind::TimedOut,
            "the limit is for the whole connection"
        );
    }

    #[tokio::test]
    async fn without_errors_over_the_limit_the_next_connection_waits() {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = listener.local_addr().unwrap();
        let mut connections = Connections::new(listener, 1);
        let _peers = [(); 2].map(|()| std::net::TcpStream::connect(address).unwrap());
        let held = connections.next().await.0;
        assert_eq!(connections.permits.available_permits(), 0);
        drop(held);
        connections.next().await;
    }
}
