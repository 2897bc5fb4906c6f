//! Slices of numbers -> an [`Observation`], the message that a vehicle sends.

use std::collections::BTreeMap;

use clearway_proto::packed::pack;
use clearway_proto::v1;

pub use clearway_proto::v1::{RoadFrame, RoadPurpose, Sensor};

/// One scan, ego pose, road, or group of packets, ready to be sent. Stamps are ns since the Unix epoch; frames follow
/// REP-103 (x forward, y left, z up); lengths are in metres. Lists are not checked here: the server refuses lists that
/// do not fit together, with a reason.
#[derive(Clone, Debug, PartialEq)]
pub struct Observation(pub(crate) v1::Observation);

impl From<Observation> for v1::Observation {
    /// The message, not yet numbered.
    fn from(observation: Observation) -> Self {
        observation.0
    }
}

impl Observation {
    fn new(sensor: &str, body: v1::observation::Body) -> Self {
        Self(v1::Observation { sensor: sensor.into(), body: Some(body), ..Default::default() })
    }

    /// Points of one scan in the sensor frame; `stamp_ns` is the end of the scan. Here and below, `sensor` may be empty
    /// if the vehicle has a single sensor.
    pub fn scan(sensor: &str, stamp_ns: i64, x: &[f32], y: &[f32], z: &[f32]) -> Self {
        let scan = v1::Scan { stamp_ns, x: pack(x), y: pack(y), z: pack(z), ..Default::default() };
        Self::new(sensor, v1::observation::Body::Scan(scan))
    }

    /// Sets the intensity of each point, 0 to 1. This and the next four functions change a scan only.
    pub fn intensity(self, intensity: &[f32]) -> Self {
        self.with_scan(|scan| scan.intensity = pack(intensity))
    }

    /// Sets the ring of each point: rank of its laser by elevation, 0 for the lowest.
    pub fn rings(self, rings: &[u16]) -> Self {
        self.with_scan(|scan| scan.ring = pack(rings))
    }

    /// Sets the time of each point in ns after the scan's stamp: 0 or less.
    pub fn offsets_ns(self, offsets_ns: &[i32]) -> Self {
        self.with_scan(|scan| scan.offset_ns = pack(offsets_ns))
    }

    /// Sets the time of each column in ns after the scan's stamp, and its number of points. The points are in the order
    /// of the columns.
    pub fn columns(mut self, offsets_ns: &[i32], points: &[u16]) -> Self {
        if let Some(v1::observation::Body::Scan(_)) = self.0.body {
            self.0.columns = Some(v1::Columns { offset_ns: pack(offsets_ns), points: pack(points) });
        }
        self
    }

    /// Sets the directions (unit vectors) of rays without a return.
    pub fn no_returns(self, directions: &[[f32; 3]]) -> Self {
        self.with_scan(|scan| scan.no_returns = pack(directions.as_flattened()))
    }

    fn with_scan(mut self, change: impl FnOnce(&mut v1::Scan)) -> Self {
        if let Some(v1::observation::Body::Scan(scan)) = &mut self.0.body {
            change(scan);
        }
        self
    }

    /// Pose `map_from_ego` as a position and a unit quaternion x y z w, and the forward speed.
    pub fn pose(stamp_ns: i64, [x, y, z]: [f64; 3], [qx, qy, qz, qw]: [f64; 4], speed_mps: f64) -> Self {
        let pose = v1::Pose { x, y, z, qx, qy, qz, qw };
        Self::new("", v1::observation::Body::EgoPose(v1::EgoPose { stamp_ns, map_from_ego: Some(pose), speed_mps }))
    }

    /// A road: x, y and full width at points of its centre line, in driving order.
    pub fn road(stamp_ns: i64, purpose: RoadPurpose, frame: RoadFrame, points: &[[f64; 3]]) -> Self {
        let of = |index: usize| points.iter().map(|point| point[index]).collect();
        let (purpose, frame) = (purpose.into(), frame.into());
        let (x, y, width) = (of(0), of(1), of(2));
        let road = v1::Road { stamp_ns, purpose, frame, x, y, width, ..v1::Road::default() };
        Self::new("", v1::observation::Body::Road(road))
    }

    /// Datagrams as a sensor sent them, each with its time of arrival.
    pub fn packets<P: AsRef<[u8]>>(sensor: &str, packets: &[(i64, P)]) -> Self {
        let stamps: Vec<i64> = packets.iter().map(|(stamp_ns, _)| *stamp_ns).collect();
        // No UDP payload is longer than 65,535 bytes. The server refuses a longer one, because its length does not fit.
        let length = |packet: &P| u16::try_from(packet.as_ref().len()).unwrap_or(u16::MAX);
        let lengths: Vec<u16> = packets.iter().map(|(_, packet)| length(packet)).collect();
        let payloads: Vec<&[u8]> = packets.iter().map(|(_, packet)| packet.as_ref()).collect();
        let packets =
            v1::Packets { captured_ns: pack(&stamps), lengths: pack(&lengths), payloads: payloads.concat().into() };
        Self::new(sensor, v1::observation::Body::Packets(packets))
    }

    /// Declares a sensor that the server's configuration does not name; it is known by its name from now on. A repeated
    /// equal declaration changes nothing.
    pub fn declare(sensor: Sensor) -> Self {
        Self::new("", v1::observation::Body::Declaration(sensor))
    }

    /// End of a sensor: its unfinished revolution becomes a partial one.
    pub fn end(sensor: &str) -> Self {
        Self::new(sensor, v1::observation::Body::End(v1::End {}))
    }

    /// Sets the time of capture; the default is the time of arrival at the server.
    pub fn captured_at(mut self, captured_ns: i64) -> Self {
        self.0.captured_ns = captured_ns;
        self
    }
}

/// An observation, or datagrams of one, that the server refused.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Refusal {
    /// Number of the observation, as returned by [`Ingester::send`](crate::Ingester::send).
    pub number: u64,
    /// Reason as a key of the server's ledger, such as `stamp`, `scan_lengths` or `queue`.
    pub reason: String,
    /// What is wrong, with its value, and what is allowed.
    pub message: String,
    /// Number of datagrams of the observation refused for this reason; else 1.
    pub count: u64,
}

/// Number of refusals by reason.
pub fn by_reason(refusals: &[Refusal]) -> BTreeMap<&str, u64> {
    let mut reasons = BTreeMap::new();
    refusals.iter().for_each(|refusal| *reasons.entry(refusal.reason.as_str()).or_default() += refusal.count);
    reasons
}
