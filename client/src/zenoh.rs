//! Maps over zenoh: keys `clearway/<vehicle>/map/<layer>`, liveliness tokens `clearway/<vehicle>`.
//!
//! In: a router's or server's endpoint. Out: the same [`MapView`], [`MapStream`] and [`Ingester`] as over gRPC. Needs tokio's
//! multi-thread runtime: zenoh panics in a current-thread one.

use std::hash::{BuildHasher, Hasher};
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use clearway_proto::v1;
use prost::Message;
use zenoh::handlers::RingChannel;
use zenoh::qos::CongestionControl;
use zenoh::sample::SampleKind;
use zenoh::{Config, Session};

use crate::ClientError;
use crate::freshness::Clock;
use crate::ingest::{Deliver, Ear, Ingester};
use crate::stream::{Feed, MapStream};
use crate::view::MapView;

const ANSWER_TIMEOUT: Duration = Duration::from_secs(5);

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
        let mut config = Config::default();
        let settings = [
            ("mode", "\"client\"".to_owned()),
            ("connect/endpoints", format!("[{endpoint:?}]")),
            ("connect/timeout_ms", ANSWER_TIMEOUT.as_millis().to_string()),
            ("scouting/multicast/enabled", "false".to_owned()),
            ("scouting/gossip/enabled", "false".to_owned()),
        ];
        for (key, value) in settings {
            config.insert_json5(key, &value).map_err(failed(format!("endpoint {endpoint:?}")))?;
        }
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
        let map = query(&self.session, &key).await?.map(MapView::decode).transpose()?;
        Ok(map.map(|map| map.arrived(&Clock::default())))
    }

    /// Streams one layer of one vehicle, beginning with the newest map there is.
    ///
    /// # Errors
    /// What zenoh says.
    pub async fn subscribe(&self, vehicle: &str, layer: &str) -> Result<MapStream, ClientError> {
        let key = format!("clearway/{vehicle}/map/{layer}");
        // Of one: the default queue of 256 would hand a slow planner maps that are seconds old.
        let subscriber = self.session.declare_subscriber(key.clone()).with(RingChannel::new(1));
        let subscriber = subscriber.await.map_err(failed(format!("subscribe to {key}")))?;
        let first = query(&self.session, &key).await?;
        // The session closes with its last clone, and takes the subscriber along: the stream keeps one.
        let Self { session, endpoint: address } = self.clone();
        Ok(MapStream::spawn(move |feed| async move {
            let _session = session;
            let mut last = None;
            if let Some(bytes) = first
                && let Err(error) = offer(&feed, &mut last, bytes)
            {
                return error;
            }
            loop {
                let Ok(sample) = subscriber.recv_async().await else { return ClientError::Ended { address } };
                if sample.kind() == SampleKind::Put
                    && let Err(error) = offer(&feed, &mut last, sample.payload().to_bytes().into_owned().into())
                {
                    return error;
                }
            }
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

/// Puts a map that is newer than the last; the holes in the sequence are the skipped ones. Another boot id is another
/// run of the server, whose sequence begins anew.
fn offer(feed: &Feed, last: &mut Option<(u64, u64)>, bytes: Bytes) -> Result<(), ClientError> {
    let map = MapView::decode(bytes)?;
    let (boot_id, sequence) = (map.header().boot_id, map.sequence());
    let skipped = match *last {
        Some((boot, seen)) if boot == boot_id && sequence <= seen => return Ok(()),
        Some((boot, seen)) if boot == boot_id => sequence - seen - 1,
        _ => 0,
    };
    *last = Some((boot_id, sequence));
    feed.put(map, skipped, 0);
    Ok(())
}

async fn query(session: &Session, key: &str) -> Result<Option<Bytes>, ClientError> {
    let replies = session.get(key).timeout(ANSWER_TIMEOUT).await.map_err(failed(format!("get {key}")))?;
    while let Ok(reply) = replies.recv_async().await {
        if let Ok(sample) = reply.result() {
            return Ok(Some(sample.payload().to_bytes().into_owned().into()));
        }
    }
    Ok(None)
}
