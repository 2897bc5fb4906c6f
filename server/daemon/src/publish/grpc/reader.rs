//! One reader of `Watch`: its requests and the newest maps -> its updates.
//!
//! The transport polls the stream for its next update when it has room for one, and only then the stream reads the
//! latest-value slot: a slow reader skips maps, learns how many, and costs the engine nothing. Credits limit the maps
//! on the way; without them the HTTP/2 windows alone hold about half a minute of maps.

use std::sync::Arc;
use std::time::Duration;

use clearway_proto::v1;
use futures::{Stream, StreamExt, stream};
use tokio::sync::watch;
use tokio::time::Interval;
use tonic::Status;

use super::selection::{Selection, Sent};
use crate::base::clock::now_ns;
use crate::engine::acknowledgements::{AcknowledgingReader, MapId};
use crate::engine::newest::Newest;
use crate::engine::plans::Plans;
use crate::engine::subscriptions::LayerSubscription;
use crate::publish::served::{Served, Vehicles};
use crate::status::{Reader, Transport, VehicleStatus};
use clearway_journal::encode::EncodedMap;

/// Time without an update after which a reader of states gets one.
const STATE_PERIOD: Duration = Duration::from_secs(1);

/// The updates of one reader: the selected parts of the newest maps, within its credits. Any executor can drive the
/// stream, unless the selection has states. `name` names the reader to people.
///
/// # Errors
/// A status that names the vehicle, layer or value of the selection that is not allowed, and what is.
pub fn watch<R>(
    vehicles: &Vehicles,
    selection: v1::Selection,
    requests: R,
    name: String,
) -> Result<impl Stream<Item = Result<v1::MapUpdate, Status>> + Send + use<R>, Status>
where
    R: Stream<Item = Result<v1::WatchRequest, Status>> + Send + Unpin,
{
    let served = vehicles.find(&selection.vehicle)?;
    let selection = Selection::new(served, selection)?;
    let finished = selection.credits.are_limited().then(|| served.wires.acknowledgements.add(name));
    Ok(Watch::new(served, selection, requests, finished, Transport::Grpc).updates())
}

/// The same for a browser: it is counted as a reader of the page, and no replay in lockstep waits for it.
///
/// # Errors
/// As [`watch()`].
pub fn watch_from_page<R>(
    served: &Served,
    selection: v1::Selection,
    requests: R,
) -> Result<impl Stream<Item = Result<v1::MapUpdate, Status>> + Send + use<R>, Status>
where
    R: Stream<Item = Result<v1::WatchRequest, Status>> + Send + Unpin,
{
    let selection = Selection::new(served, selection)?;
    Ok(Watch::new(served, selection, requests, None, Transport::Page).updates())
}

struct Watch<R> {
    requests: Option<R>,
    newest: watch::Receiver<Newest>,
    /// True while a replay stands at its end.
    replay_ended: watch::Receiver<bool>,
    /// The reader was not told yet that the replay has ended.
    is_end_due: bool,
    selection: Selection,
    /// The last map sent to this reader.
    last: Option<Sent>,
    /// The same map for a reader of deltas, which are made against it. A stopped reader keeps no other map.
    base: Option<Arc<EncodedMap>>,
    /// The reader asked for a whole map.
    want_full: bool,
    /// Learns which maps the reader has finished with; `None` if nothing waits for it.
    finished: Option<AcknowledgingReader>,
    /// Until it goes, its layers are made.
    subscription: LayerSubscription,
    status: Arc<VehicleStatus>,
    /// The plans of the vehicle; `None` if the reader does not want them.
    plans: Option<Plans>,
    /// When the reader gets the state of the vehicle; `None` if it does not want it.
    states: Option<Interval>,
    transport: Transport,
    /// The reader is counted while this lives, and what it skips.
    reader: Reader,
}

impl<R: Stream<Item = Result<v1::WatchRequest, Status>> + Unpin> Watch<R> {
    fn new(
        served: &Served,
        selection: Selection,
        requests: R,
        finished: Option<AcknowledgingReader>,
        transport: Transport,
    ) -> Self {
        let mut newest = served.newest.clone();
        // The current map, if there is one, is the first update.
        newest.mark_changed();
        let mut replay_ended = served.wires.replay_ended.subscribe();
        let is_end_due = *replay_ended.borrow_and_update();
        Self {
            requests: Some(requests),
            newest,
            replay_ended,
            is_end_due,
            subscription: served.wires.subscriptions.subscribe(&selection.layers),
            status: served.status.clone(),
            states: selection.states.then(|| tokio::time::interval(STATE_PERIOD)),
            plans: selection.plans.then(|| served.wires.plans.clone()),
            transport,
            last: None,
            base: None,
            want_full: false,
            finished,
            reader: Reader::new(&served.status.transports, transport),
            selection,
        }
    }

    fn updates(self) -> impl Stream<Item = Result<v1::MapUpdate, Status>> {
        stream::try_unfold(self, |mut watch| async move {
            watch.states.iter_mut().for_each(Interval::reset);
            Ok(watch.next().await?.map(|update| (update, watch)))
        })
    }

    /// The next update: the newest map that is due, as soon as there is a credit. `None` if the reader has
    /// disconnected.
    async fn next(&mut self) -> Result<Option<v1::MapUpdate>, Status> {
        loop {
            if self.requests.is_none() && !self.selection.credits.left() {
                let text = "the requests have ended, so no acknowledgement can come any more: keep them open, or set \
                            max_in_flight = 0";
                return Err(Status::failed_precondition(text));
            }
            // Only now: the last map comes before the end.
            if self.is_end_due && !self.newest.has_changed().unwrap_or(false) {
                self.is_end_due = false;
                return Ok(Some(v1::MapUpdate { replay_ended: true, sent_ns: now_ns(), ..Default::default() }));
            }
            tokio::select! {
                // Acknowledgements before maps: they free the credit that the map needs.
                biased;
                why = timed_out(self.finished.as_ref()) => return Err(Status::unavailable(why)),
                request = next_request(&mut self.requests) => match request? {
                    Some(request) => self.apply(request)?,
                    // Half closed: a plain reader goes on reading and sends no more acknowledgements.
                    None => self.requests = None,
                },
                changed = self.newest.changed(), if self.selection.credits.left() => {
                    changed.map_err(|_| Status::unavailable("the vehicle's engine has stopped"))?;
                    let newest = self.newest.borrow_and_update().clone();
                    match newest {
                        Some(map) if self.is_due(&map) => return self.send(map).map(Some),
                        // Left out, because of the rate.
                        Some(map) => self.finish((map.boot_id, map.sequence)),
                        None => {}
                    }
                },
                Ok(()) = self.replay_ended.changed() => self.is_end_due = *self.replay_ended.borrow_and_update(),
                () = tick(self.states.as_mut()) => {
                    let vehicle = Some(Box::new(self.status.to_proto()));
                    return Ok(Some(v1::MapUpdate { vehicle, sent_ns: now_ns(), ..Default::default() }));
                }
            }
        }
    }

    fn apply(&mut self, request: v1::WatchRequest) -> Result<(), Status> {
        if let Some(sequence) = request.acknowledged {
            self.selection.credits.acknowledge(sequence)?;
            if let Some(last) = self.last {
                self.finish((last.boot_id, last.sequence));
            }
        }
        if request.request_keyframe {
            self.want_full = true;
            self.newest.mark_changed();
        }
        Ok(())
    }

    /// Reports that the reader has finished with `map`, if it has acknowledged all that was sent.
    fn finish(&self, map: MapId) {
        if let Some(finished) = self.finished.as_ref().filter(|_| self.selection.credits.are_all_back()) {
            finished.finished(map);
        }
    }

    /// True if a map is to be sent. A map without one of the layers was made before this reader subscribed.
    fn is_due(&self, map: &EncodedMap) -> bool {
        let jumped = self.last.is_some_and(|last| last.boot_id != map.boot_id);
        let is_due = self.want_full || jumped || self.selection.rate.is_due(map.capture_end_ns);
        is_due && self.subscription.is_covered_by(map)
    }

    fn send(&mut self, map: Arc<EncodedMap>) -> Result<v1::MapUpdate, Status> {
        let plan = self.plans.as_ref().and_then(|plans| plans.over(&map)).map(Box::new);
        let _hop = self.status.traces.hop(&map, "send", Some(self.transport.as_str()));
        let Self { selection, last, base, want_full, .. } = self;
        let is_base = |base: &&EncodedMap| !*want_full && base.boot_id == map.boot_id;
        let bytes = selection.bytes(&map, base.as_deref().filter(is_base))?;
        let sent = Sent { boot_id: map.boot_id, sequence: map.sequence, stamp_ns: map.capture_end_ns };
        let (skipped, left_out) = last.replace(sent).map_or((0, 0), |last| selection.rate.between(last, sent));
        self.reader.skipped(skipped);
        selection.rate.send(sent.stamp_ns);
        selection.credits.send(sent.sequence);
        (*base, *want_full) = (selection.deltas.then_some(map), false);
        let lockstep = self.finished.as_ref().is_some_and(AcknowledgingReader::is_in_lockstep);
        Ok(v1::MapUpdate { map: bytes, skipped, sent_ns: now_ns(), left_out, lockstep, plan, ..Default::default() })
    }
}

async fn tick(interval: Option<&mut Interval>) {
    match interval {
        Some(interval) => _ = interval.tick().await,
        None => std::future::pending().await,
    }
}

/// Waits until a replay in lockstep ends because a map was not acknowledged; returns why.
async fn timed_out(reader: Option<&AcknowledgingReader>) -> String {
    match reader {
        Some(reader) => reader.timed_out().await,
        None => std::future::pending().await,
    }
}

async fn next_request<R>(requests: &mut Option<R>) -> Result<Option<v1::WatchRequest>, Status>
where
    R: Stream<Item = Result<v1::WatchRequest, Status>> + Unpin,
{
    match requests {
        Some(requests) => requests.next().await.transpose(),
        None => std::future::pending().await,
    }
}
