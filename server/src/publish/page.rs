//! The HTTP server of the page: its embedded files, its WebSocket `/live?vehicle=V`, `/vehicles`, `/healthz` and
//! `/metrics`.
//!
//! The WebSocket sends each newest map as a binary `clearway.v1.MapUpdate` with all layers, and the status once a
//! second as a JSON text. Over a replay it also sends its state as a JSON text (`type`: `replay`) at each change, and
//! takes requests from pages of its own address. A browser that reads nothing for [`SEND_TIMEOUT`] is disconnected.

use std::time::Duration;

use axum::extract::ws::{Message as Frame, WebSocket, WebSocketUpgrade};
use axum::extract::{Query, State};
use axum::http::{HeaderMap, StatusCode, Uri, header};
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use axum::{Extension, Router};
use bytes::Bytes;
use clearway_proto::v1;
use prost::Message;
use rust_embed::RustEmbed;
use serde_json::Value;
use tokio::net::TcpListener;
use tokio::sync::watch;

use super::connections::Connections;
use super::page_replay::{PageReplay, is_same_origin, replay_changed, replay_json};
use super::served::{Served, Vehicles};
use crate::clock::now_ns;
use crate::replay::ReplayHandle;
use crate::status::{Reader, prometheus};

/// Longest time to send a frame. Ours: a browser this late shows a stale map anyway, and reconnects by itself.
const SEND_TIMEOUT: Duration = Duration::from_secs(5);
/// Time between two status messages.
const STATUS_PERIOD: Duration = Duration::from_secs(1);
/// Most connections. Ours: some dozens of browsers with a few connections each.
const CONNECTIONS_MAX: usize = 256;
/// Longest message from a browser, in bytes. Ours: the page sends only pongs.
const MESSAGE_BYTES_MAX: usize = 4096;

#[derive(RustEmbed)]
#[folder = "web/"]
struct Assets;

/// Serves the page until `stop` resolves.
///
/// # Errors
/// [`std::io::Error`] if the server cannot run.
pub async fn serve(
    listener: TcpListener,
    vehicles: Vehicles,
    replay: Option<ReplayHandle>,
    stop: impl Future<Output = ()> + Send + 'static,
) -> std::io::Result<()> {
    let router = Router::new()
        .route("/live", get(live))
        .route("/vehicles", get(list))
        .route("/healthz", get(health))
        .route("/metrics", get(metrics))
        .fallback(asset)
        .layer(Extension(replay))
        .with_state(vehicles);
    axum::serve(Connections::new(listener, CONNECTIONS_MAX), router).with_graceful_shutdown(stop).await
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

async fn list(State(vehicles): State<Vehicles>) -> impl IntoResponse {
    let all: Vec<Value> = vehicles.statuses().iter().map(|status| status.to_json()).collect();
    ([(header::CONTENT_TYPE, "application/json")], Value::from(all).to_string())
}

async fn health(State(vehicles): State<Vehicles>) -> Response {
    match vehicles.statuses().iter().find(|status| !status.is_alive()) {
        None => "ok\n".into_response(),
        Some(dead) => {
            let text = format!("the engine of vehicle {} has stopped\n", dead.name);
            (StatusCode::SERVICE_UNAVAILABLE, text).into_response()
        }
    }
}

async fn metrics(State(vehicles): State<Vehicles>) -> impl IntoResponse {
    let kind = [(header::CONTENT_TYPE, "text/plain; version=0.0.4; charset=utf-8")];
    (kind, prometheus(&vehicles.statuses()))
}

#[derive(serde::Deserialize)]
struct LiveQuery {
    #[serde(default)]
    vehicle: String,
}

async fn live(
    State(vehicles): State<Vehicles>,
    Extension(replay): Extension<Option<ReplayHandle>>,
    Query(query): Query<LiveQuery>,
    headers: HeaderMap,
    upgrade: WebSocketUpgrade,
) -> Response {
    match vehicles.find(&query.vehicle) {
        Ok(served) => {
            let served = served.clone();
            let replay = replay.map(|handle| PageReplay { may_control: is_same_origin(&headers), handle });
            upgrade.max_message_size(MESSAGE_BYTES_MAX).on_upgrade(move |socket| stream(socket, served, replay))
        }
        Err(unknown) => (StatusCode::NOT_FOUND, format!("{unknown}\n")).into_response(),
    }
}

/// Sends maps and status until the browser disconnects or stalls, or the engine stops.
async fn stream(mut socket: WebSocket, served: Served, replay: Option<PageReplay>) {
    let _reader = Reader::new(&served.status.page_readers);
    let subscription = served.status.subscriptions.subscribe(&[]);
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
                    map: map.select(&[]), skipped, sent_ns: now_ns(), ..Default::default()
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
