//! Maps over gRPC: `clearway.v1.MapService`, standard health and reflection, and beside them what vehicles send
//! ([`crate::ingest::grpc`]).
//!
//! What a peer may cost is set here, explicitly, each limit with its reason; what one reader gets is
//! [`super::reader`]'s.

pub mod access;
pub mod reader;
pub mod selection;

use std::pin::Pin;
use std::sync::Arc;
use std::time::Duration;

use clearway_proto::{DESCRIPTORS, v1};
use futures::Stream;
use tokio::net::TcpListener;
use tonic::transport::{Certificate, Identity, Server, ServerTlsConfig};
use tonic::{Request, Response, Status, Streaming};

use access::{Access, Guard};
use super::connections::Connections;
use reader::watch;
use super::Vehicles;
use crate::config::{self, Certificates};
use crate::clock::now_ns;

use v1::ingest_service_server::{IngestService, IngestServiceServer};
use v1::map_service_server::{MapService, MapServiceServer};

/// Requests are names and numbers; anything longer is not meant for us.
const REQUEST_BYTES_MAX: usize = 64 << 10;
/// What a peer may have sent and nobody has read: a connection costs no more.
const WINDOW_BYTES: u32 = 1 << 20;
/// Streams a connection: a fleet page watches some vehicles' layers, nobody a hundred.
const STREAMS_MAX: u32 = 128;
/// Streams of one connection that were reset before anybody looked at them, and those the server had to reset for the
/// peer's mistakes. A planner that restarts resets its few; whoever goes on opening and resetting loses its connection.
const RESETS_PENDING_MAX: usize = 20;
const RESETS_FOR_MISTAKES_MAX: usize = 128;
/// A reader that opens `Watch` says what it wants at once.
const SELECTION_TIMEOUT: Duration = Duration::from_secs(10);
/// A peer that is gone without a word is noticed after two of these.
const KEEPALIVE: Duration = Duration::from_secs(10);
/// A peer that has begun a handshake has no reason to wait.
const HANDSHAKE_TIMEOUT: Duration = Duration::from_secs(5);

/// How peers are met: in plain text and trusting everybody, or with certificates.
pub struct Security {
    builder: Server,
    guard: Guard,
}

impl Security {
    /// From the configuration and the files it names; without certificates plain text.
    ///
    /// # Errors
    /// What the transport says of the certificates.
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

/// Serves maps, and `ingest` if the server takes observations, until `stop` resolves and all streams have ended.
///
/// # Errors
/// What the transport says.
pub async fn serve<I: IngestService>(
    listener: TcpListener,
    security: Security,
    connections_max: usize,
    vehicles: Vehicles,
    ingest: Option<IngestServiceServer<I>>,
    stop: impl Future<Output = ()>,
) -> Result<(), Box<dyn std::error::Error + Send + Sync>> {
    let Security { builder, guard } = security;
    let (health, health_service) = tonic_health::server::health_reporter();
    health.set_serving::<MapServiceServer<Maps>>().await;
    if ingest.is_some() {
        health.set_serving::<IngestServiceServer<I>>().await;
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
        // A scan is megabytes; what is not read yet is bounded by the connection's window either way.
        .initial_stream_window_size(WINDOW_BYTES)
        .initial_connection_window_size(WINDOW_BYTES)
        .max_concurrent_streams(STREAMS_MAX)
        .http2_max_pending_accept_reset_streams(Some(RESETS_PENDING_MAX))
        .http2_max_local_error_reset_streams(Some(RESETS_FOR_MISTAKES_MAX))
        .http2_max_header_list_size(16 << 10)
        .add_service(maps)
        .add_optional_service(ingest)
        .add_service(health_service)
        .add_service(reflection().build_v1()?)
        // Older grpcurl knows only this one.
        .add_service(reflection().build_v1alpha()?)
        .serve_with_incoming_shutdown(Connections::new(listener, connections_max).with_lobby().stream(), stop)
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
        let mut requests = request.into_inner();
        let first = tokio::time::timeout(SELECTION_TIMEOUT, requests.message())
            .await
            .map_err(|_| Status::deadline_exceeded(format!("no selection within {SELECTION_TIMEOUT:?}")))??;
        let selection = first.and_then(|first| first.selection);
        let selection = selection.ok_or_else(|| Status::invalid_argument("the first request carries a selection"))?;
        Ok(Response::new(Box::pin(watch(&self.vehicles, selection, requests)?)))
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
        let map = newest.ok_or_else(|| Status::unavailable(format!("vehicle {name} makes no map at present")))?;
        Ok(Response::new(v1::MapUpdate { map: map.select(&layers), skipped: 0, sent_ns: now_ns(), left_out: 0 }))
    }

    async fn list_vehicles(
        &self,
        _: Request<v1::ListVehiclesRequest>,
    ) -> Result<Response<v1::ListVehiclesResponse>, Status> {
        let vehicles = self.vehicles.statuses().iter().map(|status| status.to_proto()).collect();
        Ok(Response::new(v1::ListVehiclesResponse { vehicles }))
    }
}
