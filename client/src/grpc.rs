//! Maps over gRPC.
//!
//! In: a server's address. Out: its vehicles, their newest maps, and [`MapStream`]s. Each stream has its own connection
//! with a small window and acknowledges every map: a stalled reader then holds up nobody, and gets nothing old.

use std::time::Duration;

use bytes::Bytes;
use clearway_proto::v1;
use clearway_proto::v1::ingest_service_client::IngestServiceClient;
use clearway_proto::v1::map_service_client::MapServiceClient;
use prost::Message;
use tokio::sync::mpsc;
use tokio_stream::StreamExt;
use tokio_stream::wrappers::ReceiverStream;
use tonic::Status;
use tonic::transport::{Certificate, Channel, ClientTlsConfig, Endpoint, Identity};

use crate::ClientError;
use crate::freshness::Clock;
use crate::ingest::{Deliver, Ear, Ingester};
use crate::stream::{Between, Feed, MapStream};
use crate::view::MapView;

/// No map of ours is longer than 64 KiB, so this holds one in flight and no heap of old ones.
const WINDOW_BYTES: u32 = 65_535;
const CONNECT_TIMEOUT: Duration = Duration::from_secs(5);
/// A server that is gone without a word (a pulled cable) is noticed after two of these.
const KEEPALIVE: Duration = Duration::from_secs(2);

/// A server's maps.
#[derive(Clone, Debug)]
pub struct Client {
    address: String,
    endpoint: Endpoint,
    service: MapServiceClient<Channel>,
}

/// Which maps to stream. `Default`: every layer of the server's only vehicle, two in flight.
#[derive(Clone, Debug, PartialEq)]
pub struct Subscription {
    /// Empty where the server has a single vehicle.
    pub vehicle: String,
    /// Empty: every layer.
    pub layers: Vec<String>,
    /// Maps on their way without an acknowledgement, at least 1. With 2 the next one travels while one is looked at.
    pub max_in_flight: u32,
    /// At most so many maps a second; every map where absent.
    pub max_rate_hz: Option<f64>,
    /// The part of each layer that is sent, in the ego frame; all of it where absent.
    pub region: Option<v1::Region>,
    /// Layers travel as what has changed since the map before: less on the link, the same maps.
    pub deltas: bool,
}

/// What a client shows, and whom it believes. All PEM.
#[derive(Clone, Default)]
pub struct Tls {
    /// The CA that the server's certificate must be of.
    pub ca: String,
    /// The client's own certificate and private key, where the server asks who is there.
    pub identity: Option<(String, String)>,
    /// The name that must stand in the server's certificate; the address' host where empty.
    pub server_name: String,
}

impl Default for Subscription {
    fn default() -> Self {
        Self {
            vehicle: String::new(),
            layers: Vec::new(),
            max_in_flight: 2,
            max_rate_hz: None,
            region: None,
            deltas: false,
        }
    }
}

impl Client {
    /// Connects to `HOST:PORT` or `http://HOST:PORT`, in plain text.
    ///
    /// # Errors
    /// [`ClientError::Address`] for what is no address, [`ClientError::Unreachable`] where nobody answers.
    pub async fn connect(address: &str) -> Result<Self, ClientError> {
        Self::open(address, None).await
    }

    /// Connects to `HOST:PORT` or `https://HOST:PORT` with certificates.
    ///
    /// # Errors
    /// [`ClientError::Address`] for what is no address or no certificate, [`ClientError::Unreachable`] where nobody
    /// answers or one side does not believe the other; a client the server does not know may hear of it at its first
    /// call only.
    pub async fn connect_tls(address: &str, tls: &Tls) -> Result<Self, ClientError> {
        Self::open(address, Some(tls)).await
    }

    async fn open(address: &str, tls: Option<&Tls>) -> Result<Self, ClientError> {
        let wrong = |reason: &str| ClientError::Address { address: address.into(), reason: reason.into() };
        let scheme = if tls.is_some() { "https://" } else { "http://" };
        let rest = address.strip_prefix(scheme).unwrap_or(address).trim_end_matches('/');
        if rest.starts_with("https://") {
            return Err(wrong("https needs certificates"));
        }
        if rest.contains("://") {
            return Err(wrong(&format!("another scheme than {scheme}")));
        }
        match rest.rsplit_once(':') {
            None => return Err(wrong("no port")),
            Some(("", _)) => return Err(wrong("no host")),
            Some((_, port)) if port.parse::<u16>().is_err() => return Err(wrong("the port is no number up to 65535")),
            Some(_) => {}
        }
        let url = format!("{scheme}{rest}");
        let mut endpoint = Endpoint::from_shared(url.clone()).map_err(|error| wrong(&innermost(&error)))?;
        if let Some(tls) = tls {
            endpoint = endpoint.tls_config(tls.to_tonic()).map_err(|error| wrong(&innermost(&error)))?;
        }
        let endpoint = endpoint
            .connect_timeout(CONNECT_TIMEOUT)
            .tcp_nodelay(true)
            .initial_stream_window_size(WINDOW_BYTES)
            .initial_connection_window_size(4 * WINDOW_BYTES)
            .http2_keep_alive_interval(KEEPALIVE)
            .keep_alive_timeout(KEEPALIVE);
        let service = MapServiceClient::new(dial(&endpoint, &url).await?);
        Ok(Self { address: url, endpoint, service })
    }

    /// The server's vehicles and what it knows of them.
    ///
    /// # Errors
    /// What the server or the transport says.
    pub async fn vehicles(&self) -> Result<Vec<v1::Vehicle>, ClientError> {
        let answer = self.service.clone().list_vehicles(v1::ListVehiclesRequest {}).await;
        Ok(answer.map_err(|status| refused(&self.address, &status))?.into_inner().vehicles)
    }

    /// The newest map of a vehicle (empty: the only one) with these layers (none named: all).
    ///
    /// # Errors
    /// What the server or the transport says, or what is wrong with the map.
    pub async fn newest(&self, vehicle: &str, layers: &[String]) -> Result<MapView, ClientError> {
        let request = v1::GetMapRequest { vehicle: vehicle.into(), layers: layers.to_vec() };
        let answer = self.service.clone().get_map(request).await;
        let map = MapView::decode(answer.map_err(|status| refused(&self.address, &status))?.into_inner().map)?;
        Ok(map.arrived(&Clock::default()))
    }

    /// Streams maps over a connection of their own.
    ///
    /// # Errors
    /// What the server or the transport says; an unknown vehicle or layer is refused here.
    pub async fn subscribe(&self, subscription: Subscription) -> Result<MapStream, ClientError> {
        let Subscription { vehicle, layers, max_in_flight, max_rate_hz, region, deltas } = subscription;
        let max_in_flight = max_in_flight.max(1);
        let selection = v1::Selection { vehicle, layers, max_in_flight, max_rate_hz, region, deltas };
        let mut service = MapServiceClient::new(dial(&self.endpoint, &self.address).await?);
        let (acknowledge, requests) = mpsc::channel(8);
        let first = tokio_stream::once(v1::WatchRequest { selection: Some(selection), ..Default::default() });
        let updates = service.watch(first.chain(ReceiverStream::new(requests))).await;
        let updates = updates.map_err(|status| refused(&self.address, &status))?.into_inner();
        let address = self.address.clone();
        Ok(MapStream::spawn(move |feed| follow(feed, address, updates, acknowledge)))
    }

    /// Opens a stream for a vehicle's observations, over a connection of its own.
    ///
    /// # Errors
    /// What the server or the transport says; an unknown vehicle is refused here.
    pub async fn ingest(&self, vehicle: &str) -> Result<Ingester, ClientError> {
        let mut service = IngestServiceClient::new(dial(&self.endpoint, &self.address).await?);
        // One: what waits is bounded by the acknowledgements.
        let (observations, requests) = mpsc::channel(1);
        let greeting = tokio_stream::once(v1::Observation { vehicle: vehicle.into(), ..Default::default() });
        let reports = service.stream(greeting.chain(ReceiverStream::new(requests))).await;
        let mut reports = reports.map_err(|status| refused(&self.address, &status))?.into_inner();
        let (heard, address) = (Ear::new(), self.address.clone());
        tokio::spawn({
            let (heard, address) = (heard.clone(), address.clone());
            async move {
                heard.end(loop {
                    match reports.message().await {
                        Ok(Some(report)) => heard.report(report),
                        Ok(None) => break ClientError::Ended { address },
                        Err(status) => break refused(&address, &status),
                    }
                });
            }
        });
        let deliver: Deliver = Box::new({
            let address = address.clone();
            move |observation| {
                let (observations, address) = (observations.clone(), address.clone());
                Box::pin(
                    async move { observations.send(observation).await.map_err(|_| ClientError::Ended { address }) },
                )
            }
        });
        Ok(Ingester::new(address, deliver, heard))
    }
}

impl Tls {
    fn to_tonic(&self) -> ClientTlsConfig {
        let mut config = ClientTlsConfig::new().ca_certificate(Certificate::from_pem(&self.ca));
        if let Some((certificate, key)) = &self.identity {
            config = config.identity(Identity::from_pem(certificate, key));
        }
        if !self.server_name.is_empty() {
            config = config.domain_name(&self.server_name);
        }
        config
    }
}

/// Takes every update, acknowledges it, and says in the end why there are no more. A delta against a map that is not
/// here (an update was lost) is not shown: a whole map is asked for. All that was not shown counts as skipped, but for
/// what the reader did not want.
async fn follow(
    feed: Feed,
    address: String,
    mut updates: tonic::Streaming<v1::MapUpdate>,
    requests: mpsc::Sender<v1::WatchRequest>,
) -> ClientError {
    let mut base: Option<MapView> = None;
    let (mut asked, mut left_out) = (false, 0);
    loop {
        let update = match updates.message().await {
            Ok(Some(update)) => update,
            Ok(None) => return ClientError::Ended { address },
            Err(status) => return refused(&address, &status),
        };
        left_out += update.left_out;
        let request = match MapView::decode_on(update.map.clone(), base.as_ref()) {
            Ok(map) => {
                let sequence = map.sequence();
                let last = base.replace(map.clone()).map_or(sequence, |last| last.sequence() + 1);
                let skipped = sequence.saturating_sub(last).saturating_sub(left_out);
                feed.put(map, Between { skipped, left_out, ..Between::default() });
                (asked, left_out) = (false, 0);
                v1::WatchRequest { acknowledged: Some(sequence), ..Default::default() }
            }
            Err(error) => {
                let Some(acknowledged) = sequence_of_delta(update.map) else { return error };
                tracing::debug!(sequence = acknowledged, %error, "a delta is of no use, a whole map is asked for");
                // More deltas may be on the way already; one question is enough for them all.
                let request_keyframe = !std::mem::replace(&mut asked, true);
                v1::WatchRequest { acknowledged: Some(acknowledged), request_keyframe, selection: None }
            }
        };
        if requests.send(request).await.is_err() {
            return ClientError::Ended { address };
        }
    }
}

/// Of a map with a layer that needs another map; `None` where it stands for itself, or is no map.
fn sequence_of_delta(bytes: Bytes) -> Option<u64> {
    let map = v1::Map::decode(bytes).ok()?;
    let is_delta = map.layers.iter().any(|layer| layer.base_sequence.is_some());
    map.header.filter(|_| is_delta).map(|header| header.sequence)
}

async fn dial(endpoint: &Endpoint, address: &str) -> Result<Channel, ClientError> {
    let unreachable = |error| ClientError::Unreachable { address: address.into(), reason: innermost(&error) };
    endpoint.connect().await.map_err(unreachable)
}

fn refused(address: &str, status: &Status) -> ClientError {
    if let Some(source) = std::error::Error::source(status) {
        return ClientError::Unreachable { address: address.into(), reason: innermost(source) };
    }
    ClientError::Refused {
        address: address.into(),
        reason: status.message().into(),
        code: format!("{:?}", status.code()),
    }
}

/// "transport error" says little; what caused it says what to do.
fn innermost(error: &dyn std::error::Error) -> String {
    let mut error = error;
    while let Some(source) = error.source() {
        error = source;
    }
    error.to_string()
}
