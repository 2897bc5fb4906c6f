//! Payloads for readers with a region or deltas: some layers, cropped to a region, as deltas against an earlier map.
//!
//! In: an [`EncodedMap`](super::EncodedMap), a region in the ego frame, the map that the reader has. Out: the bytes of
//! one `clearway.v1.Map`. Each layer is cropped and compared at most once, for all readers that need the same.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, OnceLock, PoisonError};

use bytes::Bytes;
use clearway_proto::codec::Limits;
use clearway_proto::delta::encode_delta;
use clearway_proto::map::encode_layer;
use clearway_proto::region::{RegionError, crop};
use clearway_proto::v1;
use prost::Message;

/// Most payloads kept for one map; further payloads are encoded for each reader. Ours: ten readers with regions of
/// their own, seven layers each.
const PAYLOADS_MAX: usize = 64;

/// Payloads of one map, by layer, region and base.
#[derive(Debug, Default)]
pub struct PayloadCache(Mutex<BTreeMap<Key, Arc<Payload>>>);

/// Index of the layer, bits of the region, sequence of the base.
type Key = (usize, Option<[u64; 4]>, Option<u64>);

/// One payload. A reader that needs it while it is encoded waits for it.
type Payload = OnceLock<Result<Bytes, RegionError>>;

impl PayloadCache {
    /// The payload of a key, encoded or not.
    pub fn slot(&self, key: Key) -> Arc<Payload> {
        let mut payloads = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        match payloads.get(&key) {
            Some(slot) => slot.clone(),
            None if payloads.len() >= PAYLOADS_MAX => Arc::default(),
            None => payloads.entry(key).or_default().clone(),
        }
    }
}

impl Clone for PayloadCache {
    /// Payloads are not part of the map's value: a clone begins with none.
    fn clone(&self) -> Self {
        Self::default()
    }
}

impl PartialEq for PayloadCache {
    fn eq(&self, _: &Self) -> bool {
        true
    }
}

/// The delta from one chunk to another; `None` if the layer must be sent whole.
pub(super) fn delta(from: &Bytes, base_sequence: u64, to: &Bytes) -> Option<Bytes> {
    let delta = encode_delta(&decoded(from)?, base_sequence, &decoded(to)?, &Limits::default())?;
    Some(encode_layer(&delta))
}

/// A chunk cropped to a region.
///
/// # Errors
/// [`RegionError`] if the region lies outside the layer's grid.
pub(super) fn cropped(chunk: &Bytes, region: &v1::Region) -> Result<Bytes, RegionError> {
    decoded(chunk).map_or(Ok(chunk.clone()), |layer| Ok(encode_layer(&crop(&layer, region, &Limits::default())?)))
}

/// The layer of a chunk; always there for chunks that [`encode_layer`] made.
fn decoded(chunk: &Bytes) -> Option<v1::Layer> {
    v1::Map::decode(chunk.clone()).ok()?.layers.pop()
}
