//! Maps as ROS 2 topics in the key space of rmw_zenoh, or of zenoh-bridge-ros2dds.
//!
//! For each vehicle: `<namespace>/<vehicle>/<layer>` (`nav_msgs/msg/OccupancyGrid`) and the other topics of the layer
//! ([`ros::topics_of`]), `<namespace>/<vehicle>/plan` (`nav_msgs/msg/Path`: the newest path of the vehicle's planners,
//! empty without one), `<namespace>/<vehicle>/replay_ended` (`std_msgs/msg/Bool`: true from the end of a replay until
//! it is set back), and if configured its pose on `/tf`. For all: their states on `/diagnostics`
//! (`diagnostic_msgs/msg/DiagnosticArray`). All are reliable; clouds, `/tf` and states volatile, the others transient
//! local with depth 1. rmw_zenoh has a topic under `<domain>/<topic>/<type>/<hash>`, and liveliness tokens under
//! `@ros2_lv` announce the node and its publishers; the bridge has it under `<topic>`. The payload is CDR, with an
//! attachment: sequence, time of sending, length 16, the publisher's 16 bytes.
//!
//! A message is made only while there is a subscriber; the first subscriber gets the newest map at once, later
//! subscribers get it from the publisher's cache. When the newest map becomes stale, or the last subscriber leaves, its
//! grids are sent once more, unknown, so that no cache keeps a grid that looks fresh.

use std::hash::{DefaultHasher, Hash, Hasher};
use std::time::Duration;

use crate::viewer::raster::Rasters;
use crate::viewer::ros::{self, LayerTopic, ShownLayer};
use crate::viewer::view;
use clearway_proto::v1;
use clearway_ros::cdr::{Header, Writer};
use clearway_ros::published::diagnostics::{Diagnostic, DiagnosticLevel, diagnostic_array_to_cdr};
use clearway_ros::published::{BOOL, DIAGNOSTIC_ARRAY, PATH, Published, TF_MESSAGE};
use tokio::sync::watch;
use tokio::task::JoinSet;
use tokio::time::{Instant, sleep_until};
use zenoh::Session;
use zenoh::liveliness::LivelinessToken;
use zenoh::qos::CongestionControl;
use zenoh::sample::Locality;
use zenoh_ext::{AdvancedPublisher, AdvancedPublisherBuilderExt, CacheConfig, MissDetectionConfig};

use super::served::{Served, Vehicles};
use crate::base::clock::now_ns;
use crate::config::Ros2;
use crate::engine::plans::NewestPlan;
use crate::status::assess::Assessment;
use crate::status::{Reader, State, Transport, VehicleStatus, state_changed};
use crate::zenoh_session::ZenohError;
use clearway_journal::encode::EncodedMap;

/// Name of the node.
const NODE: &str = "clearway";
/// QoS of the grids: reliability 1 reliable; durability 1 transient local; history 1 keep last, depth 1; deadline,
/// lifespan and liveliness by default.
const LATCHED: &str = "1:1:1,1:,:,:,,";
/// QoS of clouds and `/tf`: the same, but durability 2 volatile, depth 100, as tf2's broadcaster has it.
const MOVING: &str = "1:2:1,100:,:,:,,";
/// Interval at which a quiet publisher repeats its last sequence, so that subscribers notice a lost last map.
const HEARTBEAT: Duration = Duration::from_secs(1);
/// Interval at which the states of the vehicles are published, as ROS 2's diagnostic updater has it.
const STATES_PERIOD: Duration = Duration::from_secs(1);

/// The node of the topics of all vehicles.
pub(super) struct Node<'a> {
    session: &'a Session,
    options: &'a Ros2,
    /// Tokens of the node and of its publishers so far.
    tokens: Vec<LivelinessToken>,
}

impl<'a> Node<'a> {
    /// Declares the liveliness token of the node, by which ROS 2 finds it.
    pub async fn declare(session: &'a Session, options: &'a Ros2) -> Result<Self, ZenohError> {
        let mut node = Self { session, options, tokens: Vec::new() };
        node.declare_token(&format!("0/NN/%/%/{NODE}")).await?;
        Ok(node)
    }

    /// Publishes the layers and the pose of a vehicle.
    pub async fn publish(&mut self, served: &Served, tasks: &mut JoinSet<()>) -> Result<(), ZenohError> {
        let vehicle = &served.status.name;
        for &layer in &served.status.layers {
            for topic in ros::topics_of(layer) {
                self.publish_layer(served, layer, topic, tasks).await?;
            }
        }
        if self.options.tf {
            let tf = self.topic("/tf", &TF_MESSAGE, MOVING).await?;
            let frames = served.frames.clone();
            let transform = move |map: &EncodedMap, is_fresh: bool| {
                let pose = ros::pose_of(&view(map, map.header.clone())?).filter(|_| is_fresh)?;
                Some(ros::tf_of(&frames, &pose))
            };
            tasks.spawn(tf.publish(served.clone(), None, transform));
        }
        let (own, wires, frames) =
            (format!("{}/{vehicle}", self.options.namespace), &served.wires, served.frames.clone());
        let path = move |plan: &NewestPlan| ros::path_of(&frames, plan.as_deref().unwrap_or(&v1::Plan::default()));
        let plans = self.topic(&format!("{own}/plan"), &PATH, LATCHED).await?;
        tasks.spawn(plans.publish_each(wires.plans.subscribe(), path));
        let has_ended = |ended: &bool| {
            let mut message = Writer::default();
            message.bytes(&[(*ended).into()]);
            message.finish()
        };
        let ends = self.topic(&format!("{own}/replay_ended"), &BOOL, LATCHED).await?;
        tasks.spawn(ends.publish_each(wires.replay_ended.subscribe(), has_ended));
        Ok(())
    }

    /// Publishes a message of each newest map's layer on one of the layer's topics.
    async fn publish_layer(
        &mut self,
        served: &Served,
        layer: &'static str,
        LayerTopic { ending, kind, is_latched, write }: &'static LayerTopic,
        tasks: &mut JoinSet<()>,
    ) -> Result<(), ZenohError> {
        let name = format!("{}/{}/{layer}{ending}", self.options.namespace, served.status.name);
        let topic = self.topic(&name, kind, if *is_latched { LATCHED } else { MOVING }).await?;
        let (mut rasters, frames) = (Rasters::default(), served.frames.clone());
        let message = move |map: &EncodedMap, is_fresh: bool| {
            let (_, chunk) = map.layers.iter().find(|(name, _)| *name == layer)?;
            let map = view(map, map.layer(chunk))?;
            let layer = map.layers().first()?;
            write(&ShownLayer { map: &map, layer, raster: rasters.of(layer), frames: &frames, is_fresh })
        };
        tasks.spawn(topic.publish(served.clone(), Some(layer), message));
        Ok(())
    }

    /// Publishes the states of the vehicles on `/diagnostics`, once a second and when one changes.
    pub async fn publish_states(&mut self, vehicles: &Vehicles, tasks: &mut JoinSet<()>) -> Result<(), ZenohError> {
        let mut topic = self.topic("/diagnostics", &DIAGNOSTIC_ARRAY, MOVING).await?;
        let statuses = vehicles.statuses();
        tasks.spawn(async move {
            let mut every = tokio::time::interval(STATES_PERIOD);
            let mut states: Vec<_> = statuses.iter().map(|status| status.states()).collect();
            loop {
                tokio::select! {
                    _ = every.tick() => {}
                    () = state_changed(&mut states) => {}
                }
                if topic.publisher.matching_status().await.is_ok_and(|status| status.matching()) {
                    let states: Vec<_> = statuses.iter().map(|status| diagnostic(status)).collect();
                    let header = Header { stamp_ns: now_ns(), frame_id: "" };
                    topic.put(Some(diagnostic_array_to_cdr(&header, &states))).await;
                }
            }
        });
        Ok(())
    }

    /// The tokens; the node disappears when they are dropped.
    pub fn into_tokens(self) -> Vec<LivelinessToken> {
        self.tokens
    }

    async fn declare_token(&mut self, entity: &str) -> Result<String, ZenohError> {
        // The node is entity 0 of its session.
        let key = format!("@ros2_lv/{}/{}/0/{entity}", self.options.domain, self.session.zid());
        if !self.options.dds_bridge {
            let token = self.session.liveliness().declare_token(key.clone());
            self.tokens.push(token.await.map_err(ZenohError::of(format!("liveliness {key}")))?);
        }
        Ok(key)
    }

    async fn topic(&mut self, topic: &str, kind: &Published, qos: &str) -> Result<Topic, ZenohError> {
        let (name, hash) = (kind.dds_name(), kind.hash);
        let plain = topic.trim_start_matches('/');
        let key = match self.options.dds_bridge {
            true => plain.to_owned(),
            false => format!("{}/{plain}/{name}/{hash}", self.options.domain),
        };
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

/// The state of a vehicle: its reasons, worst first, and what an operator reads first.
fn diagnostic(status: &VehicleStatus) -> Diagnostic {
    let Assessment { state, reasons, map_age_ms, loss, .. } = status.assess();
    let level = match state {
        State::Ok => DiagnosticLevel::Ok,
        State::Warn => DiagnosticLevel::Warn,
        State::Error => DiagnosticLevel::Error,
    };
    let age = map_age_ms.map_or_else(|| "no map".to_owned(), |age_ms| format!("{age_ms:.0}"));
    let rate = format!("{:.1}", status.snapshot().map_rate_hz);
    let loss = loss.map_or_else(|| "no packets".to_owned(), |loss| format!("{loss:.3}"));
    Diagnostic {
        level,
        name: format!("{NODE}: {}", status.name),
        message: reasons.join("; "),
        hardware_id: status.name.to_string(),
        values: vec![("map_age_ms", age), ("map_rate_hz", rate), ("loss", loss)],
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
    /// Sends the message of each newest map while there is a subscriber, and keeps the layer active meanwhile. When
    /// that map becomes stale, or the last subscriber leaves, sends its message as a stale one, once.
    async fn publish(
        mut self,
        served: Served,
        layer: Option<&'static str>,
        mut make: impl FnMut(&EncodedMap, bool) -> Option<Vec<u8>> + Send,
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
            // When the newest map becomes stale; `None` if there is none, or once that is said.
            let (mut stale_at, mut is_said) = (None, false);
            let mut is_stopped = false;
            loop {
                tokio::select! {
                    changed = newest.changed(), if !is_stopped => {
                        // The engine has stopped: its newest map becomes stale like any other.
                        is_stopped = changed.is_err();
                        let Some(map) = newest.borrow_and_update().clone().filter(|_| !is_stopped) else { continue };
                        reader.got(map.boot_id, map.sequence);
                        let _hop = served.status.traces.hop(&map, "send", Some(Transport::Ros.as_str()));
                        let fresh_for = served.status.fresh_for(map.capture_end_ns);
                        // Maps that are stale when they are made say so once, until one is fresh.
                        if !fresh_for.is_zero() {
                            self.put(make(&map, true)).await;
                            is_said = false;
                        }
                        stale_at = (!is_said).then(|| Instant::now() + fresh_for);
                    }
                    () = sleep_until(stale_at.unwrap_or_else(Instant::now)), if stale_at.is_some() => {
                        (stale_at, is_said) = (None, true);
                        let map = newest.borrow().clone();
                        self.put(map.and_then(|map| make(&map, false))).await;
                    }
                    status = matching.recv_async() => match status {
                        Ok(status) if status.matching() => {}
                        Ok(_) => {
                            let map = newest.borrow().clone();
                            self.put(map.and_then(|map| make(&map, false))).await;
                            break;
                        }
                        Err(_) => return,
                    },
                }
            }
        }
    }

    /// Sends the message of a value, now and whenever the value changes.
    async fn publish_each<T>(mut self, mut values: watch::Receiver<T>, make: impl Fn(&T) -> Vec<u8>) {
        loop {
            let message = make(&values.borrow_and_update());
            self.put(Some(message)).await;
            if values.changed().await.is_err() {
                return std::future::pending().await;
            }
        }
    }

    /// Sends a message, if there is one.
    async fn put(&mut self, message: Option<Vec<u8>>) {
        let Some(message) = message else { return };
        self.sent += 1;
        let attachment = [&self.sent.to_le_bytes()[..], &now_ns().to_le_bytes(), &[16], &self.gid].concat();
        if let Err(error) = self.publisher.put(message).attachment(attachment).await {
            tracing::warn!(%error, key = %self.publisher.key_expr(), "ros: put");
        }
    }
}
