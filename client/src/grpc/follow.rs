//! An open stream of one server -> the slot of a [`MapStream`](crate::MapStream), and the stream opened again.

use std::time::Duration;

use bytes::Bytes;
use clearway_proto::v1;
use prost::Message;
use tokio::sync::mpsc;

use crate::error::ClientError;
use crate::stream::{LatestSlot, Missed};
use crate::view::MapView;

use super::refusal::refused;

/// Shortest and longest pause before a stream is opened again; each is twice the pause before. Ours: a restart of a
/// server costs a map, and a server that is away gets few requests.
const PAUSE: (Duration, Duration) = (Duration::from_millis(100), Duration::from_secs(5));

/// The updates of an open stream, and the requests on it.
pub(super) type Watch = (tonic::Streaming<v1::MapUpdate>, mpsc::Sender<v1::WatchRequest>);

/// Stores the maps of an open stream in the slot, and after its end the maps of each stream that `open_again` opens;
/// returns why the last stream ended.
pub(super) async fn follow<F: Future<Output = Result<Watch, ClientError>>>(
    slot: LatestSlot,
    address: String,
    opened: Watch,
    open_again: Option<impl Fn() -> F>,
) -> ClientError {
    let (mut watch, mut base) = (opened, None);
    loop {
        let mut ended = receive_maps(&slot, &address, watch, &mut base).await;
        let Some(open) = open_again.as_ref().filter(|_| !slot.is_dropped()) else { return ended };
        tracing::warn!(reason = %ended, "the stream of maps has ended and is opened again");
        let mut pause = PAUSE.0;
        watch = loop {
            if is_lasting(&ended) {
                return ended;
            }
            slot.set_reasons(vec![ended.to_string()]);
            tokio::time::sleep(pause).await;
            pause = PAUSE.1.min(2 * pause);
            match open().await {
                Ok(watch) => break watch,
                Err(error) => ended = error,
            }
        };
        tracing::info!(address, "the stream of maps is open again");
    }
}

/// True if another attempt would end in the same way: the request or the client itself is refused.
fn is_lasting(ended: &ClientError) -> bool {
    match ended {
        ClientError::Refused { code, .. } => matches!(
            &**code,
            "InvalidArgument" | "PermissionDenied" | "Unauthenticated" | "FailedPrecondition" | "Unimplemented"
        ),
        ClientError::Unreachable { .. } | ClientError::Ended { .. } => false,
        _ => true,
    }
}

/// Stores the map of every update in the slot and acknowledges it, in lockstep when it was handled; returns why the
/// stream ended. If a delta needs a map that is not here (an update was lost), it requests a keyframe. Maps not stored
/// count as skipped, except maps that the requested rate excluded. `base` is the newest map.
async fn receive_maps(
    slot: &LatestSlot,
    address: &str,
    (mut updates, requests): Watch,
    base: &mut Option<MapView>,
) -> ClientError {
    let ended = || ClientError::Ended { address: address.into() };
    let (mut is_requested, mut left_out) = (false, 0);
    loop {
        let update = match updates.message().await {
            Ok(Some(update)) => update,
            Ok(None) => return ended(),
            Err(status) => return refused(address, &status),
        };
        if update.replay_ended {
            slot.end_replay(ClientError::ReplayEnded { address: address.into() });
            continue;
        }
        if let Some(vehicle) = update.vehicle {
            slot.set_reasons(vehicle.reasons);
            continue;
        }
        left_out += update.left_out;
        let request = match MapView::decode_on(update.map.clone(), base.as_ref()) {
            Ok(map) => {
                let sequence = map.sequence();
                // Maps of another run, or before a jump of a replay, were not skipped.
                let last = base.replace(map.clone()).filter(|last| last.header().boot_id == map.header().boot_id);
                let last = last.map_or(sequence, |last| last.sequence() + 1);
                let skipped = sequence.saturating_sub(last).saturating_sub(left_out);
                slot.store(map, |_| Missed { skipped, left_out, ..Missed::default() });
                (is_requested, left_out) = (false, 0);
                v1::WatchRequest { acknowledged: Some(sequence), ..Default::default() }
            }
            Err(error) => {
                let Some(acknowledged) = sequence_of_delta(update.map) else { return error };
                tracing::debug!(sequence = acknowledged, %error, "a keyframe is requested: a base is missing");
                // More deltas may be in flight; one request is enough for all of them.
                let request_keyframe = !std::mem::replace(&mut is_requested, true);
                v1::WatchRequest { acknowledged: Some(acknowledged), request_keyframe, selection: None }
            }
        };
        if update.lockstep && request.acknowledged.is_some() && !request.request_keyframe {
            slot.handled().await;
        }
        if requests.send(request).await.is_err() {
            return ended();
        }
    }
}

/// Sequence number of a map with a delta; `None` if all layers are whole, or the bytes are not a map.
fn sequence_of_delta(bytes: Bytes) -> Option<u64> {
    let map = v1::Map::decode(bytes).ok()?;
    let is_delta = map.layers.iter().any(|layer| layer.base_sequence.is_some());
    map.header.filter(|_| is_delta).map(|header| header.sequence)
}
