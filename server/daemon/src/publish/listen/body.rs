//! The body of a response -> pieces for the transport, counted while they wait.

use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};
use std::time::Duration;

use axum::body::{Body, HttpBody};
use bytes::Bytes;
use http_body::{Frame, SizeHint};
use tokio::time::Sleep;

use super::flow::Flow;
use super::places::{Grant, InProgress};

/// Longest piece of a message that the transport gets at once: how much a peer must receive within the time limit for
/// stalled connections.
const PIECE_BYTES: usize = 16 << 10;
/// Pause until a response that is over a limit looks again.
const OVER_LIMIT_PAUSE: Duration = Duration::from_millis(20);

/// A piece of a message, which counts as waiting until the transport has sent or dropped it.
struct Piece {
    bytes: Bytes,
    flow: Arc<Flow>,
}

impl AsRef<[u8]> for Piece {
    fn as_ref(&self) -> &[u8] {
        &self.bytes
    }
}

impl Drop for Piece {
    fn drop(&mut self) {
        self.flow.remove(self.bytes.len());
    }
}

/// The body of a response, whose request is in progress until it ends, and whose bytes are counted while they wait.
pub struct CountedBody {
    body: Body,
    /// What is left of the message that is being sent.
    rest: Bytes,
    flow: Option<Arc<Flow>>,
    pause: Option<Pin<Box<Sleep>>>,
    in_progress: InProgress,
    _grant: Option<Arc<Grant>>,
}

impl CountedBody {
    /// Without a flow, bytes are not counted.
    pub fn new(body: Body, in_progress: InProgress, flow: Option<Arc<Flow>>, grant: Option<Arc<Grant>>) -> Self {
        // From now on the transport should ask for the first piece.
        flow.iter().for_each(|flow| flow.set_polled(false));
        Self { body, rest: Bytes::new(), flow, pause: None, in_progress, _grant: grant }
    }

    /// The next piece of the message.
    fn piece(&mut self, flow: Arc<Flow>) -> Frame<Bytes> {
        let bytes = self.rest.split_to(self.rest.len().min(PIECE_BYTES));
        flow.set_polled(false);
        self.in_progress.place().add_piece();
        Frame::data(Bytes::from_owner(Piece { bytes, flow }))
    }
}

impl HttpBody for CountedBody {
    type Data = Bytes;
    type Error = axum::Error;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, axum::Error>>> {
        let Some(flow) = self.flow.clone() else { return Pin::new(&mut self.body).poll_frame(context) };
        flow.set_polled(true);
        if !self.rest.is_empty() {
            return Poll::Ready(Some(Ok(self.piece(flow))));
        }
        while !flow.is_within_limits() {
            let pause = self.pause.get_or_insert_with(|| Box::pin(tokio::time::sleep(OVER_LIMIT_PAUSE)));
            std::task::ready!(pause.as_mut().poll(context));
            self.pause = None;
        }
        match std::task::ready!(Pin::new(&mut self.body).poll_frame(context)) {
            Some(Ok(frame)) => match frame.into_data() {
                Ok(data) if data.is_empty() => Poll::Ready(Some(Ok(Frame::data(data)))),
                Ok(data) => {
                    flow.add(data.len());
                    self.rest = data;
                    Poll::Ready(Some(Ok(self.piece(flow))))
                }
                Err(trailers) => Poll::Ready(Some(Ok(trailers))),
            },
            end => Poll::Ready(end),
        }
    }

    fn is_end_stream(&self) -> bool {
        self.rest.is_empty() && self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        if self.rest.is_empty() { self.body.size_hint() } else { SizeHint::default() }
    }
}

impl Drop for CountedBody {
    fn drop(&mut self) {
        if let Some(flow) = &self.flow {
            flow.remove(self.rest.len());
        }
    }
}
