//! Maps over zenoh: keys `clearway/<vehicle>/map/<layer>`, liveliness tokens `clearway/<vehicle>`.
//!
//! In: a router's or server's endpoint. Out: the same [`MapView`], [`MapStream`] and [`Ingester`] as over gRPC. Needs tokio's
//! multi-thread runtime: zenoh panics in a current-thread one.
//!
//! A session that loses its router or server looks for it until it is there again; streams go on then, and tell meanwhile that
//! their map is stale. One layer a stream: each key is dropped and delivered by itself, and layers that must be of one
//! moment come together over gRPC.

use std::hash::{BuildHasher, Hasher};
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use clearway_proto::v1;
use prost::Message;
use zenoh::bytes::ZBytes;
use zenoh::qos::CongestionControl;
use zenoh::{Config, Session};

use crate::ClientError;
use crate::freshness::Clock;
use crate::ingest::{Deliver, Ear, Ingester};
use crate::stream::MapStream;
use crate::view::MapView;

mod tap;

use tap::Tap;

const ANSWER_TIMEOUT: Duration = Duration::from_secs(5);

/// What every session of ours has, whatever else its file says.
const SETTINGS: [(&str, &str); 11] = [
    ("mode", "'client'"),
    ("listen/endpoints", "[]"),
    ("scouting/multicast/enabled", "false"),
    ("scouting/gossip/enabled", "false"),
    ("connect/timeout_ms", "5000"),
    // A planner has maps again a second after its router, at the latest.
    ("connect/retry", "{ period_init_ms: 100, period_max_ms: 1000, period_increase_factor: 2 }"),
    ("transport/unicast/open_timeout", "2000"),
    // Who is gone without a word (a pulled cable) is noticed after 2 s, as over gRPC. Each side tells the other its own.
    ("transport/link/tx/lease", "2000"),
    // Far more than a map may have; what is longer is dropped before it is put together.
    ("transport/link/rx/max_message_size", "16777216"),
    // Some thirty maps: when a planner's machine halts, old maps wait here, and it reads through them when it goes on.
    ("transport/link/tcp", "{ so_rcvbuf: 262144 }"),
    ("transport/link/tls/so_rcvbuf", "262144"),
];

/// A session that reads maps.
#[derive(Clone, Debug)]
pub struct ZenohClient {
    session: Session,
    endpoint: String,
}

fn failed(what: impl Into<String>) -> impl FnOnce(zenoh::Error) -> ClientError {
    let what = what.into();
    |reason| ClientError::Zenoh { what, reason: reason.to_string() }
}

impl ZenohClient {
    /// Connects to one endpoint, such as `tcp/localhost:7447`; nothing is scouted, nothing listens.
    ///
    /// # Errors
    /// [`ClientError::Zenoh`] for what is no endpoint and where nobody answers.
    pub async fn connect(endpoint: &str) -> Result<Self, ClientError> {
        Self::open(endpoint, Config::default()).await
    }

    /// As [`ZenohClient::connect`], with a zenoh configuration (JSON5) to begin with: certificates for `tls/HOST:PORT`, as in
    /// `deploy/zenoh/client.json5`.
    ///
    /// # Errors
    /// [`ClientError::Zenoh`] also for a file that is none or cannot be read.
    pub async fn connect_with(endpoint: &str, file: &Path) -> Result<Self, ClientError> {
        let config = Config::from_file(file).map_err(failed(format!("configuration {}", file.display())))?;
        Self::open(endpoint, config).await
    }

    async fn open(endpoint: &str, mut config: Config) -> Result<Self, ClientError> {
        for (key, value) in SETTINGS {
            config.insert_json5(key, value).map_err(failed(format!("{key} = {value}")))?;
        }
        let endpoints = format!("[{endpoint:?}]");
        config.insert_json5("connect/endpoints", &endpoints).map_err(failed(format!("endpoint {endpoint:?}")))?;
        let session = zenoh::open(config).await.map_err(failed(format!("connect to {endpoint}")))?;
        Ok(Self { session, endpoint: endpoint.into() })
    }

    /// Names of the vehicles that are served now, in order.
    ///
    /// # Errors
    /// What zenoh says.
    pub async fn vehicles(&self) -> Result<Vec<String>, ClientError> {
        let liveliness = self.session.liveliness();
        let replies = liveliness.get("clearway/*").timeout(ANSWER_TIMEOUT);
        let replies = replies.await.map_err(failed("liveliness clearway/*"))?;
        let mut names = Vec::new();
        while let Ok(reply) = replies.recv_async().await {
            if let Ok(sample) = reply.result() {
                names.extend(sample.key_expr().as_str().strip_prefix("clearway/").map(str::to_owned));
            }
        }
        names.sort_unstable();
        names.dedup();
        Ok(names)
    }

    /// The newest map of one layer; `None` where nobody serves it, or before its first.
    ///
    /// # Errors
    /// What zenoh says, or what is wrong with the map.
    pub async fn newest(&self, vehicle: &str, layer: &str) -> Result<Option<MapView>, ClientError> {
        let key = format!("clearway/{vehicle}/map/{layer}");
        let map = query(&self.session, &key).await?.map(|map| decode(&map)).transpose()?;
        Ok(map.map(|map| map.arrived(&Clock::default())))
    }

    /// Streams one layer of one vehicle, beginning with the newest map there is (or the next one, where there is none yet).
    /// It does not end with the server: [`MapStream::next_or_stale`] tells that its map is stale, and goes on with the maps
    /// of the next server.
    ///
    /// # Errors
    /// What zenoh says.
    pub async fn subscribe(&self, vehicle: &str, layer: &str) -> Result<MapStream, ClientError> {
        let key = format!("clearway/{vehicle}/map/{layer}");
        let tap = Tap::open(&self.session, &key).await.map_err(failed(format!("subscribe to {key}")))?;
        // The session closes with its last clone, and takes the tap along: the stream keeps one.
        let Self { session, endpoint: address } = self.clone();
        Ok(MapStream::spawn(move |feed| async move {
            let _session = session;
            tap.run(feed).await.err().unwrap_or(ClientError::Ended { address })
        }))
    }
}

impl ZenohClient {
    /// A way to send a vehicle's observations; sensors must be named.
    ///
    /// # Errors
    /// What zenoh says; [`ClientError::Refused`] for a vehicle nobody serves, listing those that are served.
    pub async fn ingest(&self, vehicle: &str) -> Result<Ingester, ClientError> {
        let served = self.vehicles().await?;
        if !served.iter().any(|name| name == vehicle) {
            let reason = format!("vehicle {vehicle:?} is not known; known: {}", served.join(", "));
            return Err(ClientError::Refused { address: self.endpoint.clone(), reason, code: "NotFound".into() });
        }
        // Nobody else's: each `RandomState` is keyed by the system's randomness.
        let client = std::hash::RandomState::new().build_hasher().finish();
        let (heard, prefix) = (Ear::new(), format!("clearway/{vehicle}/ingest"));
        let key = format!("{prefix}/report");
        let reports = self.session.declare_subscriber(key.clone()).callback({
            let heard = heard.clone();
            move |sample| {
                // What is no report, or another's, is not for us.
                match v1::IngestReport::decode(&*sample.payload().to_bytes()) {
                    Ok(report) if report.client == client => heard.report(report),
                    _ => {}
                }
            }
        });
        let reports = Arc::new(reports.await.map_err(failed(format!("subscribe to {key}")))?);
        let session = self.session.clone();
        let deliver: Deliver = Box::new(move |observation| {
            let (session, reports) = (session.clone(), reports.clone());
            let key = key_of(&prefix, &observation);
            let bytes = v1::Observation { client, ..observation }.encode_to_vec();
            Box::pin(async move {
                // Held until the last observation is on its way.
                let _reports = reports;
                // Blocks, for no observation may be lost; who waits is the sender alone. All of one priority, zenoh's
                // ordinary one: it keeps the order only within one, and the server counts holes in the numbers.
                let put = session.put(&key, bytes).congestion_control(CongestionControl::Block);
                put.await.map_err(failed(format!("put {key}")))
            })
        });
        Ok(Ingester::new(self.endpoint.clone(), deliver, heard))
    }
}

/// Where an observation is put.
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

async fn query(session: &Session, key: &str) -> Result<Option<ZBytes>, ClientError> {
    let replies = session.get(key).timeout(ANSWER_TIMEOUT).await.map_err(failed(format!("get {key}")))?;
    while let Ok(reply) = replies.recv_async().await {
        if let Ok(sample) = reply.result() {
            return Ok(Some(sample.payload().clone()));
        }
    }
    Ok(None)
}

fn decode(payload: &ZBytes) -> Result<MapView, ClientError> {
    MapView::decode(payload.to_bytes().into_owned().into())
}
