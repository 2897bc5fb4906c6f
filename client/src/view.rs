//! One map as a planner sees it.
//!
//! In: an encoded `clearway.v1.Map`, whoever carried it. Out: header, layers and look-ups in the ego frame (x forward,
//! y left, metres), and the age, measured from the end of the capture.

use std::sync::Arc;
use std::time::{SystemTime, UNIX_EPOCH};

use bytes::Bytes;
use clearway_proto::codec::Limits;
use clearway_proto::map::{Layer, Map, decode_map};
use clearway_proto::v1;

use crate::ClientError;

/// A map, decoded once. Cloning it costs a reference count.
#[derive(Clone, Debug)]
pub struct MapView {
    map: Arc<Map>,
    bytes: Bytes,
}

impl MapView {
    /// Decodes and checks an encoded `clearway.v1.Map`.
    ///
    /// # Errors
    /// [`ClientError::Map`], naming the first thing found wrong.
    pub fn decode(bytes: Bytes) -> Result<Self, ClientError> {
        Ok(Self { map: Arc::new(decode_map(bytes.clone(), &Limits::default())?), bytes })
    }

    /// The header as on the wire: stamps, pose, speed, sensors.
    pub fn header(&self) -> &v1::Header {
        &self.map.header
    }

    /// The vehicle's name.
    pub fn vehicle(&self) -> &str {
        &self.map.header.vehicle
    }

    /// Counts from 0 without a hole within one run of the server, which [`v1::Header::boot_id`] names.
    pub fn sequence(&self) -> u64 {
        self.map.header.sequence
    }

    /// The encoded map, as it came.
    pub fn bytes(&self) -> &Bytes {
        &self.bytes
    }

    /// In the order of the server's configuration.
    pub fn layers(&self) -> &[Layer] {
        &self.map.layers
    }

    /// The layer of that name; `layer.class_at(x_m, y_m)` and `layer.value_at(channel, x_m, y_m)` look into it.
    ///
    /// # Errors
    /// [`ClientError::NoLayer`] with the names of those there are.
    pub fn layer(&self, name: &str) -> Result<&Layer, ClientError> {
        self.map.layer(name).ok_or_else(|| ClientError::NoLayer {
            layer: name.into(),
            present: self.map.layers.iter().map(|layer| layer.name.clone()).collect(),
        })
    }

    /// Age at `now_ns`, ns, from the end of the capture; negative where this machine's clock is behind the server's.
    pub fn age_ns(&self, now_ns: i64) -> i64 {
        now_ns.saturating_sub(self.map.header.capture_end_ns)
    }

    /// [`MapView::age_ns`] in milliseconds.
    pub fn age_ms(&self, now_ns: i64) -> f64 {
        self.age_ns(now_ns) as f64 * 1e-6
    }

    /// Whether the map must not be used any more at `now_ns`: its validity has passed, or its capture lies further
    /// ahead of this clock than its validity lasts, so that its age is not known.
    pub fn is_stale(&self, now_ns: i64) -> bool {
        let header = &self.map.header;
        let valid_ns = header.valid_until_ns.saturating_sub(header.capture_end_ns);
        now_ns > header.valid_until_ns || self.age_ns(now_ns) < valid_ns.saturating_neg()
    }

    /// A figure of the first layer that states it, such as `drivable_share`.
    pub fn figure(&self, name: &str) -> Option<f64> {
        self.map.layers.iter().find_map(|layer| layer.figures.get(name).copied())
    }
}

/// This machine's clock, ns since the Unix epoch.
pub fn now_ns() -> i64 {
    let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    i64::try_from(since.as_nanos()).unwrap_or(i64::MAX)
}
