//! The gRPC server: `clearway.v1.MapService`, standard health and reflection, and the ingest service if it is
//! configured ([`crate::ingest::grpc`]).
//!
//! The limits of what one client may cost are set here, each with its reason. [`reader`] has the updates of one reader.

pub mod access;
pub mod reader;
mod replay;
pub mod selection;

use std::pin::Pin;
use std::sync::Arc;
use std::time::Duration;

use clearway_proto::{DESCRIPTORS, v1};
use futures::Stream;
use tokio::net::TcpListener;
use tonic::transport::{Certificate, Identity, Server, ServerTlsConfig};
use tonic::{Request, Response, Status, Streaming};

use super::connections::Connections;
use super::served::Vehicles;
use access::{Access, Guard};
use reader::watch;
use replay::Replay;

use crate::clock::now_ns;
use crate::config::{self, Certificates};
use crate::replay::ReplayHandle;

use v1::ingest_service_server::{IngestService, IngestServiceServer};
use v1::map_service_server::{MapService, MapServiceServer};
use v1::replay_service_server::ReplayServiceServer;

/// Longest request, in bytes. Ours: requests hold names and numbers.
const REQUEST_BYTES_MAX: usize = 64 << 10;
/// Flow-control window of a connection, in bytes: what a client may send before the server reads it. Ours: a scan takes
/// a few windows, and a client that is not read costs no more than one.
const WINDOW_BYTES: u32 = 1 << 20;
/// Most streams on one connection. Ours: more than a fleet page needs for its vehicles and layers.
const STREAMS_MAX: u32 = 128;
/// Most streams of one connection that the client reset before the server accepted them, and most that the server reset
/// because of the client's errors. A planner that restarts resets a few; a client that keeps opening and resetting
/// streams loses its connection.
const RESETS_PENDING_MAX: usize = 20;
const RESETS_FOR_MISTAKES_MAX: usize = 128;
/// Longest headers of a request, in bytes. Ours: gRPC headers have a few hundred bytes; this is hyper's default.
const HEADERS_BYTES_MAX: u32 = 16 << 10;
/// Longest time from opening `Watch` to its first request. Ours: a reader sends its selection at once.
const SELECTION_TIMEOUT: Duration = Duration::from_secs(10);
/// Interval and timeout of HTTP/2 keepalive: a client that has disappeared is noticed after both.
const KEEPALIVE: Duration = Duration::from_secs(10);
/// Longest TLS handshake. Ours: a client that has begun one has no reason to wait.
const HANDSHAKE_TIMEOUT: Duration = Duration::from_secs(5);

/// How clients connect: in plain text with every right, or with certificates and roles.
pub struct Security {
    builder: Server,
    guard: Guard,
}

impl Security {
    /// The security of a configuration; plain text without certificates.
    ///
    /// # Errors
    /// [`tonic::transport::Error`] if a certificate or key is invalid.
    pub fn new(certificates: Option<Certificates>, access: &config::Access) -> Result<Self, tonic::transport::Error> {
        let Some(Certificates { certificate, key, client_ca }) = certificates else {
            return Ok(Self { builder: Server::builder(), guard: Guard(None) });
        };
        let mut tls = ServerTlsConfig::new().identity(Identity::from_pem(certificate, key)).timeout(HANDSHAKE_TIMEOUT);
        let guard = Guard(client_ca.is_some().then(|| Arc::new(Access::new(access))));
        if let Some(client_ca) = client_ca {
            tls = tls.client_ca_root(Certificate::from_pem(client_ca));
        }
        Ok(Self { builder: Server::builder().tls_config(tls)?, guard })
    }
}

/// Why the gRPC server has stopped.
#[derive(Debug, thiserror::Error)]
pub enum GrpcError {
    /// The transport failed.
    #[error(transparent)]
    Transport(#[from] tonic::transport::Error),
    /// The reflection service could not be built from the descriptors.
    #[error(transparent)]
    Reflection(#[from] tonic_reflection::server::Error),
}

/// Serves maps, `ingest` if it is configured, and the control of `replay` if there is one, until `stop` resolves and
/// all streams have ended.
///
/// # Errors
/// [`GrpcError::Transport`] if the transport fails, [`GrpcError::Reflection`] if the descriptors are invalid.
pub async fn serve<I: IngestService>(
    listener: TcpListener,
    security: Security,
    connections_max: usize,
    vehicles: Vehicles,
    ingest: Option<IngestServiceServer<I>>,
    replay: Option<ReplayHandle>,
    stop: impl Future<Output = ()>,
) -> Result<(), GrpcError> {
    let Security { builder, guard } = security;
    let (health, health_service) = tonic_health::server::health_reporter();
    health.set_serving::<MapServiceServer<Maps>>().await;
    if ingest.is_some() {
        health.set_serving::<IngestServiceServer<I>>().await;
    }
    let replay = replay.map(|replay| ReplayServiceServer::new(Replay(replay)));
    if replay.is_some() {
        health.set_serving::<ReplayServiceServer<Replay>>().await;
    }
    let reflection = || {
        tonic_reflection::server::Builder::configure()
            .register_encoded_file_descriptor_set(DESCRIPTORS)
            .register_encoded_file_descriptor_set(tonic_health::pb::FILE_DESCRIPTOR_SET)
    };
    let maps = MapServiceServer::new(Maps { vehicles }).max_decoding_message_size(REQUEST_BYTES_MAX);
    builder
        .layer(guard)
        .http2_keepalive_interval(Some(KEEPALIVE))
        .http2_keepalive_timeout(Some(KEEPALIVE))
        // Streams get the window of their connection, because one scan has megabytes.
        .initial_stream_window_size(WINDOW_BYTES)
        .initial_connection_window_size(WINDOW_BYTES)
        .max_concurrent_streams(STREAMS_MAX)
        .http2_max_pending_accept_reset_streams(Some(RESETS_PENDING_MAX))
        .http2_max_local_error_reset_streams(Some(RESETS_FOR_MISTAKES_MAX))
        .http2_max_header_list_size(HEADERS_BYTES_MAX)
        .add_service(maps)
        .add_optional_service(ingest)
        .add_optional_service(replay)
        .add_service(health_service)
        .add_service(reflection().build_v1()?)
        // Older versions of grpcurl know only this version.
        .add_service(reflection().build_v1alpha()?)
        .serve_with_incoming_shutdown(
            Connections::new(listener, connections_max).with_errors_over_limit().stream(),
            stop,
        )
        .await?;
    Ok(())
}

struct Maps {
    vehicles: Vehicles,
}

#[tonic::async_trait]
impl MapService for Maps {
    type WatchStream = Pin<Box<dyn Stream<Item = Result<v1::MapUpdate, Status>> + Send>>;

    async fn watch(
        &self,
        request: Request<Streaming<v1::WatchRequest>>,
    ) -> Result<Response<Self::WatchStream>, Status> {
        let agent = request.metadata().get("user-agent").and_then(|agent| agent.to_str().ok()).map(str::to_owned);
        let mut requests = request.into_inner();
        let first = tokio::time::timeout(SELECTION_TIMEOUT, requests.message())
            .await
            .map_err(|_| Status::deadline_exceeded(format!("no selection within {SELECTION_TIMEOUT:?}")))??;
        let selection = first.and_then(|first| first.selection);
        let selection = selection.ok_or_else(|| Status::invalid_argument("the first request carries a selection"))?;
        let layers = if selection.layers.is_empty() { "all layers".to_owned() } else { selection.layers.join(", ") };
        let name = format!("gRPC reader of {layers} ({})", agent.as_deref().unwrap_or("no user-agent"));
        Ok(Response::new(Box::pin(watch(&self.vehicles, selection, requests, name)?)))
    }

    async fn get_map(&self, request: Request<v1::GetMapRequest>) -> Result<Response<v1::MapUpdate>, Status> {
        let v1::GetMapRequest { vehicle, layers } = request.into_inner();
        let served = self.vehicles.find(&vehicle)?;
        served.check_layers(&layers)?;
        let name = &served.status.name;
        if served.newest.borrow().is_none() {
            return Err(Status::unavailable(format!("vehicle {name} has no map yet")));
        }
        let newest = served.status.subscriptions.subscribe(&layers).newest_map(&served.newest).await;
        let map = newest.ok_or_else(|| {
            Status::unavailable(format!("vehicle {name} makes no map at present: no data arrived since the request"))
        })?;
        Ok(Response::new(v1::MapUpdate { map: map.select(&layers), sent_ns: now_ns(), ..Default::default() }))
    }

    async fn list_vehicles(
        &self,
        _: Request<v1::ListVehiclesRequest>,
    ) -> Result<Response<v1::ListVehiclesResponse>, Status> {
        let vehicles = self.vehicles.statuses().iter().map(|status| status.to_proto()).collect();
        Ok(Response::new(v1::ListVehiclesResponse { vehicles }))
    }
}
