//! One reader of `Watch`: its requests and the newest maps -> its updates.
//!
//! The transport polls the stream for its next update when it has room for one, and only then the stream reads the
//! latest-value slot: a slow reader skips maps, learns how many, and costs the engine nothing. Credits limit the maps
//! on the way; without them the HTTP/2 windows alone hold about half a minute of maps.

use std::sync::Arc;

use clearway_proto::v1;
use futures::{Stream, StreamExt, stream};
use tokio::sync::watch;
use tonic::Status;

use super::selection::{Selection, Sent};
use crate::clock::now_ns;
use crate::encode::EncodedMap;
use crate::newest::Newest;
use crate::publish::served::{Served, Vehicles};
use crate::status::Reader;
use crate::subscriptions::LayerSubscription;

/// The updates of one reader: the selected parts of the newest maps, within its credits. Any executor can drive the
/// stream.
///
/// # Errors
/// A status that names the vehicle, layer or value of the selection that is not allowed, and what is.
pub fn watch<R>(
    vehicles: &Vehicles,
    selection: v1::Selection,
    requests: R,
) -> Result<impl Stream<Item = Result<v1::MapUpdate, Status>> + Send + use<R>, Status>
where
    R: Stream<Item = Result<v1::WatchRequest, Status>> + Send + Unpin,
{
    let served = vehicles.find(&selection.vehicle)?;
    Ok(Watch::new(served, Selection::new(served, selection)?, requests).updates())
}

struct Watch<R> {
    requests: Option<R>,
    newest: watch::Receiver<Newest>,
    selection: Selection,
    /// The last map sent to this reader.
    last: Option<Sent>,
    /// The same map for a reader of deltas, which are made against it. A stopped reader keeps no other map.
    base: Option<Arc<EncodedMap>>,
    /// The reader asked for a whole map.
    want_full: bool,
    /// Until it goes, its layers are made.
    subscription: LayerSubscription,
    // Last, and only held: the reader is counted while this lives.
    _reader: Reader,
}

impl<R: Stream<Item = Result<v1::WatchRequest, Status>> + Unpin> Watch<R> {
    fn new(served: &Served, selection: Selection, requests: R) -> Self {
        let mut newest = served.newest.clone();
        // The current map, if there is one, is the first update.
        newest.mark_changed();
        Self {
            requests: Some(requests),
            newest,
            subscription: served.status.subscriptions.subscribe(&selection.layers),
            selection,
            last: None,
            base: None,
            want_full: false,
            _reader: Reader::new(&served.status.grpc_readers),
        }
    }

    fn updates(self) -> impl Stream<Item = Result<v1::MapUpdate, Status>> {
        stream::try_unfold(self, |mut watch| async move { Ok(watch.next().await?.map(|update| (update, watch))) })
    }

    /// The next update: the newest map that is due, as soon as there is a credit. `None` if the reader has
    /// disconnected.
    async fn next(&mut self) -> Result<Option<v1::MapUpdate>, Status> {
        loop {
            tokio::select! {
                // Acknowledgements first: they free the credit that the map needs.
                biased;
                request = next_request(&mut self.requests) => match request? {
                    Some(request) => self.apply(request)?,
                    // Half closed: a plain reader goes on reading and sends no more acknowledgements.
                    None => self.requests = None,
                },
                changed = self.newest.changed(), if self.selection.credits.left() => {
                    changed.map_err(|_| Status::unavailable("the vehicle's engine has stopped"))?;
                    let newest = self.newest.borrow_and_update().clone();
                    if let Some(map) = newest.filter(|map| self.is_due(map)) {
                        return self.send(map).map(Some);
                    }
                },
            }
        }
    }

    fn apply(&mut self, request: v1::WatchRequest) -> Result<(), Status> {
        if let Some(sequence) = request.acknowledged {
            self.selection.credits.acknowledge(sequence)?;
        }
        if request.request_keyframe {
            self.want_full = true;
            self.newest.mark_changed();
        }
        Ok(())
    }

    /// True if a map is to be sent. A map without one of the layers was made before this reader subscribed.
    fn is_due(&self, map: &EncodedMap) -> bool {
        (self.want_full || self.selection.rate.is_due(map.capture_end_ns)) && self.subscription.is_covered_by(map)
    }

    fn send(&mut self, map: Arc<EncodedMap>) -> Result<v1::MapUpdate, Status> {
        let Self { selection, last, base, want_full, .. } = self;
        let bytes = selection.bytes(&map, base.as_deref().filter(|_| !*want_full))?;
        let sent = Sent { sequence: map.sequence, stamp_ns: map.capture_end_ns };
        let (skipped, left_out) = last.replace(sent).map_or((0, 0), |last| selection.rate.between(last, sent));
        selection.rate.send(sent.stamp_ns);
        selection.credits.send(sent.sequence);
        (*base, *want_full) = (selection.deltas.then_some(map), false);
        Ok(v1::MapUpdate { map: bytes, skipped, sent_ns: now_ns(), left_out })
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
