//! Maps, points and poses to Foxglove and whoever else speaks its WebSocket protocol (`foxglove.sdk.v1`).
//!
//! Channels: `/<vehicle>/map/<layer>` (`foxglove.Grid`), `/<vehicle>/points` (`foxglove.PointCloud`: what the newest
//! map was made from) and `/tf` (`foxglove.FrameTransforms`: `<vehicle>/base_link` in `map`). What nobody subscribes to
//! is not made. Whoever comes gets the newest map at once. A stalled client holds [`BACKLOG`] messages, then the oldest
//! are dropped.

use std::collections::HashMap;
use std::sync::{Arc, Mutex};

use clearway_client::MapView;
use crate::encode::viewer::raster::Rasters;
use crate::encode::viewer::{base_frame, foxglove as messages};
use foxglove::messages::{FrameTransforms, Grid, PointCloud};
use foxglove::websocket::{ChannelView, Client, ServerListener};
use foxglove::{Channel, ChannelId, Context, Encode, FoxgloveError, PartialMetadata, SinkId, WebSocketServerHandle};
use tokio::sync::{Notify, watch};
use tokio::task::JoinSet;

use super::{Served, Vehicles};
use crate::config::Foxglove as Options;
use crate::subscriptions::LayerSubscription;
use crate::newest::NewestSweep;
use crate::sync::locked;
use crate::encode::EncodedMap;

/// Messages on the way to one client: some revolutions of every layer; the largest, a grid, has about 1 MB.
const BACKLOG: usize = 32;

/// The running WebSocket server.
pub struct Publisher {
    server: WebSocketServerHandle,
    /// What joins channels and server; neither of them keeps it.
    _context: Arc<Context>,
    tasks: JoinSet<()>,
}

impl Publisher {
    /// Listens, and shows every vehicle.
    ///
    /// # Errors
    /// What the WebSocket server says, as of an address in use.
    pub async fn start(options: &Options, vehicles: &Vehicles) -> Result<Self, FoxgloveError> {
        let context = Context::new();
        let tf = Arc::new(context.channel_builder("/tf").build::<FrameTransforms>());
        let stages: Vec<_> = vehicles.0.iter().map(|served| Arc::new(Stage::new(served, &context, &tf))).collect();
        let server = context.websocket_server().name("clearway").message_backlog_size(BACKLOG);
        let server = server.listener(Arc::new(Audience(stages.clone())));
        let server = server.bind(options.listen.ip().to_string(), options.listen.port()).start().await?;
        let mut tasks = JoinSet::new();
        for stage in stages {
            tasks.spawn(async move { stage.play().await });
        }
        Ok(Self { server, _context: context, tasks })
    }

    /// The port that is listened on.
    pub fn port(&self) -> u16 {
        self.server.port()
    }

    /// Ends it; the clients are told.
    pub async fn stop(mut self) {
        self.tasks.shutdown().await;
        self.server.stop().wait().await;
    }
}

/// Tells the vehicles who comes and goes.
struct Audience(Vec<Arc<Stage>>);

impl ServerListener for Audience {
    fn on_subscribe(&self, client: Client, channel: ChannelView) {
        let Some(sink) = client.sink_id() else { return };
        self.0.iter().for_each(|stage| stage.seat(channel.id(), sink));
    }

    fn on_unsubscribe(&self, client: Client, channel: ChannelView) {
        let Some(sink) = client.sink_id() else { return };
        self.0.iter().for_each(|stage| _ = locked(&stage.seats).remove(&(channel.id(), sink)));
    }
}

/// One vehicle's channels.
struct Stage {
    served: Served,
    layers: Vec<(&'static str, Channel<Grid>)>,
    points: Channel<PointCloud>,
    /// All vehicles share it.
    tf: Arc<Channel<FrameTransforms>>,
    seats: Mutex<HashMap<(ChannelId, SinkId), Seat>>,
    came: Notify,
}

/// One client's subscription to one channel.
struct Seat {
    /// Has not been shown the newest map yet.
    is_new: bool,
    /// What is made for it.
    _taken: Option<LayerSubscription>,
    points: Option<watch::Receiver<NewestSweep>>,
}

impl Stage {
    fn new(served: &Served, context: &Arc<Context>, tf: &Arc<Channel<FrameTransforms>>) -> Self {
        let vehicle = &served.status.name;
        let layer = |&name: &&'static str| (name, context.channel_builder(format!("/{vehicle}/map/{name}")).build());
        Self {
            served: served.clone(),
            layers: served.status.layers.iter().map(layer).collect(),
            points: context.channel_builder(format!("/{vehicle}/points")).build(),
            tf: tf.clone(),
            seats: Mutex::default(),
            came: Notify::new(),
        }
    }

    /// Somebody wants a channel; those of other vehicles are not seen to here.
    fn seat(&self, channel: ChannelId, sink: SinkId) {
        let layer = self.layers.iter().find(|(_, of)| of.id() == channel);
        let is_points = self.points.id() == channel;
        if layer.is_none() && !is_points && self.tf.id() != channel {
            return;
        }
        let status = &self.served.status;
        let taken = layer.map(|(name, _)| status.subscriptions.subscribe(&[(*name).to_owned()]));
        let points = is_points.then(|| status.sweeps.subscribe());
        locked(&self.seats).insert((channel, sink), Seat { is_new: true, _taken: taken, points });
        self.came.notify_one();
    }

    /// Shows each newest map to all, and the newest one there is to whoever comes.
    async fn play(&self) {
        let mut newest = self.served.newest.clone();
        let mut rasters = Rasters::default();
        newest.mark_changed();
        loop {
            let is_new_map = tokio::select! {
                changed = newest.changed() => match changed {
                    Ok(()) => true,
                    // The engine has stopped; who comes now still finds its last map.
                    Err(_) => {
                        self.came.notified().await;
                        false
                    }
                },
                () = self.came.notified() => false,
            };
            let map = if is_new_map { newest.borrow_and_update().clone() } else { newest.borrow().clone() };
            let (newcomers, Some(map)) = (self.newcomers(), map) else { continue };
            if is_new_map {
                self.show(&map, None, &mut rasters);
            } else {
                newcomers.into_iter().for_each(|seat| self.show(&map, Some(seat), &mut rasters));
            }
        }
    }

    /// Those not shown a map yet; from now on they are.
    fn newcomers(&self) -> Vec<(ChannelId, SinkId)> {
        let mut seats = locked(&self.seats);
        let new = seats.iter_mut().filter_map(|(&seat, at)| std::mem::take(&mut at.is_new).then_some(seat));
        new.collect()
    }

    /// Sends what a map has: to all who subscribe, or on one channel to one client.
    fn show(&self, map: &EncodedMap, to: Option<(ChannelId, SinkId)>, rasters: &mut Rasters) {
        for (name, channel) in &self.layers {
            let chunk = map.layers.iter().find(|(of, _)| of == name).filter(|_| is_wanted(channel, to));
            let Some(view) = chunk.and_then(|(_, chunk)| view(map.layer(chunk))) else { continue };
            let Some(layer) = view.layers().first() else { continue };
            send(channel, &messages::grid(&view, layer, rasters.of(layer)), map, to);
        }
        if is_wanted(&self.tf, to)
            && let Some(transforms) = view(map.header.clone()).and_then(|view| messages::transforms(&view))
        {
            send(&self.tf, &transforms, map, to);
        }
        if is_wanted(&self.points, to)
            && let Some(sweep) = self.sweep().filter(|sweep| sweep.0 == map.capture_end_ns)
        {
            let sweep = &sweep.1;
            let points = (0..sweep.x.len()).map(|i| [sweep.x[i], sweep.y[i], sweep.z[i]]);
            let cloud = messages::points(map.capture_end_ns, &base_frame(&map.vehicle), points);
            send(&self.points, &cloud, map, to);
        }
    }

    /// The newest points that somebody takes.
    fn sweep(&self) -> NewestSweep {
        locked(&self.seats).values().find_map(|seat| seat.points.as_ref()?.borrow().clone())
    }
}

fn view(bytes: bytes::Bytes) -> Option<MapView> {
    MapView::decode(bytes).inspect_err(|error| tracing::error!(%error, "foxglove: a map of our own")).ok()
}

fn is_wanted<T: Encode>(channel: &Channel<T>, to: Option<(ChannelId, SinkId)>) -> bool {
    to.map_or(channel.has_sinks(), |(id, _)| id == channel.id())
}

fn send<T: Encode>(channel: &Channel<T>, message: &T, map: &EncodedMap, to: Option<(ChannelId, SinkId)>) {
    let stamp_ns = u64::try_from(map.capture_end_ns).unwrap_or(0);
    channel.log_with_meta_to_sink(message, PartialMetadata::with_log_time(stamp_ns), to.map(|(_, sink)| sink));
}
