//! The key `clearway/<vehicle>/status` -> why no map comes, in the words of the vehicle's server.

use serde_json::Value;
use zenoh::Session;
use zenoh::pubsub::Subscriber;

use crate::error::ClientError;
use crate::stream::LatestSlot;
use crate::zenoh::query::failed;

/// Longest status that is read, bytes. Ours: a vehicle of 64 sensors has a tenth of it.
const LENGTH_MAX: usize = 1 << 19;

/// Tells the slot the reasons of the vehicle's state while the subscriber lives. A message that is not of the key's
/// form is passed over.
///
/// # Errors
/// [`ClientError::Zenoh`] if the subscription fails.
pub(super) async fn subscribe(
    session: &Session,
    vehicle: &str,
    slot: LatestSlot,
) -> Result<Subscriber<()>, ClientError> {
    let key = format!("clearway/{vehicle}/status");
    let subscriber = session.declare_subscriber(key.clone()).callback(move |sample| {
        let payload = sample.payload();
        if payload.len() > LENGTH_MAX {
            return;
        }
        let Ok(status) = serde_json::from_slice::<Value>(&payload.to_bytes()) else { return };
        let Some(reasons) = status["reasons"].as_array() else { return };
        slot.set_reasons(reasons.iter().filter_map(Value::as_str).map(str::to_owned).collect());
    });
    subscriber.await.map_err(failed(format!("subscribe to {key}")))
}
