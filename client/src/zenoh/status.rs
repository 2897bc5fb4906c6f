//! Why no map comes: the words of the vehicle's server on the key `clearway/<vehicle>/status`, and names that no server
//! publishes.

use std::time::Duration;

use serde_json::Value;
use zenoh::Session;
use zenoh::pubsub::Subscriber;

use crate::error::ClientError;
use crate::stream::LatestSlot;
use crate::zenoh::query::{LayerKey, failed};

/// Longest status that is read, bytes. Ours: a vehicle of 64 sensors has a tenth of it.
const LENGTH_MAX: usize = 1 << 19;

/// Time between two looks for what is published. Ours: a person or a program that waits learns of a wrong name.
const ABSENCE_PERIOD: Duration = Duration::from_secs(1);

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

/// Tells the slot once a second, until it has a map, that no server publishes the vehicle or the layer, if none does.
pub(super) async fn tell_absence(session: &Session, layer: &LayerKey, slot: &LatestSlot) {
    while !slot.has_map() {
        tokio::time::sleep(ABSENCE_PERIOD).await;
        // The session is closed.
        let Ok(absence) = layer.absence(session).await else { return };
        slot.set_absence(absence);
    }
}
