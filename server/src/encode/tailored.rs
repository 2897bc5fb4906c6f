//! A map as one reader asked for it: some layers, cut to a region, as deltas against the map the reader has.
//!
//! In: an [`EncodedMap`], a region in the ego frame, the map sent before. Out: the bytes of one `clearway.v1.Map`. Each
//! layer is cut and compared once, for all readers that ask for the same, and never when nobody asks.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, OnceLock};

use bytes::{Bytes, BytesMut};
use clearway_proto::codec::Limits;
use clearway_proto::delta::encode_delta;
use clearway_proto::map::encode_layer;
use clearway_proto::region::{RegionError, crop};
use clearway_proto::v1;
use prost::Message;

use crate::sync::locked;
use crate::encode::EncodedMap;

/// What readers with regions of their own may keep in memory, beside the map: more are made again for each.
const KEPT_MAX: usize = 64;

/// Layers of one map that were cut already.
#[derive(Debug, Default)]
pub struct Cuts(Mutex<BTreeMap<Key, Arc<Made>>>);

/// Layer by its place in the map, the region's bits, sequence of the base.
type Key = (usize, Option<[u64; 4]>, Option<u64>);

/// Whoever asks while it is made waits for it.
type Made = OnceLock<Result<Bytes, RegionError>>;

impl Cuts {
    fn slot(&self, key: Key) -> Arc<Made> {
        let mut kept = locked(&self.0);
        match kept.get(&key) {
            Some(slot) => slot.clone(),
            None if kept.len() >= KEPT_MAX => Arc::default(),
            None => kept.entry(key).or_default().clone(),
        }
    }
}

impl Clone for Cuts {
    /// What was cut is no part of the map's value: another copy begins anew.
    fn clone(&self) -> Self {
        Self::default()
    }
}

impl PartialEq for Cuts {
    fn eq(&self, _: &Self) -> bool {
        true
    }
}

impl EncodedMap {
    /// The encoded map with these layers (every layer where none is named), cut to `region`, each as a delta against
    /// that of `base` where that is shorter.
    ///
    /// # Errors
    /// The region lies outside a layer's grid.
    pub fn cut(
        &self,
        layers: &[String],
        region: Option<&v1::Region>,
        base: Option<&EncodedMap>,
    ) -> Result<Bytes, RegionError> {
        if region.is_none() && base.is_none() {
            return Ok(self.select(layers));
        }
        let mut message = BytesMut::from(&self.header[..]);
        for index in 0..self.layers.len() {
            if layers.is_empty() || layers.iter().any(|layer| layer == self.layers[index].0) {
                message.extend_from_slice(&self.cut_layer(index, region, base)?);
            }
        }
        Ok(message.freeze())
    }

    fn cut_layer(
        &self,
        index: usize,
        region: Option<&v1::Region>,
        base: Option<&EncodedMap>,
    ) -> Result<Bytes, RegionError> {
        let (name, whole) = &self.layers[index];
        let base = base.and_then(|base| Some((base, base.layers.iter().position(|(of, _)| of == name)?)));
        let bits =
            |region: &v1::Region| [region.x_from_m, region.x_to_m, region.y_from_m, region.y_to_m].map(f64::to_bits);
        let slot = |base| self.cuts.slot((index, region.map(bits), base));
        match (region, base) {
            (None, None) => Ok(whole.clone()),
            (Some(region), None) => slot(None).get_or_init(|| cropped(whole, region)).clone(),
            (_, Some((base, at))) => slot(Some(base.sequence))
                .get_or_init(|| {
                    let (from, to) = (base.cut_layer(at, region, None)?, self.cut_layer(index, region, None)?);
                    Ok(delta(&from, base.sequence, &to).unwrap_or(to))
                })
                .clone(),
        }
    }
}

/// `None` where the layer is to be sent whole.
fn delta(from: &Bytes, base_sequence: u64, to: &Bytes) -> Option<Bytes> {
    let delta = encode_delta(&decoded(from)?, base_sequence, &decoded(to)?, &Limits::default())?;
    Some(encode_layer(&delta))
}

fn cropped(chunk: &Bytes, region: &v1::Region) -> Result<Bytes, RegionError> {
    decoded(chunk).map_or(Ok(chunk.clone()), |layer| Ok(encode_layer(&crop(&layer, region, &Limits::default())?)))
}

/// The layer of a chunk; `None` never, for chunks that [`encode_layer`] made.
fn decoded(chunk: &Bytes) -> Option<v1::Layer> {
    v1::Map::decode(chunk.clone()).ok()?.layers.pop()
}
