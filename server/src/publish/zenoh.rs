//! Maps over zenoh, one layer a key: `clearway/<vehicle>/map/<layer>`.
//!
//! A layer is made while somebody subscribes to its key, and for who asks for it: late joiners get the current map from the
//! publisher's cache (an old one where nobody took it; its age tells), the same key answers queries. Misses can be detected. A liveliness token `clearway/<vehicle>` lives as long as the vehicle is served; `clearway/<vehicle>/status`
//! has the status once a second, JSON.
//!
//! Congestion drops: blocking would let one stopped peer hold up the healthy ones. Maps go before all else on a link, for a
//! planner brakes by them; the status, which the next one replaces anyway, goes after all else; observations and reports
//! have zenoh's ordinary priority in between.

use std::time::Duration;

use tokio::task::JoinSet;
use zenoh::bytes::Encoding;
use zenoh::handlers::FifoChannelHandler;
use zenoh::liveliness::LivelinessToken;
use zenoh::matching::{MatchingListener, MatchingStatus};
use zenoh::qos::{CongestionControl, Priority};
use zenoh::{Config, Session};
use zenoh_ext::{AdvancedPublisher, AdvancedPublisherBuilderExt, CacheConfig, MissDetectionConfig, RepliesConfig};

use super::ros::Node;
use super::{Served, Vehicles};
use crate::config::Zenoh as Options;
use crate::ingest::gateway::Entrances;
use crate::ingest::zenoh::Ingest;

const STATUS_PERIOD: Duration = Duration::from_secs(1);
/// How often a publisher tells its last number, so that a lost last map is noticed. By the clock and not only after a map:
/// then a lost heartbeat is made good by the next one, and it may be dropped (zenoh's sporadic one blocks).
const HEARTBEAT: Duration = Duration::from_secs(1);
/// Above zenoh's ordinary one (`Data`); `RealTime` is left to what a vehicle has that is more urgent than a map.
const MAPS: Priority = Priority::InteractiveHigh;
const STATUS: Priority = Priority::DataLow;

/// What one peer may cost. A file named in `[zenoh]` has its own; those in `deploy/zenoh` have these.
const LIMITS: [(&str, &str); 12] = [
    // A thousand readers, and the vehicles.
    ("transport/unicast/max_sessions", "1024"),
    // Handshakes at a time; who opens a connection and says nothing loses it after 5 s.
    ("transport/unicast/accept_pending", "100"),
    ("transport/unicast/accept_timeout", "5000"),
    ("transport/unicast/open_timeout", "5000"),
    // A router that was restarted has the maps again within a second.
    ("connect/retry", "{ period_init_ms: 100, period_max_ms: 1000, period_increase_factor: 2 }"),
    // Who is gone without a word (a pulled cable) is noticed after 2 s, told by four signs of life.
    ("transport/link/tx/lease", "2000"),
    ("transport/link/tx/keep_alive", "4"),
    // Batches of 64 KiB in the queue of the maps, allocated when needed: all layers of several maps, so that a hiccup of the
    // machine drops nothing; and all that waits here for a peer that has stopped,
    ("transport/link/tx/queue/size", "{ interactive_high: 8 }"),
    // beside what the kernel holds for it.
    ("transport/link/tcp", "{ so_sndbuf: 262144 }"),
    ("transport/link/tls/so_sndbuf", "262144"),
    // In us. A congested peer is waited for once; until it takes something again, its maps are dropped at once.
    ("transport/link/tx/queue/congestion_control/drop", "{ wait_before_drop: 1000 }"),
    // In us. What may not be dropped (declarations, answers to who asks so) waits so long; then the peer is hung up on.
    ("transport/link/tx/queue/congestion_control/block", "{ wait_before_close: 1000000 }"),
];
/// The longest message of a peer, beside which the longest observation is looked at: what is longer still is dropped
/// before it is put together, and what is shorter than this is refused by name.
const MESSAGE_BYTES_MAX: usize = 64 << 20;

/// The open session and what it publishes.
pub struct Publisher {
    session: Session,
    tokens: Vec<LivelinessToken>,
    tasks: JoinSet<()>,
}

/// Why zenoh is not published.
#[derive(Debug, thiserror::Error)]
#[error("zenoh: {what}: {reason}")]
pub struct ZenohError {
    /// What was tried.
    what: String,
    /// What zenoh says.
    reason: zenoh::Error,
}

pub(crate) fn failed(what: impl Into<String>) -> impl FnOnce(zenoh::Error) -> ZenohError {
    let what = what.into();
    |reason| ZenohError { what, reason }
}

impl Publisher {
    /// Opens the session, declares every vehicle's keys and starts publishing, and taking what vehicles send. Needs a multi-thread runtime.
    ///
    /// # Errors
    /// [`ZenohError`] with what zenoh says.
    pub async fn start(options: &Options, vehicles: &Vehicles, entrances: &Entrances) -> Result<Self, ZenohError> {
        let config = session_config(options, MESSAGE_BYTES_MAX.max(2 * entrances.message_bytes_max()))?;
        let endpoints = options.listen.join(", ");
        let session = zenoh::open(config).await.map_err(failed(format!("open (listen {endpoints})")))?;
        let mut publisher = Self { session, tokens: Vec::new(), tasks: JoinSet::new() };
        for served in vehicles.0.iter() {
            publisher.publish(served).await?;
        }
        if options.ros2.enabled {
            let mut node = Node::declare(&publisher.session, &options.ros2).await?;
            for served in vehicles.0.iter() {
                node.publish(served, &mut publisher.tasks).await?;
            }
            publisher.tokens.append(&mut node.into_tokens());
        }
        for entrance in entrances.all() {
            let ingest = Ingest::subscribe(&publisher.session, entrance.clone()).await?;
            publisher.tasks.spawn(ingest.run());
        }
        Ok(publisher)
    }

    /// The session, for the doors that listen on it.
    pub fn session(&self) -> &Session {
        &self.session
    }

    /// Where the session listens, ports found.
    pub async fn endpoints(&self) -> Vec<String> {
        self.session.info().locators().await.iter().map(ToString::to_string).collect()
    }

    /// Ends publishing; the tokens vanish at once.
    pub async fn stop(mut self) {
        self.tasks.shutdown().await;
        for token in self.tokens {
            if let Err(error) = token.undeclare().await {
                tracing::warn!(%error, "zenoh: liveliness token");
            }
        }
        if let Err(error) = self.session.close().await {
            tracing::warn!(%error, "zenoh: close");
        }
    }

    async fn publish(&mut self, served: &Served) -> Result<(), ZenohError> {
        let vehicle = &served.status.name;
        let mut publishers = Vec::new();
        // By default they block, and one late joiner that stops at once would hold up the next ones.
        let replies = RepliesConfig::default().congestion_control(CongestionControl::Drop).priority(MAPS);
        let cache = CacheConfig::default().max_samples(1).replies_config(replies);
        for layer in &served.status.layers {
            let key = format!("clearway/{vehicle}/map/{layer}");
            let publisher = self
                .session
                .declare_publisher(key.clone())
                .encoding(map_encoding())
                .congestion_control(CongestionControl::Drop)
                .priority(MAPS)
                // Its own sequence numbers: the cache needs them or time stamps, and with them misses are seen.
                .sample_miss_detection(MissDetectionConfig::default().heartbeat(HEARTBEAT))
                .cache(cache.clone())
                .publisher_detection()
                .await
                .map_err(failed(format!("publisher {key}")))?;
            let matching = publisher.matching_listener().await.map_err(failed(format!("subscribers of {key}")))?;
            let matches = publisher.matching_status().await.map_err(failed(format!("subscribers of {key}")))?;
            self.tasks.spawn(take_while(served.clone(), layer, matches.matching(), matching));
            publishers.push((*layer, publisher));
            self.answer(served, layer, key).await?;
        }
        let key = format!("clearway/{vehicle}/status");
        let status = self.session.declare_publisher(key.clone()).encoding(Encoding::APPLICATION_JSON);
        let status = status.priority(STATUS);
        let status =
            status.congestion_control(CongestionControl::Drop).await.map_err(failed(format!("publisher {key}")))?;
        let token = self.session.liveliness().declare_token(format!("clearway/{vehicle}"));
        self.tokens.push(token.await.map_err(failed(format!("liveliness clearway/{vehicle}")))?);
        self.tasks.spawn(send_maps(served.clone(), publishers));
        self.tasks.spawn({
            let served = served.clone();
            async move {
                let mut every = tokio::time::interval(STATUS_PERIOD);
                loop {
                    every.tick().await;
                    if let Err(error) = status.put(served.status.to_json().to_string()).await {
                        tracing::warn!(%error, "zenoh: status");
                    }
                }
            }
        });
        Ok(())
    }

    /// Answers queries on a layer's key with its newest map.
    async fn answer(&mut self, served: &Served, layer: &'static str, key: String) -> Result<(), ZenohError> {
        let queryable = self.session.declare_queryable(key.clone()).complete(true);
        let queries = queryable.await.map_err(failed(format!("queryable {key}")))?;
        let (newest, demand) = (served.newest.clone(), served.status.demand.clone());
        self.tasks.spawn(async move {
            while let Ok(query) = queries.recv_async().await {
                let Some(map) = demand.take(&[layer.to_owned()]).newest(&newest).await else { continue };
                let Some((_, chunk)) = map.layers.iter().find(|(name, _)| *name == layer) else { continue };
                if let Err(error) = query.reply(&key, map.layer(chunk)).encoding(map_encoding()).await {
                    tracing::debug!(%error, "zenoh: reply");
                }
            }
        });
        Ok(())
    }
}

/// Takes a layer while the listener says that somebody subscribes to it.
async fn take_while(
    served: Served,
    layer: &'static str,
    mut matches: bool,
    matching: MatchingListener<FifoChannelHandler<MatchingStatus>>,
) {
    loop {
        let _taken = matches.then(|| served.status.demand.take(&[layer.to_owned()]));
        match matching.recv_async().await {
            Ok(status) => matches = status.matching(),
            Err(_) => return,
        }
    }
}

async fn send_maps(served: Served, publishers: Vec<(&'static str, AdvancedPublisher<'static>)>) {
    let mut newest = served.newest.clone();
    newest.mark_changed();
    while newest.changed().await.is_ok() {
        let map = newest.borrow_and_update().clone();
        let Some(map) = map else { continue };
        for (layer, chunk) in &map.layers {
            let Some((_, publisher)) = publishers.iter().find(|(name, _)| name == layer) else { continue };
            if let Err(error) = publisher.put(map.layer(chunk)).await {
                tracing::warn!(%error, layer, "zenoh: put");
            }
        }
    }
    // The engine has stopped, but the current map stays in the caches until the session ends.
    std::future::pending::<()>().await;
}

fn map_encoding() -> Encoding {
    Encoding::APPLICATION_PROTOBUF.with_schema("clearway.v1.Map")
}

fn session_config(options: &Options, message_bytes_max: usize) -> Result<Config, ZenohError> {
    let mut config = match options.file.as_os_str().is_empty() {
        true => limited()?,
        false => Config::from_file(&options.file).map_err(failed(format!("zenoh.file {}", options.file.display())))?,
    };
    let json = |value: serde_json::Value| value.to_string();
    let settings = [
        ("mode", json(options.mode.as_str().into())),
        ("listen/endpoints", json(options.listen.clone().into())),
        ("connect/endpoints", json(options.connect.clone().into())),
        ("scouting/multicast/enabled", json(options.scouting.into())),
        ("scouting/gossip/enabled", json(options.scouting.into())),
        ("timestamping/enabled", json(true.into())),
        ("transport/link/rx/max_message_size", json(message_bytes_max.into())),
    ];
    for (key, value) in settings {
        config.insert_json5(key, &value).map_err(failed(format!("{key} = {value}")))?;
    }
    Ok(config)
}

/// zenoh's defaults, but for [`LIMITS`].
fn limited() -> Result<Config, ZenohError> {
    let mut config = Config::default();
    for (key, value) in LIMITS {
        config.insert_json5(key, value).map_err(failed(format!("{key} = {value}")))?;
    }
    Ok(config)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_files_of_deploy_have_the_limits_of_a_server_without_a_file() {
        let limited = limited().unwrap();
        for name in ["server.json5", "router.json5"] {
            let file = format!("{}/../deploy/zenoh/{name}", env!("CARGO_MANIFEST_DIR"));
            let config = Config::from_file(&file).unwrap();
            for (key, _) in LIMITS {
                assert_eq!(config.get_json(key).unwrap(), limited.get_json(key).unwrap(), "{name}: {key}");
            }
        }
    }
}
