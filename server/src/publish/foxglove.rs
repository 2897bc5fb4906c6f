//! Maps, points and poses for Foxglove, and for other clients of its WebSocket protocol (`foxglove.sdk.v1`).
//!
//! Channels: `/<vehicle>/map/<layer>` (`foxglove.Grid`), `/<vehicle>/safe_points` (`foxglove.SceneUpdate`: lines and
//! circles of the layer `safe_path`), `/<vehicle>/points` (`foxglove.PointCloud`: what the newest map was made from)
//! and `/tf` (`foxglove.FrameTransforms`: `<vehicle>/base_link` in `map`). Channels without a subscription are not
//! made. A new subscription gets the newest map at once. A stalled client has at most [`BACKLOG`] messages, then the
//! oldest are dropped.

use std::collections::HashMap;
use std::sync::{Arc, Mutex};

use crate::encode::viewer::raster::Rasters;
use crate::encode::viewer::{base_frame, foxglove as messages, safe_paths};
use clearway_client::MapView;
use foxglove::messages::{FrameTransforms, Grid, PointCloud, SceneUpdate};
use foxglove::websocket::{ChannelView, Client, ServerListener};
use foxglove::{Channel, ChannelId, Context, Encode, FoxgloveError, PartialMetadata, SinkId, WebSocketServerHandle};
use tokio::sync::{Notify, watch};
use tokio::task::JoinSet;

use super::served::{Served, Vehicles};
use crate::config::Foxglove as Options;
use crate::encode::EncodedMap;
use crate::newest::NewestSweep;
use crate::status::Reader;
use crate::subscriptions::LayerSubscription;
use crate::sync::locked;

/// Most messages on the way to one client. Ours: some revolutions of every layer; the largest message, a grid, has
/// about 1 MB.
const BACKLOG: usize = 32;

/// The running WebSocket server.
pub struct Publisher {
    server: WebSocketServerHandle,
    /// Connects channels and server; neither of them owns it.
    _context: Arc<Context>,
    tasks: JoinSet<()>,
}

impl Publisher {
    /// Starts the server, with channels for every vehicle.
    ///
    /// # Errors
    /// [`FoxgloveError`] if the server cannot start, for example if its address is in use.
    pub async fn start(options: &Options, vehicles: &Vehicles) -> Result<Self, FoxgloveError> {
        let context = Context::new();
        let tf = Arc::new(context.channel_builder("/tf").build::<FrameTransforms>());
        let vehicles_channels: Vec<_> =
            vehicles.0.iter().map(|served| Arc::new(VehicleChannels::new(served, &context, &tf))).collect();
        let server = context.websocket_server().name("clearway").message_backlog_size(BACKLOG);
        let server = server.listener(Arc::new(SubscriptionListener(vehicles_channels.clone())));
        let server = server.bind(options.listen.ip().to_string(), options.listen.port()).start().await?;
        let mut tasks = JoinSet::new();
        for channels in vehicles_channels {
            tasks.spawn(async move { channels.run().await });
        }
        Ok(Self { server, _context: context, tasks })
    }

    /// The port of the server.
    pub fn port(&self) -> u16 {
        self.server.port()
    }

    /// Stops the server and closes its connections.
    pub async fn stop(mut self) {
        self.tasks.shutdown().await;
        self.server.stop().wait().await;
    }
}

/// Reports subscriptions of clients to the vehicles' channels.
struct SubscriptionListener(Vec<Arc<VehicleChannels>>);

impl ServerListener for SubscriptionListener {
    fn on_subscribe(&self, client: Client, channel: ChannelView) {
        let Some(sink) = client.sink_id() else { return };
        self.0.iter().for_each(|channels| channels.subscribe(channel.id(), sink));
    }

    fn on_unsubscribe(&self, client: Client, channel: ChannelView) {
        let Some(sink) = client.sink_id() else { return };
        self.0.iter().for_each(|channels| _ = locked(&channels.subscriptions).remove(&(channel.id(), sink)));
    }
}

/// One vehicle's channels.
struct VehicleChannels {
    served: Served,
    layers: Vec<(&'static str, Channel<Grid>)>,
    /// The channel of the safe points; `None` if the vehicle's maps have none.
    safe_points: Option<Channel<SceneUpdate>>,
    points: Channel<PointCloud>,
    /// The channel of transforms, shared by all vehicles.
    tf: Arc<Channel<FrameTransforms>>,
    subscriptions: Mutex<HashMap<(ChannelId, SinkId), ClientSubscription>>,
    subscribed: Notify,
}

/// One client's subscription to one channel.
struct ClientSubscription {
    /// True until the newest map was sent.
    is_new: bool,
    /// Keeps its layer active.
    _layer: Option<LayerSubscription>,
    points: Option<watch::Receiver<NewestSweep>>,
    _reader: Reader,
}

impl VehicleChannels {
    fn new(served: &Served, context: &Arc<Context>, tf: &Arc<Channel<FrameTransforms>>) -> Self {
        let vehicle = &served.status.name;
        let layer = |&name: &&'static str| (name, context.channel_builder(format!("/{vehicle}/map/{name}")).build());
        Self {
            served: served.clone(),
            layers: served.status.layers.iter().map(layer).collect(),
            safe_points: (served.status.layers.contains(&safe_paths::LAYER))
                .then(|| context.channel_builder(format!("/{vehicle}/safe_points")).build()),
            points: context.channel_builder(format!("/{vehicle}/points")).build(),
            tf: tf.clone(),
            subscriptions: Mutex::default(),
            subscribed: Notify::new(),
        }
    }

    /// Adds a client's subscription, if the channel is one of this vehicle's.
    fn subscribe(&self, channel: ChannelId, sink: SinkId) {
        let of_safe_points = self.safe_points.iter().map(|of| (safe_paths::LAYER, of.id()));
        let mut layers = self.layers.iter().map(|(name, of)| (*name, of.id())).chain(of_safe_points);
        let layer = layers.find(|(_, id)| *id == channel).map(|(name, _)| name);
        let is_points = self.points.id() == channel;
        if layer.is_none() && !is_points && self.tf.id() != channel {
            return;
        }
        let status = &self.served.status;
        let layer_subscription = layer.map(|name| status.subscriptions.subscribe(&[name.to_owned()]));
        let points = is_points.then(|| status.sweeps.subscribe());
        let _reader = Reader::new(&status.foxglove_readers);
        locked(&self.subscriptions)
            .insert((channel, sink), ClientSubscription { is_new: true, _layer: layer_subscription, points, _reader });
        self.subscribed.notify_one();
    }

    /// Sends each newest map to all subscribed clients, and the current one to each new subscription.
    async fn run(&self) {
        let mut newest = self.served.newest.clone();
        let mut rasters = Rasters::default();
        newest.mark_changed();
        loop {
            let is_new_map = tokio::select! {
                changed = newest.changed() => match changed {
                    Ok(()) => true,
                    // The engine has stopped; new subscriptions still get its last map.
                    Err(_) => {
                        self.subscribed.notified().await;
                        false
                    }
                },
                () = self.subscribed.notified() => false,
            };
            let map = if is_new_map { newest.borrow_and_update().clone() } else { newest.borrow().clone() };
            let (new, Some(map)) = (self.take_new(), map) else { continue };
            if is_new_map {
                self.send_map(&map, None, &mut rasters);
            } else {
                new.into_iter().for_each(|key| self.send_map(&map, Some(key), &mut rasters));
            }
        }
    }

    /// New subscriptions, which are no longer new afterwards.
    fn take_new(&self) -> Vec<(ChannelId, SinkId)> {
        let mut subscriptions = locked(&self.subscriptions);
        let new = subscriptions
            .iter_mut()
            .filter_map(|(&key, subscription)| std::mem::take(&mut subscription.is_new).then_some(key));
        new.collect()
    }

    /// Sends a map: to all subscribed clients, or on one channel to one client.
    fn send_map(&self, map: &EncodedMap, to: Option<(ChannelId, SinkId)>, rasters: &mut Rasters) {
        for (name, channel) in &self.layers {
            let safe_points = self.safe_points.as_ref().filter(|_| *name == safe_paths::LAYER);
            let safe_points = safe_points.filter(|channel| is_subscribed(channel, to));
            let channel = Some(channel).filter(|channel| is_subscribed(channel, to));
            let chunk = map.layers.iter().find(|(of, _)| of == name);
            let chunk = chunk.filter(|_| channel.is_some() || safe_points.is_some());
            let Some(view) = chunk.and_then(|(_, chunk)| view(map.layer(chunk))) else { continue };
            let Some(layer) = view.layers().first() else { continue };
            if let Some(channel) = channel {
                send(channel, &messages::grid(&view, layer, rasters.of(layer)), map, to);
            }
            if let Some(channel) = safe_points {
                send(channel, &messages::safe_paths(&view, layer), map, to);
            }
        }
        if is_subscribed(&self.tf, to)
            && let Some(transforms) = view(map.header.clone()).and_then(|view| messages::transforms(&view))
        {
            send(&self.tf, &transforms, map, to);
        }
        if is_subscribed(&self.points, to)
            && let Some(sweep) = self.sweep().filter(|sweep| sweep.0 == map.capture_end_ns)
        {
            let sweep = &sweep.1;
            let points = (0..sweep.x.len()).map(|i| [sweep.x[i], sweep.y[i], sweep.z[i]]);
            let cloud = messages::points(map.capture_end_ns, &base_frame(&map.vehicle), points);
            send(&self.points, &cloud, map, to);
        }
    }

    /// The newest points, if a client subscribes to them.
    fn sweep(&self) -> NewestSweep {
        locked(&self.subscriptions).values().find_map(|subscription| subscription.points.as_ref()?.borrow().clone())
    }
}

fn view(bytes: bytes::Bytes) -> Option<MapView> {
    MapView::decode(bytes)
        .inspect_err(|error| tracing::error!(%error, "foxglove: the newest map cannot be decoded"))
        .ok()
}

fn is_subscribed<T: Encode>(channel: &Channel<T>, to: Option<(ChannelId, SinkId)>) -> bool {
    to.map_or(channel.has_sinks(), |(id, _)| id == channel.id())
}

fn send<T: Encode>(channel: &Channel<T>, message: &T, map: &EncodedMap, to: Option<(ChannelId, SinkId)>) {
    let stamp_ns = u64::try_from(map.capture_end_ns).unwrap_or(0);
    channel.log_with_meta_to_sink(message, PartialMetadata::with_log_time(stamp_ns), to.map(|(_, sink)| sink));
}
