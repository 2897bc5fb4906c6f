//! One reader of `Watch`: its requests and the newest maps -> its updates.
//!
//! The stream is asked for its next update when the transport has room for one, and looks at the newest-map slot only
//! then: a slow reader skips maps and is told how many, and costs the engine nothing. Credits bound what is on the way:
//! without them HTTP/2 windows alone hold about half a minute of maps.

use std::sync::Arc;

use clearway_proto::v1;
use futures::{Stream, StreamExt, stream};
use tokio::sync::watch;
use tonic::Status;

use super::selection::{Selection, Sent};
use crate::publish::{Served, Vehicles};
use crate::subscriptions::LayerSubscription;
use crate::newest::Newest;
use crate::clock::now_ns;
use crate::status::Reader;
use crate::encode::EncodedMap;

/// The updates of one reader: what it selected of the newest maps, as far as what it acknowledges allows. Any executor
/// drives it.
///
/// # Errors
/// What is wrong with the selection.
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
    /// What this reader was sent last.
    last: Option<Sent>,
    /// The same map, for a reader of deltas alone: they are put on it. A stopped reader keeps nothing else.
    base: Option<Arc<EncodedMap>>,
    /// The reader asked for a whole map.
    want_full: bool,
    over: bool,
    /// Until it goes, its layers are made.
    taken: LayerSubscription,
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
            taken: served.status.subscriptions.subscribe(&selection.layers),
            selection,
            last: None,
            base: None,
            want_full: false,
            over: false,
            _reader: Reader::new(&served.status.grpc_readers),
        }
    }

    fn updates(self) -> impl Stream<Item = Result<v1::MapUpdate, Status>> {
        stream::unfold(self, |mut watch| async move {
            if watch.over {
                return None;
            }
            let update = watch.next().await.transpose()?;
            watch.over = update.is_err();
            Some((update, watch))
        })
    }

    /// The next update: when a credit is there, the newest map that is due. `None` when the reader has gone.
    async fn next(&mut self) -> Result<Option<v1::MapUpdate>, Status> {
        loop {
            tokio::select! {
                // Acknowledgements first: they free the credit that the map needs.
                biased;
                request = next_request(&mut self.requests) => match request? {
                    Some(request) => self.hear(request)?,
                    // Half closed: a plain reader goes on reading. Nobody will acknowledge any more.
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

    fn hear(&mut self, request: v1::WatchRequest) -> Result<(), Status> {
        if let Some(sequence) = request.acknowledged {
            self.selection.credits.acknowledge(sequence)?;
        }
        if request.request_keyframe {
            self.want_full = true;
            self.newest.mark_changed();
        }
        Ok(())
    }

    /// A map without one of the layers was made before this reader came.
    fn is_due(&self, map: &EncodedMap) -> bool {
        (self.want_full || self.selection.rate.is_due(map.capture_end_ns)) && self.taken.is_covered_by(map)
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
