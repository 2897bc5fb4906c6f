//! The HTTP server of the page: its embedded files, what the classes say (`/classes.json`), its WebSocket `/live`
//! ([`super::page_live`]), `/vehicles`, a vehicle's last ten minutes (`/history?vehicle=NAME`), `/healthz`, `/readyz`
//! and `/metrics`. The last three are also served alone, on a listener of their own.

use std::sync::{Arc, LazyLock};
use std::time::Instant;

use axum::Router;
use axum::extract::ws::WebSocketUpgrade;
use axum::extract::{Extension, Query, State};
use axum::http::{StatusCode, Uri, header};
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use rust_embed::RustEmbed;
use serde::Deserialize;
use serde_json::{Map, Value, json};

use super::listen::access::Caller;
use super::listen::{CallPermit, Listener, ListenerHandle, READ_BUFFER_BYTES};
pub use super::page_live::Summaries;
use super::page_live::{Live, MESSAGE_BYTES_MAX};
use super::page_recorder::PageRecorder;
use super::page_replay::PageReplay;
use super::served::Vehicles;
use crate::fleet::Fleet;
use crate::record::writer::RecorderControl;
use crate::replay_control::ReplayHandle;
use crate::status::{CONTENT_TYPE, prometheus, vehicle_json};

#[derive(RustEmbed)]
#[folder = "../web/"]
struct Assets;

/// The decoder, which is a package of its own. `../web/wire` links to it, for the tests in Node; a link that leads
/// out of a folder is not followed here.
#[derive(RustEmbed)]
#[folder = "../../client/web/src/"]
#[prefix = "wire/"]
struct Decoder;

/// The document with a table of the meanings.
const MEANINGS: &str = include_str!("../../../../client/guide/planner.md");

/// JSON: `layers`, what each class of each layer says, and `meanings`, what a planner may do by each meaning.
static CLASSES: LazyLock<String> = LazyLock::new(|| {
    let classes = |document: &str| -> Map<String, Value> {
        let says = |row: Vec<&str>| Some((row.first()?.replace('`', ""), (*row.last()?).into()));
        rows(document, "| class |").filter_map(says).collect()
    };
    let of_layer = |(name, document): &(&str, &str)| ((*name).to_owned(), classes(document).into());
    let layers: Map<String, Value> = clearway_mapping::layer::PAGES.iter().map(of_layer).collect();
    let may = |row: Vec<&str>| Some(((*row.first()?).to_owned(), (*row.get(1)?).into()));
    let meanings: Map<String, Value> = rows(MEANINGS, "| meaning |").filter_map(may).collect();
    json!({ "layers": layers, "meanings": meanings }).to_string()
});

/// The cells of each row of the first table in a document whose header begins so.
fn rows<'a>(document: &'a str, header: &'a str) -> impl Iterator<Item = Vec<&'a str>> {
    let table = document.lines().skip_while(move |line| !line.starts_with(header)).skip(2);
    let cells = |line: &'a str| line.trim_matches('|').split('|').map(str::trim).collect();
    table.take_while(|line| line.starts_with('|')).map(cells)
}

/// What is served: the vehicles, the counts of the listeners by name, and the replay if there is one.
#[derive(Clone)]
pub struct Shown {
    /// The vehicles of this server.
    pub vehicles: Vehicles,
    /// The vehicles of other servers.
    pub fleet: Fleet,
    /// The TCP listeners, each with its name.
    pub listeners: Arc<[(&'static str, ListenerHandle)]>,
    /// Controls the replay that the server serves.
    pub replay: Option<ReplayHandle>,
    /// Controls the recorder, if the server records.
    pub recorder: Option<RecorderControl>,
    /// What all browsers share of the vehicles' status.
    pub summaries: Summaries,
}

/// Serves the page until `stop` resolves.
pub async fn serve(listener: Listener, shown: Shown, stop: impl Future<Output = ()>) {
    let router = metrics_routes().route("/live", get(live)).route("/vehicles", get(list));
    let router = router.route("/classes.json", get(classes)).route("/history", get(history)).fallback(asset);
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
    match Assets::get(path).or_else(|| Decoder::get(path)).filter(|_| is_asset) {
        Some(file) => {
            let kind = file.metadata.mimetype().to_owned();
            let headers = [(header::CONTENT_TYPE, kind), (header::CACHE_CONTROL, "no-cache".to_owned())];
            (headers, file.data.into_owned()).into_response()
        }
        None => (StatusCode::NOT_FOUND, format!("nothing at {}\n", uri.path())).into_response(),
    }
}

async fn classes() -> impl IntoResponse {
    ([(header::CONTENT_TYPE, "application/json"), (header::CACHE_CONTROL, "no-cache")], CLASSES.as_str())
}

async fn list(State(shown): State<Shown>, Extension(caller): Extension<Caller>) -> impl IntoResponse {
    let statuses = shown.vehicles.statuses();
    let own = statuses.iter().filter(|status| caller.may_reach(&status.name)).map(|status| status.to_json());
    let mut others = shown.fleet.vehicles(Instant::now());
    others.retain(|vehicle| caller.may_reach(&vehicle.name));
    let all = own.chain(others.iter().map(vehicle_json));
    ([(header::CONTENT_TYPE, "application/json")], Value::from(all.collect::<Vec<_>>()).to_string())
}

/// Whose history is asked for.
#[derive(Deserialize)]
struct HistoryOf {
    #[serde(default)]
    vehicle: String,
}

async fn history(
    State(shown): State<Shown>,
    Extension(caller): Extension<Caller>,
    Query(HistoryOf { vehicle }): Query<HistoryOf>,
) -> Response {
    let statuses = shown.vehicles.statuses();
    match statuses.iter().find(|status| *status.name == *vehicle && caller.may_reach(&vehicle)) {
        Some(status) => ([(header::CONTENT_TYPE, "application/json")], status.history_json()).into_response(),
        None => {
            (StatusCode::NOT_FOUND, format!("no vehicle is named {vehicle:?}, or you may not see it\n")).into_response()
        }
    }
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

/// Ready: the state of at least one vehicle is no error. A line follows for each vehicle in error that the caller may
/// reach, with its worst reason.
async fn ready(State(shown): State<Shown>, Extension(caller): Extension<Caller>) -> Response {
    match shown.vehicles.readiness(&caller) {
        (true, lines) => format!("ready\n{lines}").into_response(),
        (false, lines) => unavailable(format!("not ready\n{lines}")),
    }
}

fn unavailable(text: String) -> Response {
    (StatusCode::SERVICE_UNAVAILABLE, text).into_response()
}

async fn metrics(State(shown): State<Shown>, Extension(caller): Extension<Caller>) -> impl IntoResponse {
    let mut statuses = shown.vehicles.statuses();
    statuses.retain(|status| caller.may_reach(&status.name));
    let listeners: Vec<_> = shown.listeners.iter().map(|(name, listener)| (*name, listener.counts())).collect();
    ([(header::CONTENT_TYPE, CONTENT_TYPE)], prometheus(&statuses, &listeners, &shown.fleet))
}

/// The WebSocket of all vehicles that the caller may reach.
async fn live(
    State(shown): State<Shown>,
    Extension(caller): Extension<Caller>,
    Extension(call): Extension<Arc<CallPermit>>,
    upgrade: WebSocketUpgrade,
) -> Response {
    let recorder = shown.recorder.and_then(|control| PageRecorder::new(control, &caller));
    let replay = shown.replay.and_then(|handle| PageReplay::new(handle, &caller));
    let live = Live::new(&shown.vehicles, shown.fleet, shown.summaries, caller, replay, recorder);
    let upgrade = upgrade.max_message_size(MESSAGE_BYTES_MAX).max_frame_size(MESSAGE_BYTES_MAX);
    let upgrade = upgrade.read_buffer_size(READ_BUFFER_BYTES);
    upgrade.on_upgrade(async move |socket| {
        call.slot.closing.run_until_cancelled(live.serve(socket, &call.slot)).await;
    })
}

#[cfg(test)]
mod tests {
    use clearway_mapping::layer::ClassInfo;
    use clearway_mapping::layer::drivability::class::DrivabilityClass;
    use clearway_mapping::layer::freespace::class::FreespaceClass;
    use clearway_mapping::layer::height_difference::class::HeightDifferenceClass;
    use clearway_mapping::layer::occupancy::class::OccupancyClass;
    use clearway_mapping::layer::safe_path::class::SafePathClass;
    use clearway_mapping::layer::speed::class::SpeedClass;
    use clearway_mapping::layer::terrain::class::TerrainClass;

    use super::*;

    #[test]
    fn the_page_has_words_for_every_class_and_every_meaning() {
        let classes: Value = serde_json::from_str(&CLASSES).unwrap();
        let legends: [(&str, &[ClassInfo]); 7] = [
            ("drivability", DrivabilityClass::LEGEND),
            ("height_difference", HeightDifferenceClass::LEGEND),
            ("terrain", TerrainClass::LEGEND),
            ("occupancy", OccupancyClass::LEGEND),
            ("speed", SpeedClass::LEGEND),
            ("safe_path", SafePathClass::LEGEND),
            ("freespace", FreespaceClass::LEGEND),
        ];
        for (layer, legend) in legends {
            let said = classes["layers"][layer].as_object().unwrap();
            let names: Vec<_> = legend.iter().map(|class| class.name).collect();
            assert!(names.iter().all(|name| said[*name].as_str().unwrap().ends_with('.')), "{layer}: {said:?}");
            assert_eq!(said.len(), names.len(), "{layer}: {said:?}");
        }
        let meanings = classes["meanings"].as_object().unwrap();
        assert_eq!(meanings["not reached"], "not drive there: it is ground, but no way to it was found");
        assert_eq!(meanings.len(), 7);
    }
}
