//! The HTTP server of the page: its embedded files, its WebSocket `/live?vehicle=V`, `/vehicles`, `/healthz`, `/readyz`
//! and `/metrics`. The last three are also served alone, on a listener of their own.
//!
//! The WebSocket sends each newest map as a binary `clearway.v1.MapUpdate` with all layers, and the status once a
//! second as a JSON text. Over a replay it also sends its state as a JSON text (`type`: `replay`) at each change, and
//! takes requests of operators. A browser that reads nothing for [`SEND_TIMEOUT`] is disconnected.

use std::sync::Arc;
use std::time::{Duration, Instant};

use axum::Router;
use axum::extract::ws::{Message as Frame, WebSocket, WebSocketUpgrade};
use axum::extract::{Extension, Query, State};
use axum::http::{StatusCode, Uri, header};
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use bytes::Bytes;
use clearway_proto::v1;
use prost::Message;
use rust_embed::RustEmbed;
use serde_json::Value;
use tokio::sync::watch;

use super::listen::access::Caller;
use super::listen::{InProgress, Listener, ListenerHandle, Place};
use super::page_replay::{PageReplay, replay_changed, replay_json};
use super::served::{Served, Vehicles};
use crate::clock::now_ns;
use crate::fleet::Fleet;
use crate::replay::ReplayHandle;
use crate::status::{Reader, prometheus, vehicle_json};

/// Longest time to send a frame. Ours: a browser this late shows a stale map anyway, and reconnects by itself.
const SEND_TIMEOUT: Duration = Duration::from_secs(5);
/// Time between two status messages.
const STATUS_PERIOD: Duration = Duration::from_secs(1);
/// Longest message from a browser, in bytes. Ours: the page sends pongs and short requests.
const MESSAGE_BYTES_MAX: usize = 4096;

#[derive(RustEmbed)]
#[folder = "web/"]
struct Assets;

/// What is served: the vehicles, the counts of the listeners by name, and the replay if there is one.
#[derive(Clone)]
pub struct Shown {
    /// The vehicles.
    pub vehicles: Vehicles,
    /// The vehicles of other servers.
    pub fleet: Fleet,
    /// The listeners.
    pub listeners: Arc<[(&'static str, ListenerHandle)]>,
    /// Controls the replay that the server serves.
    pub replay: Option<ReplayHandle>,
}

/// Serves the page until `stop` resolves.
pub async fn serve(listener: Listener, shown: Shown, stop: impl Future<Output = ()>) {
    let router = metrics_routes().route("/live", get(live)).route("/vehicles", get(list)).fallback(asset);
    listener.serve(router.with_state(shown), stop).await;
}

/// Serves `/healthz`, `/readyz` and `/metrics` alone until `stop` resolves.
pub async fn serve_metrics(listener: Listener, shown: Shown, stop: impl Future<Output = ()>) {
    listener.serve(metrics_routes().with_state(shown), stop).await;
}

fn metrics_routes() -> Router<Shown> {
    Router::new().route("/healthz", get(health)).route("/readyz", get(ready)).route("/metrics", get(metrics))
}

async fn asset(uri: Uri) -> Response {
    let path = uri.path().trim_start_matches('/');
    let path = if path.is_empty() { "index.html" } else { path };
    // The page's tests lie beside its files and are not served.
    let is_asset = !path.ends_with(".mjs") && !path.ends_with(".json");
    match Assets::get(path).filter(|_| is_asset) {
        Some(file) => {
            let kind = file.metadata.mimetype().to_owned();
            let headers = [(header::CONTENT_TYPE, kind), (header::CACHE_CONTROL, "no-cache".to_owned())];
            (headers, file.data.into_owned()).into_response()
        }
        None => (StatusCode::NOT_FOUND, format!("nothing at {}\n", uri.path())).into_response(),
    }
}

async fn list(State(shown): State<Shown>, Extension(caller): Extension<Caller>) -> impl IntoResponse {
    let statuses = shown.vehicles.statuses();
    let own = statuses.iter().filter(|status| caller.may_reach(&status.name)).map(|status| status.to_json());
    let mut others = shown.fleet.vehicles(Instant::now());
    others.retain(|vehicle| caller.may_reach(&vehicle.name));
    let all = own.chain(others.iter().map(vehicle_json));
    ([(header::CONTENT_TYPE, "application/json")], Value::from(all.collect::<Vec<_>>()).to_string())
}

async fn health(State(shown): State<Shown>) -> Response {
    let statuses = shown.vehicles.statuses();
    match statuses.iter().find_map(|status| status.fault()) {
        // The maps are served, so a supervisor must not end the server.
        None => match statuses.iter().find_map(|status| status.recorder_problem()) {
            None => "ok\n".into_response(),
            Some(problem) => format!("degraded\nrecorder: {problem}\n").into_response(),
        },
        Some(fault) => unavailable(fault + "\n"),
    }
}

/// Ready: every vehicle is alive and has a map.
async fn ready(State(shown): State<Shown>) -> Response {
    match shown.vehicles.0.iter().find(|served| !served.status.is_alive() || served.newest.borrow().is_none()) {
        None => "ready\n".into_response(),
        Some(served) => unavailable(format!("vehicle {} has no map\n", served.status.name)),
    }
}

fn unavailable(text: String) -> Response {
    (StatusCode::SERVICE_UNAVAILABLE, text).into_response()
}

async fn metrics(State(shown): State<Shown>, Extension(caller): Extension<Caller>) -> impl IntoResponse {
    let kind = [(header::CONTENT_TYPE, "text/plain; version=0.0.4; charset=utf-8")];
    let mut statuses = shown.vehicles.statuses();
    statuses.retain(|status| caller.may_reach(&status.name));
    let listeners: Vec<_> = shown.listeners.iter().map(|(name, listener)| (*name, listener.counts())).collect();
    (kind, prometheus(&statuses, &listeners))
}

#[derive(serde::Deserialize)]
struct LiveQuery {
    #[serde(default)]
    vehicle: String,
}

async fn live(
    State(shown): State<Shown>,
    Extension(caller): Extension<Caller>,
    Extension(place): Extension<Arc<Place>>,
    Query(query): Query<LiveQuery>,
    upgrade: WebSocketUpgrade,
) -> Response {
    let served = match shown.vehicles.find(&query.vehicle) {
        Ok(served) => served.clone(),
        Err(unknown) => return (StatusCode::NOT_FOUND, format!("{unknown}\n")).into_response(),
    };
    match caller.layers(&served.status.name, Vec::new(), &served.status.layers) {
        Ok(layers) => {
            let replay = shown.replay.and_then(|handle| PageReplay::new(handle, &caller));
            let in_progress = place.begin_request();
            let upgrade = upgrade.max_message_size(MESSAGE_BYTES_MAX);
            upgrade.on_upgrade(move |socket| stream(socket, served, layers, replay, in_progress))
        }
        Err(denied) => (StatusCode::FORBIDDEN, format!("{}\n", denied.message())).into_response(),
    }
}

/// Sends maps and status until the browser disconnects or stalls, or the engine stops.
async fn stream(
    mut socket: WebSocket,
    served: Served,
    layers: Vec<String>,
    replay: Option<PageReplay>,
    _in_progress: InProgress,
) {
    let _reader = Reader::new(&served.status.page_readers);
    let subscription = served.status.subscriptions.subscribe(&layers);
    let mut newest = served.newest.clone();
    newest.mark_changed();
    let mut every = tokio::time::interval(STATUS_PERIOD);
    let mut replay_state = replay.as_ref().map(|replay| replay.handle.state());
    replay_state.iter_mut().for_each(watch::Receiver::mark_changed);
    let mut last_sequence = None;
    loop {
        let frame = tokio::select! {
            changed = newest.changed() => {
                let Ok(()) = changed else { break };
                let map = newest.borrow_and_update().clone();
                let Some(map) = map.filter(|map| subscription.is_covered_by(map)) else { continue };
                let last = last_sequence.filter(|(boot_id, _)| *boot_id == map.boot_id);
                let skipped = last.map_or(0, |(_, last): (u64, u64)| map.sequence.saturating_sub(last + 1));
                last_sequence = Some((map.boot_id, map.sequence));
                let update = v1::MapUpdate {
                    map: map.select(&layers), skipped, sent_ns: now_ns(), ..Default::default()
                };
                Frame::Binary(Bytes::from(update.encode_to_vec()))
            }
            _ = every.tick() => {
                let mut status = served.status.to_json();
                status["type"] = "status".into();
                Frame::Text(status.to_string().into())
            }
            state = replay_changed(&mut replay_state) => Frame::Text(replay_json(&state, "").into()),
            received = socket.recv() => match received {
                Some(Ok(Frame::Text(text))) => match &replay {
                    Some(replay) => Frame::Text(replay.answer(&text).await.into()),
                    // Other messages of the page have no meaning; the library answers pings.
                    None => continue,
                },
                Some(Ok(_)) => continue,
                Some(Err(_)) | None => break,
            },
        };
        match tokio::time::timeout(SEND_TIMEOUT, socket.send(frame)).await {
            Ok(Ok(())) => {}
            Ok(Err(_)) | Err(_) => break,
        }
    }
}
