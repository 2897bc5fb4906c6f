//! One accepted connection, plain or encrypted, which ends when its place says so.

use std::io;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};

use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::TcpStream;
use tokio_rustls::server::TlsStream;
use tokio_util::sync::WaitForCancellationFutureOwned;

use super::frames::Frames;
use super::places::Place;

/// Most bytes that are read of one connection before other tasks have their turn. Ours: what a thread reads and answers
/// in less than a millisecond, whatever it is; a scan takes some dozens of turns.
const TURN_BYTES: usize = 64 << 10;

/// The bytes of a connection.
#[derive(Debug)]
pub enum Transport {
    /// Plain text.
    Plain(TcpStream),
    /// Encrypted.
    Tls(Box<TlsStream<TcpStream>>),
}

/// An accepted connection.
pub struct Connection {
    transport: Transport,
    place: Arc<Place>,
    closing: Pin<Box<WaitForCancellationFutureOwned>>,
    /// Bytes read in this turn.
    read: usize,
    /// The client's frames, if it speaks HTTP/2.
    frames: Option<Frames>,
}

impl Connection {
    /// A connection in this place.
    pub fn new(transport: Transport, place: Arc<Place>, is_http2: bool) -> Self {
        let closing = Box::pin(place.closing().cancelled_owned());
        Self { transport, place, closing, read: 0, frames: is_http2.then(Frames::new) }
    }

    /// # Errors
    /// `TimedOut` once the connection is to be closed.
    fn check_open(&mut self, context: &mut Context<'_>) -> io::Result<()> {
        match self.closing.as_mut().poll(context) {
            Poll::Ready(()) => Err(io::ErrorKind::TimedOut.into()),
            Poll::Pending => Ok(()),
        }
    }

    /// # Errors
    /// `ConnectionAborted` if the client floods the server.
    fn check_frames(&mut self, bytes: &[u8]) -> io::Result<()> {
        let Some(frames) = &mut self.frames else { return Ok(()) };
        frames.count(bytes, self.place.take_pieces()).map_err(|flood| {
            self.place.close_for_flood(flood.frame);
            io::Error::new(io::ErrorKind::ConnectionAborted, flood)
        })
    }

    fn written<T>(&self, written: Poll<T>) -> Poll<T> {
        self.place.set_blocked(written.is_pending());
        written
    }
}

macro_rules! on_transport {
    ($self:ident, $method:ident $(, $argument:expr)*) => {
        match &mut $self.transport {
            Transport::Plain(stream) => Pin::new(stream).$method($($argument),*),
            Transport::Tls(stream) => Pin::new(stream).$method($($argument),*),
        }
    };
}

impl AsyncRead for Connection {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        self.check_open(context)?;
        if self.read >= TURN_BYTES {
            self.read = 0;
            context.waker().wake_by_ref();
            return Poll::Pending;
        }
        let before = buffer.filled().len();
        let read = on_transport!(self, poll_read, context, buffer);
        let bytes = &buffer.filled()[before..];
        self.read = if read.is_pending() { 0 } else { self.read + bytes.len() };
        self.check_frames(bytes)?;
        read
    }
}

impl AsyncWrite for Connection {
    fn poll_write(mut self: Pin<&mut Self>, context: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        self.check_open(context)?;
        let written = on_transport!(self, poll_write, context, bytes);
        self.written(written)
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        self.check_open(context)?;
        let flushed = on_transport!(self, poll_flush, context);
        self.written(flushed)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        self.check_open(context)?;
        on_transport!(self, poll_shutdown, context)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bytes: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        self.check_open(context)?;
        let written = on_transport!(self, poll_write_vectored, context, bytes);
        self.written(written)
    }

    fn is_write_vectored(&self) -> bool {
        match &self.transport {
            Transport::Plain(stream) => stream.is_write_vectored(),
            Transport::Tls(stream) => stream.is_write_vectored(),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::future::poll_fn;
    use std::pin::pin;

    use tokio::io::AsyncReadExt;
    use tokio::net::TcpListener;

    use super::super::flow::Flows;
    use super::super::places::{Limits, Places};
    use super::*;
    use crate::config;

    #[tokio::test]
    async fn other_tasks_have_their_turn_beside_a_connection_that_always_has_bytes() {
        let limits = Limits::new(&config::Connections::default(), 8, "the test");
        let place = Arc::new(Places::new(limits, Flows::new(8, 8, 0)).admit([127, 0, 0, 1].into()));
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let client = TcpStream::connect(listener.local_addr().unwrap()).await.unwrap();
        let (server, _) = listener.accept().await.unwrap();
        client.writable().await.unwrap();
        let mut waiting = 0;
        while let Ok(count) = client.try_write(&[0; 1 << 16]) {
            waiting += count;
        }
        assert!(waiting > 3 * TURN_BYTES, "the kernel holds {waiting} bytes");
        let mut connection = Connection::new(Transport::Plain(server), place, false);
        // Small enough that tokio's own limit, 128 reads, is later.
        let mut bytes = vec![0; 4096];
        let (mut all, mut in_turn, mut most) = (0, 0, 0);
        while all < 3 * TURN_BYTES {
            let mut reading = pin!(connection.read(&mut bytes));
            let count = poll_fn(|context| {
                let polled = reading.as_mut().poll(context);
                in_turn = if polled.is_pending() { 0 } else { in_turn };
                polled
            });
            let count = count.await.unwrap();
            (all, in_turn) = (all + count, in_turn + count);
            most = most.max(in_turn);
        }
        assert!(most < 2 * TURN_BYTES, "{most} bytes were read in one turn");
    }
}
