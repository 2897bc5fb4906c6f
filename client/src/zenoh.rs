//! Maps over zenoh: keys `clearway/<vehicle>/map/<layer>`, the end of a replay on `clearway/<vehicle>/replay`, why no
//! map comes on `clearway/<vehicle>/status`, liveliness tokens `clearway/<vehicle>`.
//!
//! In: the endpoints of routers or servers. Out: the same [`MapView`], [`MapStream`] and [`Ingester`] as over gRPC. It
//! needs tokio's multi-thread runtime, because zenoh panics in a current-thread one.
//!
//! A session that loses its router or server reconnects when it is available again. Until then its streams report that
//! their map is stale; afterwards they continue. A stream has one layer, because zenoh delivers and drops each key
//! separately. Use gRPC for layers that must belong to one map.

use std::hash::{BuildHasher, Hasher};
use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, Instant};

use base64::Engine;
use base64::prelude::BASE64_STANDARD;
use clearway_proto::{plan, v1};
use prost::Message;
use zenoh::qos::CongestionControl;
use zenoh::sample::SourceInfo;
use zenoh::{Config, Session};

use crate::error::ClientError;
use crate::freshness::{Clock, now_ns};
use crate::grpc::Tls;
use crate::ingest::{Ingester, ReportReceiver, SendObservation};
use crate::signature::PublicKey;
use crate::stream::{LatestSlot, MapStream};
use crate::view::MapView;

mod query;
mod replay;
mod status;
mod subscription;

use query::{LayerKey, failed};
use subscription::LayerSubscription;

/// Settings of every session. They override the settings of a configuration file.
const SETTINGS: [(&str, &str); 9] = [
    ("listen/endpoints", "[]"),
    ("scouting/multicast/enabled", "false"),
    ("scouting/gossip/enabled", "false"),
    ("connect/exit_on_failure", "false"),
    // Tries again at most 0.5 s after an attempt.
    ("connect/retry", "{ period_init_ms: 100, period_max_ms: 500, period_increase_factor: 2 }"),
    // A peer that disappears (a pulled cable) is noticed after 2 s, about as over gRPC. Each side announces its own
    // lease.
    ("transport/link/tx/lease", "2000"),
    // 16 MiB, far more than a map may have. A longer message is dropped before it is assembled.
    ("transport/link/rx/max_message_size", "16777216"),
    // About thirty maps: while a planner's machine is suspended, old maps wait here; it reads them all when it resumes.
    ("transport/link/tcp", "{ so_rcvbuf: 262144 }"),
    ("transport/link/tls/so_rcvbuf", "262144"),
];
/// The mode of a session that has one router, the separator of its endpoints, and `connect/timeout_ms`: each endpoint
/// once. With a time-out zenoh tries the first of a client's endpoints again until the time is over, and never the next
/// one.
const CLIENT: (&str, char, &str) = ("'client'", ',', "0");
/// The same of a session that has all routers: each endpoint until it answers. Without a time-out zenoh never tries an
/// endpoint again that did not answer a peer at the start.
const PEER: (&str, char, &str) = ("'peer'", '+', "-1");
/// Longest time in which a router must begin to answer. Ours: a router and its readers may start together.
const OPEN_MAX: Duration = Duration::from_secs(5);
/// Time between two attempts to open a session.
const OPEN_RETRY: Duration = Duration::from_millis(200);
/// Longest time for one endpoint to answer, in ms: in the first attempt, and in the attempts after it, which double it.
/// Ours: a router that is silent costs 0.5 s, and a handshake with certificates over a slow link takes up to 2 s.
const OPEN_TIMEOUT_MS: (u64, u64) = (500, 2000);

/// A zenoh session that reads maps and sends observations.
#[derive(Clone)]
pub struct ZenohClient {
    session: Session,
    endpoint: String,
    signed_by: Option<PublicKey>,
}

impl std::fmt::Debug for ZenohClient {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        formatter.debug_struct("ZenohClient").field("endpoint", &self.endpoint).finish_non_exhaustive()
    }
}

impl ZenohClient {
    /// Connects to an endpoint, such as `tcp/localhost:7447`, without scouting or listening.
    ///
    /// Of several endpoints that are separated by commas it uses the first that answers, and after a loss again the
    /// first that answers. A router that is killed costs 0.3 s of maps, and a router that is stopped 4 s. While the
    /// router answers and maps do not reach it, there are none.
    ///
    /// Of several endpoints that are separated by `+` it uses all at once, and does not wait for any of them: where
    /// every gap counts. Each map then comes once over each router, so that no fault of one router or of the link
    /// between two of them costs a map. The server must have `zenoh.mode = "client"`.
    ///
    /// # Errors
    /// [`ClientError::Zenoh`] if the text is not an endpoint, [`ClientError::Unreachable`] if no router answers within
    /// 5 s.
    pub async fn connect(endpoint: &str) -> Result<Self, ClientError> {
        Self::open(endpoint, Config::default()).await
    }

    /// As [`ZenohClient::connect`], with a zenoh configuration file (JSON5) as the base: certificates for
    /// `tls/HOST:PORT`, as in `deploy/zenoh/client.json5`.
    ///
    /// # Errors
    /// [`ClientError::Zenoh`] if the file cannot be read or is not a configuration; else as [`ZenohClient::connect`].
    pub async fn connect_with(endpoint: &str, file: &Path) -> Result<Self, ClientError> {
        let config = Config::from_file(file).map_err(failed(format!("configuration {}", file.display())))?;
        Self::open(endpoint, config).await
    }

    /// As [`ZenohClient::connect`], with these certificates, for `tls/HOST:PORT`. The name in the certificate of the
    /// router must be the name in the endpoint.
    ///
    /// # Errors
    /// As [`ZenohClient::connect`].
    pub async fn connect_tls(endpoint: &str, tls: &Tls) -> Result<Self, ClientError> {
        let mut config = Config::default();
        let (certificate, key) = tls.identity.clone().unwrap_or_default();
        let values = [
            ("root_ca_certificate_base64", &tls.ca),
            ("connect_certificate_base64", &certificate),
            ("connect_private_key_base64", &key),
        ];
        for (name, pem) in values.into_iter().filter(|(_, pem)| !pem.is_empty()) {
            let (setting, value) = (format!("transport/link/tls/{name}"), BASE64_STANDARD.encode(pem));
            config.insert_json5(&setting, &format!("{value:?}")).map_err(failed(setting))?;
        }
        let mtls = "transport/link/tls/enable_mtls";
        config.insert_json5(mtls, &tls.identity.is_some().to_string()).map_err(failed(mtls))?;
        Self::open(endpoint, config).await
    }

    async fn open(endpoint: &str, mut config: Config) -> Result<Self, ClientError> {
        let (mode, separator, timeout_ms) = if endpoint.contains('+') { PEER } else { CLIENT };
        for (key, value) in SETTINGS.into_iter().chain([("mode", mode), ("connect/timeout_ms", timeout_ms)]) {
            config.insert_json5(key, value).map_err(failed(format!("{key} = {value}")))?;
        }
        let endpoints = format!("{:?}", endpoint.split(separator).collect::<Vec<_>>());
        config.insert_json5("connect/endpoints", &endpoints).map_err(|_| ClientError::Zenoh {
            what: format!("endpoint {endpoint:?}"),
            reason: "PROTOCOL/HOST:PORT is allowed, such as tcp/localhost:7447".into(),
        })?;
        let (until, (first_ms, longest_ms)) = (Instant::now() + OPEN_MAX, OPEN_TIMEOUT_MS);
        // The one attempt to open a peer goes on in the background.
        let mut open_timeout_ms = if endpoint.contains('+') { longest_ms } else { first_ms };
        loop {
            let setting = "transport/unicast/open_timeout";
            config.insert_json5(setting, &open_timeout_ms.to_string()).map_err(failed(setting))?;
            match zenoh::open(config.clone()).await {
                Ok(session) => return Ok(Self { session, endpoint: endpoint.into(), signed_by: None }),
                Err(error) if Instant::now() >= until => return Err(unconnected(endpoint, error)),
                Err(_) => tokio::time::sleep(OPEN_RETRY).await,
            }
            open_timeout_ms = longest_ms.min(2 * open_timeout_ms);
        }
    }

    /// Believes only maps that have a signature of this key; the others are counted and passed over
    /// ([`MapStream::passed_over`]). The server signs with `zenoh.signing_key`.
    #[must_use]
    pub fn signed_by(self, key: PublicKey) -> Self {
        Self { signed_by: Some(key), ..self }
    }

    /// Sorted names of the vehicles that are served now.
    ///
    /// # Errors
    /// [`ClientError::Zenoh`] if the query fails.
    pub async fn vehicles(&self) -> Result<Vec<String>, ClientError> {
        query::published(&self.session, "clearway/*", 1).await
    }

    /// Newest map of one layer; `None` if no server serves it or there is no map yet.
    ///
    /// # Errors
    /// [`ClientError::Zenoh`] if the query fails, [`ClientError::Map`] if there are answers and none is a valid map.
    pub async fn newest(&self, vehicle: &str, layer: &str) -> Result<Option<MapView>, ClientError> {
        LayerKey::new(vehicle, layer, self.signed_by.clone())?.newest(&self.session).await
    }

    /// Streams one layer of one vehicle, starting with the newest map if there is one. The stream does not end with the
    /// server: [`MapStream::next_or_stale`] reports that its map is stale, and continues with the maps of the next
    /// server; the end of a replay it reports as over gRPC. Nor does it end with a message that is no valid map: it is
    /// counted ([`MapStream::passed_over`]).
    ///
    /// # Errors
    /// [`ClientError::Name`] if a name is not allowed, [`ClientError::Zenoh`] if the subscription fails.
    pub async fn subscribe(&self, vehicle: &str, layer: &str) -> Result<MapStream, ClientError> {
        let layer = LayerKey::new(vehicle, layer, self.signed_by.clone())?;
        let (slot, key) = (LatestSlot::new(Clock::default()), layer.key.clone());
        let subscription = LayerSubscription::open(&self.session, layer.clone(), slot.clone()).await;
        let subscription = subscription.map_err(failed(format!("subscribe to {key}")))?;
        let replay = replay::subscribe(&self.session, vehicle, slot.clone(), &self.endpoint).await?;
        let status = status::subscribe(&self.session, vehicle, slot.clone()).await?;
        let told = slot.clone();
        // A session closes with its last clone and ends its subscriptions, so the stream keeps a clone.
        let Self { session, endpoint: address, .. } = self.clone();
        Ok(MapStream::of_slot(&slot, async move {
            let _held = (replay, status);
            tokio::join!(subscription.closed(), status::tell_absence(&session, &layer, &told));
            ClientError::Ended { address }
        }))
    }
}

impl ZenohClient {
    /// Sends what a planner did with a map, as [`crate::Client::send_plan`]. The server counts a refusal in its status
    /// and does not answer.
    ///
    /// # Errors
    /// [`ClientError::Plan`] if the plan cannot be drawn, [`ClientError::Zenoh`] if zenoh fails.
    pub async fn send_plan(&self, plan: &v1::Plan) -> Result<(), ClientError> {
        plan::check(plan, now_ns())?;
        let key = format!("clearway/{}/plan", plan.vehicle);
        let put = self.session.put(&key, plan.encode_to_vec()).congestion_control(CongestionControl::Drop);
        // With roles the server looks up the certificate of the session that this names.
        let put = put.source_info(SourceInfo::new(self.session.id(), 0));
        put.await.map_err(failed(format!("put {key}")))
    }

    /// Opens a sender of a vehicle's observations. Each observation of a sensor must name the sensor.
    ///
    /// # Errors
    /// [`ClientError::Zenoh`] if a query or subscription fails, [`ClientError::Refused`] with the known vehicles if the
    /// vehicle is not served.
    pub async fn ingest(&self, vehicle: &str) -> Result<Ingester, ClientError> {
        let served = self.vehicles().await?;
        if !served.iter().any(|name| name == vehicle) {
            let reason = format!("vehicle {vehicle:?} is not known; known: {}", served.join(", "));
            return Err(ClientError::Refused { address: self.endpoint.clone(), reason, code: "NotFound".into() });
        }
        // Unique: the system's randomness is the key of each `RandomState`.
        let client = std::hash::RandomState::new().build_hasher().finish();
        let (receiver, prefix) = (ReportReceiver::new(), format!("clearway/{vehicle}/ingest"));
        let key = format!("{prefix}/report");
        let reports = self.session.declare_subscriber(key.clone()).callback({
            let receiver = receiver.clone();
            move |sample| {
                // Ignores messages that are not reports, and reports for other senders.
                match v1::IngestReport::decode(&*sample.payload().to_bytes()) {
                    Ok(report) if report.client == client => receiver.push(report),
                    _ => {}
                }
            }
        });
        let reports = Arc::new(reports.await.map_err(failed(format!("subscribe to {key}")))?);
        let session = self.session.clone();
        let send: SendObservation = Box::new(move |observation| {
            let (session, reports) = (session.clone(), reports.clone());
            let (key, number) = (key_of(&prefix, &observation), observation.number as u32);
            let bytes = v1::Observation { client, ..observation }.encode_to_vec();
            Box::pin(async move {
                // Keeps the subscription until the last observation is sent.
                let _reports = reports;
                // Blocks, because no observation may be lost; only the sender waits. All observations have zenoh's
                // default priority: zenoh keeps the order within one priority, and the server counts gaps in the
                // numbers.
                let put = session.put(&key, bytes).congestion_control(CongestionControl::Block);
                // With roles the server looks up the certificate of the session that this names.
                let put = put.source_info(SourceInfo::new(session.id(), number));
                put.await.map_err(failed(format!("put {key}")))
            })
        });
        Ok(Ingester::new(self.endpoint.clone(), send, receiver))
    }
}

/// The error of a session that could not be opened. zenoh has the same words for a missing router and for a refused
/// certificate.
fn unconnected(endpoint: &str, error: zenoh::Error) -> ClientError {
    if !error.to_string().contains("Unable to connect") {
        return failed(format!("connect to {endpoint}"))(error);
    }
    let reason = format!("no zenoh router or server accepts a connection within {} s", OPEN_MAX.as_secs());
    ClientError::Unreachable { address: endpoint.into(), reason }
}

/// Key of an observation.
fn key_of(prefix: &str, observation: &v1::Observation) -> String {
    use v1::observation::Body;
    let (kind, sensor) = match &observation.body {
        Some(Body::EgoPose(_)) => ("pose", ""),
        Some(Body::Declaration(declared)) => ("sensor", &*declared.name),
        Some(Body::Road(_)) => ("road", ""),
        Some(Body::Packets(_)) => ("packet", &*observation.sensor),
        Some(Body::End(_)) => ("end", &*observation.sensor),
        Some(Body::Scan(_)) | None => ("scan", &*observation.sensor),
    };
    let key = format!("{prefix}/{kind}/{sensor}");
    key.trim_end_matches('/').to_owned()
}
