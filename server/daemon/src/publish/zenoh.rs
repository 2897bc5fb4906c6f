//! Maps over zenoh, one key for each layer: `clearway/<vehicle>/map/<layer>`.
//!
//! A layer is made while its key has a subscriber, and for each query on it. Late joiners get the current map from the
//! publisher's cache; it is old if the layer had no subscriber, and its age says so. The same key answers queries.
//! Subscribers can detect misses. A liveliness token `clearway/<vehicle>` lives as long as the vehicle is served;
//! `clearway/<vehicle>/status` has the status once a second and at each change of its state, as JSON; what another
//! server says there of a vehicle of the same name is in this server's status. `clearway/<vehicle>/replay` has
//! `{"ended":true,"boot_id":B,"sequence":N}` after the last map of a replay, which has these numbers, and
//! `{"ended":false}` when it is set back; with `"error"` the replay has ended because a map was not acknowledged. The
//! key answers queries too.
//!
//! With `zenoh.signing_key` each map has a signature ([`clearway_client::signature`]) as the sample's attachment.
//!
//! A server that is the client of a router has one map of a vehicle on the way at a time ([`Pace`]), so that a thin
//! link has fewer maps and not older maps; the maps between count as skipped.
//!
//! Congestion drops: blocking would let one stopped peer delay the healthy peers. Maps have the highest priority on a
//! link, because planners brake by them; the status has the lowest, because the next status replaces it; observations
//! and reports have zenoh's default priority.

use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, Instant};

use clearway_client::signature::SigningKey;
use futures::future::{Fuse, FusedFuture, FutureExt};
use tokio::task::JoinSet;
use zenoh::Session;
use zenoh::bytes::{Encoding, ZBytes};
use zenoh::handlers::FifoChannelHandler;
use zenoh::liveliness::LivelinessToken;
use zenoh::matching::{MatchingListener, MatchingStatus};
use zenoh::qos::{CongestionControl, Priority};
use zenoh::sample::Locality;
use zenoh_ext::{AdvancedPublisher, AdvancedPublisherBuilderExt, CacheConfig, MissDetectionConfig, RepliesConfig};

use super::ros::Node;
use super::served::{Served, Vehicles};
use crate::config::{Zenoh as Options, ZenohMode, secret};
use crate::status::{Reader, Transport, state_changed};
use crate::zenoh_session::{ZenohError, declare_publisher};
use clearway_journal::encode::EncodedMap;

/// Time between two status messages.
const STATUS_PERIOD: Duration = Duration::from_secs(1);
/// Interval at which a publisher repeats its last sequence, so that subscribers notice a lost last map. By the clock
/// and not only after a map: then the next heartbeat replaces a lost one, and a heartbeat may be dropped (zenoh's
/// sporadic heartbeat blocks).
const HEARTBEAT: Duration = Duration::from_secs(1);
/// Priority of maps: above zenoh's default (`Data`); `RealTime` is left for more urgent data of a vehicle.
const MAPS: Priority = Priority::InteractiveHigh;
/// Longest wait for the answer that a map has passed the link. Ours: longer than a link takes for a map that a planner
/// can use. A full queue drops a query as it drops maps, and a router that denies it gets a map a second.
const PASSED_MAX: Duration = Duration::from_secs(1);
/// Priority of the status.
const STATUS: Priority = Priority::DataLow;

/// The open session and what it publishes.
pub struct Publisher {
    session: Session,
    tokens: Vec<LivelinessToken>,
    tasks: JoinSet<()>,
    signing_key: Option<Arc<SigningKey>>,
    /// True if all maps travel over one link, to a router. A server with several links does not wait for them, because
    /// a peer that stops must not delay the others.
    awaits_router: bool,
    /// Shortest time between two maps of a vehicle.
    period: Duration,
    /// Each vehicle with the publisher of its replay's end.
    replays: Vec<(Served, Arc<zenoh::pubsub::Publisher<'static>>)>,
}

impl Publisher {
    /// Declares every vehicle's keys on the session and starts publishing. Needs a multi-thread runtime.
    ///
    /// # Errors
    /// [`ZenohError`] if the signing key cannot be read, or if a publisher, queryable, listener or liveliness token
    /// cannot be declared.
    pub async fn start(session: &Session, options: &Options, vehicles: &Vehicles) -> Result<Self, ZenohError> {
        let signing_key = signing_key(&options.signing_key)?.map(Arc::new);
        let (tokens, tasks, replays) = (Vec::new(), JoinSet::new(), Vec::new());
        let awaits_router = options.mode == ZenohMode::Client;
        let (session, period) = (session.clone(), options.period());
        let mut publisher = Self { session, tokens, tasks, signing_key, awaits_router, period, replays };
        for served in vehicles.0.iter() {
            publisher.publish(served).await?;
        }
        if options.ros2.enabled {
            let mut node = Node::declare(&publisher.session, &options.ros2).await?;
            for served in vehicles.0.iter() {
                node.publish(served, &mut publisher.tasks).await?;
            }
            node.publish_states(vehicles, &mut publisher.tasks).await?;
            publisher.tokens.append(&mut node.into_tokens());
        }
        Ok(publisher)
    }

    /// Stops publishing; the tokens disappear at once.
    pub async fn stop(mut self) {
        self.tasks.shutdown().await;
        for (served, replay) in &self.replays {
            if served.wires.acknowledgements.why_timed_out().is_some() {
                put_replay(served, replay).await;
            }
        }
        for token in self.tokens {
            if let Err(error) = token.undeclare().await {
                tracing::warn!(%error, "zenoh: liveliness token");
            }
        }
    }

    async fn publish(&mut self, served: &Served) -> Result<(), ZenohError> {
        let vehicle = &served.status.name;
        let mut publishers = Vec::new();
        // By default replies block, and one late joiner that stops at once would delay the next late joiners.
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
                // Sequence numbers of the publisher: the cache needs them or time stamps, and subscribers detect misses
                // by them.
                .sample_miss_detection(MissDetectionConfig::default().heartbeat(HEARTBEAT))
                .cache(cache.clone())
                .publisher_detection()
                .await
                .map_err(ZenohError::of(format!("publisher {key}")))?;
            let matching =
                publisher.matching_listener().await.map_err(ZenohError::of(format!("subscribers of {key}")))?;
            let matches = publisher.matching_status().await.map_err(ZenohError::of(format!("subscribers of {key}")))?;
            let publisher = Arc::new(publisher);
            self.tasks.spawn(subscribe_while(served.clone(), layer, publisher.clone(), matches.matching(), matching));
            publishers.push((*layer, key.clone(), publisher));
            self.answer(served, layer, key).await?;
        }
        let key = format!("clearway/{vehicle}/status");
        let status = declare_publisher(&self.session, key, Encoding::APPLICATION_JSON, STATUS).await?;
        let token = self.session.liveliness().declare_token(format!("clearway/{vehicle}"));
        self.tokens.push(token.await.map_err(ZenohError::of(format!("liveliness clearway/{vehicle}")))?);
        let key = format!("clearway/{vehicle}/replay");
        let replay = declare_publisher(&self.session, key.clone(), Encoding::APPLICATION_JSON, MAPS).await?;
        let replay = Arc::new(replay);
        self.replays.push((served.clone(), replay.clone()));
        self.answer_replay(served, key).await?;
        let link = self.awaits_router.then(|| (self.session.clone(), format!("clearway/{vehicle}/link")));
        let pace = Pace { link, period: self.period };
        self.tasks.spawn(send_maps(served.clone(), publishers, self.signing_key.clone(), replay, pace));
        self.tasks.spawn({
            let served = served.clone();
            async move {
                let mut every = tokio::time::interval(STATUS_PERIOD);
                let mut states = [served.status.states()];
                loop {
                    tokio::select! {
                        _ = every.tick() => {}
                        () = state_changed(&mut states) => {}
                    }
                    if let Err(error) = status.put(served.status.to_json().to_string()).await {
                        tracing::warn!(vehicle = %served.status.name, %error, "zenoh: status");
                    }
                }
            }
        });
        Ok(())
    }

    /// Answers queries whether the replay has ended.
    async fn answer_replay(&mut self, served: &Served, key: String) -> Result<(), ZenohError> {
        let queryable = self.session.declare_queryable(key.clone()).complete(true);
        let queries = queryable.await.map_err(ZenohError::of(format!("queryable {key}")))?;
        let served = served.clone();
        self.tasks.spawn(async move {
            while let Ok(query) = queries.recv_async().await {
                let reply = query.reply(&key, replay_document(&served)).encoding(Encoding::APPLICATION_JSON);
                if let Err(error) = reply.await {
                    tracing::debug!(%error, "zenoh: reply");
                }
            }
        });
        Ok(())
    }

    /// Answers queries on a layer's key with its newest map.
    async fn answer(&mut self, served: &Served, layer: &'static str, key: String) -> Result<(), ZenohError> {
        let queryable = self.session.declare_queryable(key.clone()).complete(true);
        let queries = queryable.await.map_err(ZenohError::of(format!("queryable {key}")))?;
        let (newest, subscriptions) = (served.newest.clone(), served.wires.subscriptions.clone());
        let signing_key = self.signing_key.clone();
        self.tasks.spawn(async move {
            while let Ok(query) = queries.recv_async().await {
                let Some(map) = subscriptions.subscribe(&[layer.to_owned()]).newest_map(&newest).await else {
                    continue;
                };
                let Some((_, chunk)) = map.layers.iter().find(|(name, _)| *name == layer) else { continue };
                let bytes = map.layer(chunk);
                let signature = signature(signing_key.as_deref(), &key, &bytes);
                if let Err(error) = query.reply(&key, bytes).encoding(map_encoding()).attachment(signature).await {
                    tracing::debug!(%error, "zenoh: reply");
                }
            }
        });
        Ok(())
    }
}

/// Keeps a layer active while its key has a subscriber. The publisher is held, because zenoh logs an error if it ends
/// before its listener.
async fn subscribe_while(
    served: Served,
    layer: &'static str,
    _publisher: Arc<AdvancedPublisher<'static>>,
    mut matches: bool,
    matching: MatchingListener<FifoChannelHandler<MatchingStatus>>,
) {
    loop {
        let _taken = matches.then(|| {
            (
                served.wires.subscriptions.subscribe(&[layer.to_owned()]),
                Reader::new(&served.status.transports, Transport::Zenoh),
            )
        });
        match matching.recv_async().await {
            Ok(status) => matches = status.matching(),
            Err(_) => return,
        }
    }
}

/// Reads the key that signs maps; `None` if the path is empty.
///
/// # Errors
/// [`ZenohError`] if it cannot be read or is no key.
pub fn signing_key(file: &Path) -> Result<Option<SigningKey>, ZenohError> {
    if file.as_os_str().is_empty() {
        return Ok(None);
    }
    let wrong = |error: zenoh::Error| ZenohError::of(format!("zenoh.signing_key {}", file.display()))(error);
    let text = secret(file).map_err(|error| wrong(error.into()))?;
    SigningKey::from_pem(&text).map(Some).map_err(|error| wrong(error.into()))
}

/// The attachment of a map on a key: its signature.
fn signature(key: Option<&SigningKey>, on: &str, map: &[u8]) -> Option<ZBytes> {
    key.map(|key| key.sign(on, map).as_slice().into())
}

/// Sends each newest map, and after the last map of a replay that it has ended.
async fn send_maps(
    served: Served,
    publishers: Vec<(&'static str, String, Arc<AdvancedPublisher<'static>>)>,
    signing_key: Option<Arc<SigningKey>>,
    replay: Arc<zenoh::pubsub::Publisher<'static>>,
    pace: Pace,
) {
    let mut on_the_way = std::pin::pin!(Fuse::terminated());
    let (mut newest, mut replay_ended) = (served.newest.clone(), served.wires.replay_ended.subscribe());
    newest.mark_changed();
    let (mut reported, mut last, mut was_answered) = (false, None, true);
    loop {
        tokio::select! {
            biased;
            changed = newest.changed(), if on_the_way.is_terminated() => {
                if changed.is_err() {
                    break;
                }
                let map = newest.borrow_and_update().clone();
                if let Some(map) = map {
                    let before = last.replace((map.boot_id, map.sequence));
                    let before = before.filter(|(boot_id, _)| *boot_id == map.boot_id);
                    let skipped = before.map_or(0, |(_, last)| map.sequence.saturating_sub(last + 1));
                    served.status.transports.skip_for_all(Transport::Zenoh, skipped);
                    let _hop = served.status.traces.hop(&map, "send", Some(Transport::Zenoh.as_str()));
                    let began = Instant::now();
                    send_map(&map, &publishers, signing_key.as_deref()).await;
                    // Without a subscriber nothing travels.
                    if served.status.transports.count(Transport::Zenoh) > 0 {
                        on_the_way.set(pace.passed(began).fuse());
                    }
                }
            }
            is_answered = &mut on_the_way, if !on_the_way.is_terminated() => {
                if was_answered && !is_answered {
                    let key = format!("clearway/{}/link", served.status.name);
                    let reason = "the link is cut, or the router denies this query";
                    tracing::warn!(key, reason, "zenoh: a map a second is sent");
                }
                was_answered = is_answered;
            }
            Ok(()) = replay_ended.changed() => {}
        }
        let ended = *replay_ended.borrow();
        if ended != reported && !newest.has_changed().unwrap_or(false) {
            reported = ended;
            put_replay(&served, &replay).await;
        }
    }
    // The engine has stopped, but the current map stays in the caches until the session ends.
    std::future::pending::<()>().await;
}

/// When the next map of a vehicle may be sent.
struct Pace {
    /// The session with the router, and a key without a queryable there; `None`: maps do not wait for the link.
    link: Option<(Session, String)>,
    /// Shortest time between two maps.
    period: Duration,
}

impl Pace {
    /// Waits until the map that was sent from `began` on has passed the link, and the next is due. Returns false if the
    /// router has not answered in time.
    async fn passed(&self, began: Instant) -> bool {
        let answered = async {
            let Some((session, key)) = &self.link else { return true };
            // The router ends this query at once. It travels behind the map; express, because in one batch with the map
            // it would arrive together with it.
            let query = session.get(key).allowed_destination(Locality::Remote).timeout(PASSED_MAX).express(true);
            let answers = query.priority(MAPS).congestion_control(CongestionControl::Drop).await;
            // A reply says that the time is over.
            match answers {
                Ok(answers) => answers.recv_async().await.is_err(),
                Err(_) => false,
            }
        };
        tokio::join!(answered, tokio::time::sleep_until((began + self.period).into())).0
    }
}

/// Whether the replay has ended, for its key.
fn replay_document(served: &Served) -> String {
    let newest = served.newest.borrow().clone();
    let why = served.wires.acknowledgements.why_timed_out();
    let mut document = serde_json::json!({ "ended": *served.wires.replay_ended.borrow() || why.is_some() });
    if let Some(map) = newest.filter(|_| document["ended"] == true) {
        document["boot_id"] = map.boot_id.into();
        document["sequence"] = map.sequence.into();
    }
    if let Some(why) = why {
        document["error"] = why.into();
    }
    document.to_string()
}

async fn put_replay(served: &Served, replay: &zenoh::pubsub::Publisher<'static>) {
    if let Err(error) = replay.put(replay_document(served)).await {
        tracing::warn!(vehicle = %served.status.name, %error, "zenoh: replay");
    }
}

async fn send_map(
    map: &EncodedMap,
    publishers: &[(&'static str, String, Arc<AdvancedPublisher<'static>>)],
    signing_key: Option<&SigningKey>,
) {
    for (layer, chunk) in &map.layers {
        let Some((_, key, publisher)) = publishers.iter().find(|(name, ..)| name == layer) else { continue };
        let bytes = map.layer(chunk);
        let signature = signature(signing_key, key, &bytes);
        if let Err(error) = publisher.put(bytes).attachment(signature).await {
            tracing::warn!(vehicle = %map.vehicle, layer, %error, "zenoh: put");
        }
    }
}

fn map_encoding() -> Encoding {
    Encoding::APPLICATION_PROTOBUF.with_schema("clearway.v1.Map")
}
