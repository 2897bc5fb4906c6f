//! The key `clearway/<vehicle>/replay` -> the end of a replay, for the reader of a stream.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use serde_json::Value;
use zenoh::Session;
use zenoh::pubsub::Subscriber;
use zenoh::sample::Sample;

use crate::error::ClientError;
use crate::stream::LatestSlot;
use crate::zenoh::query::{QUERY_TIMEOUT, failed};

/// Tells the slot of every end of the vehicle's replay while the subscriber lives, and of an end before. zenoh calls
/// back in the order in which the server puts, so that the last map comes before the end.
///
/// # Errors
/// [`ClientError::Zenoh`] if the subscription or the query fails.
pub(super) async fn subscribe(
    session: &Session,
    vehicle: &str,
    slot: LatestSlot,
    endpoint: &str,
) -> Result<Subscriber<()>, ClientError> {
    let key = format!("clearway/{vehicle}/replay");
    let ends = Ends { slot, endpoint: endpoint.into(), is_told: Arc::default() };
    let subscriber = session.declare_subscriber(key.clone()).callback({
        let ends = ends.clone();
        move |sample| ends.read(&sample)
    });
    let subscriber = subscriber.await.map_err(failed(format!("subscribe to {key}")))?;
    let query = session.get(&key).timeout(QUERY_TIMEOUT).callback(move |reply| {
        if let Ok(sample) = reply.result() {
            ends.read(sample);
        }
    });
    query.await.map_err(failed(format!("get {key}")))?;
    Ok(subscriber)
}

/// Tells the slot of each end once.
#[derive(Clone)]
struct Ends {
    slot: LatestSlot,
    endpoint: String,
    is_told: Arc<AtomicBool>,
}

impl Ends {
    /// Reads a message of the key; a message of another form is ignored.
    fn read(&self, sample: &Sample) {
        let Ok(document) = serde_json::from_slice::<Value>(&sample.payload().to_bytes()) else { return };
        let Some(ended) = document["ended"].as_bool() else { return };
        let was_told = self.is_told.swap(ended, Ordering::Relaxed);
        let address = self.endpoint.clone();
        match document["error"].as_str() {
            Some(why) => {
                let (reason, code) = (why.to_owned(), "Unavailable".to_owned());
                self.slot.end_replay(ClientError::Refused { address, reason, code });
            }
            None if ended && !was_told => self.slot.end_replay(ClientError::ReplayEnded { address }),
            None => {}
        }
    }
}
