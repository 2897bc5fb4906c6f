//! Maps over gRPC.
//!
//! In: the address of a server. Out: its vehicles, their newest maps, and [`MapStream`]s. Each stream has its own
//! connection with a small window and acknowledges every map, so a stalled reader delays no other reader and receives
//! no old maps. A server that knows which other server serves a vehicle leads the client there.

mod address;
mod follow;
mod refusal;

use std::time::Duration;

use clearway_proto::v1::ingest_service_client::IngestServiceClient;
use clearway_proto::v1::map_service_client::MapServiceClient;
use clearway_proto::v1::plan_service_client::PlanServiceClient;
use clearway_proto::v1::recording_service_client::RecordingServiceClient;
use clearway_proto::v1::replay_service_client::ReplayServiceClient;
use clearway_proto::{SERVED_AT, plan, v1};
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tokio_stream::{Stream, StreamExt};
use tonic::Status;
use tonic::transport::{Certificate, Channel, ClientTlsConfig, Endpoint, Identity};

use crate::error::ClientError;
use crate::freshness::{Clock, now_ns};
use crate::ingest::{Ingester, ReportReceiver, SendObservation};
use crate::stream::MapStream;
use crate::view::MapView;

use address::url;
use follow::{Watch, follow};
use refusal::{innermost, refused};

/// Flow-control window of a stream, in bytes: one map with the default grids. More would queue old maps.
const WINDOW_BYTES: u32 = 65_535;
/// Longest time to connect. Ours.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(5);
/// Interval of keep-alive pings. A server that disappears (a pulled cable) is noticed after two intervals.
const KEEPALIVE: Duration = Duration::from_secs(2);

/// A connection to a server.
#[derive(Clone, Debug)]
pub struct Client {
    address: String,
    endpoint: Endpoint,
    tls: Option<Tls>,
    channel: Channel,
    service: MapServiceClient<Channel>,
}

/// Which maps to stream. The default is every layer of the server's only vehicle, with two maps in flight.
#[derive(Clone, Debug, PartialEq)]
pub struct Subscription {
    /// Name of the vehicle. May be empty if the server has a single vehicle.
    pub vehicle: String,
    /// Names of the layers; empty: every layer.
    pub layers: Vec<String>,
    /// Most maps sent without an acknowledgement, at least 1. With 2, the next map travels while the reader uses one.
    pub max_in_flight: u32,
    /// Highest rate in maps per second; absent: every map.
    pub max_rate_hz: Option<f64>,
    /// The part of each layer that is sent, in the ego frame; absent: the whole layer.
    pub region: Option<v1::Region>,
    /// Layers may be sent as deltas to the map before: fewer bytes, the same maps.
    pub deltas: bool,
    /// True: a map is as old as it was when it was made, plus the time since it came. So the maps of a replay that
    /// keeps the recorded stamps are judged by the replay's clock; pass [`MapView::now_ns`] to [`MapView::is_stale`].
    pub replay_clock: bool,
    /// True: a stream that a server or a connection has ended is opened again, after pauses of 0.1 to 5 s;
    /// [`MapStream::reasons`] and the log say so. It ends if the server refuses the subscription itself, such as after
    /// the loss of a role.
    pub reconnects: bool,
}

/// Certificates of an encrypted connection, as PEM text. Debug output does not show them.
#[derive(Clone, Default)]
pub struct Tls {
    /// Certificate of the authority that must have signed the server's certificate.
    pub ca: String,
    /// Certificate and private key of the client, if the server requires them.
    pub identity: Option<(String, String)>,
    /// Name that the server's certificate must contain; empty: the host of the address.
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
            replay_clock: false,
            reconnects: false,
        }
    }
}

impl Client {
    /// Connects to `HOST:PORT` or `http://HOST:PORT`, in plain text.
    ///
    /// # Errors
    /// [`ClientError::Address`] if the text is not an address, [`ClientError::Unreachable`] if no server answers.
    pub async fn connect(address: &str) -> Result<Self, ClientError> {
        Self::open(address, None).await
    }

    /// Connects to `HOST:PORT` or `https://HOST:PORT` with certificates.
    ///
    /// # Errors
    /// [`ClientError::Address`] if the text is not an address, [`ClientError::Certificate`] if a certificate is
    /// invalid, [`ClientError::Unreachable`] if no server answers or one side rejects the certificate of the other. The
    /// server may reject a client's certificate only at the first call.
    pub async fn connect_tls(address: &str, tls: &Tls) -> Result<Self, ClientError> {
        Self::open(address, Some(tls)).await
    }

    /// Controls the server's recorder; needs the role of an operator, if clients have roles.
    ///
    /// # Errors
    /// [`ClientError::Unreachable`] if no server answers.
    pub async fn recorder(&self) -> Result<RecordingServiceClient<Channel>, ClientError> {
        let channel = self
            .endpoint
            .connect()
            .await
            .map_err(|error| ClientError::Unreachable { address: self.address.clone(), reason: innermost(&error) })?;
        Ok(RecordingServiceClient::new(channel))
    }

    async fn open(address: &str, tls: Option<&Tls>) -> Result<Self, ClientError> {
        let wrong = |reason: &str| ClientError::Address { address: address.into(), reason: reason.into() };
        let url = url(address, tls.is_some())?;
        let mut endpoint = Endpoint::from_shared(url.clone()).map_err(|error| wrong(&innermost(&error)))?;
        if let Some(tls) = tls {
            endpoint = endpoint
                .tls_config(tls.to_tonic())
                .map_err(|error| ClientError::Certificate { address: address.into(), reason: innermost(&error) })?;
        }
        let endpoint = endpoint
            .connect_timeout(CONNECT_TIMEOUT)
            .tcp_nodelay(true)
            .initial_stream_window_size(WINDOW_BYTES)
            .initial_connection_window_size(4 * WINDOW_BYTES)
            .http2_keep_alive_interval(KEEPALIVE)
            .keep_alive_timeout(KEEPALIVE);
        let channel = dial(&endpoint, &url).await?;
        let service = MapServiceClient::new(channel.clone());
        Ok(Self { address: url, endpoint, tls: tls.cloned(), channel, service })
    }

    /// State of every vehicle of the server.
    ///
    /// # Errors
    /// [`ClientError::Unreachable`] if the connection fails, [`ClientError::Refused`] if the server refuses the call.
    pub async fn vehicles(&self) -> Result<Vec<v1::Vehicle>, ClientError> {
        let answer = self.service.clone().list_vehicles(v1::ListVehiclesRequest {}).await;
        Ok(answer.map_err(|status| refused(&self.address, &status))?.into_inner().vehicles)
    }

    /// State of these vehicles (empty: all) once a second, and at each change of a vehicle's state. The stream ends
    /// with an error if the connection fails.
    ///
    /// # Errors
    /// [`ClientError::Unreachable`] if the connection fails, [`ClientError::Refused`] if the server refuses the call or
    /// a vehicle is unknown.
    pub async fn watch_status(
        &self,
        vehicles: &[String],
    ) -> Result<impl Stream<Item = Result<Vec<v1::Vehicle>, ClientError>> + Unpin + use<>, ClientError> {
        let request = v1::WatchStatusRequest { vehicles: vehicles.to_vec() };
        let answer = self.service.clone().watch_status(request).await;
        let updates = answer.map_err(|status| refused(&self.address, &status))?.into_inner();
        let address = self.address.clone();
        Ok(updates.map(move |update| match update {
            Ok(update) => Ok(update.vehicles),
            Err(status) => Err(refused(&address, &status)),
        }))
    }

    /// Newest map of a vehicle (empty: the only one) with these layers (empty: all).
    ///
    /// # Errors
    /// [`ClientError::Unreachable`] if the connection fails, [`ClientError::Refused`] if the vehicle or a layer is
    /// unknown or there is no map yet, [`ClientError::Map`] if the map is invalid.
    pub async fn newest(&self, vehicle: &str, layers: &[String]) -> Result<MapView, ClientError> {
        let request = v1::GetMapRequest { vehicle: vehicle.into(), layers: layers.to_vec() };
        let mut answer = self.service.clone().get_map(request.clone()).await;
        if let Some(server) = self.led_by(answer.as_ref().err()).await? {
            answer = server.service.clone().get_map(request).await;
        }
        let map = MapView::decode(answer.map_err(|status| refused(&self.address, &status))?.into_inner().map)?;
        Ok(map.with_arrival(&Clock::default()))
    }

    /// Controls the replay that the server serves; an empty request changes nothing. Returns the state after the
    /// change.
    ///
    /// # Errors
    /// [`ClientError::Unreachable`] if the connection fails, [`ClientError::Refused`] if the server serves no replay
    /// (`Unimplemented`) or the request is not allowed.
    pub async fn replay_control(&self, request: v1::ReplayControl) -> Result<v1::ReplayState, ClientError> {
        let mut service = ReplayServiceClient::new(dial(&self.endpoint, &self.address).await?);
        let answer = service.control(request).await;
        Ok(answer.map_err(|status| refused(&self.address, &status))?.into_inner())
    }

    /// Streams maps over a separate connection.
    ///
    /// # Errors
    /// [`ClientError::Unreachable`] if the connection fails, [`ClientError::Refused`] if the vehicle, a layer, the rate
    /// or the region cannot be served.
    pub async fn subscribe(&self, subscription: Subscription) -> Result<MapStream, ClientError> {
        let Subscription { vehicle, layers, max_in_flight, max_rate_hz, region, deltas, .. } = subscription;
        let Subscription { replay_clock, reconnects, .. } = subscription;
        let max_in_flight = max_in_flight.max(1);
        let selection =
            v1::Selection { vehicle, layers, max_in_flight, max_rate_hz, region, deltas, states: true, plans: false };
        let (mut client, mut opened) = (self.clone(), self.watch(&selection).await?);
        if let Some(server) = self.led_by(opened.as_ref().err()).await? {
            opened = server.watch(&selection).await?;
            client = server;
        }
        let opened = opened.map_err(|status| refused(&client.address, &status))?;
        let clock = Clock { is_of_replay: replay_clock, ..Clock::default() };
        let address = client.address.clone();
        let open_again = reconnects.then_some(move || {
            let (client, selection) = (client.clone(), selection.clone());
            async move { client.watch(&selection).await?.map_err(|status| refused(&client.address, &status)) }
        });
        Ok(MapStream::spawn(clock, move |slot| follow(slot, address, opened, open_again)))
    }

    /// Opens a stream of maps on a connection of its own. The inner error is the server's answer.
    async fn watch(&self, selection: &v1::Selection) -> Result<Result<Watch, Status>, ClientError> {
        let mut service = MapServiceClient::new(dial(&self.endpoint, &self.address).await?);
        let (acknowledge, requests) = mpsc::channel(8);
        let first = v1::WatchRequest { selection: Some(selection.clone()), ..Default::default() };
        let updates = service.watch(tokio_stream::once(first).chain(ReceiverStream::new(requests))).await;
        Ok(updates.map(|updates| (updates.into_inner(), acknowledge)))
    }

    /// The server to which this server leads: it serves the vehicle that this server does not. With the certificates of
    /// this connection.
    async fn led_by(&self, status: Option<&Status>) -> Result<Option<Self>, ClientError> {
        let address = status.and_then(|status| status.metadata().get(SERVED_AT)?.to_str().ok());
        match address {
            Some(address) => Self::open(address, self.tls.as_ref()).await.map(Some),
            None => Ok(None),
        }
    }

    /// Sends what a planner did with a map ([`MapView::plan`]), to be recorded and drawn over the maps. Needs the role
    /// of an ingester, if clients have roles.
    ///
    /// # Errors
    /// [`ClientError::Plan`] if the plan cannot be drawn, [`ClientError::Unreachable`] if the connection fails,
    /// [`ClientError::Refused`] if the vehicle is unknown or there are too many plans.
    pub async fn send_plan(&self, plan: &v1::Plan) -> Result<(), ClientError> {
        plan::check(plan, now_ns())?;
        let mut service = PlanServiceClient::new(self.channel.clone());
        service.send(plan.clone()).await.map_err(|status| refused(&self.address, &status))?;
        Ok(())
    }

    /// Opens a stream for a vehicle's observations, over a separate connection.
    ///
    /// # Errors
    /// [`ClientError::Unreachable`] if the connection fails, [`ClientError::Refused`] if the vehicle is unknown.
    pub async fn ingest(&self, vehicle: &str) -> Result<Ingester, ClientError> {
        let mut service = IngestServiceClient::new(dial(&self.endpoint, &self.address).await?);
        // A queue of one: the acknowledgements bound the number of observations that wait.
        let (observations, requests) = mpsc::channel(1);
        let first = tokio_stream::once(v1::Observation { vehicle: vehicle.into(), ..Default::default() });
        let reports = service.stream(first.chain(ReceiverStream::new(requests))).await;
        let mut incoming = reports.map_err(|status| refused(&self.address, &status))?.into_inner();
        let (reports, address) = (ReportReceiver::new(), self.address.clone());
        tokio::spawn({
            let (reports, address) = (reports.clone(), address.clone());
            async move {
                reports.end(loop {
                    match incoming.message().await {
                        Ok(Some(report)) => reports.push(report),
                        Ok(None) => break ClientError::Ended { address },
                        Err(status) => break refused(&address, &status),
                    }
                });
            }
        });
        let send: SendObservation = Box::new({
            let address = address.clone();
            move |observation| {
                let (observations, address) = (observations.clone(), address.clone());
                Box::pin(
                    async move { observations.send(observation).await.map_err(|_| ClientError::Ended { address }) },
                )
            }
        });
        Ok(Ingester::new(address, send, reports))
    }
}

impl std::fmt::Debug for Tls {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Tls").finish_non_exhaustive()
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

async fn dial(endpoint: &Endpoint, address: &str) -> Result<Channel, ClientError> {
    let unreachable = |error| ClientError::Unreachable { address: address.into(), reason: innermost(&error) };
    endpoint.connect().await.map_err(unreachable)
}
