//! One decoded map with its age.
//!
//! In: an encoded `clearway.v1.Map` from any transport. Out: header, layers and look-ups in the ego frame (x forward, y
//! left, metres), and the age, measured from the end of the capture.

use std::fmt;
use std::sync::Arc;

use bytes::Bytes;
use clearway_proto::codec::Limits;
use clearway_proto::map::{Layer, Map, decode_map_on};
use clearway_proto::v1;

use crate::error::ClientError;
use crate::freshness::{Arrival, Clock, now_ns};

/// Longest time after its capture for which a map is believed to be valid, whatever it states: a forged map is not
/// fresh for good. Ours: far longer than any planner uses a map.
const VALID_NS_MAX: i64 = 60_000_000_000;

/// Why a map must not be used. [`fmt::Display`] says it in a sentence, which `client/golden/staleness.json` holds equal
/// in every client and on the page.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Staleness {
    /// Its validity has passed since it arrived, and no newer map has arrived.
    NoNewer,
    /// Its validity had passed when it arrived: the link or the server delays maps, or the server's clock is behind
    /// this machine's. One map does not tell which.
    OnArrival {
        /// Age on arrival by this machine's clock, in ns.
        age_ns: i64,
    },
    /// Its capture is in the future of this machine's clock, so that the clocks differ.
    InTheFuture {
        /// Time from now until the capture, in ns: at least so far the server's clock is ahead of this machine's.
        ahead_ns: i64,
    },
}

impl fmt::Display for Staleness {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let ms = |ns: i64| ns as f64 * 1e-6;
        match self {
            Self::NoNewer => formatter.write_str("no newer map has arrived"),
            Self::OnArrival { age_ns } => write!(
                formatter,
                "it was {:.0} ms old when it arrived: maps are delayed, its stamps are behind the reader's clock, \
                 or a recording is replayed without --as-live",
                ms(*age_ns)
            ),
            Self::InTheFuture { ahead_ns } => write!(
                formatter,
                "it was captured {:.0} ms in the future: its stamps are ahead of the reader's clock",
                ms(*ahead_ns)
            ),
        }
    }
}

/// A map, decoded once. A clone shares the decoded map.
#[derive(Clone, Debug)]
pub struct MapView {
    map: Arc<Map>,
    bytes: Bytes,
    /// Absent if the map did not come from a server.
    arrival: Option<Arc<Arrival>>,
}

impl MapView {
    /// Decodes and checks an encoded `clearway.v1.Map`.
    ///
    /// # Errors
    /// [`ClientError::Map`] with the first fault, if the bytes are not a valid map or if a layer is a delta.
    pub fn decode(bytes: Bytes) -> Result<Self, ClientError> {
        Self::decode_on(bytes, None)
    }

    /// As [`MapView::decode`]; layers may be deltas to the layers of `base`.
    ///
    /// # Errors
    /// [`ClientError::Map`] with the first fault, also if a layer is a delta to another map than `base`.
    pub fn decode_on(bytes: Bytes, base: Option<&Self>) -> Result<Self, ClientError> {
        let map = decode_map_on(bytes.clone(), base.map(|base| &*base.map), &Limits::default())?;
        Ok(Self { map: Arc::new(map), bytes, arrival: None })
    }

    /// Sets the arrival of the map to now.
    pub(crate) fn with_arrival(self, clock: &Clock) -> Self {
        let arrival = Arrival::new(clock.clone(), self.map.header.capture_end_ns, self.map.header.completed_ns);
        Self { arrival: Some(Arc::new(arrival)), ..self }
    }

    /// The header as on the wire: stamps, pose, speed and sensors.
    pub fn header(&self) -> &v1::Header {
        &self.map.header
    }

    /// Name of the vehicle.
    pub fn vehicle(&self) -> &str {
        &self.map.header.vehicle
    }

    /// Number of the map: 0, 1, 2 and so on, without gaps, within one run of the server ([`v1::Header::boot_id`]).
    pub fn sequence(&self) -> u64 {
        self.map.header.sequence
    }

    /// The encoded map as received. With [`crate::Subscription::deltas`] it may need the map before to be decoded.
    pub fn bytes(&self) -> &Bytes {
        &self.bytes
    }

    /// The layers, in the order of the server's configuration.
    pub fn layers(&self) -> &[Layer] {
        &self.map.layers
    }

    /// The layer with this name. `layer.class_at(x_m, y_m)`, `layer.meaning_at(x_m, y_m)` and
    /// `layer.value_at(channel, x_m, y_m)` look up a point.
    ///
    /// # Errors
    /// [`ClientError::NoLayer`] if the map does not have the layer.
    pub fn layer(&self, name: &str) -> Result<&Layer, ClientError> {
        self.map.layer(name).ok_or_else(|| ClientError::NoLayer {
            layer: name.into(),
            present: self.map.layers.iter().map(|layer| layer.name.clone()).collect(),
        })
    }

    /// A plan that was made with this map: its path from point to point in the ego frame, in metres. Set what else is
    /// known of it, such as `footprint_m`, `goal` and `text`, and send it ([`crate::Client::send_plan`]).
    pub fn plan(&self, planner: &str, path: &[[f64; 2]]) -> v1::Plan {
        let header = self.header();
        v1::Plan {
            vehicle: header.vehicle.clone(),
            planner: planner.into(),
            stamp_ns: header.capture_end_ns,
            frame: v1::PlanFrame::Ego.into(),
            map_sequence: Some(header.sequence),
            map_from_ego: header.map_from_ego,
            x: path.iter().map(|[x, _]| *x).collect(),
            y: path.iter().map(|[_, y]| *y).collect(),
            ..v1::Plan::default()
        }
    }

    /// Age of the map at `now_ns`, in ns, measured from the end of the capture. If the map came from a server, it is at
    /// least the age on arrival plus the time since, so that no step of the clock makes the map younger. Else it is
    /// negative if
    /// `now_ns` is before the capture.
    pub fn age_ns(&self, now_ns: i64) -> i64 {
        let by_wall_ns = now_ns.saturating_sub(self.map.header.capture_end_ns);
        self.arrival.as_ref().map_or(by_wall_ns, |arrival| arrival.age_ns_min().max(by_wall_ns))
    }

    /// Age of the map at `now_ns` in milliseconds ([`MapView::age_ns`]).
    pub fn age_ms(&self, now_ns: i64) -> f64 {
        self.age_ns(now_ns) as f64 * 1e-6
    }

    /// Time from the end of the capture until the map is stale, in ns; at most [`VALID_NS_MAX`].
    fn valid_ns(&self) -> i64 {
        self.map.header.valid_until_ns.saturating_sub(self.map.header.capture_end_ns).min(VALID_NS_MAX)
    }

    /// Time since the map arrived at this process, in ns, by the steady clock; 0 if it did not come from a server.
    pub(crate) fn since_arrival_ns(&self) -> i64 {
        self.arrival.as_ref().map_or(0, |arrival| arrival.since_ns())
    }

    /// Present time of the clock by which the map's age is measured, ns since the Unix epoch: this machine's wall
    /// clock, or the clock of a replay ([`crate::Subscription::replay_clock`]).
    pub fn now_ns(&self) -> i64 {
        self.arrival.as_ref().map_or_else(now_ns, |arrival| arrival.now_ns())
    }

    /// True if the map must not be used at `now_ns`: its validity has passed, or its capture is so far in the future of
    /// this clock that its age cannot be known.
    pub fn is_stale(&self, now_ns: i64) -> bool {
        self.staleness(now_ns).is_some()
    }

    /// Why the map must not be used at `now_ns`; `None` if it may be used.
    pub fn staleness(&self, now_ns: i64) -> Option<Staleness> {
        let ahead_ns = self.map.header.capture_end_ns.saturating_sub(now_ns);
        if ahead_ns > self.valid_ns() {
            return Some(Staleness::InTheFuture { ahead_ns });
        }
        let age_on_arrival_ns = self.arrival.as_ref().map_or(0, |arrival| arrival.age_on_arrival_ns());
        if age_on_arrival_ns > self.valid_ns() {
            return Some(Staleness::OnArrival { age_ns: age_on_arrival_ns });
        }
        (self.age_ns(now_ns) > self.valid_ns()).then_some(Staleness::NoNewer)
    }

    /// Time from now until the map is stale, in ns; `None` if it is stale.
    pub(crate) fn fresh_for_ns(&self) -> Option<i64> {
        let now_ns = self.now_ns();
        (!self.is_stale(now_ns)).then(|| self.valid_ns().saturating_sub(self.age_ns(now_ns)))
    }

    /// Metric of the first layer that has it, such as `drivable_share`.
    pub fn metric(&self, name: &str) -> Option<f64> {
        self.map.layers.iter().find_map(|layer| layer.metrics.get(name).copied())
    }
}
