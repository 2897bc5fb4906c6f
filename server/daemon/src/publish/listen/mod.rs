//! The one path by which every TCP listener accepts: gRPC, the page, the metrics and Foxglove.
//!
//! A connection gets a slot (or an error that says why not), shows its certificate, and then its requests are checked
//! and answered. Connections and calls are limited in number, the time until the first request and the bytes that wait
//! for a peer too.
//!
//! | file | in -> out |
//! |---|---|
//! | `slots` | peers -> connections and calls within the limits, in all and of one address; idle connections closed |
//! | `tls` | certificates -> TLS, names of clients |
//! | [`access`] | names -> roles -> RPCs and paths, vehicles and layers |
//! | [`security`] | certificates, roles and tokens that hold at present |
//! | `web` | a browser's request -> who may ask, by which host, from which origin; headers |

pub mod access;
pub mod security;
mod slots;
mod tls;
mod web;

use std::convert::Infallible;
use std::error::Error;
use std::future::poll_fn;
use std::net::SocketAddr;
use std::pin::Pin;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use axum::Router;
use axum::body::Body;
use axum::http::{Request, Response, StatusCode};
use axum::response::IntoResponse;
use http_body_util::BodyExt;
use hyper::body::Incoming;
use hyper::server::conn::{http1, http2};
use hyper::service::service_fn;
use hyper_util::rt::{TokioExecutor, TokioIo, TokioTimer};
use socket2::SockRef;
use tokio::net::{TcpListener, TcpStream};
use tokio::task::JoinSet;
use tokio_rustls::server::TlsStream;
use tokio_util::either::Either;
use tokio_util::sync::CancellationToken;
use tonic::Status;
use tower_service::Service;

use crate::base::sync::locked;
use crate::config::Connections;
use crate::status::ListenerCounts;
use access::Caller;
use security::Security;
use slots::{Authorization, ConnectionSlots};

pub use slots::{CallPermit, ConnectionSlot};

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

/// The protocol of a listener.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Protocol {
    /// HTTP/2 with gRPC: refusals are a gRPC status.
    Grpc,
    /// HTTP/1 for browsers and programs: refusals are a status and a text. Pages of these origins may connect, beside
    /// the server's own pages and the configured origins.
    Web(&'static [&'static str]),
}

/// The connection slots of all listeners of a server, which share its file handles.
pub type AllSlots = Arc<Mutex<Vec<Arc<ConnectionSlots>>>>;

/// A TCP listener with its limits and its security.
pub struct Listener {
    socket: TcpListener,
    shared: Shared,
    all: AllSlots,
}

/// What the connections of a listener share.
#[derive(Clone)]
struct Shared {
    protocol: Protocol,
    slots: Arc<ConnectionSlots>,
    security: Security,
}

/// The counts of one listener, and its limits, which can be replaced.
#[derive(Clone)]
pub struct ListenerHandle(Shared);

impl ListenerHandle {
    /// The counts at present.
    pub fn counts(&self) -> ListenerCounts {
        let (open, closed) = self.0.slots.counts();
        ListenerCounts { open, closed }
    }

    /// Uses other limits from now on; open connections stay.
    pub fn set_limits(&self, limits: Connections) {
        self.0.slots.set_limits(limits);
    }

    /// Closes the connections whose clients have lost their role, or may reach other vehicles or layers than when their
    /// call began.
    pub fn recheck(&self, current: &security::Current) {
        let Some(access) = &current.access else { return };
        self.0.slots.recheck(|call| {
            let allowed = match self.0.protocol {
                Protocol::Grpc => access.check(&call.path, &call.names),
                Protocol::Web(_) => access.check_path(&call.path, &call.names),
            };
            allowed.is_ok_and(|caller| caller == call.caller)
        });
    }

    /// How long the listener has given no sign of life; it gives one twice a second. `None` before its first.
    pub fn silent(&self) -> Option<Duration> {
        self.0.slots.silent()
    }
}

impl Listener {
    /// A listener with these limits. It shares file handles with the listeners of `all`.
    pub fn new(
        socket: TcpListener,
        protocol: Protocol,
        limits: Connections,
        security: Security,
        all: &AllSlots,
    ) -> (Self, ListenerHandle) {
        let slots = ConnectionSlots::new(limits);
        locked(all).push(slots.clone());
        let shared = Shared { protocol, slots, security };
        (Self { socket, shared: shared.clone(), all: all.clone() }, ListenerHandle(shared))
    }

    /// The address on which the listener accepts; `None` if it has none.
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
                    shared.slots.sweep();
                    continue;
                }
                Some(_) = connections.join_next() => continue,
                accepted = socket.accept() => accepted,
            };
            match accepted {
                Ok((stream, peer)) => {
                    let slot = Arc::new(shared.slots.admit(peer.ip().to_canonical()));
                    let (closing, router) = (slot.closing.clone(), router.clone());
                    let served = shared.clone().serve(stream, slot, router, stopping.clone());
                    connections.spawn(async move { closing.run_until_cancelled_owned(served).await });
                }
                Err(error) => {
                    shared.slots.count("accept_error");
                    // There may be no free file handle.
                    let freed: usize = locked(&all).iter().map(|slots| slots.free(FREED_MAX)).sum();
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
    async fn serve(self, stream: TcpStream, slot: Arc<ConnectionSlot>, router: Router, stopping: CancellationToken) {
        // A failure leaves the default, which is slower but right.
        let _ = stream.set_nodelay(true);
        // The kernel ends a connection whose peer takes no byte of what waits for it.
        let _ = SockRef::from(&stream).set_tcp_user_timeout(Some(self.slots.stalled_max()));
        let Some((stream, names)) = self.secure(stream, &slot).await else { return };
        let (protocol, names, of) = (self.protocol, Arc::new(names), slot.clone());
        let service =
            service_fn(move |request| self.clone().answer(request, slot.clone(), names.clone(), router.clone()));
        let io = TokioIo::new(stream);
        let ended = match protocol {
            Protocol::Grpc => {
                let connection = http2().serve_connection(io, service);
                until_stopped(connection, http2::Connection::graceful_shutdown, stopping).await
            }
            Protocol::Web(_) => {
                let connection = http1().serve_connection(io, service).with_upgrades();
                until_stopped(connection, http1::UpgradeableConnection::graceful_shutdown, stopping).await
            }
        };
        // An error ends this connection alone.
        if let Some(reason) = ended.err().as_ref().and_then(reason_of) {
            of.close(reason);
        }
    }

    /// The TLS handshake, if there are certificates; the names in the client's certificate.
    async fn secure(
        &self,
        stream: TcpStream,
        slot: &ConnectionSlot,
    ) -> Option<(Either<TcpStream, TlsStream<TcpStream>>, Vec<String>)> {
        let current = self.security.current();
        let Some(tls) = &current.tls else { return Some((Either::Left(stream), Vec::new())) };
        let acceptor = if self.protocol == Protocol::Grpc { &tls.grpc } else { &tls.web };
        let stream = match tokio::time::timeout(HANDSHAKE_TIMEOUT, acceptor.accept(stream)).await {
            Ok(Ok(stream)) => stream,
            Ok(Err(error)) => {
                tracing::info!(peer = %slot.peer, %error, "TLS handshake");
                slot.count("handshake");
                return None;
            }
            Err(_) => {
                slot.count("handshake_timeout");
                return None;
            }
        };
        let chain = stream.get_ref().1.peer_certificates().unwrap_or_default();
        let names = chain.first().map(|certificate| tls::names(certificate)).unwrap_or_default();
        slot.set_certificate_end(tls::end_s(chain));
        if current.access.as_ref().is_some_and(|access| access.knows(&names)) {
            slot.set_known();
        }
        Some((Either::Right(stream), names))
    }

    /// Checks a request and answers it.
    async fn answer(
        self,
        request: Request<Incoming>,
        slot: Arc<ConnectionSlot>,
        names: Arc<Vec<String>>,
        mut router: Router,
    ) -> Result<Response<Body>, Infallible> {
        let mut request = request.map(Body::new);
        let mut response = match self.begin(&request, &slot, &names) {
            Ok((caller, call)) => {
                let call = Arc::new(call);
                request.extensions_mut().insert(caller);
                request.extensions_mut().insert(call.clone());
                let Ok(()) = poll_fn(|context| Service::<Request<Body>>::poll_ready(&mut router, context)).await;
                let Ok(response) = router.call(request).await;
                access::refusal(&response).inspect(|reason| slot.count(reason));
                // The call is in progress until its response ends.
                response.map(|body| {
                    Body::new(body.map_frame(move |frame| {
                        let _in_progress = &call;
                        frame
                    }))
                })
            }
            Err(refusal) => *refusal,
        };
        if self.protocol != Protocol::Grpc {
            web::protect(&mut response);
        }
        Ok(response)
    }

    /// Checks a request and begins its call.
    fn begin(
        &self,
        request: &Request<Body>,
        slot: &Arc<ConnectionSlot>,
        names: &[String],
    ) -> Result<(Caller, CallPermit), Box<Response<Body>>> {
        let full = |reason, text| {
            slot.count(reason);
            Box::new(self.refuse(StatusCode::SERVICE_UNAVAILABLE, Status::resource_exhausted(text)))
        };
        slot.begin_request().map_err(|text| full("over_limit", text))?;
        let (caller, names) = self.check(request, slot, names).inspect_err(|refusal| {
            if !refusal.status().is_redirection() {
                tracing::info!(peer = %slot.peer, status = %refusal.status(), "denied");
                slot.count("denied");
            }
        })?;
        let path = request.uri().path().to_owned();
        let call = slot.begin_call(Authorization { path, names, caller: caller.clone() }).ok_or_else(|| {
            full("calls", format!("too many calls are in progress, of all clients or of {}", slot.peer))
        })?;
        Ok((caller, call))
    }

    /// What the client of a request may reach, and its names.
    fn check(
        &self,
        request: &Request<Body>,
        slot: &ConnectionSlot,
        names: &[String],
    ) -> Result<(Caller, Vec<String>), Box<Response<Body>>> {
        let current = self.security.current();
        let Protocol::Web(origins) = self.protocol else {
            let Some(access) = &current.access else { return Ok((Caller::unlimited(), Vec::new())) };
            let caller = access.check(request.uri().path(), names).map_err(|status| Box::new(status.into_http()))?;
            return Ok((caller, names.to_vec()));
        };
        let (caller, names) = web::check(request, &current, origins, names)?;
        if current.access.as_ref().is_some_and(|access| access.knows(&names)) {
            slot.set_known();
        }
        Ok((caller, names))
    }

    fn refuse(&self, code: StatusCode, status: Status) -> Response<Body> {
        match self.protocol {
            Protocol::Grpc => status.into_http(),
            Protocol::Web(_) => (code, format!("{}\n", status.message())).into_response(),
        }
    }
}

/// Serves a connection until it ends; once `stopping`, until its calls have ended.
async fn until_stopped<C: Future>(connection: C, shutdown: fn(Pin<&mut C>), stopping: CancellationToken) -> C::Output {
    tokio::pin!(connection);
    tokio::select! {
        ended = connection.as_mut() => return ended,
        () = stopping.cancelled() => shutdown(connection.as_mut()),
    }
    connection.await
}

/// The reason for which the library or the kernel has ended a connection, if the client breached the protocol or a
/// limit.
fn reason_of(error: &hyper::Error) -> Option<&'static str> {
    let source = error.source()?;
    let http2 = source.downcast_ref::<h2::Error>();
    match http2.filter(|error| error.is_library()).and_then(h2::Error::reason) {
        Some(h2::Reason::ENHANCE_YOUR_CALM) => return Some("flood"),
        Some(_) => return Some("http2"),
        None => {}
    }
    let io = source.downcast_ref::<std::io::Error>().or_else(|| http2.and_then(h2::Error::get_io));
    io.is_some_and(|error| error.kind() == std::io::ErrorKind::TimedOut).then_some("stalled")
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
