//! Maps as ROS 2 topics in rmw_zenoh's key space, without a bridge.
//!
//! For each vehicle: `<namespace>/<vehicle>/<layer>` (`nav_msgs/msg/OccupancyGrid`), of the layer `safe_path` also
//! `.../safe_path/markers` (`visualization_msgs/msg/MarkerArray`) and `.../safe_path/poses`
//! (`geometry_msgs/msg/PoseArray`), and `<namespace>/<vehicle>/replay_ended` (`std_msgs/msg/Bool`: true from the end of
//! a replay until it is set back), all reliable, transient local, depth 1; and its pose in `map` on `/tf` (reliable,
//! volatile). A topic is published under `<domain>/<topic>/<type>/<hash>`,
//! the payload CDR, with an attachment: sequence, time of sending, length 16, the publisher's 16 bytes. Liveliness
//! tokens under `@ros2_lv` announce the node and its publishers. A message is made only while there is a subscriber;
//! the first subscriber gets the newest map at once, later ones get it from the publisher's cache.

use std::hash::{DefaultHasher, Hash, Hasher};
use std::time::Duration;

use crate::encode::viewer::raster::Rasters;
use crate::encode::viewer::{ros, safe_paths, view};
use clearway_client::Layer;
use clearway_client::MapView;
use clearway_ros::cdr::Writer;
use clearway_ros::published::{BOOL, MARKER_ARRAY, OCCUPANCY_GRID, POSE_ARRAY, Published, TF_MESSAGE};
use tokio::task::JoinSet;
use zenoh::Session;
use zenoh::liveliness::LivelinessToken;
use zenoh::qos::CongestionControl;
use zenoh::sample::Locality;
use zenoh_ext::{AdvancedPublisher, AdvancedPublisherBuilderExt, CacheConfig, MissDetectionConfig};

use super::served::Served;
use crate::base::clock::now_ns;
use crate::config::Ros2;
use crate::status::{Reader, Transport};
use crate::zenoh_session::ZenohError;
use clearway_journal::encode::EncodedMap;

/// Name of the node.
const NODE: &str = "clearway";
/// QoS of the grids: reliability 1 reliable; durability 1 transient local; history 1 keep last, depth 1; deadline,
/// lifespan and liveliness by default.
const LATCHED: &str = "1:1:1,1:,:,:,,";
/// QoS of `/tf`: the same, but durability 2 volatile, depth 100, as tf2's broadcaster has it.
const MOVING: &str = "1:2:1,100:,:,:,,";
/// Interval at which a quiet publisher repeats its last sequence, so that subscribers notice a lost last map.
const HEARTBEAT: Duration = Duration::from_secs(1);

/// The node of the topics of all vehicles.
pub(super) struct Node<'a> {
    session: &'a Session,
    options: &'a Ros2,
    /// Tokens of the node and of its publishers so far.
    tokens: Vec<LivelinessToken>,
}

impl<'a> Node<'a> {
    /// Declares the node.
    pub async fn declare(session: &'a Session, options: &'a Ros2) -> Result<Self, ZenohError> {
        let mut node = Self { session, options, tokens: Vec::new() };
        node.declare_token(&format!("0/NN/%/%/{NODE}")).await?;
        Ok(node)
    }

    /// Publishes the layers and the pose of a vehicle.
    pub async fn publish(&mut self, served: &Served, tasks: &mut JoinSet<()>) -> Result<(), ZenohError> {
        let vehicle = &served.status.name;
        for &layer in &served.status.layers {
            let topic = format!("{}/{vehicle}/{layer}", self.options.namespace);
            let mut rasters = Rasters::default();
            let grid = move |map: &MapView, layer: &Layer| ros::occupancy_grid(map, layer, rasters.of(layer));
            self.publish_layer(served, layer, (&topic, &OCCUPANCY_GRID), grid, tasks).await?;
            if layer == safe_paths::LAYER {
                let (markers, poses) = (format!("{topic}/markers"), format!("{topic}/poses"));
                self.publish_layer(served, layer, (&markers, &MARKER_ARRAY), ros::safe_path_markers, tasks).await?;
                self.publish_layer(served, layer, (&poses, &POSE_ARRAY), ros::safe_point_poses, tasks).await?;
            }
        }
        let tf = self.topic("/tf", &TF_MESSAGE, MOVING).await?;
        let transform = |map: &EncodedMap| {
            let map = view(map, map.header.clone())?;
            ros::tf(&map)
        };
        tasks.spawn(tf.publish(served.clone(), None, transform));
        let topic = format!("{}/{vehicle}/replay_ended", self.options.namespace);
        tasks.spawn(self.topic(&topic, &BOOL, LATCHED).await?.publish_replay_end(served.clone()));
        Ok(())
    }

    /// Publishes a message of each newest map's layer on a topic of this name and type.
    async fn publish_layer(
        &mut self,
        served: &Served,
        layer: &'static str,
        (topic, kind): (&str, &Published),
        mut write: impl FnMut(&MapView, &Layer) -> Vec<u8> + Send + 'static,
        tasks: &mut JoinSet<()>,
    ) -> Result<(), ZenohError> {
        let topic = self.topic(topic, kind, LATCHED).await?;
        let message = move |map: &EncodedMap| {
            let (_, chunk) = map.layers.iter().find(|(name, _)| *name == layer)?;
            let map = view(map, map.layer(chunk))?;
            let layer = map.layers().first()?;
            Some(write(&map, layer))
        };
        tasks.spawn(topic.publish(served.clone(), Some(layer), message));
        Ok(())
    }

    /// The tokens; the node disappears when they are dropped.
    pub fn into_tokens(self) -> Vec<LivelinessToken> {
        self.tokens
    }

    async fn declare_token(&mut self, entity: &str) -> Result<String, ZenohError> {
        // The node is entity 0 of its session.
        let key = format!("@ros2_lv/{}/{}/0/{entity}", self.options.domain, self.session.zid());
        let token = self.session.liveliness().declare_token(key.clone());
        self.tokens.push(token.await.map_err(ZenohError::of(format!("liveliness {key}")))?);
        Ok(key)
    }

    async fn topic(&mut self, topic: &str, kind: &Published, qos: &str) -> Result<Topic, ZenohError> {
        let (name, hash) = (kind.dds_name(), kind.hash);
        let key = format!("{}/{}/{name}/{hash}", self.options.domain, topic.trim_start_matches('/'));
        // Not to this session: a vehicle may get its own poses from the same /tf.
        let publisher = self.session.declare_publisher(key.clone()).allowed_destination(Locality::Remote);
        let publisher = publisher.congestion_control(CongestionControl::Drop);
        let publisher = match qos {
            LATCHED => publisher
                .cache(CacheConfig::default().max_samples(1))
                .sample_miss_detection(MissDetectionConfig::default().sporadic_heartbeat(HEARTBEAT))
                .publisher_detection(),
            _ => publisher.advanced(),
        };
        let publisher = publisher.await.map_err(ZenohError::of(format!("publisher {key}")))?;
        let (id, mangled) = (self.tokens.len(), topic.replace('/', "%"));
        let token = self.declare_token(&format!("{id}/MP/%/%/{NODE}/{mangled}/{name}/{hash}/{qos}")).await?;
        Ok(Topic { publisher, gid: gid(&token), sent: 0 })
    }
}

/// Sixteen bytes that identify a publisher, hashed from its token, which contains the session's id.
fn gid(token: &str) -> [u8; 16] {
    let half = |half: u8| {
        let mut hasher = DefaultHasher::new();
        (half, token).hash(&mut hasher);
        hasher.finish().to_le_bytes()
    };
    let mut gid = [0; 16];
    gid[..8].copy_from_slice(&half(0));
    gid[8..].copy_from_slice(&half(1));
    gid
}

/// The publisher of one topic.
struct Topic {
    publisher: AdvancedPublisher<'static>,
    gid: [u8; 16],
    sent: i64,
}

impl Topic {
    /// Sends the message of each newest map while there is a subscriber, and keeps the layer active meanwhile.
    async fn publish(
        mut self,
        served: Served,
        layer: Option<&'static str>,
        mut make: impl FnMut(&EncodedMap) -> Option<Vec<u8>> + Send,
    ) {
        let Ok(matching) = self.publisher.matching_listener().await else { return };
        let mut newest = served.newest.clone();
        loop {
            // Checked first, because the first subscriber may be older than the listener.
            if !self.publisher.matching_status().await.is_ok_and(|status| status.matching()) {
                match matching.recv_async().await {
                    Ok(_) => continue,
                    Err(_) => return,
                }
            }
            let _subscription = layer.map(|layer| served.wires.subscriptions.subscribe(&[layer.to_owned()]));
            let mut reader = Reader::new(&served.status.transports, Transport::Ros);
            newest.mark_changed();
            loop {
                tokio::select! {
                    changed = newest.changed() => match changed {
                        Ok(()) => {
                            let map = newest.borrow_and_update().clone();
                            map.iter().for_each(|map| _ = reader.got(map.boot_id, map.sequence));
                            let trace = |map: &EncodedMap| served.status.traces.hop(map, "send", Some(Transport::Ros.as_str()));
                            let _hop = map.as_deref().map(trace);
                            if let Some(message) = map.and_then(|map| make(&map)) {
                                self.put(message).await;
                            }
                        }
                        // The engine has stopped; the newest map stays in the cache until the session ends.
                        Err(_) => return std::future::pending().await,
                    },
                    status = matching.recv_async() => match status {
                        Ok(status) if status.matching() => {}
                        Ok(_) => break,
                        Err(_) => return,
                    },
                }
            }
        }
    }

    /// Sends whether a replay has ended, now and whenever that changes, after the last map.
    async fn publish_replay_end(mut self, served: Served) {
        let mut ended = served.wires.replay_ended.subscribe();
        loop {
            let has_ended = *ended.borrow_and_update();
            let mut message = Writer::default();
            message.bytes(&[has_ended.into()]);
            self.put(message.finish()).await;
            if ended.changed().await.is_err() {
                return std::future::pending().await;
            }
        }
    }

    async fn put(&mut self, message: Vec<u8>) {
        self.sent += 1;
        let attachment = [&self.sent.to_le_bytes()[..], &now_ns().to_le_bytes(), &[16], &self.gid].concat();
        if let Err(error) = self.publisher.put(message).attachment(attachment).await {
            tracing::warn!(%error, key = %self.publisher.key_expr(), "ros: put");
        }
    }
}
