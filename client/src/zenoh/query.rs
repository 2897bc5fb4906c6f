//! Samples of a key -> maps that belong there; key -> the newest map; and the errors of zenoh.

use std::collections::BTreeSet;
use std::time::Duration;

use zenoh::Session;
use zenoh::query::{ConsolidationMode, QueryTarget};
use zenoh::sample::Sample;

use crate::error::ClientError;
use crate::freshness::Clock;
use crate::signature::PublicKey;
use crate::stream::Reason;
use crate::view::MapView;

/// Longest time to wait for the replies to a query. Ours.
pub(super) const QUERY_TIMEOUT: Duration = Duration::from_secs(5);

/// Makes the error of a failed operation.
pub(super) fn failed(what: impl Into<String>) -> impl FnOnce(zenoh::Error) -> ClientError {
    let what = what.into();
    |reason| {
        // Without the line of zenoh's sources that made the error.
        let reason = reason.to_string();
        ClientError::Zenoh { what, reason: reason.split(" at /").next().unwrap_or(&reason).trim_end().to_owned() }
    }
}

/// The key of one layer of one vehicle, and the server that publishes it.
#[derive(Clone, Debug)]
pub(super) struct LayerKey {
    pub key: String,
    vehicle: String,
    layer: String,
    /// Maps must have the signature of this key; `None`: every map on the key is believed.
    signed_by: Option<PublicKey>,
}

impl LayerKey {
    /// The key of a layer of a vehicle.
    ///
    /// # Errors
    /// [`ClientError::Name`]: in a key the characters `*`, `$` and `/` would ask for other vehicles or for none.
    pub fn new(vehicle: &str, layer: &str, signed_by: Option<PublicKey>) -> Result<Self, ClientError> {
        let is_allowed = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '-' || c == '_';
        for (what, name) in [("vehicle", vehicle), ("layer", layer)] {
            if !(1..=64).contains(&name.len()) || !name.chars().all(is_allowed) {
                return Err(ClientError::Name { what, name: name.to_owned() });
            }
        }
        let key = format!("clearway/{vehicle}/map/{layer}");
        Ok(Self { key, vehicle: vehicle.into(), layer: layer.into(), signed_by })
    }

    /// Decodes the map of a sample.
    ///
    /// # Errors
    /// Why it does not belong on this key: the counter of [`crate::PassedOver`], and the error if it is no map.
    pub fn map(&self, sample: &Sample) -> Result<MapView, (Reason, Option<ClientError>)> {
        // A sample on `clearway/**` reaches this subscription too.
        if sample.key_expr().as_str() != self.key {
            return Err((|passed| &mut passed.misplaced, None));
        }
        let payload = sample.payload().to_bytes();
        if let Some(server) = &self.signed_by {
            let signature = sample.attachment().map(|attachment| attachment.to_bytes()).unwrap_or_default();
            if !server.verifies(&self.key, &payload, &signature) {
                return Err((|passed| &mut passed.unsigned, None));
            }
        }
        let map = MapView::decode(payload.into_owned().into());
        let map = map.map_err(|error| (undecodable as Reason, Some(error)))?;
        let is_ours = map.vehicle() == self.vehicle && map.layers().iter().all(|layer| layer.name == self.layer);
        if is_ours { Ok(map) } else { Err((|passed| &mut passed.misplaced, None)) }
    }

    /// Why no map can come on the key now: no server publishes the vehicle, or the layer; `None` if one does.
    ///
    /// # Errors
    /// [`ClientError::Zenoh`] if the query fails.
    pub async fn absence(&self, session: &Session) -> Result<Option<String>, ClientError> {
        let (vehicle, layer) = (&self.vehicle, &self.layer);
        let absent = |what: String, names: Vec<String>| {
            let names = if names.is_empty() { "none".to_owned() } else { names.join(", ") };
            Some(format!("no server publishes {what} now; published: {names}"))
        };
        let vehicles = published(session, "clearway/*", 1).await?;
        if !vehicles.contains(vehicle) {
            return Ok(absent(format!("the vehicle {vehicle:?}"), vehicles));
        }
        let layers = published(session, &format!("clearway/{vehicle}/map/*/@adv/pub/**"), 3).await?;
        Ok(if layers.contains(layer) { None } else { absent(format!("the layer {layer:?} of {vehicle}"), layers) })
    }

    /// The newest map among the replies to a query; `None` if there is none.
    ///
    /// # Errors
    /// [`ClientError::Zenoh`] if the query fails, [`ClientError::Map`] if there are replies and none is a valid map.
    pub async fn newest(&self, session: &Session) -> Result<Option<MapView>, ClientError> {
        let query = session.get(&self.key).timeout(QUERY_TIMEOUT);
        // Every reply of every peer: zenoh would otherwise select one, perhaps the reply of a peer that is no server.
        let query = query.target(QueryTarget::All).consolidation(ConsolidationMode::None);
        let replies = query.await.map_err(failed(format!("get {}", self.key)))?;
        let (mut newest, mut wrong) = (None::<MapView>, None);
        while let Ok(reply) = replies.recv_async().await {
            match reply.result().map(|sample| self.map(sample)) {
                Ok(Ok(map)) => {
                    let map = map.with_arrival(&Clock::default());
                    let order = |map: &MapView| (map.fresh_for_ns().is_some(), map.header().capture_end_ns);
                    newest = newest.filter(|newest| order(newest) >= order(&map)).or(Some(map));
                }
                Ok(Err((_, error))) => wrong = wrong.or(error),
                Err(_) => {}
            }
        }
        match (newest, wrong) {
            (None, Some(error)) => Err(error),
            (newest, _) => Ok(newest),
        }
    }
}

/// Sorted names at a place of the keys that are published now and fit `keys`.
///
/// # Errors
/// [`ClientError::Zenoh`] if the query fails.
pub(super) async fn published(session: &Session, keys: &str, place: usize) -> Result<Vec<String>, ClientError> {
    let replies = session.liveliness().get(keys).timeout(QUERY_TIMEOUT);
    let replies = replies.await.map_err(failed(format!("liveliness {keys}")))?;
    let mut names = BTreeSet::new();
    while let Ok(reply) = replies.recv_async().await {
        if let Ok(sample) = reply.result() {
            names.extend(sample.key_expr().as_str().split('/').nth(place).map(str::to_owned));
        }
    }
    Ok(names.into_iter().collect())
}

fn undecodable(passed: &mut crate::stream::PassedOver) -> &mut u64 {
    &mut passed.undecodable
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_name_that_would_ask_for_other_vehicles_is_refused_with_what_is_allowed() {
        assert!(LayerKey::new("car-2", "safe_path", None).is_ok());
        for (vehicle, layer) in [("*", "freespace"), ("car$*", "freespace"), ("a/b", "freespace"), ("car", "")] {
            let Err(error) = LayerKey::new(vehicle, layer, None) else { panic!("{vehicle}/{layer}") };
            let error = error.to_string();
            assert!(error.ends_with(": 1 to 64 of the characters a-z, 0-9, - and _ are allowed"), "{error}");
        }
    }
}
