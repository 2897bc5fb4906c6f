//! The page's WebSocket: one connection of a browser for all vehicles that it shows.
//!
//! | direction | message |
//! |---|---|
//! | from the browser, text | `{"type":"watch","vehicle","id","layers","max_rate_hz","deltas","max_in_flight"}` begins the maps of a vehicle, or replaces the selection |
//! | | `{"type":"acknowledge","vehicle","id","sequence"}`: the map is drawn (`sequence` is a string of digits) |
//! | | `{"type":"keyframe","vehicle","id"}`: the base of a delta is missing |
//! | | `{"type":"unwatch","vehicle"}`; `{"type":"detail","vehicle"}`: whose whole status is wanted |
//! | | `{"type":"replay",...}`: a request of the time bar, of operators |
//! | | `{"type":"points","vehicle","wanted"}`: one frame of points, or no more of them ([`super::page_points`]) |
//! | to the browser, binary | `clearway.v1.MapUpdate`; the header names the vehicle. A frame of points |
//! | to the browser, text | `"watching"` (the maps after it belong to the selection with this `id`), `"refused"` (with `reason`), `"fleet"` (the status of each vehicle, once a second), `"replay"` (at each change), `"points"` (with `reason`: why there are none) |
//!
//! A selection means what it means over gRPC. With `max_in_flight`, no more maps than that are on the way, so a slow
//! link has no backlog.
//!
//! The server sends a ping once a second, and the status with the answer, which a browser gives by itself. While an
//! answer is late nothing else is sent: a peer that does not read costs a ping. A peer that has not answered for
//! [`PONG_TIMEOUT`], or takes no byte for [`SEND_TIMEOUT`], is disconnected.

use std::collections::BTreeMap;
use std::hash::{BuildHasher, RandomState};
use std::pin::Pin;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use axum::extract::ws::{Message as Frame, WebSocket};
use bytes::Bytes;
use clearway_proto::v1;
use futures::Stream;
use futures::channel::mpsc;
use futures::future::BoxFuture;
use futures::stream::FuturesUnordered;
use prost::Message;
use serde::Deserialize;
use serde_json::{Value, json};
use tokio::sync::watch;
use tokio_stream::{StreamExt, StreamMap};
use tonic::{Code, Status};

use super::grpc::reader::watch_from_page;
use super::listen::ConnectionSlot;
use super::listen::access::Caller;
use super::page_points::{PagePoints, next_points};
use super::page_recorder::{PageRecorder, RecorderRequest};
use super::page_replay::{PageReplay, ReplayRequest, replay_changed, replay_json};
use super::served::{Served, Vehicles};
use crate::base::sync::locked;
use crate::base::token_bucket::TokenBucket;
use crate::fleet::Fleet;
use crate::status::vehicle_json;

/// Longest time to send a frame. Ours: a browser this late shows a stale map anyway, and reconnects by itself.
const SEND_TIMEOUT: Duration = Duration::from_secs(5);
/// Longest time until a browser answers a ping. Ours: a link may need seconds for the maps that are on the way.
const PONG_TIMEOUT: Duration = Duration::from_secs(10);
/// Time between two pings, and so between two status messages; an answer that takes longer is late.
const STATUS_PERIOD: Duration = Duration::from_secs(1);
/// Longest message from a browser, in bytes. Ours: the page sends pongs and short requests.
pub(super) const MESSAGE_BYTES_MAX: usize = 4096;
/// Most vehicles whose maps one browser receives. Ours: more maps than a screen shows.
const WATCHES_MAX: usize = 64;
/// Most acknowledgements that wait for one vehicle; more are a fault of the browser.
const REQUESTS_MAX: usize = 64;
/// Most frames of a browser at once, and how many more each second. Ours: 64 vehicles with ten maps a second need 640
/// acknowledgements a second.
const FRAMES_MAX: u32 = 4000;
const FRAMES_PER_SECOND: u32 = 2000;
/// Most requests of the replay and the recorder that wait for their answers. Ours: people press few buttons at once.
const ANSWERS_MAX: usize = 16;
/// Shortest time between two statuses that are sent at once because another vehicle's is wanted. Ours.
const DETAIL_PERIOD: Duration = Duration::from_millis(200);
/// Parts of the status that only the view of one vehicle shows.
const DETAILS: [&str; 4] = ["sensors", "ledger", "observations_refused", "recorder"];

/// A text of a browser.
#[derive(Debug, Deserialize)]
#[serde(tag = "type", rename_all = "snake_case", deny_unknown_fields)]
enum Request {
    Watch(WatchRequest),
    Unwatch { vehicle: String },
    Acknowledge { vehicle: String, id: u64, sequence: String },
    Keyframe { vehicle: String, id: u64 },
    Detail { vehicle: String },
    Points { vehicle: String, wanted: bool },
    Replay(ReplayRequest),
    Recorder(RecorderRequest),
}

#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields, default)]
struct WatchRequest {
    vehicle: String,
    id: u64,
    layers: Vec<String>,
    max_rate_hz: Option<f64>,
    deltas: bool,
    max_in_flight: u32,
}

/// What a browser asked for of one vehicle.
struct Watching {
    id: u64,
    requests: mpsc::Sender<Result<v1::WatchRequest, Status>>,
}

/// The maps of one vehicle on their way to a browser.
type Updates = Pin<Box<dyn Stream<Item = Result<v1::MapUpdate, Status>> + Send>>;

/// Whether the browser reads: the pings it was sent, and its answers.
#[derive(Default)]
struct Pings {
    /// Keys that the browser does not know: it can answer only what it has read.
    keys: RandomState,
    count: u64,
    has_answered: bool,
    /// The ping that is not answered yet: what it says, and since when.
    unanswered: Option<([u8; 8], Instant)>,
}

impl Pings {
    /// True if more may be sent.
    fn allow_more(&self) -> bool {
        self.has_answered && self.unanswered.is_none_or(|(_, since)| since.elapsed() < STATUS_PERIOD)
    }

    /// The next ping, unless one waits for its answer.
    fn next(&mut self) -> Next {
        match self.unanswered {
            Some((_, since)) if since.elapsed() >= PONG_TIMEOUT => Next::End,
            Some(_) => Next::Nothing,
            None => {
                self.count += 1;
                let says = self.keys.hash_one(self.count).to_be_bytes();
                self.unanswered = Some((says, Instant::now()));
                Next::Frame(Frame::Ping(Bytes::copy_from_slice(&says)))
            }
        }
    }

    /// Returns true if this answers the ping that waits.
    fn answer(&mut self, pong: &[u8]) -> bool {
        let is_answer = self.unanswered.take_if(|(says, _)| pong == says).is_some();
        self.has_answered |= is_answer;
        is_answer
    }
}

/// What a connection sends next.
#[derive(Debug)]
enum Next {
    Frame(Frame),
    Nothing,
    End,
}

/// The short status of each vehicle as JSON, by its name and the run of its server, which all browsers share for half a
/// second.
#[derive(Clone, Debug, Default)]
pub struct Summaries(Arc<Mutex<BTreeMap<(String, u64), Summary>>>);

/// When a short status was written, and its text.
type Summary = (Instant, Arc<str>);

impl Summaries {
    fn of(&self, vehicle: &str, boot_id: u64, status: impl FnOnce() -> Value) -> Arc<str> {
        let (mut all, key) = (locked(&self.0), (vehicle.to_owned(), boot_id));
        all.retain(|_, (written, _)| written.elapsed() < STATUS_PERIOD / 2);
        if let Some((_, kept)) = all.get(&key) {
            return kept.clone();
        }
        let mut status = status();
        if let Some(fields) = status.as_object_mut() {
            DETAILS.iter().for_each(|part| _ = fields.remove(*part));
        }
        let summary: Arc<str> = status.to_string().into();
        all.insert(key, (Instant::now(), summary.clone()));
        summary
    }
}

/// One browser's connection.
pub(super) struct Live {
    vehicles: Vec<Served>,
    /// The vehicles of other servers.
    fleet: Fleet,
    summaries: Summaries,
    caller: Caller,
    replay: Option<PageReplay>,
    points: Option<PagePoints>,
    recorder: Option<PageRecorder>,
    /// The answers to requests of the replay and the recorder: a step waits for its maps, which may wait for this
    /// page's acknowledgement, and a disk may hang.
    answers: FuturesUnordered<BoxFuture<'static, String>>,
    /// The vehicle whose whole status is sent.
    detail: String,
    /// When a status was last sent at once, because another vehicle's is wanted.
    detailed: Option<Instant>,
    watching: BTreeMap<String, Watching>,
    /// By vehicle: a new selection ends that before it at once, also while nothing is sent.
    updates: StreamMap<String, Updates>,
}

impl Live {
    /// A connection of all vehicles that the caller may reach.
    pub fn new(
        vehicles: &Vehicles,
        fleet: Fleet,
        summaries: Summaries,
        caller: Caller,
        replay: Option<PageReplay>,
        recorder: Option<PageRecorder>,
    ) -> Self {
        let vehicles = vehicles.0.iter().filter(|served| caller.may_reach(&served.status.name)).cloned().collect();
        Self {
            vehicles,
            fleet,
            summaries,
            caller,
            replay,
            points: None,
            recorder,
            answers: FuturesUnordered::new(),
            detail: String::new(),
            detailed: None,
            watching: BTreeMap::new(),
            updates: StreamMap::new(),
        }
    }

    /// Sends maps and status until the browser disconnects or stalls, or the engines stop.
    pub async fn serve(mut self, mut socket: WebSocket, slot: &ConnectionSlot) {
        let mut frames = TokenBucket::new(FRAMES_MAX, FRAMES_PER_SECOND);
        let mut every = tokio::time::interval(STATUS_PERIOD);
        if let Some(recorder) = &self.recorder
            && socket.send(Frame::Text(recorder.state().into())).await.is_err()
        {
            return;
        }
        let mut replay_state = self.replay.as_ref().map(|replay| replay.handle.state());
        replay_state.iter_mut().for_each(watch::Receiver::mark_changed);
        let mut pings = Pings::default();
        loop {
            let may_send = pings.allow_more();
            let next = tokio::select! {
                Some(update) = self.updates.next(), if may_send && !self.updates.is_empty() => self.send(update),
                _ = every.tick() => pings.next(),
                points = next_points(&mut self.points), if may_send => Next::Frame(Frame::Binary(points)),
                state = replay_changed(&mut replay_state), if may_send => text(replay_json(&state, "")),
                Some(answer) = self.answers.next() => text(answer),
                received = socket.recv() => match received {
                    Some(Ok(_)) if !frames.take() => {
                        slot.close("flood");
                        Next::End
                    }
                    Some(Ok(Frame::Text(text))) => self.apply(&text),
                    Some(Ok(Frame::Pong(pong))) if pings.answer(&pong) => self.status(),
                    // The library answers pings.
                    Some(Ok(_)) => Next::Nothing,
                    Some(Err(_)) | None => Next::End,
                },
            };
            let frame = match next {
                Next::Frame(frame) => frame,
                Next::Nothing => continue,
                Next::End => break,
            };
            let Ok(Ok(())) = tokio::time::timeout(SEND_TIMEOUT, socket.send(frame)).await else { break };
        }
    }

    fn send(&mut self, (vehicle, update): (String, Result<v1::MapUpdate, Status>)) -> Next {
        match update {
            // The end of a replay is in its state.
            Ok(update) if update.replay_ended => Next::Nothing,
            Ok(update) => Next::Frame(Frame::Binary(Bytes::from(update.encode_to_vec()))),
            Err(status) if status.code() == Code::Unavailable => Next::End,
            Err(status) => {
                self.updates.remove(&vehicle);
                let id = self.watching.remove(&vehicle).map_or(0, |watching| watching.id);
                refused(&vehicle, id, status.message())
            }
        }
    }

    /// The status of all vehicles; the parts that only one vehicle's view shows are left out of the others.
    fn status(&self) -> Next {
        if !self.vehicles.is_empty() && self.vehicles.iter().all(|served| served.newest.has_changed().is_err()) {
            return Next::End;
        }
        let own = self.vehicles.iter().map(|served| {
            let status = &served.status;
            match *status.name == self.detail {
                true => status.to_json().to_string().into(),
                false => self.summaries.of(&status.name, status.boot_id, || status.to_json()),
            }
        });
        let mut others = self.fleet.vehicles(Instant::now());
        others.retain(|vehicle| self.caller.may_reach(&vehicle.name));
        let others = others.iter().map(|of| self.summaries.of(&of.name, of.boot_id, || vehicle_json(of)));
        let [own, others] = [own.collect::<Vec<_>>(), others.collect()].map(|all| all.join(","));
        text(format!(r#"{{"type":"fleet","vehicles":[{own}],"others":[{others}]}}"#))
    }

    fn apply(&mut self, message: &str) -> Next {
        match serde_json::from_str(message) {
            Err(error) => refused("", 0, &error.to_string()),
            Ok(Request::Replay(_) | Request::Recorder(_)) if self.answers.len() >= ANSWERS_MAX => {
                refused("", 0, &format!("{ANSWERS_MAX} requests are not answered yet, which are allowed"))
            }
            Ok(Request::Replay(request)) => match &self.replay {
                Some(replay) => self.answer_later(replay.answer(&request)),
                None => refused("", 0, "the server replays nothing that this reader may control"),
            },
            Ok(Request::Recorder(request)) => match &self.recorder {
                Some(recorder) => self.answer_later(recorder.answer(request)),
                None => refused("", 0, "the server records nothing that this reader may control"),
            },
            Ok(Request::Watch(request)) => {
                let (vehicle, id) = (request.vehicle.clone(), request.id);
                match self.watch(request) {
                    Ok(()) => text(json!({ "type": "watching", "vehicle": vehicle, "id": id }).to_string()),
                    Err(status) => refused(&vehicle, id, status.message()),
                }
            }
            Ok(Request::Unwatch { vehicle }) => {
                self.unwatch(&vehicle);
                Next::Nothing
            }
            Ok(Request::Detail { vehicle }) => {
                self.detail = vehicle;
                // More of them wait for the next answer to a ping.
                if self.detailed.is_some_and(|at| at.elapsed() < DETAIL_PERIOD) {
                    return Next::Nothing;
                }
                self.detailed = Some(Instant::now());
                self.status()
            }
            Ok(Request::Points { vehicle, wanted: false }) => {
                self.points.take_if(|points| points.are_of(&vehicle));
                Next::Nothing
            }
            Ok(Request::Points { vehicle, wanted: true }) => match self.request_points(&vehicle) {
                Ok(()) => Next::Nothing,
                Err(status) => {
                    text(json!({ "type": "points", "vehicle": vehicle, "reason": status.message() }).to_string())
                }
            },
            Ok(Request::Keyframe { vehicle, id }) => {
                let request = v1::WatchRequest { request_keyframe: true, ..v1::WatchRequest::default() };
                self.request(&vehicle, id, request)
            }
            Ok(Request::Acknowledge { vehicle, id, sequence }) => match sequence.parse() {
                Err(_) => refused(&vehicle, id, &format!("sequence {sequence:?}: digits in a string are allowed")),
                Ok(sequence) => {
                    let request = v1::WatchRequest { acknowledged: Some(sequence), ..v1::WatchRequest::default() };
                    self.request(&vehicle, id, request)
                }
            },
        }
    }

    fn answer_later(&self, answer: impl Future<Output = String> + Send + 'static) -> Next {
        self.answers.push(Box::pin(answer));
        Next::Nothing
    }

    fn served(&self, vehicle: &str) -> Result<&Served, Status> {
        let served = self.vehicles.iter().find(|served| *served.status.name == *vehicle);
        served.ok_or_else(|| Status::not_found(format!("no vehicle is named {vehicle:?}")))
    }

    fn request_points(&mut self, vehicle: &str) -> Result<(), Status> {
        if !self.points.as_ref().is_some_and(|points| points.are_of(vehicle)) {
            self.points = Some(PagePoints::new(self.served(vehicle)?, &self.caller)?);
        }
        self.points.iter_mut().for_each(PagePoints::request);
        Ok(())
    }

    fn watch(&mut self, request: WatchRequest) -> Result<(), Status> {
        let WatchRequest { vehicle, id, layers, max_rate_hz, deltas, max_in_flight } = request;
        let served = self.served(&vehicle)?;
        let layers = self.caller.layers(&vehicle, layers, &served.status.layers)?;
        if self.watching.len() >= WATCHES_MAX && !self.watching.contains_key(&vehicle) {
            return Err(Status::resource_exhausted(format!("at most {WATCHES_MAX} vehicles are allowed at a time")));
        }
        let of = v1::Selection { vehicle: vehicle.clone(), layers, max_in_flight, max_rate_hz, ..Default::default() };
        let selection = v1::Selection { deltas, plans: true, ..of };
        let (requests, receiver) = mpsc::channel(REQUESTS_MAX);
        let updates = watch_from_page(served, selection, receiver)?;
        self.updates.insert(vehicle.clone(), Box::pin(updates));
        self.watching.insert(vehicle, Watching { id, requests });
        Ok(())
    }

    fn unwatch(&mut self, vehicle: &str) {
        self.watching.remove(vehicle);
        self.updates.remove(vehicle);
    }

    /// Passes a request to a vehicle's maps. One for a selection that was replaced meanwhile means nothing any more.
    fn request(&mut self, vehicle: &str, id: u64, request: v1::WatchRequest) -> Next {
        let Some(watching) = self.watching.get_mut(vehicle).filter(|watching| watching.id == id) else {
            return Next::Nothing;
        };
        if watching.requests.try_send(Ok(request)).is_ok() {
            return Next::Nothing;
        }
        self.unwatch(vehicle);
        refused(vehicle, id, &format!("more than {REQUESTS_MAX} requests wait"))
    }
}

fn text(json: String) -> Next {
    Next::Frame(Frame::Text(json.into()))
}

fn refused(vehicle: &str, id: u64, reason: &str) -> Next {
    text(json!({ "type": "refused", "vehicle": vehicle, "id": id, "reason": reason }).to_string())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nothing_is_sent_before_a_ping_is_answered_with_what_it_said() {
        let mut pings = Pings::default();
        assert!(!pings.allow_more() && !pings.answer(&[]));
        let Next::Frame(Frame::Ping(says)) = pings.next() else { panic!("a ping is first") };
        assert!(!pings.answer(b"a guess!") && !pings.allow_more());
        assert!(matches!(pings.next(), Next::Nothing), "one ping waits at a time");
        assert!(pings.answer(&says) && pings.allow_more());
        assert!(!pings.answer(&says), "an answer counts once");
        let Next::Frame(Frame::Ping(other)) = pings.next() else { panic!("the next ping is due") };
        assert!(says != other && pings.allow_more());
        pings.unanswered = pings.unanswered.map(|(says, since)| (says, since - STATUS_PERIOD));
        assert!(!pings.allow_more(), "the answer is late");
        assert!(matches!(pings.next(), Next::Nothing));
        pings.unanswered = pings.unanswered.map(|(says, since)| (says, since - PONG_TIMEOUT));
        assert!(matches!(pings.next(), Next::End));
    }

    #[test]
    fn a_request_of_a_browser_is_read_whole_or_refused() {
        let read = |text: &str| serde_json::from_str::<Request>(text);
        let watch = read(r#"{"type":"watch","vehicle":"car","id":3,"layers":["speed"],"max_rate_hz":2,"deltas":true}"#);
        let Ok(Request::Watch(watch)) = watch else { panic!("{watch:?}") };
        assert_eq!((&*watch.vehicle, watch.id, watch.max_rate_hz, watch.deltas), ("car", 3, Some(2.0), true));
        assert!(matches!(read(r#"{"type":"replay","paused":true}"#), Ok(Request::Replay(_))));
        for wrong in [r#"{"type":"watch","layer":"x"}"#, r#"{"type":"jump"}"#, r#"{"type":"replay","jump":1}"#, "{"] {
            assert!(read(wrong).is_err(), "{wrong}");
        }
    }
}
