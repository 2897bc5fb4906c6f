//! One map as a planner sees it.
//!
//! In: an encoded `clearway.v1.Map`, whoever carried it. Out: header, layers and look-ups in the ego frame (x forward,
//! y left, metres), and the age, measured from the end of the capture.

use std::sync::Arc;

use bytes::Bytes;
use clearway_proto::codec::Limits;
use clearway_proto::map::{Layer, Map, decode_map_on};
use clearway_proto::v1;

use crate::ClientError;
use crate::freshness::{Arrival, Clock, now_ns};

/// A map, decoded once. Cloning it costs a reference count.
#[derive(Clone, Debug)]
pub struct MapView {
    map: Arc<Map>,
    bytes: Bytes,
    /// Absent where the map came from no server.
    arrival: Option<Arc<Arrival>>,
}

impl MapView {
    /// Decodes and checks an encoded `clearway.v1.Map`.
    ///
    /// # Errors
    /// [`ClientError::Map`], naming the first thing found wrong.
    pub fn decode(bytes: Bytes) -> Result<Self, ClientError> {
        Self::decode_on(bytes, None)
    }

    /// As [`MapView::decode`], of a map that may be a delta against `base`.
    ///
    /// # Errors
    /// [`ClientError::Map`], also where the delta is against another map.
    pub fn decode_on(bytes: Bytes, base: Option<&Self>) -> Result<Self, ClientError> {
        let map = decode_map_on(bytes.clone(), base.map(|base| &*base.map), &Limits::default())?;
        Ok(Self { map: Arc::new(map), bytes, arrival: None })
    }

    /// The map came just now.
    pub(crate) fn arrived(self, clock: &Clock) -> Self {
        let arrival = Arrival::new(clock.clone(), self.map.header.capture_end_ns);
        Self { arrival: Some(Arc::new(arrival)), ..self }
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

    /// The encoded map, as it came: with [`crate::Subscription::deltas`] it may need the one before.
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

    /// Age at `now_ns`, ns, from the end of the capture. Of a map from a server at least its age when it came and the
    /// time since, so that no step of the clock makes it younger; else negative where `now_ns` is before the capture.
    pub fn age_ns(&self, now_ns: i64) -> i64 {
        let by_wall_ns = now_ns.saturating_sub(self.map.header.capture_end_ns);
        self.arrival.as_ref().map_or(by_wall_ns, |arrival| arrival.age_ns_min().max(by_wall_ns))
    }

    /// [`MapView::age_ns`] in milliseconds.
    pub fn age_ms(&self, now_ns: i64) -> f64 {
        self.age_ns(now_ns) as f64 * 1e-6
    }

    /// How long the map may be used after the end of its capture, ns.
    fn valid_ns(&self) -> i64 {
        self.map.header.valid_until_ns.saturating_sub(self.map.header.capture_end_ns)
    }

    /// Whether the map must not be used any more at `now_ns`: its validity has passed, or its capture lies further
    /// ahead of this clock than its validity lasts, so that its age is not known.
    pub fn is_stale(&self, now_ns: i64) -> bool {
        let ahead_ns = self.map.header.capture_end_ns.saturating_sub(now_ns);
        self.age_ns(now_ns) > self.valid_ns() || ahead_ns > self.valid_ns()
    }

    /// As far as is known now, ns until the map is stale; `None` where it is already.
    pub(crate) fn fresh_for_ns(&self) -> Option<i64> {
        let now_ns = self.arrival.as_ref().map_or_else(now_ns, |arrival| arrival.now_ns());
        (!self.is_stale(now_ns)).then(|| self.valid_ns().saturating_sub(self.age_ns(now_ns)))
    }

    /// A figure of the first layer that states it, such as `drivable_share`.
    pub fn figure(&self, name: &str) -> Option<f64> {
        self.map.layers.iter().find_map(|layer| layer.metrics.get(name).copied())
    }
}
