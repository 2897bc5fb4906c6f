//! Maps over gRPC: `clearway.v1.MapService`, standard health and reflection, and beside them what vehicles send
//! ([`crate::ingest::grpc`]).
//!
//! A `Watch` reader is a stream that is asked for its next update when the transport has room for one, and looks at the
//! newest-map slot only then: a slow reader skips maps and is told how many, and costs the engine nothing. Credits bound
//! what is on the way: without them HTTP/2 windows alone hold about half a minute of maps.

use std::collections::VecDeque;
use std::pin::Pin;
use std::sync::Arc;
use std::time::Duration;

use clearway_proto::{DESCRIPTORS, v1};
use futures::{Stream, StreamExt, stream};
use tokio::net::TcpListener;
use tokio::sync::watch;
use tonic::transport::{Certificate, Identity, Server, ServerTlsConfig};
use tonic::{Request, Response, Status, Streaming};

use super::access::{Access, Guard};
use super::connections::Connections;
use super::{Served, Unknown, Vehicles};
use crate::config::{self, Certificates};
use crate::demand::Taken;
use crate::engine::Newest;
use crate::ingest::entrance::Entrances;
use crate::ingest::grpc::Ingest;
use crate::ingest::now_ns;
use crate::status::Reader;
use crate::wire::EncodedMap;

use v1::ingest_service_server::IngestServiceServer;
use v1::map_service_server::{MapService, MapServiceServer};

/// Requests are names and numbers; anything longer is not meant for us.
const REQUEST_BYTES_MAX: usize = 64 << 10;
/// What a peer may have sent and nobody has read: a connection costs no more.
const WINDOW_BYTES: u32 = 1 << 20;
/// Streams a connection: a fleet page watches some vehicles' layers, nobody a hundred.
const STREAMS_MAX: u32 = 128;
/// A reader that opens `Watch` says what it wants at once.
const SELECTION_TIMEOUT: Duration = Duration::from_secs(10);
/// A peer that is gone without a word is noticed after two of these.
const KEEPALIVE: Duration = Duration::from_secs(10);
/// What a reader may ask to have on its way: more would only be older.
const IN_FLIGHT_MAX: u32 = 64;

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

/// Serves until `stop` resolves and all streams have ended.
///
/// # Errors
/// What the transport says.
pub async fn serve(
    listener: TcpListener,
    security: Security,
    vehicles: Vehicles,
    entrances: Entrances,
    stop: impl Future<Output = ()>,
) -> Result<(), Box<dyn std::error::Error + Send + Sync>> {
    let Security { builder, guard } = security;
    let (health, health_service) = tonic_health::server::health_reporter();
    health.set_serving::<MapServiceServer<Maps>>().await;
    let ingest = (!entrances.all().is_empty()).then(|| Ingest::new(entrances).service());
    if ingest.is_some() {
        health.set_serving::<IngestServiceServer<Ingest>>().await;
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
        .http2_max_header_list_size(16 << 10)
        .add_service(maps)
        .add_optional_service(ingest)
        .add_service(health_service)
        .add_service(reflection().build_v1()?)
        // Older grpcurl knows only this one.
        .add_service(reflection().build_v1alpha()?)
        .serve_with_incoming_shutdown(Connections::new(listener).stream(), stop)
        .await?;
    Ok(())
}

struct Maps {
    vehicles: Vehicles,
}

impl From<Unknown> for Status {
    fn from(unknown: Unknown) -> Self {
        match unknown {
            Unknown::Vehicle { .. } | Unknown::Sensor { .. } => Status::not_found(unknown.to_string()),
            Unknown::Layer { .. } => Status::invalid_argument(unknown.to_string()),
        }
    }
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
        let newest = served.status.demand.take(&layers).newest(&served.newest).await;
        let map = newest.ok_or_else(|| Status::unavailable(format!("vehicle {name} makes no map at present")))?;
        Ok(Response::new(v1::MapUpdate { map: map.select(&layers), skipped: 0, sent_ns: now_ns() }))
    }

    async fn list_vehicles(
        &self,
        _: Request<v1::ListVehiclesRequest>,
    ) -> Result<Response<v1::ListVehiclesResponse>, Status> {
        let vehicles = self.vehicles.statuses().iter().map(|status| status.to_proto()).collect();
        Ok(Response::new(v1::ListVehiclesResponse { vehicles }))
    }
}

/// The updates of one reader of `Watch`: what it selected of the newest maps, as far as what it acknowledges allows. Any
/// executor drives it.
///
/// # Errors
/// What is wrong with the selection.
pub fn watch<R>(
    vehicles: &Vehicles,
    selection: v1::Selection,
    requests: R,
) -> Result<impl Stream<Item = Result<v1::MapUpdate, Status>> + Send + use<R>, Status>
where
    R: Stream<Item = Result<v1::WatchRequest, Status>> + Send + Unpin,
{
    let served = vehicles.find(&selection.vehicle)?;
    served.check_layers(&selection.layers)?;
    if selection.max_in_flight > IN_FLIGHT_MAX {
        let asked = selection.max_in_flight;
        return Err(Status::invalid_argument(format!("max_in_flight {asked}: 0 to {IN_FLIGHT_MAX} is allowed")));
    }
    Ok(Watch::new(served, selection, requests).updates())
}

/// One reader of `Watch`.
struct Watch<R> {
    requests: Option<R>,
    newest: watch::Receiver<Newest>,
    layers: Vec<String>,
    credits: Credits,
    last_sequence: Option<u64>,
    over: bool,
    /// Until it goes, its layers are made.
    taken: Taken,
    // Last, and only held: the reader is counted while this lives.
    _reader: Reader,
}

impl<R: Stream<Item = Result<v1::WatchRequest, Status>> + Unpin> Watch<R> {
    fn new(served: &Served, selection: v1::Selection, requests: R) -> Self {
        let mut newest = served.newest.clone();
        // The current map, if there is one, is the first update.
        newest.mark_changed();
        Self {
            requests: Some(requests),
            newest,
            taken: served.status.demand.take(&selection.layers),
            layers: selection.layers,
            credits: Credits::new(selection.max_in_flight as usize),
            last_sequence: None,
            over: false,
            _reader: Reader::new(&served.status.grpc_readers),
        }
    }

    fn updates(self) -> impl Stream<Item = Result<v1::MapUpdate, Status>> {
        stream::unfold(self, |mut watch| async move {
            if watch.over {
                return None;
            }
            let update = watch.next().await.transpose()?;
            watch.over = update.is_err();
            Some((update, watch))
        })
    }

    /// The next update: when a credit is there, the newest map not sent yet. `None` when the reader has gone.
    async fn next(&mut self) -> Result<Option<v1::MapUpdate>, Status> {
        loop {
            tokio::select! {
                // Acknowledgements first: they free the credit that the map needs.
                biased;
                request = next_request(&mut self.requests) => match request? {
                    Some(request) => self.credits.acknowledge(request.acknowledged),
                    // Half closed: a plain reader goes on reading. Nobody will acknowledge any more.
                    None => self.requests = None,
                },
                changed = self.newest.changed(), if self.credits.left() => {
                    changed.map_err(|_| Status::unavailable("the vehicle's engine has stopped"))?;
                    let newest = self.newest.borrow_and_update().clone();
                    if let Some(map) = newest.filter(|map| self.taken.are_in(map)) {
                        return Ok(Some(self.update(&map)));
                    }
                },
            }
        }
    }

    fn update(&mut self, map: &EncodedMap) -> v1::MapUpdate {
        let skipped = self.last_sequence.map_or(0, |last| map.sequence.saturating_sub(last + 1));
        self.last_sequence = Some(map.sequence);
        self.credits.send(map.sequence);
        v1::MapUpdate { map: map.select(&self.layers), skipped, sent_ns: now_ns() }
    }
}

async fn next_request<R>(requests: &mut Option<R>) -> Result<Option<v1::WatchRequest>, Status>
where
    R: Stream<Item = Result<v1::WatchRequest, Status>> + Unpin,
{
    match requests {
        Some(requests) => requests.next().await.transpose(),
        None => std::future::pending().await,
    }
}

/// What is on its way to a reader without an acknowledgement.
struct Credits {
    max_in_flight: usize,
    in_flight: VecDeque<u64>,
}

impl Credits {
    fn new(max_in_flight: usize) -> Self {
        Self { max_in_flight, in_flight: VecDeque::new() }
    }

    /// Whether one more map may go; always, for readers that never acknowledge.
    fn left(&self) -> bool {
        self.max_in_flight == 0 || self.in_flight.len() < self.max_in_flight
    }

    fn send(&mut self, sequence: u64) {
        if self.max_in_flight > 0 {
            self.in_flight.push_back(sequence);
        }
    }

    /// The reader has finished with this map, and so with all before it.
    fn acknowledge(&mut self, sequence: Option<u64>) {
        let Some(sequence) = sequence else { return };
        while self.in_flight.front().is_some_and(|&sent| sent <= sequence) {
            self.in_flight.pop_front();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_more_maps_are_on_their_way_than_the_reader_allows() {
        let mut credits = Credits::new(2);
        credits.send(10);
        assert!(credits.left());
        credits.send(14);
        assert!(!credits.left());
        credits.acknowledge(Some(9));
        assert!(!credits.left(), "an old acknowledgement frees nothing");
        credits.acknowledge(Some(10));
        assert!(credits.left());
        credits.send(15);
        credits.acknowledge(Some(u64::MAX));
        assert!(credits.in_flight.is_empty());
    }

    #[test]
    fn a_reader_that_never_acknowledges_is_not_held_up() {
        let mut credits = Credits::new(0);
        (0..1000).for_each(|sequence| credits.send(sequence));
        assert!(credits.left() && credits.in_flight.is_empty());
    }
}
