//! Maps, points and poses for Foxglove, and for other clients of its WebSocket protocol (`foxglove.sdk.v1`).
//!
//! Channels: `/<vehicle>/map/<layer>` (`foxglove.Grid`), `/<vehicle>/safe_points` (`foxglove.SceneUpdate`: lines and
//! circles of the layer `safe_path`), `/<vehicle>/plan` (the same: the newest plan), `/<vehicle>/log` (`foxglove.Log`:
//! the end of a replay), `/<vehicle>/points` (`foxglove.PointCloud`: what the newest map was made from) and `/tf`
//! (`foxglove.FrameTransforms`: `<vehicle>/base_link` in `map`). Channels of maps without a subscription are not made;
//! a message is encoded once for all clients. A new subscription gets the newest map at once. A slow client skips
//! messages, and a client that receives nothing for [`SEND_TIMEOUT`] is disconnected.

use std::collections::BTreeMap;
use std::ops::Bound;
use std::sync::Arc;
use std::time::Duration;

use axum::Router;
use axum::extract::ws::{Message as WsMessage, WebSocket, WebSocketUpgrade};
use axum::extract::{Extension, State};
use axum::http::StatusCode;
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use base64::Engine as _;
use base64::prelude::BASE64_STANDARD;
use bytes::{BufMut, Bytes, BytesMut};
use foxglove::messages::{FrameTransforms, Grid, Log, PointCloud, SceneUpdate};
use foxglove::{Encode, Schema};
use serde::Deserialize;
use serde_json::{Value, json};
use tokio::sync::{Notify, watch};
use tokio::task::JoinSet;

use super::listen::access::Caller;
use super::listen::{CallPermit, ConnectionSlot, Listener, READ_BUFFER_BYTES};
use super::served::{Served, Vehicles};
use crate::base::clock::now_ns;
use crate::base::token_bucket::TokenBucket;
use crate::engine::newest::NewestSweep;
use crate::engine::subscriptions::LayerSubscription;
use crate::status::{Reader, Transport};
use crate::viewer::raster::Rasters;
use crate::viewer::{base_frame, foxglove as messages, safe_paths, view};
use clearway_journal::encode::EncodedMap;

/// Pages from which Foxglove connects, beside the configured pages.
pub const ORIGINS: &[&str] = &["https://app.foxglove.dev"];
/// Name of the WebSocket subprotocol.
const PROTOCOL: &str = "foxglove.sdk.v1";
/// Longest time to send a message. Ours: a client this late shows stale maps anyway.
const SEND_TIMEOUT: Duration = Duration::from_secs(5);
/// Longest message of a client, in bytes. Ours: a subscription to some hundred channels.
const MESSAGE_BYTES_MAX: usize = 64 << 10;
/// Most frames of a client at once, and how many more each second. Ours: a request for each of its subscriptions.
const FRAMES_MAX: u32 = 1000;
const FRAMES_PER_SECOND: u32 = 100;
/// Most subscriptions of one client. Ours: some of each channel of some vehicles.
const SUBSCRIPTIONS_MAX: usize = 256;

/// Serves the WebSocket until `stop` resolves.
pub async fn serve(listener: Listener, vehicles: Vehicles, stop: impl Future<Output = ()>) {
    let published = Arc::new(watch::Sender::new(0));
    let (mut vehicles_channels, mut tasks) = (Vec::new(), JoinSet::new());
    let mut number = 0;
    for served in vehicles.0.iter() {
        let channels = Arc::new(VehicleChannels::new(served, &mut number, published.clone()));
        tasks.spawn({
            let channels = channels.clone();
            async move { channels.run().await }
        });
        vehicles_channels.push(channels);
    }
    let all = All { vehicles: vehicles_channels.into(), published };
    // The tasks end with this function.
    listener.serve(Router::new().route("/", get(connect)).with_state(all), stop).await;
}

/// The channels of all vehicles.
#[derive(Clone)]
struct All {
    vehicles: Arc<[Arc<VehicleChannels>]>,
    /// Changes whenever a channel has a new message.
    published: Arc<watch::Sender<u64>>,
}

/// The kind of a channel's messages.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Kind {
    Layer(&'static str),
    SafePoints,
    Points,
    Transforms,
    Log,
    Plan,
}

/// A message of a channel, without the subscription that it is for.
#[derive(Clone, Debug)]
struct Message {
    sequence: u64,
    log_ns: u64,
    data: Bytes,
}

/// One channel of the server, for all clients.
struct Channel {
    id: u64,
    topic: String,
    kind: Kind,
    newest: watch::Sender<Option<Message>>,
}

impl Channel {
    /// The layer that the channel needs; `None` if it needs none.
    fn layer(&self) -> Option<&'static str> {
        match self.kind {
            Kind::Layer(name) => Some(name),
            Kind::SafePoints => Some(safe_paths::LAYER),
            Kind::Points | Kind::Transforms | Kind::Log | Kind::Plan => None,
        }
    }

    fn schema(&self) -> Option<Schema> {
        match self.kind {
            Kind::Layer(_) => Grid::get_schema(),
            Kind::SafePoints | Kind::Plan => SceneUpdate::get_schema(),
            Kind::Points => PointCloud::get_schema(),
            Kind::Transforms => FrameTransforms::get_schema(),
            Kind::Log => Log::get_schema(),
        }
    }

    fn advertisement(&self) -> Value {
        let schema = self.schema().unwrap_or_else(|| Schema::new("", "", Vec::new()));
        json!({
            "id": self.id, "topic": self.topic, "encoding": "protobuf",
            "schemaName": schema.name, "schemaEncoding": schema.encoding,
            "schema": BASE64_STANDARD.encode(&schema.data),
        })
    }

    /// True if a client waits for a message of this map.
    fn lacks(&self, map: &EncodedMap) -> bool {
        let is_old = |message: &Message| message.sequence != map.sequence || message.log_ns != log_ns(map);
        self.newest.receiver_count() > 0 && self.newest.borrow().as_ref().is_none_or(is_old)
    }

    fn publish<T: Encode>(&self, map: &EncodedMap, message: &T) {
        self.put(map.sequence, log_ns(map), message);
    }

    fn put<T: Encode>(&self, sequence: u64, log_ns: u64, message: &T) {
        let mut data = BytesMut::with_capacity(message.encoded_len().unwrap_or(1024));
        match message.encode(&mut data) {
            Ok(()) => {
                self.newest.send_replace(Some(Message { sequence, log_ns, data: data.freeze() }));
            }
            Err(error) => tracing::error!(%error, topic = self.topic, "foxglove: a message cannot be encoded"),
        }
    }
}

fn log_ns(map: &EncodedMap) -> u64 {
    u64::try_from(map.capture_end_ns).unwrap_or(0)
}

/// One vehicle's channels.
struct VehicleChannels {
    served: Served,
    channels: Vec<Channel>,
    subscribed: Notify,
    published: Arc<watch::Sender<u64>>,
}

impl VehicleChannels {
    fn new(served: &Served, number: &mut u64, published: Arc<watch::Sender<u64>>) -> Self {
        let vehicle = &served.status.name;
        let (of, layers) = (|name: &str| format!("/{vehicle}/{name}"), &served.status.layers);
        let mut kinds: Vec<_> = layers.iter().map(|&name| (of(&format!("map/{name}")), Kind::Layer(name))).collect();
        kinds.extend(layers.contains(&safe_paths::LAYER).then(|| (of("safe_points"), Kind::SafePoints)));
        let others = [("plan", Kind::Plan), ("log", Kind::Log), ("points", Kind::Points)];
        kinds.extend(others.map(|(name, kind)| (of(name), kind)));
        kinds.push(("/tf".to_owned(), Kind::Transforms));
        let channel = |(topic, kind)| {
            *number += 1;
            Channel { id: *number, topic, kind, newest: watch::Sender::new(None) }
        };
        let channels = kinds.into_iter().map(channel).collect();
        Self { served: served.clone(), channels, subscribed: Notify::new(), published }
    }

    /// Publishes a line of the log, after all maps so far.
    fn log(&self, text: &str) {
        let now_ns = now_ns();
        self.put(Kind::Log, now_ns, &messages::log(now_ns, &self.served.status.name, text));
    }

    /// Publishes a message that belongs to no map.
    fn put<T: Encode>(&self, kind: Kind, log_ns: i64, message: &T) {
        let channels = self.channels.iter().filter(|channel| channel.kind == kind);
        channels.for_each(|channel| channel.put(0, u64::try_from(log_ns).unwrap_or(0), message));
        self.published.send_modify(|count| *count += 1);
    }

    /// Encodes each newest map for the channels that have subscriptions, and the current one for new subscriptions.
    async fn run(&self) {
        let mut newest = self.served.newest.clone();
        let mut rasters = Rasters::default();
        let mut sweeps = None;
        newest.mark_changed();
        let mut plans = self.served.wires.plans.subscribe();
        let mut replay_ended = self.served.wires.replay_ended.subscribe();
        // What is so from the beginning is no change.
        let mut reported = false;
        loop {
            let ended = *replay_ended.borrow_and_update();
            if ended != reported && !newest.has_changed().unwrap_or(false) {
                reported = ended;
                self.log(if ended { "the replay has ended" } else { "the replay was set back" });
            }
            tokio::select! {
                biased;
                changed = newest.changed() => if changed.is_err() {
                    // The engine has stopped; new subscriptions still get its last map.
                    self.subscribed.notified().await;
                },
                () = self.subscribed.notified() => {}
                Ok(()) = replay_ended.changed() => continue,
                Ok(()) = plans.changed() => {
                    if let Some(plan) = plans.borrow_and_update().clone() {
                        self.put(Kind::Plan, plan.stamp_ns, &messages::plan(&self.served.status.name, &plan));
                    }
                    continue;
                }
            }
            let has_points = |channel: &Channel| channel.kind == Kind::Points && channel.newest.receiver_count() > 0;
            match self.channels.iter().any(has_points) {
                true => _ = sweeps.get_or_insert_with(|| self.served.wires.sweeps.subscribe()),
                false => sweeps = None,
            }
            let map = newest.borrow_and_update().clone();
            let Some(map) = map else { continue };
            let sweep = sweeps.as_ref().and_then(|sweeps| sweeps.borrow().clone());
            let lacking: Vec<_> = self.channels.iter().filter(|channel| channel.lacks(&map)).collect();
            let trace = || self.served.status.traces.hop(&map, "send", Some(Transport::Foxglove.as_str()));
            let _hop = (!lacking.is_empty()).then(trace);
            lacking.into_iter().for_each(|channel| publish(channel, &map, &sweep, &mut rasters));
            self.published.send_modify(|count| *count += 1);
        }
    }
}

/// Encodes a map for a channel, if it has what the channel carries.
fn publish(channel: &Channel, map: &EncodedMap, sweep: &NewestSweep, rasters: &mut Rasters) {
    match channel.kind {
        Kind::Layer(_) | Kind::SafePoints => {
            let name = channel.layer().unwrap_or_default();
            let chunk = map.layers.iter().find(|(of, _)| *of == name);
            let Some(view) = chunk.and_then(|(_, chunk)| view(map, map.layer(chunk))) else { return };
            let Some(layer) = view.layers().first() else { return };
            match channel.kind {
                Kind::SafePoints => channel.publish(map, &messages::safe_paths(&view, layer)),
                _ => channel.publish(map, &messages::grid(&view, layer, rasters.of(layer))),
            }
        }
        Kind::Transforms => {
            if let Some(transforms) = view(map, map.header.clone()).and_then(|view| messages::transforms(&view)) {
                channel.publish(map, &transforms);
            }
        }
        // They have no map.
        Kind::Log | Kind::Plan => {}
        Kind::Points => {
            if let Some(sweep) = sweep.as_ref().filter(|sweep| sweep.0 == map.capture_end_ns) {
                let sweep = &sweep.1;
                let points = (0..sweep.x.len()).map(|i| [sweep.x[i], sweep.y[i], sweep.z[i]]);
                channel.publish(map, &messages::points(map.capture_end_ns, &base_frame(&map.vehicle), points));
            }
        }
    }
}

async fn connect(
    State(all): State<All>,
    Extension(caller): Extension<Caller>,
    Extension(call): Extension<Arc<CallPermit>>,
    upgrade: WebSocketUpgrade,
) -> Response {
    let upgrade = upgrade.protocols([PROTOCOL]).max_message_size(MESSAGE_BYTES_MAX).max_frame_size(MESSAGE_BYTES_MAX);
    let upgrade = upgrade.read_buffer_size(READ_BUFFER_BYTES);
    if upgrade.selected_protocol().is_none() {
        return (StatusCode::BAD_REQUEST, format!("the protocol {PROTOCOL} is needed\n")).into_response();
    }
    upgrade.on_upgrade(move |socket| async move {
        let mut published = all.published.subscribe();
        published.mark_changed();
        let client = FoxgloveClient { all, caller, subscriptions: BTreeMap::new() };
        call.slot.closing.run_until_cancelled(client.run(socket, published, &call.slot)).await;
    })
}

/// One connected client.
struct FoxgloveClient {
    all: All,
    caller: Caller,
    subscriptions: BTreeMap<u32, Subscription>,
}

/// One client's subscription to one channel.
struct Subscription {
    newest: watch::Receiver<Option<Message>>,
    /// Keeps the channel's layer active.
    layer: Option<LayerSubscription>,
    reader: Reader,
}

/// A client's request, as JSON.
#[derive(Deserialize)]
#[serde(tag = "op", rename_all = "camelCase")]
enum FoxgloveRequest {
    Subscribe {
        subscriptions: Vec<Wanted>,
    },
    #[serde(rename_all = "camelCase")]
    Unsubscribe {
        subscription_ids: Vec<u32>,
    },
}

/// A subscription that a client asks for.
#[derive(Clone, Copy, Deserialize)]
#[serde(rename_all = "camelCase")]
struct Wanted {
    id: u32,
    channel_id: u64,
}

impl FoxgloveClient {
    /// Sends what the client subscribes to until it disconnects or stalls.
    async fn run(mut self, mut socket: WebSocket, mut published: watch::Receiver<u64>, slot: &ConnectionSlot) {
        let channels = self.channels().map(|(_, channel)| channel.advertisement());
        let advertise = json!({ "op": "advertise", "channels": channels.collect::<Vec<_>>() });
        let info = json!({ "op": "serverInfo", "name": "clearway", "capabilities": [] });
        for text in [info, advertise] {
            if !send(&mut socket, WsMessage::Text(text.to_string().into())).await {
                return;
            }
        }
        let mut frames = TokenBucket::new(FRAMES_MAX, FRAMES_PER_SECOND);
        loop {
            let answer = tokio::select! {
                changed = published.changed() => {
                    let Ok(()) = changed else { return };
                    None
                }
                received = socket.recv() => match received {
                    Some(Ok(_)) if !frames.take() => return slot.close("flood"),
                    Some(Ok(WsMessage::Text(text))) => self.apply(&text).err(),
                    // The library answers pings, and other messages have no meaning here.
                    Some(Ok(_)) => continue,
                    Some(Err(_)) | None => return,
                },
            };
            let status = answer.map(|text| json!({ "op": "status", "level": 2, "message": text }));
            if let Some(status) = status
                && !send(&mut socket, WsMessage::Text(status.to_string().into())).await
            {
                return;
            }
            let mut last = None;
            while let Some((id, frame)) = next_due(&mut self.subscriptions, last) {
                last = Some(id);
                if !send(&mut socket, frame).await {
                    return;
                }
            }
        }
    }

    /// The channels that this client may read.
    fn channels(&self) -> impl Iterator<Item = (&Arc<VehicleChannels>, &Channel)> {
        let all = self.all.vehicles.iter().flat_map(|of| of.channels.iter().map(move |channel| (of, channel)));
        all.filter(|(of, channel)| {
            let vehicle = &of.served.status.name;
            channel.layer().map_or_else(
                // Points and transforms are of the whole vehicle.
                || of.served.status.layers.iter().all(|layer| self.caller.may_read(vehicle, layer)),
                |layer| self.caller.may_read(vehicle, layer),
            )
        })
    }

    /// # Errors
    /// A text that says what of a request cannot be done.
    fn apply(&mut self, text: &str) -> Result<(), String> {
        let request: FoxgloveRequest = serde_json::from_str(text).map_err(|error| error.to_string())?;
        match request {
            FoxgloveRequest::Unsubscribe { subscription_ids } => {
                subscription_ids.iter().for_each(|id| _ = self.subscriptions.remove(id));
            }
            FoxgloveRequest::Subscribe { subscriptions } => {
                for Wanted { id, channel_id } in subscriptions {
                    if self.subscriptions.len() >= SUBSCRIPTIONS_MAX {
                        return Err(format!("subscription {id}: at most {SUBSCRIPTIONS_MAX} are allowed"));
                    }
                    let found = self.channels().find(|(_, channel)| channel.id == channel_id);
                    let (of, channel) = found.ok_or_else(|| format!("channel {channel_id} is not known"))?;
                    let layer = channel.layer().map(|layer| of.served.wires.subscriptions.subscribe(&[layer.into()]));
                    let mut newest = channel.newest.subscribe();
                    newest.mark_changed();
                    of.subscribed.notify_one();
                    let reader = Reader::new(&of.served.status.transports, Transport::Foxglove);
                    self.subscriptions.insert(id, Subscription { newest, layer, reader });
                }
            }
        }
        Ok(())
    }
}

/// The first subscription after `last` (all, if there is none) that has a new message, and its frame. One frame is made
/// at a time: frames of many subscriptions that a client does not read would be many times the message.
fn next_due(subscriptions: &mut BTreeMap<u32, Subscription>, last: Option<u32>) -> Option<(u32, WsMessage)> {
    let after = (last.map_or(Bound::Unbounded, Bound::Excluded), Bound::Unbounded);
    let mut changed = subscriptions.range_mut(after).filter(|(_, of)| of.newest.has_changed().unwrap_or(false));
    changed.find_map(|(&id, of)| {
        let message = of.newest.borrow_and_update().clone()?;
        // Points and poses are not in every map.
        if of.layer.is_some() {
            of.reader.got(0, message.sequence);
        }
        let mut frame = BytesMut::with_capacity(13 + message.data.len());
        frame.put_u8(1);
        frame.put_u32_le(id);
        frame.put_u64_le(message.log_ns);
        frame.extend_from_slice(&message.data);
        Some((id, WsMessage::Binary(frame.freeze())))
    })
}

/// `false` if the client is gone, or does not receive.
async fn send(socket: &mut WebSocket, frame: WsMessage) -> bool {
    matches!(tokio::time::timeout(SEND_TIMEOUT, socket.send(frame)).await, Ok(Ok(())))
}

#[cfg(test)]
mod tests {
    use bytes::Buf;

    use super::*;

    #[test]
    fn the_frame_of_a_subscription_is_made_when_the_one_before_it_was_sent() {
        let message = |sequence| Some(Message { sequence, log_ns: sequence, data: Bytes::from_static(b"points") });
        let channel = watch::Sender::new(message(1));
        let readers = Arc::default();
        let mut subscriptions: BTreeMap<_, _> = (5..=7)
            .map(|id| {
                let mut newest = channel.subscribe();
                newest.mark_changed();
                (id, Subscription { newest, layer: None, reader: Reader::new(&readers, Transport::Foxglove) })
            })
            .collect();
        let mut next = |last| {
            let (id, frame) = next_due(&mut subscriptions, last)?;
            Some((id, frame.into_data().slice(5..13).get_u64_le()))
        };
        assert_eq!(next(None), Some((5, 1)));
        channel.send_replace(message(2));
        assert_eq!([next(Some(5)), next(Some(6)), next(Some(7))], [Some((6, 2)), Some((7, 2)), None]);
        assert_eq!([next(None), next(Some(5))], [Some((5, 2)), None]);
    }
}
