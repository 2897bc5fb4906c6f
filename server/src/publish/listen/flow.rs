//! What waits in the server for its readers: bytes of one response, of its connection, of its address, and of all.
//!
//! A response gives its next message to the transport only while all four are within their limits, so that readers that
//! do not read cost the server no more than these, and skip maps instead. A connection for which nothing waits may
//! always have one message: nothing that others do can stop a reader that reads.

use std::collections::HashMap;
use std::net::IpAddr;
use std::pin::Pin;
use std::sync::{Arc, Mutex};
use std::task::{Context, Poll};
use std::time::{Duration, Instant};

use axum::body::{Body, HttpBody};
use bytes::Bytes;
use http_body::{Frame, SizeHint};
use tokio::time::Sleep;

use super::places::InProgress;
use crate::sync::locked;

/// Most bytes that wait for one response, for one connection, for one address and for all. Ours: a map of the default
/// grids has less than 64 KiB; a message may exceed a limit once.
const RESPONSE_BYTES_MAX: usize = 128 << 10;
const CONNECTION_BYTES_MAX: usize = 1 << 20;
const ADDRESS_BYTES_MAX: usize = 8 << 20;
const ALL_BYTES_MAX: usize = 32 << 20;
/// Longest piece of a message that the transport gets at once: how much a peer must receive within the time limit for
/// stalled connections.
const PIECE_BYTES: usize = 16 << 10;
/// Pause until a response that is over a limit looks again.
const OVER_LIMIT_PAUSE: Duration = Duration::from_millis(20);

/// What waits for all readers of one listener.
#[derive(Debug)]
pub struct Flows {
    responses_max: usize,
    responses_per_address_max: usize,
    held: Mutex<Held>,
}

#[derive(Debug, Default)]
struct Held {
    bytes: usize,
    responses: usize,
    addresses: HashMap<IpAddr, Share>,
    connections: HashMap<u64, Share>,
}

#[derive(Debug, Default)]
struct Share {
    bytes: usize,
    responses: usize,
}

impl Flows {
    /// At most so many responses at once, in all and for one address.
    pub fn new(responses_max: usize, responses_per_address_max: usize) -> Arc<Self> {
        Arc::new(Self { responses_max, responses_per_address_max, held: Mutex::default() })
    }

    /// Begins a response; `None` if there are too many.
    pub fn begin(self: &Arc<Self>, peer: IpAddr, connection: u64) -> Option<Arc<Flow>> {
        let mut held = locked(&self.held);
        let of_address = held.addresses.get(&peer).map_or(0, |share| share.responses);
        if held.responses >= self.responses_max || of_address >= self.responses_per_address_max {
            return None;
        }
        held.responses += 1;
        held.addresses.entry(peer).or_default().responses += 1;
        held.connections.entry(connection).or_default().responses += 1;
        let state = Mutex::new(State { bytes: 0, is_polled: true, moved: Instant::now() });
        Some(Arc::new(Flow { peer, connection, flows: self.clone(), state }))
    }

    /// Bytes that wait for all readers.
    pub fn bytes(&self) -> usize {
        locked(&self.held).bytes
    }
}

/// What waits for one response.
#[derive(Debug)]
pub struct Flow {
    peer: IpAddr,
    connection: u64,
    flows: Arc<Flows>,
    state: Mutex<State>,
}

#[derive(Debug)]
struct State {
    bytes: usize,
    /// True if the transport has asked for the next piece since it got the last one.
    is_polled: bool,
    moved: Instant,
}

impl Flow {
    /// Since when a piece waits that the transport cannot send; `None` if none does.
    pub fn stuck_since(&self) -> Option<Instant> {
        let state = locked(&self.state);
        (state.bytes > 0 || !state.is_polled).then_some(state.moved)
    }

    fn is_within_limits(&self) -> bool {
        let own = locked(&self.state).bytes;
        let held = locked(&self.flows.held);
        let of_connection = held.connections.get(&self.connection).map_or(0, |share| share.bytes);
        let of_address = held.addresses.get(&self.peer).map_or(0, |share| share.bytes);
        of_connection == 0
            || (own < RESPONSE_BYTES_MAX
                && of_connection < CONNECTION_BYTES_MAX
                && of_address < ADDRESS_BYTES_MAX
                && held.bytes < ALL_BYTES_MAX)
    }

    fn add(&self, bytes: usize) {
        let mut state = locked(&self.state);
        if state.bytes == 0 {
            state.moved = Instant::now();
        }
        state.bytes += bytes;
        self.change(|held| *held += bytes);
    }

    fn remove(&self, bytes: usize) {
        let mut state = locked(&self.state);
        (state.bytes, state.moved) = (state.bytes - bytes, Instant::now());
        self.change(|held| *held -= bytes);
    }

    fn change(&self, change: impl Fn(&mut usize)) {
        let mut held = locked(&self.flows.held);
        change(&mut held.bytes);
        held.addresses.get_mut(&self.peer).into_iter().for_each(|share| change(&mut share.bytes));
        held.connections.get_mut(&self.connection).into_iter().for_each(|share| change(&mut share.bytes));
    }

    fn set_polled(&self, is_polled: bool) {
        let mut state = locked(&self.state);
        if state.is_polled != is_polled {
            (state.is_polled, state.moved) = (is_polled, Instant::now());
        }
    }
}

impl Drop for Flow {
    fn drop(&mut self) {
        let mut held = locked(&self.flows.held);
        held.responses -= 1;
        let Held { addresses, connections, .. } = &mut *held;
        release(addresses, &self.peer);
        release(connections, &self.connection);
    }
}

/// Ends a response in a share, which goes with its last one.
fn release<K: std::hash::Hash + Eq>(shares: &mut HashMap<K, Share>, key: &K) {
    if let Some(share) = shares.get_mut(key) {
        share.responses -= 1;
        if share.responses == 0 {
            shares.remove(key);
        }
    }
}

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
    _in_progress: InProgress,
}

impl CountedBody {
    /// Without a flow, bytes are not counted.
    pub fn new(body: Body, in_progress: InProgress, flow: Option<Arc<Flow>>) -> Self {
        // From now on the transport should ask for the first piece.
        flow.iter().for_each(|flow| flow.set_polled(false));
        Self { body, rest: Bytes::new(), flow, pause: None, _in_progress: in_progress }
    }

    /// The next piece of the message.
    fn piece(&mut self, flow: Arc<Flow>) -> Frame<Bytes> {
        let bytes = self.rest.split_to(self.rest.len().min(PIECE_BYTES));
        flow.set_polled(false);
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
