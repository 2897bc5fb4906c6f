//! Key -> the newest map; and the errors of zenoh.

use std::time::Duration;

use zenoh::Session;
use zenoh::bytes::ZBytes;

use crate::error::ClientError;
use crate::view::MapView;

/// Longest time to wait for the replies to a query. Ours.
pub(super) const QUERY_TIMEOUT: Duration = Duration::from_secs(5);

/// Makes the error of a failed operation.
pub(super) fn failed(what: impl Into<String>) -> impl FnOnce(zenoh::Error) -> ClientError {
    let what = what.into();
    |reason| ClientError::Zenoh { what, reason: reason.to_string() }
}

/// Returns the first reply to a query; `None` if there is none.
pub(super) async fn query(session: &Session, key: &str) -> Result<Option<ZBytes>, ClientError> {
    let replies = session.get(key).timeout(QUERY_TIMEOUT).await.map_err(failed(format!("get {key}")))?;
    while let Ok(reply) = replies.recv_async().await {
        if let Ok(sample) = reply.result() {
            return Ok(Some(sample.payload().clone()));
        }
    }
    Ok(None)
}

/// Decodes the map of a sample.
pub(super) fn decode(payload: &ZBytes) -> Result<MapView, ClientError> {
    MapView::decode(payload.to_bytes().into_owned().into())
}
