//! The one path by which every TCP listener accepts: gRPC, the page, the metrics and Foxglove.
//!
//! A connection gets a place (or an error that says why not), shows its certificate, and then its requests are checked
//! and answered. What it may cost is limited in number, time and bytes.
//!
//! | file | in -> out |
//! |---|---|
//! | `places` | connections -> those that may stay: limits in all and of one address, idle and stalled ones closed |
//! | `flow` | responses -> their bytes while they wait, limited |
//! | `body` | the body of a response -> pieces for the transport, counted |
//! | `connection` | a socket, plain or encrypted -> bytes, in turn with others, until its place is closed |
//! | `frames` | the bytes of an HTTP/2 client -> its frames without data, limited by a `budget` |
//! | `tls` | certificates -> TLS, names of clients |
//! | [`access`] | names -> roles -> RPCs and paths, vehicles and layers |
//! | [`security`] | certificates, roles and tokens that hold at present |
//! | `web` | a browser's request -> who may ask, by which host, from which origin; headers |

pub mod access;
mod body;
mod budget;
mod connection;
mod flow;
mod frames;
mod places;
pub mod security;
mod tls;
mod web;

use std::collections::BTreeMap;
use std::convert::Infallible;
use std::error::Error;
use std::future::poll_fn;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use axum::Router;
use axum::body::Body;
use axum::http::{Request, Response, StatusCode};
use axum::response::IntoResponse;
use hyper::body::Incoming;
use hyper::server::conn::{http1, http2};
use hyper::service::service_fn;
use hyper_util::rt::{TokioExecutor, TokioIo, TokioTimer};
use tokio::net::{TcpListener, TcpStream};
use tokio::task::JoinSet;
use tokio_util::sync::CancellationToken;
use tonic::Status;
use tower_service::Service;

use access::Caller;
use body::CountedBody;
pub use budget::Budget;
use connection::{Connection, Transport};
use flow::Flows;
use places::{Grant, Places};
use security::Security;

pub use places::{AllPlaces, InProgress, Limits, Place};

/// Pause after an error of the listener itself, such as no free file handle: to try again at once would only use a
/// core.
const ACCEPT_PAUSE: Duration = Duration::from_millis(100);
/// That pause if connections without a request were closed, and most that are closed at once. Ours: 3200 newcomers a
/// second get a file handle, more than the kernel's queue of them holds.
const FREED_PAUSE: Duration = Duration::from_millis(10);
const FREED_MAX: usize = 32;
/// Time between two looks for connections that are idle or stalled.
const SWEEP_PERIOD: Duration = Duration::from_millis(500);
/// Longest TLS handshake. Ours: a client that has begun one has no reason to wait.
const HANDSHAKE_TIMEOUT: Duration = Duration::from_secs(5);
/// Longest time for the head of a request of HTTP/1. Ours: it has a few hundred bytes.
const HEAD_TIMEOUT: Duration = Duration::from_secs(10);
/// Longest head of a request, in bytes. Ours: heads have a few hundred bytes; this is hyper's default for HTTP/2.
const HEAD_BYTES_MAX: usize = 16 << 10;
/// Flow-control window of a connection, in bytes: what a client may send before the server reads it. Ours: a scan takes
/// a few windows, and a client that is not read costs no more than one.
const WINDOW_BYTES: u32 = 1 << 20;
/// Most bytes that HTTP/2 holds for one stream of a client that does not read. Ours: about one map.
const SEND_BYTES_MAX: usize = 32 << 10;
/// Memory kept to read from a WebSocket, in bytes. Ours: its clients send short texts; the library would keep 128 KiB.
pub const READ_BUFFER_BYTES: usize = 4 << 10;
/// Most streams on one connection. Ours: more than a fleet page needs for its vehicles and layers.
const STREAMS_MAX: u32 = 128;
/// Most streams of one connection that the client reset before the server accepted them, and most that the server reset
/// because of the client's errors. A planner that restarts resets a few; a client that keeps opening and resetting
/// streams loses its connection.
const RESETS_PENDING_MAX: usize = 20;
const RESETS_FOR_MISTAKES_MAX: usize = 128;
/// Interval and timeout of HTTP/2 keepalive: a client that has disappeared is noticed after both.
const KEEPALIVE: Duration = Duration::from_secs(10);

/// What a listener speaks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Protocol {
    /// HTTP/2 with gRPC: refusals are a gRPC status.
    Grpc,
    /// HTTP/1 for browsers and programs: refusals are a status and a text. Pages of these origins may connect, beside
    /// the server's own and those of the configuration.
    Web(&'static [&'static str]),
}

/// A TCP listener with its limits and its security.
pub struct Listener {
    socket: TcpListener,
    shared: Shared,
    all: AllPlaces,
}

/// What the connections of a listener share.
#[derive(Clone)]
struct Shared {
    protocol: Protocol,
    places: Arc<Places>,
    security: Security,
}

/// Number of open connections, bytes that wait for readers, and connections refused or closed, by reason.
pub type Counts = (usize, usize, BTreeMap<&'static str, u64>);

/// The counts of one listener, and its limits, which can be replaced.
#[derive(Clone)]
pub struct ListenerHandle(Arc<Places>, Arc<Flows>, Protocol);

impl ListenerHandle {
    /// The counts at present.
    pub fn counts(&self) -> Counts {
        let (open, closed) = self.0.counts();
        (open, self.1.bytes(), closed)
    }

    /// Uses other limits from now on; open connections stay.
    pub fn set_limits(&self, limits: Limits) {
        self.0.set_limits(limits);
    }

    /// Closes the connections whose clients have lost their role, or may reach other vehicles or layers than when their
    /// request began.
    pub fn recheck(&self, current: &security::Current) {
        let Some(access) = &current.access else { return };
        self.0.recheck(|grant| {
            let allowed = match self.2 {
                Protocol::Grpc => access.check(&grant.path, &grant.names),
                Protocol::Web(_) => access.check_path(&grant.path, &grant.names),
            };
            allowed.is_ok_and(|caller| caller == grant.caller)
        });
    }

    /// How long the listener has given no sign of life; it gives one twice a second. `None` before its first.
    pub fn silent(&self) -> Option<Duration> {
        self.0.silent()
    }
}

impl Listener {
    /// A listener with these limits; at most so many responses at once, in all and for one address. It shares file
    /// handles with those of `all`.
    pub fn new(
        socket: TcpListener,
        protocol: Protocol,
        limits: Limits,
        calls: (usize, usize),
        security: Security,
        all: &AllPlaces,
    ) -> (Self, ListenerHandle) {
        let flows = Flows::new(calls.0, calls.1, limits.kept);
        let places = Places::new(limits, flows.clone());
        let shared = Shared { protocol, places: places.clone(), security };
        all.add(places.clone());
        (Self { socket, shared, all: all.clone() }, ListenerHandle(places, flows, protocol))
    }

    /// The address it listens on.
    pub fn address(&self) -> Option<SocketAddr> {
        self.socket.local_addr().ok()
    }

    /// Answers requests until `stop` resolves and all connections have ended.
    pub async fn serve(self, router: Router, stop: impl Future<Output = ()>) {
        let Self { socket, shared, all } = self;
        let stopping = CancellationToken::new();
        let mut connections = JoinSet::new();
        let mut sweep = tokio::time::interval(SWEEP_PERIOD);
        tokio::pin!(stop);
        loop {
            let accepted = tokio::select! {
                () = &mut stop => break,
                _ = sweep.tick() => {
                    shared.places.beat();
                    shared.places.sweep();
                    continue;
                }
                Some(_) = connections.join_next() => continue,
                accepted = socket.accept() => accepted,
            };
            match accepted {
                Ok((stream, peer)) => {
                    let place = Arc::new(shared.places.admit(peer.ip().to_canonical()));
                    let run = shared.clone().run(stream, place, router.clone(), stopping.clone());
                    connections.spawn(run);
                }
                Err(error) => {
                    shared.places.count("accept_error");
                    // There may be no free file handle.
                    let freed = all.free(FREED_MAX);
                    tracing::warn!(%error, freed, "accept");
                    tokio::time::sleep(if freed > 0 { FREED_PAUSE } else { ACCEPT_PAUSE }).await;
                }
            }
        }
        drop(socket);
        stopping.cancel();
        while connections.join_next().await.is_some() {}
    }
}

impl Shared {
    /// Answers the requests of one connection.
    async fn run(self, stream: TcpStream, place: Arc<Place>, router: Router, stopping: CancellationToken) {
        // A failure leaves the default, which is slower but right.
        let _ = stream.set_nodelay(true);
        let Some((transport, names)) = self.secure(stream, &place).await else { return };
        let is_http2 = self.protocol == Protocol::Grpc;
        let io = TokioIo::new(Connection::new(transport, place.clone(), is_http2));
        let (protocol, names, of) = (self.protocol, Arc::new(names), place.clone());
        let service =
            service_fn(move |request| self.clone().answer(request, place.clone(), names.clone(), router.clone()));
        // An error ends this connection alone, and the peer knows it better.
        match protocol {
            Protocol::Grpc => {
                let connection = http2().serve_connection(io, service);
                tokio::pin!(connection);
                let ended = tokio::select! {
                    ended = connection.as_mut() => ended,
                    () = stopping.cancelled() => {
                        connection.as_mut().graceful_shutdown();
                        connection.await
                    }
                };
                if let Some(reason) = ended.err().as_ref().and_then(breach) {
                    of.close_for_breach(reason);
                }
            }
            Protocol::Web(_) => {
                let connection = http1().serve_connection(io, service).with_upgrades();
                tokio::pin!(connection);
                tokio::select! {
                    _ = connection.as_mut() => return,
                    () = stopping.cancelled() => connection.as_mut().graceful_shutdown(),
                }
                let _ = connection.await;
            }
        }
    }

    /// The TLS handshake, if there are certificates; the names in the client's certificate.
    async fn secure(&self, stream: TcpStream, place: &Place) -> Option<(Transport, Vec<String>)> {
        let current = self.security.current();
        let Some(tls) = &current.tls else { return Some((Transport::Plain(stream), Vec::new())) };
        let acceptor = if self.protocol == Protocol::Grpc { &tls.grpc } else { &tls.web };
        let closing = place.closing();
        let stream = tokio::select! {
            () = closing.cancelled() => return None,
            shaken = tokio::time::timeout(HANDSHAKE_TIMEOUT, acceptor.accept(stream)) => match shaken {
                Ok(Ok(stream)) => stream,
                Ok(Err(error)) => {
                    tracing::info!(peer = %place.peer(), %error, "TLS handshake");
                    place.count("handshake");
                    return None;
                }
                Err(_) => {
                    place.count("handshake_timeout");
                    return None;
                }
            },
        };
        let certificate = stream.get_ref().1.peer_certificates().and_then(|chain| chain.first());
        let names = certificate.map(|certificate| tls::names(certificate)).unwrap_or_default();
        if current.access.as_ref().is_some_and(|access| access.knows(&names)) {
            place.set_known();
        }
        Some((Transport::Tls(Box::new(stream)), names))
    }

    /// Checks a request and answers it.
    async fn answer(
        self,
        request: Request<Incoming>,
        place: Arc<Place>,
        names: Arc<Vec<String>>,
        mut router: Router,
    ) -> Result<Response<CountedBody>, Infallible> {
        let in_progress = place.begin_request();
        let mut request = request.map(Body::new);
        let mut grant = None;
        let (mut response, flow) = match self.check(&request, &place, &names) {
            Ok((caller, names)) => match place.begin_flow() {
                None => (self.refuse_call(&place), None),
                flow => {
                    let path = request.uri().path().to_owned();
                    grant = Some(place.grant(Grant { path, names, caller: caller.clone() }));
                    request.extensions_mut().insert(caller);
                    request.extensions_mut().insert(place);
                    let Ok(()) = poll_fn(|context| Service::<Request<Body>>::poll_ready(&mut router, context)).await;
                    let Ok(response) = router.call(request).await;
                    (response, flow)
                }
            },
            Err(refusal) => (*refusal, None),
        };
        if self.protocol != Protocol::Grpc {
            web::protect(&mut response);
        }
        Ok(response.map(|body| CountedBody::new(body, in_progress, flow, grant)))
    }

    /// What the client of a request may reach, and its names.
    fn check(
        &self,
        request: &Request<Body>,
        place: &Place,
        names: &[String],
    ) -> Result<(Caller, Vec<String>), Box<Response<Body>>> {
        if let Some(text) = place.over_limit() {
            place.count("over_limit");
            return Err(Box::new(self.refuse(StatusCode::SERVICE_UNAVAILABLE, Status::resource_exhausted(text))));
        }
        let current = self.security.current();
        match self.protocol {
            Protocol::Grpc => {
                let Some(access) = &current.access else { return Ok((Caller::unlimited(), Vec::new())) };
                access.check(request.uri().path(), names).map(|caller| (caller, names.to_vec())).map_err(|status| {
                    tracing::info!(peer = %place.peer(), status = status.message(), "denied");
                    place.count("denied");
                    Box::new(status.into_http())
                })
            }
            Protocol::Web(origins) => match web::check(request, &current, origins, names) {
                Ok((caller, names)) => {
                    if current.access.as_ref().is_some_and(|access| access.knows(&names)) {
                        place.set_known();
                    }
                    Ok((caller, names))
                }
                Err(refusal) => {
                    if !refusal.status().is_redirection() {
                        tracing::info!(peer = %place.peer(), status = %refusal.status(), "denied");
                        place.count("denied");
                    }
                    Err(refusal)
                }
            },
        }
    }

    fn refuse_call(&self, place: &Place) -> Response<Body> {
        place.count("calls");
        let text = format!(
            "too many calls are in progress: connections.calls_max, of which connections.kept are for known peers, and \
             connections.calls_per_address_max limit those of all clients and those of {}",
            place.peer()
        );
        self.refuse(StatusCode::SERVICE_UNAVAILABLE, Status::resource_exhausted(text))
    }

    fn refuse(&self, code: StatusCode, status: Status) -> Response<Body> {
        match self.protocol {
            Protocol::Grpc => status.into_http(),
            Protocol::Web(_) => (code, format!("{}\n", status.message())).into_response(),
        }
    }
}

/// Why the library has ended a connection of HTTP/2, if the client breached the protocol or the library's limits.
fn breach(error: &hyper::Error) -> Option<h2::Reason> {
    let of_library = error.source().and_then(|source| source.downcast_ref::<h2::Error>());
    of_library.filter(|error| error.is_library()).and_then(h2::Error::reason)
}

fn http2() -> http2::Builder<TokioExecutor> {
    let mut http2 = http2::Builder::new(TokioExecutor::new());
    http2
        .timer(TokioTimer::new())
        .keep_alive_interval(Some(KEEPALIVE))
        .keep_alive_timeout(KEEPALIVE)
        // Streams get the window of their connection, because one scan has megabytes.
        .initial_stream_window_size(WINDOW_BYTES)
        .initial_connection_window_size(WINDOW_BYTES)
        .max_concurrent_streams(STREAMS_MAX)
        .max_send_buf_size(SEND_BYTES_MAX)
        .max_pending_accept_reset_streams(Some(RESETS_PENDING_MAX))
        .max_local_error_reset_streams(Some(RESETS_FOR_MISTAKES_MAX))
        .max_header_list_size(HEAD_BYTES_MAX as u32);
    http2
}

fn http1() -> http1::Builder {
    let mut http1 = http1::Builder::new();
    http1.timer(TokioTimer::new()).header_read_timeout(HEAD_TIMEOUT).max_buf_size(HEAD_BYTES_MAX);
    http1
}
