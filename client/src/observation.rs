//! What a vehicle tells, as the wire carries it: slices of numbers -> an [`Observation`].

use std::collections::BTreeMap;

use clearway_proto::packed::pack;
use clearway_proto::v1;

pub use clearway_proto::v1::{RoadFrame, RoadPurpose, Sensor};

/// One scan, ego pose, road, or handful of packets, ready to be sent. Stamps are ns since the Unix epoch, frames
/// REP-103 (x forward, y left, z up), lengths metres. Lists are not checked here: the server refuses what does not fit
/// together, and says why.
#[derive(Clone, Debug, PartialEq)]
pub struct Observation(pub(crate) v1::Observation);

impl From<Observation> for v1::Observation {
    /// As the wire carries it, not numbered yet.
    fn from(observation: Observation) -> Self {
        observation.0
    }
}

impl Observation {
    fn of(sensor: &str, body: v1::observation::Body) -> Self {
        Self(v1::Observation { sensor: sensor.into(), body: Some(body), ..Default::default() })
    }

    /// Points of one turn or pass in the sensor's frame; `stamp_ns` is its end. `sensor` may be empty where the vehicle
    /// has only one, here and below.
    pub fn scan(sensor: &str, stamp_ns: i64, x: &[f32], y: &[f32], z: &[f32]) -> Self {
        let scan = v1::Scan { stamp_ns, x: pack(x), y: pack(y), z: pack(z), ..Default::default() };
        Self::of(sensor, v1::observation::Body::Scan(scan))
    }

    /// 0 to 1, one a point. This and the four that follow are a scan's; of anything else they change nothing.
    pub fn intensity(self, intensity: &[f32]) -> Self {
        self.with_scan(|scan| scan.intensity = pack(intensity))
    }

    /// Rank of each point's laser by elevation, 0 lowest.
    pub fn rings(self, rings: &[u16]) -> Self {
        self.with_scan(|scan| scan.ring = pack(rings))
    }

    /// When each point was seen, ns after the scan's stamp: at most 0.
    pub fn offsets_ns(self, offsets_ns: &[i32]) -> Self {
        self.with_scan(|scan| scan.offset_ns = pack(offsets_ns))
    }

    /// When each column was seen, ns after the scan's stamp, and how many points it has: the points lie column by
    /// column.
    pub fn columns(mut self, offsets_ns: &[i32], points: &[u16]) -> Self {
        if let Some(v1::observation::Body::Scan(_)) = self.0.body {
            self.0.columns = Some(v1::Columns { offset_ns: pack(offsets_ns), points: pack(points) });
        }
        self
    }

    /// Directions (unit vectors) of rays that came back with nothing.
    pub fn no_returns(self, directions: &[[f32; 3]]) -> Self {
        self.with_scan(|scan| scan.no_returns = pack(directions.as_flattened()))
    }

    fn with_scan(mut self, change: impl FnOnce(&mut v1::Scan)) -> Self {
        if let Some(v1::observation::Body::Scan(scan)) = &mut self.0.body {
            change(scan);
        }
        self
    }

    /// Where the vehicle was: `map_from_ego` as a position and a unit quaternion x y z w, and its forward speed.
    pub fn pose(stamp_ns: i64, [x, y, z]: [f64; 3], [qx, qy, qz, qw]: [f64; 4], speed_mps: f64) -> Self {
        let pose = v1::Pose { x, y, z, qx, qy, qz, qw };
        Self::of("", v1::observation::Body::EgoPose(v1::EgoPose { stamp_ns, map_from_ego: Some(pose), speed_mps }))
    }

    /// Where a road lies: x, y and whole width, in the order it is driven.
    pub fn road(stamp_ns: i64, purpose: RoadPurpose, frame: RoadFrame, points: &[[f64; 3]]) -> Self {
        let of = |index: usize| points.iter().map(|point| point[index]).collect();
        let (purpose, frame) = (purpose.into(), frame.into());
        let road = v1::Road { stamp_ns, purpose, frame, x: of(0), y: of(1), width: of(2), orientations: Vec::new() };
        Self::of("", v1::observation::Body::Road(road))
    }

    /// Datagrams as a sensor sent them, each with the stamp at which it was received.
    pub fn packets<P: AsRef<[u8]>>(sensor: &str, packets: &[(i64, P)]) -> Self {
        let stamps: Vec<i64> = packets.iter().map(|(stamp_ns, _)| *stamp_ns).collect();
        // No UDP payload is longer; one that claims to be is not what its length says, and the server refuses it.
        let length = |packet: &P| u16::try_from(packet.as_ref().len()).unwrap_or(u16::MAX);
        let lengths: Vec<u16> = packets.iter().map(|(_, packet)| length(packet)).collect();
        let payloads: Vec<&[u8]> = packets.iter().map(|(_, packet)| packet.as_ref()).collect();
        let packets =
            v1::Packets { captured_ns: pack(&stamps), lengths: pack(&lengths), payloads: payloads.concat().into() };
        Self::of(sensor, v1::observation::Body::Packets(packets))
    }

    /// A sensor that the server's configuration does not name; from here on it is known by its name. The same again
    /// changes nothing.
    pub fn declare(sensor: Sensor) -> Self {
        Self::of("", v1::observation::Body::Declaration(sensor))
    }

    /// The sensor has ended: an unfinished turn becomes a partial one.
    pub fn end(sensor: &str) -> Self {
        Self::of(sensor, v1::observation::Body::End(v1::End {}))
    }

    /// When it was captured; without this it counts as captured when the server gets it.
    pub fn captured_at(mut self, captured_ns: i64) -> Self {
        self.0.captured_ns = captured_ns;
        self
    }
}

/// Something the server did not take.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Refusal {
    /// Of the observation, as [`Ingester::send`](crate::Ingester::send) gave it.
    pub number: u64,
    /// Short, as the server's ledger has it: `stamp`, `scan_lengths`, `queue`, ….
    pub reason: String,
    /// What was wrong, with its value, and what is allowed.
    pub message: String,
    /// Datagrams of the observation refused for this reason; else 1.
    pub count: u64,
}

/// How many were refused, by reason.
pub fn by_reason(refusals: &[Refusal]) -> BTreeMap<&str, u64> {
    let mut reasons = BTreeMap::new();
    refusals.iter().for_each(|refusal| *reasons.entry(refusal.reason.as_str()).or_default() += refusal.count);
    reasons
}
